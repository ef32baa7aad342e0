"""The arguments of what guards a scene's numbers: ``baseline`` and ``check``."""

from msmpetsc.cli.options.values import Commands, add_json, add_set, file_argument


def add_baseline(commands: Commands) -> None:
    """Add ``msmpetsc baseline``."""
    parser = commands.add_parser(
        "baseline",
        help="store the numbers of a scene",
        description="Run the first steps of a scene, each solved to 1e-9, and store counts, energies, momentum and "
        "places, with what later ones may be off.",
    )
    parser.add_argument("scene", type=file_argument, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("-o", "--output", type=file_argument, metavar="FILE.json", help="default: SCENE.baseline.json")
    parser.add_argument("--cells", type=int, metavar="N", help="cages.count; the scene's cells if not given")
    parser.add_argument("--frames", type=int, default=20, metavar="N", help="steps, the scene's at the most (20)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the run (1)")
    parser.add_argument("--overwrite", action="store_true", help="replace the numbers stored")
    add_set(parser)


def add_check(commands: Commands) -> None:
    """Add ``msmpetsc check``."""
    parser = commands.add_parser(
        "check",
        help="say whether a scene's numbers are still those stored",
        description="Run scenes as their numbers were stored by baseline, and compare. "
        "Exit status 0: all are as stored; 1: something differs.",
    )
    parser.add_argument("scenes", type=file_argument, nargs="+", metavar="SCENE", help="scene files (TOML)")
    parser.add_argument("--baseline", type=file_argument, metavar="FILE.json", help="default: SCENE.baseline.json")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the runs (1)")
    parser.add_argument("--junit", type=file_argument, metavar="OUT.xml", help="write what was checked as JUnit XML")
    add_json(parser)

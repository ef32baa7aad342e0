"""The arguments of ``check``, which guards a scene's numbers."""

from msmpetsc.cli.options.values import Commands, add_json, add_set, file_argument


def add_check(commands: Commands) -> None:
    """Add ``msmpetsc check``."""
    parser = commands.add_parser(
        "check",
        help="store a scene's numbers; say whether they still hold",
        description="Run the first steps of scenes, each solved to 1e-9, and hold counts, energies, momentum and "
        "places against those that --update stored. Exit status 0: all are as stored; 1: something differs.",
    )
    parser.add_argument("scenes", type=file_argument, nargs="+", metavar="SCENE", help="scene files (TOML)")
    parser.add_argument("--baseline", type=file_argument, metavar="FILE.json", help="default: SCENE.baseline.json")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the runs (1)")
    parser.add_argument("--update", action="store_true", help="store the numbers, in place of those stored before")
    parser.add_argument("--cells", type=int, metavar="N", help="of --update: cages.count; the scene's if not given")
    parser.add_argument("--frames", type=int, metavar="N", help="of --update: steps, the scene's at the most (20)")
    add_set(parser)
    parser.add_argument("--junit", type=file_argument, metavar="OUT.xml", help="write what was checked as JUnit XML")
    add_json(parser)

"""The arguments of what tries a scene before it is run: ``inspect``, ``plan`` and ``study``."""

from msmpetsc.cli.options.values import Commands, add_json, add_set, file_argument, path_argument


def add_inspect(commands: Commands) -> None:
    """Add ``msmpetsc inspect``."""
    parser = commands.add_parser(
        "inspect",
        help="say what a scene would need on so many ranks",
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect its memory.",
    )
    parser.add_argument("scene", type=path_argument, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks (1)")
    add_set(parser)
    add_json(parser)


def add_plan(commands: Commands) -> None:
    """Add ``msmpetsc plan``."""
    parser = commands.add_parser(
        "plan",
        help="find the cheapest options that meet an error of the surface",
        description="Try lattices, integrators, time steps and errors of a step on the first frames of a scene, and "
        "say which is the cheapest that meets the error. Exit status 3: none does.",
    )
    parser.add_argument("scene", type=path_argument, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument(
        "--surface-error", type=float, metavar="E", required=True,
        help="error of the surface, of its largest displacement: cells, step and solver together",
    )  # fmt: skip
    parser.add_argument("--frames", type=int, default=20, metavar="N", help="of the scene's steps, the first N (20)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the trials")
    parser.add_argument("--write", action="store_true", help="put the answer into the scene file")
    parser.add_argument("--cells", type=int, metavar="N", help="of the finest trial; the scene's count")
    parser.add_argument("--chart", type=file_argument, metavar="OUT.png", help="draw error over cost of all trials")
    add_json(parser)


def add_study(commands: Commands) -> None:
    """Add ``msmpetsc study``."""
    parser = commands.add_parser(
        "study",
        help="sweep methods over scenes",
        description="Run the cases of a study, each in its own process, into a table and a report. "
        "Stopped, the same command goes on.",
    )
    parser.add_argument("study", type=path_argument, metavar="FILE.toml", help="study file")
    parser.add_argument("-o", "--output", type=path_argument, metavar="FOLDER", help="default: out/FILE")
    parser.add_argument("--full", action="store_true", help="also what is marked full = true: the long cases")
    parser.add_argument("--jobs", type=int, metavar="N", help="cases at a time (they slow each other)")
    parser.add_argument("--restart", action="store_true", help="forget the cases that are done")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--part", metavar="I/N", help="only the I-th of N parts, for another machine or array task")
    only.add_argument("--list", action="store_true", help="only say which cases there are, and which are done")

"""The arguments of what is done with results: ``compare``, ``render`` and ``export``."""

from msmpetsc.cli.options.values import Commands, add_json, file_argument


def add_compare(commands: Commands) -> None:
    """Add ``msmpetsc compare``."""
    parser = commands.add_parser(
        "compare",
        help="say whether two results agree",
        description="Compare two results at the times that both have; of different lattices their surfaces alone. "
        "Exit status 0: they agree; 1: they differ; 2: they cannot be compared.",
    )
    parser.add_argument("first", metavar="A.h5", type=file_argument)
    parser.add_argument("second", metavar="B.h5", type=file_argument)
    parser.add_argument("--rtol", type=float, default=1e-6, metavar="E", help="relative error that still agrees (1e-6)")
    parser.add_argument(
        "--fields", metavar="NAME,...", help="of /frames; position, surface, the energies and momentum if not given"
    )
    parser.add_argument(
        "--shared", action="store_true", help="times that only one of them has do not count as different"
    )
    add_json(parser)


def add_render(commands: Commands) -> None:
    """Add ``msmpetsc render``."""
    parser = commands.add_parser("render", help="draw some moments of a result side by side")
    parser.add_argument("result", metavar="OUT.h5", type=file_argument)
    parser.add_argument(
        "-o", "--output", metavar="PNG", type=file_argument, help="default: beside the result, ending in .png"
    )
    parser.add_argument("--frames", metavar="0,10,20", help="these frames, in this order")
    parser.add_argument(
        "--count", metavar="N", type=int, help="choose this many moments (default: the scene's picture.times, or 5)"
    )
    parser.add_argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)")


def add_export(commands: Commands) -> None:
    """Add ``msmpetsc export``."""
    parser = commands.add_parser(
        "export",
        help="write frames of a result in another format",
        description="Write frames of a result for another program; the name's ending says in which format: .vtkhdf and "
        ".glb hold frames in time, .obj, .ply, .stl and .vtu one frame.",
    )
    parser.add_argument("result", metavar="OUT.h5", type=file_argument)
    parser.add_argument("-o", "--output", metavar="FILE", type=file_argument, required=True, help="what to write")
    parser.add_argument("--mesh", choices=("surface", "lattice"), help="default: the first that the format can hold")
    parser.add_argument("--frames", metavar="0,10,20", help="these frames; default: all, or the last (-1) of one")
    parser.add_argument("--every", metavar="N", type=int, default=1, help="every N-th of them (1)")

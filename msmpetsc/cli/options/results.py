"""The arguments of what is done with results: ``compare``, ``render`` and ``export``."""

import argparse

from msmpetsc.cli.options.values import Commands, add_json, add_set, file_argument
from msmpetsc.output.frame_choice import frames_in


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
    parser = commands.add_parser(
        "render",
        help="draw a result as a picture, a film or a page; or a scene or a mesh before anything is run",
        description="Draw some moments of a result side by side (*.png), a film (*.mp4, *.gif, *.webp), or a page for "
        "a browser in which the body turns and its frames play (*.html). A scene or a mesh is drawn as it lies.",
    )
    parser.add_argument("subject", metavar="OUT.h5|SCENE.toml|MESH", type=file_argument, help="what is drawn")
    parser.add_argument(
        "-o", "--output", metavar="FILE", type=file_argument,
        help="*.png, *.mp4, *.gif, *.webp or *.html; default: beside what is drawn, ending in .png",
    )  # fmt: skip
    add_frames(parser, "these frames; slices like 0:250:5 as Python counts")
    parser.add_argument(
        "--count", metavar="N", type=int, help="choose this many moments (default: the scene's picture.times, or 5)"
    )
    parser.add_argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)")
    add_look(parser)
    add_film(parser)
    add_set(parser)


def add_frames(parser: argparse.ArgumentParser, about: str) -> None:
    """Add ``--frames``, which chooses among those of a result."""
    parser.add_argument("--frames", metavar="0,10,20", type=frames_in, help=about)


def add_look(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``render`` that say how things look."""
    parser.add_argument("--size", metavar="WxH", help="of a film, or of a panel at most [px] (960x720; 460x1000)")
    parser.add_argument(
        "--colour",
        metavar="FIELD",
        help="colour by displacement, speed, strain, contact, part or error, with a legend",
    )
    parser.add_argument(
        "--reference",
        metavar="OUT.h5",
        type=file_argument,
        help="of --colour error: the result that it is counted from",
    )
    parser.add_argument("--axes", action="store_true", help="draw a box around the body, with lengths")
    parser.add_argument("--scale-bar", action="store_true", help="put a length into the legend")
    parser.add_argument(
        "--show", metavar="cells,springs", help="cut the body open: boundary cells red, interior ones blue"
    )


def add_film(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``render`` for films."""
    parser.add_argument("--fps", type=float, metavar="N", help="pictures a second; alone: every frame is one picture")
    parser.add_argument("--speed", type=float, metavar="S", help="simulated seconds a second (1, which is real time)")
    parser.add_argument(
        "--turntable", action="store_true", help="go around the body once; of the last frame unless --frames is given"
    )


def add_export(commands: Commands) -> None:
    """Add ``msmpetsc export``."""
    parser = commands.add_parser(
        "export",
        help="write frames of a result in another format",
        description="Write frames of a result for another program; the name's ending says in which format: .glb "
        "and .usd hold frames in time, .obj, .ply, .stl and .vtu one frame.",
    )
    parser.add_argument("result", metavar="OUT.h5", type=file_argument)
    parser.add_argument("-o", "--output", metavar="FILE", type=file_argument, required=True, help="what to write")
    parser.add_argument("--mesh", choices=("surface", "lattice"), help="default: the first that the format can hold")
    add_frames(parser, "these frames, or slices like 0:250:5; default: all, or the last (-1) of one")
    parser.add_argument("--every", metavar="N", type=int, default=1, help="every N-th of them (1)")

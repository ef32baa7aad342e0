"""The arguments of ``run``."""

import argparse
import sys
from typing import Any

from msmpetsc.cli.options.values import Commands, add_set, file_argument, path_argument


def add_run(commands: Commands) -> None:
    """Add ``msmpetsc run``."""
    parser = commands.add_parser(
        "run",
        help="simulate a scene",
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=path_argument, nargs="?", metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("-o", "--output", type=file_argument, metavar="OUT.h5", help="default: out/SCENE.h5")
    add_method(parser)
    add_output(parser)
    add_measuring(parser)


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` that choose what is computed, and how."""
    parser.add_argument("--preset", metavar="NAME", help="solver preset (see --list-presets)")
    parser.add_argument("--error", metavar="E", help="relative error at which a step is done")
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="where to compute: cuda is -mat_type aijcusparse, a CUDA GPU"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="stop after N steps")
    add_set(parser)


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` on its files."""
    parser.add_argument("--picture", action="store_true", help="also draw a few moments: OUT.png")
    parser.add_argument(
        "--watch", type=file_argument, metavar="PAGE.html", help="keep a page that shows the newest frame in a browser"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.h5 if it exists")
    parser.add_argument(
        "--resume", type=file_argument, metavar="OUT.h5",
        help="go on where the run that wrote this file was stopped; with SCENE, start it if there is no such file yet",
    )  # fmt: skip
    parser.add_argument("--force", action="store_true", help="resume with another scene or other options than before")
    parser.add_argument(
        "--checkpoint-every", metavar="N", help="frames, or 30s, 5min, 2h; default: as takes 1%% of the time at most"
    )
    parser.add_argument("--compress", action="store_true", help="pack the finished OUT.h5: smaller, slower to read")


def add_measuring(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` that measure, or only say something."""
    parser.add_argument(
        "--true-error", type=int, metavar="N", help="also solve every N-th step to rounding, and store its true error"
    )
    parser.add_argument("--trace", type=int, metavar="K", help="follow the iterates of step K (needs --measure)")
    parser.add_argument(
        "--measure", type=file_argument, metavar="OUT.json", help="write what the run cost: times, memory"
    )
    parser.add_argument(
        "--show-options", action="store_true", help="say which PETSc options a preset sets, as an options file"
    )
    parser.add_argument("--list-presets", action=ListPresets, help="say what each preset is for")


class ListPresets(argparse.Action):
    """Print the presets and leave."""

    def __init__(self, option_strings: list[str], dest: str, help: str):
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from msmpetsc.solve.presets import find_preset, preset_names

        names = preset_names()
        width = max(map(len, names))
        lines = [f"{name:{width}} {find_preset(name).about}\n" for name in names]
        parser._print_message("".join(lines), sys.stdout)
        parser.exit()

"""The arguments of each command, and the examples that its help ends with."""

import argparse
import sys
from dataclasses import fields
from typing import Any

from msmpetsc.app.checks import checked_file, checked_path
from msmpetsc.app.request import OPTIONS, Option, RunRequest, flag_of
from msmpetsc.results.frame_choice import frames_in

Commands = argparse._SubParsersAction  # argparse has no public name for what add_subparsers returns
SHELLS = ("bash", "zsh", "fish")
EXAMPLES_HEAD = "examples:"
EXAMPLES: dict[str, tuple[str, ...]] = {
    "new": (
        "msmpetsc new my.toml --mesh my.ply",
        "msmpetsc new --list",
        "msmpetsc new my.toml --from bunny_fall",
    ),
    "run": (
        "msmpetsc run my.toml --picture",
        "msmpetsc run my.toml -o out/coarse.h5 --set cages.count=1000 --overwrite",
        "msmpetsc run my.toml --error 1e-4 --measure out/cost.json -ksp_type pipecg -log_view",
        "msmpetsc run --resume out/my.h5",
    ),
    "inspect": ("msmpetsc inspect my.toml --ranks 64", "msmpetsc inspect my.toml --json"),
    "study": ("msmpetsc study my_study.toml --list", "msmpetsc study my_study.toml -o out/my_study --jobs 2"),
    "plan": (
        "msmpetsc plan my.toml --surface-error 0.1 --write",
        "msmpetsc plan my.toml --surface-error 0.03 --frames 10 --chart out/plan.png",
    ),
    "compare": ("msmpetsc compare out/a.h5 out/b.h5 --rtol 1e-3", "msmpetsc compare out/a.h5 out/b.h5 --json"),
    "render": (
        "msmpetsc render out/my.h5 --frames 0,10,20 --eye=-1,2,0.5",
        "msmpetsc render out/my.h5 -o out/my.mp4 --speed 0.1",
        "msmpetsc render out/my.h5 -o out/my.html --colour strain",
        "msmpetsc render out/my.h5 -o out/turn.gif --turntable --size 480x360",
        "msmpetsc render my.toml --show cells",
    ),
    "export": (
        "msmpetsc export out/my.h5 -o out/my.glb --frames 0::2",
        "msmpetsc export out/my.h5 -o out/last.obj --frames -1",
    ),
    "check": (
        "msmpetsc check my.toml --update --cells 400 --frames 10",
        "msmpetsc check my.toml other.toml --ranks 2 --junit out/check.xml",
    ),
    "fetch": ("msmpetsc fetch --list", "msmpetsc fetch bunny armadillo"),
    "keys": ("msmpetsc keys", "msmpetsc keys material", "msmpetsc keys pin.region"),
    "schema": ("msmpetsc schema > msmpetsc.schema.json",),
    "doctor": ("msmpetsc doctor",),
    "completion": (
        "msmpetsc completion bash > ~/.local/share/bash-completion/completions/msmpetsc",
        "msmpetsc completion fish > ~/.config/fish/completions/msmpetsc.fish",
    ),
}


class ExamplesKept(argparse.HelpFormatter):
    """Formats help, and leaves the lines of examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:  # where argparse wraps description and epilog
        return text if text.startswith(EXAMPLES_HEAD) else super()._fill_text(text, width, indent)


# What several commands share


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add ``--set``, which changes a scene."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``, for programs that read what a command prints."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add ``--quiet`` and ``--verbose``, which every command has."""
    said = parser.add_mutually_exclusive_group()
    said.add_argument("--quiet", action="store_true", help="no notes and no progress; warnings and errors stay")
    said.add_argument("--verbose", action="store_true", help="notes with the time [s]; of an error where it arose, too")


# Running, and what is known before


def add_run(commands: Commands) -> None:
    """Add ``msmpetsc run``, whose options are the fields of a request."""
    parser = commands.add_parser(
        "run",
        help="simulate a scene",
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    )
    for field in fields(RunRequest):
        if not OPTIONS[field.name].python:
            add_option(parser, field.name, OPTIONS[field.name], field.default)
    parser.add_argument(
        "--show-options", action="store_true", help="say which PETSc options a preset sets, as an options file"
    )
    parser.add_argument("--list-presets", action=ListPresets, help="say what each preset is for")


def add_option(parser: argparse.ArgumentParser, name: str, option: Option, default: Any) -> None:
    """Add the option of a field of the request."""
    about = option.help.replace("%", "%%")
    if name == "scene":
        parser.add_argument(name, type=option.kind, nargs="?", metavar=option.value, help=about)
    elif default is False:
        parser.add_argument(flag_of(name), action="store_true", help=about)
    elif default == ():
        parser.add_argument(flag_of(name), action="append", default=[], metavar=option.value, help=about)
    else:
        parser.add_argument(
            *filter(None, [option.short, flag_of(name)]), type=option.kind, choices=option.choices,
            metavar=option.value or None, help=about,
        )  # fmt: skip


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


def add_inspect(commands: Commands) -> None:
    """Add ``msmpetsc inspect``."""
    parser = commands.add_parser(
        "inspect",
        help="say what a scene would need on so many ranks",
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect its memory.",
    )
    parser.add_argument("scene", type=checked_path, metavar="SCENE", help="scene file (TOML)")
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
    parser.add_argument("scene", type=checked_path, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument(
        "--surface-error", type=float, metavar="E", required=True,
        help="error of the surface, of its largest displacement: cells, step and solver together",
    )  # fmt: skip
    parser.add_argument("--frames", type=int, default=20, metavar="N", help="of the scene's steps, the first N (20)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the trials")
    parser.add_argument("--write", action="store_true", help="put the answer into the scene file")
    parser.add_argument("--cells", type=int, metavar="N", help="of the finest trial; the scene's count")
    parser.add_argument("--chart", type=checked_file, metavar="OUT.png", help="draw error over cost of all trials")
    add_json(parser)


def add_study(commands: Commands) -> None:
    """Add ``msmpetsc study``."""
    parser = commands.add_parser(
        "study",
        help="sweep methods over scenes",
        description="Run the cases of a study, each in its own process, into a table and a report. "
        "Stopped, the same command goes on.",
    )
    parser.add_argument("study", type=checked_path, metavar="FILE.toml", help="study file")
    parser.add_argument("-o", "--output", type=checked_path, metavar="FOLDER", help="default: out/FILE")
    parser.add_argument("--full", action="store_true", help="also what is marked full = true: the long cases")
    parser.add_argument("--jobs", type=int, metavar="N", help="cases at a time (they slow each other)")
    parser.add_argument("--restart", action="store_true", help="forget the cases that are done")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--part", metavar="I/N", help="only the I-th of N parts, for another machine or array task")
    only.add_argument("--list", action="store_true", help="only say which cases there are, and which are done")


def add_check(commands: Commands) -> None:
    """Add ``msmpetsc check``."""
    parser = commands.add_parser(
        "check",
        help="store a scene's numbers; say whether they still hold",
        description="Run the first steps of scenes, each solved to 1e-9, and hold counts, energies, momentum and "
        "places against those that --update stored. Exit status 0: all are as stored; 1: something differs.",
    )
    parser.add_argument("scenes", type=checked_file, nargs="+", metavar="SCENE", help="scene files (TOML)")
    parser.add_argument("--baseline", type=checked_file, metavar="FILE.json", help="default: SCENE.baseline.json")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the runs (1)")
    parser.add_argument("--update", action="store_true", help="store the numbers, in place of those stored before")
    parser.add_argument("--cells", type=int, metavar="N", help="of --update: cages.count; the scene's if not given")
    parser.add_argument("--frames", type=int, metavar="N", help="of --update: steps, the scene's at the most (20)")
    add_set(parser)
    parser.add_argument("--junit", type=checked_file, metavar="OUT.xml", help="write what was checked as JUnit XML")
    add_json(parser)


# Results


def add_compare(commands: Commands) -> None:
    """Add ``msmpetsc compare``."""
    parser = commands.add_parser(
        "compare",
        help="say whether two results agree",
        description="Compare two results at the times that both have; of different lattices their surfaces alone. "
        "Exit status 0: they agree; 1: they differ; 2: they cannot be compared.",
    )
    parser.add_argument("first", metavar="A.h5", type=checked_file)
    parser.add_argument("second", metavar="B.h5", type=checked_file)
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
    parser.add_argument("subject", metavar="OUT.h5|SCENE.toml|MESH", type=checked_file, help="what is drawn")
    parser.add_argument(
        "-o", "--output", metavar="FILE", type=checked_file,
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
        type=checked_file,
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
    parser.add_argument("result", metavar="OUT.h5", type=checked_file)
    parser.add_argument("-o", "--output", metavar="FILE", type=checked_file, required=True, help="what to write")
    parser.add_argument("--mesh", choices=("surface", "lattice"), help="default: the first that the format can hold")
    add_frames(parser, "these frames, or slices like 0:250:5; default: all, or the last (-1) of one")


# Scenes and meshes


def add_new(commands: Commands) -> None:
    """Add ``msmpetsc new``."""
    parser = commands.add_parser(
        "new",
        help="write a first scene for a mesh",
        description="Measure a mesh and write a commented scene that runs at once, or copy one that comes with "
        "msmpetsc; beside it the schema by which editors complete its keys.",
    )
    parser.add_argument("scene", nargs="?", type=checked_file, metavar="SCENE.toml", help="what is written")
    parser.add_argument(
        "--mesh",
        type=checked_file,
        metavar="MESH",
        help="a mesh file in or below the scene's folder, or a model",
    )
    parser.add_argument("--from", dest="from_scene", metavar="NAME", help="copy this scene, see --list")
    parser.add_argument("--list", action="store_true", help="list the scenes that come with msmpetsc")
    parser.add_argument("--overwrite", action="store_true", help="replace SCENE.toml if it exists")


def add_keys(commands: Commands) -> None:
    """Add ``msmpetsc keys``."""
    parser = commands.add_parser(
        "keys",
        help="list the keys of a scene",
        description="List the keys of a scene, or of one of its tables: unit, default, range, meaning.",
    )
    parser.add_argument("table", nargs="?", metavar="TABLE", help="a table or a key: material, pin.region, time.step")


def add_schema(commands: Commands) -> None:
    """Add ``msmpetsc schema``."""
    commands.add_parser("schema", help="print the JSON schema of a scene, for editors")


def add_fetch(commands: Commands) -> None:
    """Add ``msmpetsc fetch``."""
    parser = commands.add_parser("fetch", help="download named meshes, or list them")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a model, see --list")
    parser.add_argument("--list", action="store_true", help="list the models and where they lie")


# The program itself


def add_doctor(commands: Commands) -> None:
    """Add ``msmpetsc doctor``."""
    commands.add_parser(
        "doctor",
        help="say what is installed, and how to get what is not",
        description="Examine PETSc, MPI, the device, HDF5, the kernels' cache, packages and meshes. "
        "Exit status 1: a run lacks something that it needs.",
    )


def add_completion(commands: Commands) -> None:
    """Add ``msmpetsc completion``."""
    parser = commands.add_parser(
        "completion",
        help="print the completion of a shell",
        description="Print the script by which a shell completes commands, options and files.",
    )
    parser.add_argument("shell", choices=SHELLS)

"""The table of commands: help, arguments and examples, from which the parser is made."""

import argparse
import sys
from dataclasses import dataclass, fields
from typing import Any

from msmpetsc.app.checks import checked_file, checked_path
from msmpetsc.app.request import OPTIONS, RunRequest, flag_of
from msmpetsc.results.frame_choice import frames_in

Argument = tuple[
    tuple[str, ...], dict[str, Any]
]  # names and keywords, as argparse's ``add_argument`` takes them


@dataclass(frozen=True)
class Command:
    """A command.

    exclusive   : arguments of which only one may be given
    starts_runs : whether it starts runs of its own
    module      : in ``commands``, that carries it out; that of its name if empty
    """

    help: str
    examples: tuple[str, ...]
    arguments: tuple[Argument, ...] = ()
    exclusive: tuple[Argument, ...] = ()
    description: str | None = None
    starts_runs: bool = False
    module: str = ""


class Shown(argparse.Action):
    """Prints what its ``const``, a function, returns, and exits."""

    def __init__(self, option_strings: list[str], const: Any, help: str, **_: Any):
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, const=const, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        parser._print_message(f"{self.const()}\n", sys.stdout)
        parser.exit()


def listed_presets() -> str:
    """Return one line for each preset, which says when to use it."""
    from msmpetsc.solve.presets import find_preset, preset_names

    names = preset_names()
    width = max(map(len, names))
    return "\n".join(f"{name:{width}} {find_preset(name).about}" for name in names)


def argument(*names: str, **keywords: Any) -> Argument:
    """Return an argument of these names."""
    return names, keywords


def switch(name: str, about: str) -> Argument:
    """Return an option that has no value."""
    return argument(name, action="store_true", help=about)


def arguments_of_run() -> tuple[Argument, ...]:
    """Return the fields of a run request as arguments, without those that only Python takes."""
    taken = []
    for field in fields(RunRequest):
        name, option = field.name, OPTIONS[field.name]
        about = option.help.replace("%", "%%")
        valued: dict[str, Any] = {
            "type": option.kind,
            "metavar": option.value or None,
            "help": about,
        }
        if option.python:
            continue
        if name == "scene":
            taken.append(argument(name, nargs="?", **valued))
        elif field.default is False:
            taken.append(switch(flag_of(name), about))
        elif field.default == ():
            taken.append(
                argument(
                    flag_of(name), action="append", default=[], metavar=option.value, help=about
                )
            )
        else:
            taken.append(
                argument(
                    *filter(None, [option.short, flag_of(name)]), choices=option.choices, **valued
                )
            )
    return tuple(taken)


def at_least_1(word: str) -> int:
    """Return a word as an integer of at least 1, as argparse's ``type``."""
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {word}")
    return int(word)


def whole(name: str, value: str, about: str, **keywords: Any) -> Argument:
    """Return an option whose value is an integer of at least 1."""
    return argument(name, type=at_least_1, metavar=value, help=about, **keywords)


SCENE = argument("scene", type=checked_path, metavar="SCENE", help="scene file (TOML)")
SET = argument(
    "--set",
    action="append",
    default=[],
    metavar="KEY=VALUE",
    help="override a scene key: cages.count=3000",
)
JSON = switch("--json", "print one JSON object and nothing else")
SAID = (  # of every command
    switch("--quiet", "no notes and no progress; warnings and errors stay"),
    switch("--verbose", "notes with the time [ms]; of an error where it arose, too"),
)


def frames(about: str) -> Argument:
    """Return ``--frames``, which selects frames of a result."""
    return argument("--frames", metavar="0,10,20", type=frames_in, help=about)


def ranks(about: str) -> Argument:
    """Return ``--ranks``, of commands that start runs."""
    return whole("--ranks", "R", about, default=1)


RENDER = (
    argument("subject", metavar="OUT.h5|SCENE.toml", type=checked_file, help="what is drawn"),
    argument(
        "-o", "--output", metavar="FILE", type=checked_file,
        help="*.png, *.mp4, *.gif, *.webp or *.html; default: beside what is drawn, ending in .png",
    ),
    frames("these frames; slices like 0:250:5 as Python counts"),
    whole("--count", "N", "choose this many moments (default: the scene's picture.times, or 5)"),
    argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)"),
    argument("--size", metavar="WxH", help="of a film, or of a panel at most [px] (960x720; 460x1000)"),
    argument(
        "--colour", metavar="FIELD",
        help="colour by displacement, speed, strain, stress or part, with a legend",
    ),
    switch("--cells", "cut the body open: boundary cells red, interior ones blue"),
    argument("--speed", type=float, metavar="S", help="simulated seconds a second (1, which is real time)"),
    SET,
)  # fmt: skip
COMMANDS = {
    "new": Command(
        "write a first scene for a mesh",
        (
            "msmpetsc new my.toml --mesh my.ply",
            "msmpetsc new --list",
            "msmpetsc new my.toml --from bunny_fall",
        ),
        (
            argument("scene", nargs="?", type=checked_file, metavar="SCENE.toml", help="what is written"),
            argument(
                "--mesh", type=checked_file, metavar="MESH",
                help="a mesh file in or below the scene's folder, or a model",
            ),
            argument("--up", choices=("y", "z"), help="the mesh's upward axis; guessed if not given"),
            argument("--from", dest="from_scene", metavar="NAME", help="copy this scene, see --list"),
            switch("--list", "list the scenes that come with msmpetsc"),
            switch("--overwrite", "replace SCENE.toml if it exists"),
        ),
        description="Measure a mesh and write a commented scene that runs at once, or copy one that comes with "
        "msmpetsc; beside it the schema by which editors complete its keys.",
    ),
    "run": Command(
        "simulate a scene",
        (
            "msmpetsc run my.toml --picture",
            "msmpetsc run my.toml -o out/coarse.h5 --set cages.count=1000 --overwrite",
            "msmpetsc run my.toml --error 1e-4 --measure out/cost.json -ksp_type pipecg -log_view",
            "msmpetsc run --resume out/my.h5",
        ),
        (
            *arguments_of_run(),
            switch("--show-options", "say which PETSc options a preset sets, as an options file"),
            argument("--list-presets", action=Shown, const=listed_presets, help="say what each preset is for"),
        ),
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    ),
    "inspect": Command(
        "say what a scene would need on so many ranks",
        ("msmpetsc inspect my.toml --ranks 64", "msmpetsc inspect my.toml --json"),
        (SCENE, ranks("MPI ranks (1)"), SET, JSON),
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect its memory.",
    ),
    "study": Command(
        "sweep methods over scenes",
        ("msmpetsc study my_study.toml --list", "msmpetsc study my_study.toml -o out/my_study --jobs 2"),
        (
            argument("study", type=checked_path, metavar="FILE.toml", help="study file"),
            argument("-o", "--output", type=checked_path, metavar="FOLDER", help="default: out/FILE"),
            switch("--full", "also what is marked full = true: the long cases"),
            whole("--jobs", "N", "cases at a time (they slow each other)"),
            switch("--restart", "forget the cases that are done"),
        ),
        (
            argument("--part", metavar="I/N", help="only the I-th of N parts, for another machine or array task"),
            switch("--list", "only say which cases there are, and which are done"),
        ),
        "Run the cases of a study, each in its own process, into a table and a report. "
        "Stopped, the same command goes on.",
        starts_runs=True,
    ),
    "plan": Command(
        "find the cheapest options that meet an error of the surface",
        (
            "msmpetsc plan my.toml --surface-error 0.1 --write",
            "msmpetsc plan my.toml --surface-error 0.03 --frames 10",
        ),
        (
            SCENE,
            argument(
                "--surface-error", type=float, metavar="E", default=0.1,
                help="error of the surface, of its largest displacement: cells, step and solver together (0.1)",
            ),
            whole("--frames", "N", "of the scene's steps, the first N (20)", default=20),
            ranks("MPI ranks of the trials"),
            switch("--write", "put the answer into the scene file"),
            whole("--cells", "N", "of the finest trial; the scene's count"),
            JSON,
        ),
        description="Try lattices, integrators, time steps and errors of a step on the first frames of a scene, and "
        "say which is the cheapest that meets the error. Exit status 3: none does.",
        starts_runs=True,
    ),
    "compare": Command(
        "say whether two results agree",
        ("msmpetsc compare out/a.h5 out/b.h5 --rtol 1e-3", "msmpetsc compare out/a.h5 out/b.h5 --json"),
        (
            argument("first", metavar="A.h5", type=checked_file),
            argument("second", metavar="B.h5", type=checked_file),
            argument("--rtol", type=float, default=1e-6, metavar="E", help="relative error that still agrees (1e-6)"),
            JSON,
        ),
        description="Compare two results at the times that both have; of different lattices their surfaces alone. "
        "Exit status 0: they agree; 1: they differ; 2: they cannot be compared.",
    ),
    "render": Command(
        "draw a result as a picture, a film or a page; or a scene before anything is run",
        (
            "msmpetsc render out/my.h5 --frames 0,10,20 --eye=-1,2,0.5",
            "msmpetsc render out/my.h5 -o out/my.mp4 --speed 0.1",
            "msmpetsc render out/my.h5 -o out/my.html --colour strain",
            "msmpetsc render my.toml --cells",
        ),
        RENDER,
        description="Draw some moments of a result side by side (*.png), a film (*.mp4, *.gif, *.webp), or a page for "
        "a browser in which the body turns and its frames play (*.html). A scene is drawn as it lies.",
    ),
    "export": Command(
        "write frames of a result in another format",
        (
            "msmpetsc export out/my.h5 -o out/my.glb --frames 0::2",
            "msmpetsc export out/my.h5 -o out/last.obj --frames -1",
        ),
        (
            argument("result", metavar="OUT.h5", type=checked_file),
            argument("-o", "--output", metavar="FILE", type=checked_file, required=True, help="what to write"),
            frames("these frames, or slices like 0:250:5; default: all, or the last (-1) of one"),
        ),
        description="Write frames of a result for another program; the name's ending says in which format: .glb "
        "and .usd hold frames in time, .obj, .ply and .stl one frame.",
    ),
    "series": Command(
        "print energies, forces and places of probes of a result, a row a frame",
        ("msmpetsc series out/my.h5 -o out/my.csv", "msmpetsc series out/my.h5 > out/my.csv"),
        (
            argument("result", metavar="OUT.h5", type=checked_file),
            argument("-o", "--output", metavar="FILE.csv", type=checked_file, help="default: print them"),
            switch("--overwrite", "replace FILE.csv"),
        ),
        description="Write as CSV, for each frame, energies, momentum, loads, the reaction of each pin and anchor, the "
        "push of each obstacle and of contacts on each body, and where the scene's probes are.",
    ),
    "check": Command(
        "store a scene's numbers; say whether they still hold",
        (
            "msmpetsc check my.toml --update --cells 400 --frames 10",
            "msmpetsc check my.toml other.toml --ranks 2",
        ),
        (
            argument("scenes", type=checked_file, nargs="+", metavar="SCENE", help="scene files (TOML)"),
            ranks("MPI ranks of the runs (1)"),
            switch("--update", "store the numbers, in place of those stored before"),
            whole("--cells", "N", "of --update: cages.count; the scene's if not given"),
            whole("--frames", "N", "of --update: steps, the scene's at the most (20)"),
            SET,
            JSON,
        ),
        description="Run the first steps of scenes, each solved to 1e-9, and hold counts, energies, momentum and "
        "places against those that --update stored. Exit status 0: all are as stored; 1: something differs.",
        starts_runs=True,
    ),
    "fetch": Command(
        "download named meshes, or list them",
        ("msmpetsc fetch --list", "msmpetsc fetch bunny armadillo"),
        (
            argument("names", nargs="*", metavar="NAME", help="a model, see --list"),
            switch("--list", "list the models and where they lie"),
        ),
    ),
    "keys": Command(
        "list the keys of a scene, or of one of its tables: unit, default, range, meaning",
        ("msmpetsc keys", "msmpetsc keys material", "msmpetsc keys pin.region"),
        (argument("table", nargs="?", metavar="TABLE", help="a table or a key: material, pin.region, time.step"),),
    ),
    "schema": Command(
        "print the JSON schema of a scene, for editors", ("msmpetsc schema > msmpetsc.schema.json",),
        module="keys",
    ),
    "doctor": Command(
        "say what is installed, and how to get what is not",
        ("msmpetsc doctor",),
        description="Examine PETSc, MPI, the device, HDF5 and the packages of each extra. "
        "Exit status 1: a run lacks something that it needs.",
    ),
}  # fmt: skip

"""The table of commands with their help, arguments and examples, used to make the parser."""

import argparse
import sys
from dataclasses import dataclass
from typing import Any

from msmpetsc.app.checks import checked_file, checked_path
from msmpetsc.app.ranks import MOST_RANKS
from msmpetsc.app.request import OPTIONS, flag_of
from msmpetsc.results.frame_choice import frames_in

# names and keywords for argparse's ``add_argument``
Argument = tuple[tuple[str, ...], dict[str, Any]]


@dataclass(frozen=True)
class Command:
    """A command of the command line.

    starts_runs : whether the command starts runs in other processes
    module      : module in ``commands`` with its ``run`` function; the command's name if empty
    """

    help: str
    examples: tuple[str, ...]
    arguments: tuple[Argument, ...] = ()
    description: str | None = None
    starts_runs: bool = False
    module: str = ""


class Shown(argparse.Action):
    """Action that calls its ``const``, a function, prints the returned text, and exits."""

    def __init__(self, option_strings: list[str], const: Any, help: str, **_: Any):
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, const=const, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        parser._print_message(f"{self.const()}\n", sys.stdout)
        parser.exit()


def listed_presets() -> str:
    """Return a line for each preset that says when to use it."""
    from msmpetsc.solve.presets import find_preset, preset_names

    names = preset_names()
    width = max(map(len, names))
    return "\n".join(f"{name:{width}} {find_preset(name).about}" for name in names)


def argument(*names: str, **keywords: Any) -> Argument:
    """Return an argument for the table of commands."""
    return names, keywords


def switch(name: str, about: str) -> Argument:
    """Return an option without a value."""
    return argument(name, action="store_true", help=about)


def arguments_of_run() -> tuple[Argument, ...]:
    """Return the arguments of ``run``: all fields of a run request that are not for Python only."""
    return tuple(
        argument(
            *option.short,
            name if name == "scene" else flag_of(name),
            help=option.help.replace("%", "%%"),
            **option.keywords,
        )
        for name, option in OPTIONS.items()
        if not option.python
    )


def at_least_1(word: str) -> int:
    """Return a word as an integer of at least 1; a ``type`` for argparse."""
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {word}")
    return int(word)


def whole(name: str, value: str, about: str, **keywords: Any) -> Argument:
    """Return an option whose value is an integer of at least 1."""
    return argument(name, type=at_least_1, metavar=value, help=about, **keywords)


SCENE = argument("scene", type=checked_file, metavar="SCENE", help="scene file (TOML)")
SET = argument(
    "--set",
    action="append",
    default=[],
    metavar="KEY=VALUE",
    help="override a scene key: cages.count=3000",
)
JSON = switch("--json", "print a JSON object only")
# options of every command
VERBOSITY = (
    switch("--quiet", "show only warnings and errors"),
    switch("--verbose", "show times [ms] in the log and a traceback of errors"),
)


def frames(about: str) -> Argument:
    """Return the option ``--frames``, which selects frames of a result."""
    return argument("--frames", metavar="0,10,20", type=frames_in, help=about)


def rank_count(word: str) -> int:
    """Return a word as a number of ranks; a ``type`` for argparse."""
    count = at_least_1(word)
    if count > MOST_RANKS:
        raise argparse.ArgumentTypeError(f"must be at most {MOST_RANKS}, not {word}")
    return count


def ranks(about: str) -> Argument:
    """Return the option ``--ranks``."""
    return argument("--ranks", type=rank_count, metavar="R", help=about, default=1)


RENDER = (
    argument(
        "subject", metavar="OUT.h5|SCENE.toml", type=checked_file, help="result or scene to draw"
    ),
    argument(
        "-o", "--output", metavar="FILE", type=checked_file,
        help="*.png, *.mp4, *.gif, *.webp or *.html; default: OUT.png or SCENE.png",
    ),
    frames("frames to draw; slices such as 0:250:5 as in Python"),
    whole("--count", "N", "number of frames to choose (default: the scene's picture.times, or 5)"),
    argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)"),
    argument(
        "--size", metavar="WxH",
        help="size of a film with its caption (default: a view of up to 960x960), or largest size "
        "of a panel without (400x870, of a scene 760x900) [px]",
    ),
    argument(
        "--colour", metavar="FIELD",
        help="colour by displacement, speed, strain, stress or part, with a legend",
    ),
    switch("--cells", "cut the body open: boundary cells in red, interior cells in blue"),
    argument(
        "--speed", type=float, metavar="S",
        help="simulated seconds per second of the film (1: real time)",
    ),
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
            argument(
                "scene", nargs="?", type=checked_file, metavar="SCENE.toml", help="scene to write"
            ),
            argument(
                "--mesh", type=checked_file, metavar="MESH",
                help="mesh file in or below the scene's folder, or a model of `fetch --list`",
            ),
            argument("--up", choices=("y", "z"), help="mesh's upward axis (z; y for glTF)"),
            argument("--from", dest="from_scene", metavar="NAME", help="scene to copy, see --list"),
            switch("--list", "list the scenes that come with msmpetsc"),
            switch("--overwrite", "replace SCENE.toml if it exists"),
        ),
        description="Measure a mesh and write a commented scene that is ready to run, or copy a "
        "scene that comes with msmpetsc. Also write the JSON schema by which editors complete its "
        "keys.",
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
            switch("--show-options", "print the PETSc options of the preset as an options file"),
            argument(
                "--list-presets", action=Shown, const=listed_presets,
                help="list the presets and when to use each",
            ),
        ),
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options, with a single "
        "dash, may follow.",
    ),
    "modes": Command(
        "find natural frequencies and mode shapes",
        (
            "msmpetsc modes my.toml --count 20",
            "msmpetsc modes my.toml -o out/modes.h5 --overwrite",
        ),
        (
            SCENE,
            whole("--count", "N", "number of modes, rigid modes included (10)", default=10),
            argument(
                "-o", "--output", metavar="OUT.h5", type=checked_file,
                help="result file of the shapes: frame N is mode N",
            ),
            switch("--overwrite", "replace OUT.h5 if it exists"),
            SET,
            JSON,
        ),
        description="Find the lowest natural frequencies of the held or free bodies, rigid modes "
        "first: about the equilibrium of a static scene, about the state that start.from names, or "
        "at rest.",
    ),
    "inspect": Command(
        "estimate the size and memory of a scene on a number of ranks",
        ("msmpetsc inspect my.toml --ranks 64", "msmpetsc inspect my.toml --json"),
        (SCENE, ranks("MPI ranks (1)"), SET, JSON),
        description="Count cells, nodes, springs, ghosts and messages of each rank, and estimate "
        "its memory.",
    ),
    "study": Command(
        "sweep methods over scenes",
        (
            "msmpetsc study my_study.toml --list",
            "msmpetsc study my_study.toml -o out/my_study --jobs 2",
        ),
        (
            argument("study", type=checked_file, metavar="FILE.toml", help="study file"),
            argument(
                "-o", "--output", type=checked_path, metavar="FOLDER",
                help="folder of the results; default: out/FILE",
            ),
            switch("--full", "also run the long cases, marked full = true"),
            whole("--jobs", "N", "number of cases to run at a time (they slow each other)"),
            switch("--restart", "run finished cases again"),
            argument(
                "--part", metavar="I/N",
                help="run only the I-th of N parts, for several machines or array tasks",
            ),
            switch("--list", "list the cases and which are done, and run nothing"),
        ),
        description="Run the cases of a study, each in its own process, and write a table and a "
        "report. After a stop the same command continues.",
        starts_runs=True,
    ),
    "plan": Command(
        "find the cheapest options that meet a surface error",
        (
            "msmpetsc plan my.toml --surface-error 0.1 --write",
            "msmpetsc plan my.toml --surface-error 0.03 --frames 10",
        ),
        (
            SCENE,
            argument(
                "--surface-error", type=float, metavar="E", default=0.1,
                help="error of cells and time steps together, over the surface's largest "
                "displacement (0.1)",
            ),
            whole("--frames", "N", "number of the scene's steps in a trial (20)", default=20),
            ranks("MPI ranks of the trials (1)"),
            switch("--write", "write the chosen options into the scene file"),
            whole("--cells", "N", "cells of the finest trial (the scene's cages.count)"),
            JSON,
        ),
        description="Try integrators and cell counts on the first frames of a scene, and print the "
        "cheapest choice that meets the error. Exit status 3: no choice meets it.",
        starts_runs=True,
    ),
    "compare": Command(
        "compare two results",
        (
            "msmpetsc compare out/a.h5 out/b.h5 --rtol 1e-3",
            "msmpetsc compare out/a.h5 out/b.h5 --json",
        ),
        (
            argument("first", metavar="A.h5", type=checked_file),
            argument("second", metavar="B.h5", type=checked_file),
            argument(
                "--rtol", type=float, default=1e-6, metavar="E",
                help="relative difference up to which results agree (1e-6)",
            ),
            JSON,
        ),
        description="Compare two results at their common times; results on different lattices by "
        "their surfaces only. Exit status 0: they agree; 1: they differ; 2: they cannot be "
        "compared.",
    ),
    "render": Command(
        "draw a result as a picture, a film or a page; or draw a scene before it is run",
        (
            "msmpetsc render out/my.h5 --frames 0,10,20 --eye=-1,2,0.5",
            "msmpetsc render out/my.h5 -o out/my.mp4 --speed 0.1",
            "msmpetsc render out/my.h5 -o out/my.html --colour strain",
            "msmpetsc render my.toml --cells",
        ),
        RENDER,
        description="Draw some frames of a result side by side (*.png), a film (*.mp4, *.gif, "
        "*.webp), or an interactive page for a browser (*.html). A scene is drawn at rest.",
    ),
    "export": Command(
        "write frames of a result in another format",
        (
            "msmpetsc export out/my.h5 -o out/my.glb --frames 0::2",
            "msmpetsc export out/my.h5 -o out/last.obj --frames -1",
        ),
        (
            argument("result", metavar="OUT.h5", type=checked_file),
            argument(
                "-o", "--output", metavar="FILE", type=checked_file, required=True,
                help="file to write; its ending chooses the format",
            ),
            frames(
                "frames to write; slices such as 0:250:5; default: all frames, or the last frame "
                "(-1) in a format of a single frame"
            ),
        ),
        description="Write frames of a result for another program. Formats: .glb and .usd hold "
        "many frames; .obj, .ply and .stl hold a single frame.",
    ),
    "series": Command(
        "print energies, forces and probe positions of a result, a row per frame",
        ("msmpetsc series out/my.h5 -o out/my.csv", "msmpetsc series out/my.h5 > out/my.csv"),
        (
            argument("result", metavar="OUT.h5", type=checked_file),
            argument(
                "-o", "--output", metavar="FILE.csv", type=checked_file,
                help="file to write; default: standard output",
            ),
            switch("--overwrite", "replace FILE.csv if it exists"),
        ),
        description="Write as CSV, for each frame: energies, momentum, loads, reactions of pins "
        "and anchors, contact forces of obstacles and on bodies, and positions of probes.",
    ),
    "check": Command(
        "check the numbers of a scene against stored numbers",
        (
            "msmpetsc check my.toml --update --cells 400 --frames 10",
            "msmpetsc check my.toml other.toml --ranks 2",
        ),
        (
            argument(
                "scenes", type=checked_file, nargs="+", metavar="SCENE", help="scene files (TOML)"
            ),
            ranks("MPI ranks of the runs (1)"),
            switch("--update", "store the numbers and replace the stored numbers"),
            whole("--cells", "N", "cages.count, with --update; default: the scene's"),
            whole("--frames", "N", "number of steps, with --update (20, or all if fewer)"),
            SET,
            JSON,
        ),
        description="Run the first steps of scenes, each solved to 1e-9, and compare counts, "
        "energies, momentum and positions with the numbers that --update has stored. --cells, "
        "--frames and --set are for --update alone. Exit status 0: all agree; 1: a number differs.",
        starts_runs=True,
    ),
    "fetch": Command(
        "download named meshes, or list them",
        ("msmpetsc fetch --list", "msmpetsc fetch bunny armadillo"),
        (
            argument("names", nargs="*", metavar="NAME", help="model, see --list"),
            switch("--list", "list the models and where they are stored"),
        ),
    ),
    "keys": Command(
        "list the keys of a scene or of a table: unit, default, range, meaning",
        ("msmpetsc keys", "msmpetsc keys material", "msmpetsc keys pin.region"),
        (
            argument(
                "table", nargs="?", metavar="TABLE",
                help="table or key, for example material, pin.region or time.step",
            ),
        ),
    ),
    "schema": Command(
        "print the JSON schema of a scene, for editors",
        ("msmpetsc schema > msmpetsc.schema.json",),
        module="keys",
    ),
    "doctor": Command(
        "check the installation and say how to complete it",
        ("msmpetsc doctor",),
        description="Check PETSc, MPI, the GPU, HDF5 and the packages of each extra. Exit status "
        "1: a requirement of runs is missing or broken.",
    ),
}  # fmt: skip

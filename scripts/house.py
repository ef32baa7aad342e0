#!/usr/bin/env python3
"""Prints the measures of a tree of msmpetsc as a Markdown table: state, files, imports, findings, times.

    scripts/house.py [FOLDER] [--before FOLDER] [--quick]

FOLDER is a clone, this one if none is given; --before puts an older one's column beside it. A tree with a .venv runs
by its own Python. --quick leaves out what runs the program, ruff or mypy, whose rules are this clone's.
"""

import ast
import os
import re
import subprocess
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from time import perf_counter

from clone import PYTHON, ROOT, parser

LAYERS = (
    "errors",
    "scene scene_reading scene_problems comm backend place extensions",
    "geometry",
    "model",
    "solve",
    "output",
    "app",
    "study",
    "cli __main__",
)
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names.split()}
LONGEST = 35  # lines of a function, docstrings not counted
MOST_FILES = 15  # of a folder
REPEATS = 5
DEF = ast.FunctionDef | ast.AsyncFunctionDef
# run in the tree: counts the frames of msmpetsc from entry_point to PETSc's SNES.solve
FRAMES = """
import sys, traceback
def profile(frame, event, function):
    if event == "c_call" and function.__name__ == "solve" and type(function.__self__).__name__ == "SNES":
        sys.setprofile(None)
        frames = [f for f, _ in traceback.walk_stack(frame) if "/msmpetsc/" in f.f_code.co_filename]
        print("frames:", " > ".join(f.f_code.co_name for f in frames[::-1]))
from msmpetsc.cli.main import entry_point
sys.setprofile(profile)
entry_point()
"""


def trees(folder: Path) -> dict[str, ast.Module]:
    """Return the syntax tree of each module of the package by its dotted name, without "msmpetsc."."""
    package = folder / "msmpetsc"
    names = {path: path.relative_to(package).with_suffix("") for path in sorted(package.rglob("*.py"))}
    return {".".join(name.parts): ast.parse(path.read_text()) for path, name in names.items()}


# ---- state


def attributes(kind: ast.ClassDef) -> tuple[set[str], set[str]]:
    """Return the names of a class's attributes, and of those that are not born in __init__ or the class's body."""
    methods = [node for node in kind.body if isinstance(node, DEF)]
    born = {
        node.target.id for node in kind.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    every = set(born)
    for method in methods:
        written = {
            node.attr
            for node in ast.walk(method)
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
            if isinstance(node.value, ast.Name) and node.value.id == "self"
        }
        every |= written
        born |= written if method.name == "__init__" else set()
    return every, every - born


def classes(modules: dict[str, ast.Module]) -> dict[str, list[ast.ClassDef]]:
    """Return the classes of each name."""
    kinds = defaultdict(list)
    for module in modules.values():
        for node in ast.walk(module):
            if isinstance(node, ast.ClassDef):
                kinds[node.name].append(node)
    return kinds


def state(modules: dict[str, ast.Module]) -> Iterator[tuple[str, object]]:
    """Yield rows of classes and their attributes."""
    kinds = classes(modules)
    counts: list[tuple[str, int, int]] = []
    for name, nodes in kinds.items():
        counts += [(name, len(every), len(late)) for every, late in map(attributes, nodes)]
    shown = [f"{name} {every} ({late})" for name, every, late in sorted(counts, key=lambda row: -row[1])]
    yield "attributes of Stepper (born late)", next(text for text in shown if text.startswith("Stepper "))
    yield "most attributes (born late)", ", ".join(shown[:5])
    yield "attributes born late, all classes", sum(late for _, _, late in counts)
    twice = sorted(name for name, nodes in kinds.items() if len(nodes) > 1)
    yield "classes whose name stands twice", f"{len(twice)} {', '.join(twice)}"


# ---- files and imports


def imports(name: str, module: ast.Module, names: set[str]) -> set[str]:
    """Return the modules of the package that a module imports, those inside functions and of TYPE_CHECKING included."""
    dotted = []
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            dotted += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            dotted += [f"{node.module}.{alias.name}" for alias in node.names] + [str(node.module)]
    return {word.removeprefix("msmpetsc.") for word in dotted if word.startswith("msmpetsc.")} & names - {name}


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = [start]
        while ahead:
            new = arrows[ahead.pop()] - seen
            seen |= new
            ahead += new
        return seen

    behind = {name: reached(name) for name in arrows}
    groups = {tuple(sorted(b for b in behind[a] if a in behind[b])) for a in arrows if a in behind[a]}
    return [list(group) for group in sorted(groups)]


def top(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(counts).most_common(10))


def rooms(folder: Path, modules: dict[str, ast.Module]) -> Iterator[tuple[str, object]]:
    """Yield rows of files, imports and functions."""
    paths = [path for path in (folder / "msmpetsc").rglob("*.py") if path.name != "__init__.py"]
    folders = Counter(str(path.parent.relative_to(folder)) for path in paths)
    yield "files, __init__ left out", len(paths)
    yield "lines", f"{sum(len(path.read_text().splitlines()) for path in paths):,}"
    yield "files of the fullest folders", top(folders)
    yield f"folders of more than {MOST_FILES} files", sum(count > MOST_FILES for count in folders.values())
    arrows = {name: imports(name, module, set(modules)) for name, module in modules.items()}
    yield "largest fan-in", top(Counter(name for targets in arrows.values() for name in targets))
    yield "largest fan-out", top({name: len(targets) for name, targets in arrows.items()})
    found = circles(arrows)
    yield "import circles", f"{len(found)} {'; '.join(' - '.join(group) for group in found)}"
    height = {name: HEIGHT.get(name.partition(".")[0], 0) for name in modules if name != "__init__"}
    upward = [f"{a} > {b}" for a in height for b in arrows[a] if b in height and height[b] > height[a]]
    yield "upward imports", f"{len(upward)} {', '.join(upward)}"
    long = sorted(long_functions(modules), reverse=True)
    yield f"functions over {LONGEST} lines", f"{len(long)} {', '.join(f'{name} {lines}' for lines, name in long[:5])}"


def long_functions(modules: dict[str, ast.Module]) -> Iterator[tuple[int, str]]:
    """Yield lines and name of each function over the limit."""
    for module, tree in modules.items():
        for node in (node for node in ast.walk(tree) if isinstance(node, DEF)):
            first = node.body[0]
            lines = height(node) - (height(first) if ast.get_docstring(node) is not None else 0)
            if lines > LONGEST:
                yield lines, f"{module}.{node.name}"


def height(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


# ---- documents


def documents(folder: Path) -> Iterator[tuple[str, object]]:
    """Yield rows of the README files."""
    every = [path for path in folder.rglob("README.md") if not {".venv", "out"} & set(path.relative_to(folder).parts)]
    for title, paths in (("README.md", [folder / "README.md"]), ("all README files", every)):
        text = "".join(path.read_text() for path in paths)
        yield f"{title}: lines, words", f"{len(text.splitlines()):,}, {len(text.split()):,}"


# ---- what runs


def findings(folder: Path) -> Iterator[tuple[str, object]]:
    """Yield rows of what ruff and mypy of this clone say of the tree."""
    rules = ["--config", str(ROOT / "pyproject.toml")]
    commands = {
        "ruff check": (["ruff", "check", *rules, "--output-format", "concise", "."], r"^\S+:\d+:\d+: "),
        "ruff format": (["ruff", "format", "--check", *rules, "."], r"^Would reformat"),
        "mypy": (["mypy", "--config-file", str(ROOT / "pyproject.toml"), "msmpetsc"], r": error: "),
    }
    for name, (words, pattern) in commands.items():
        done = subprocess.run([PYTHON, "-m", *words], cwd=folder, capture_output=True, text=True)
        known = done.returncode in (0, 1) and "No module named" not in done.stderr
        yield f"{name} findings", len(re.findall(pattern, done.stdout, re.M)) if known else "not run"


def runs(folder: Path) -> Iterator[tuple[str, object]]:
    """Yield rows of what a run needs: frames down to PETSc, and times, the medians of warm starts."""
    python = str(next(path for path in (folder / ".venv" / "bin" / "python", PYTHON) if path.exists()))
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    beam = str(folder / "scenes" / "studies" / "beam_soft.toml")

    def python_of(*words: str) -> str:
        done = subprocess.run([python, *words], cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{folder}: {' '.join(words)}\n{done.stderr}"
        return done.stdout

    def seconds(*words: str) -> str:
        times = []
        for _ in range(1 + REPEATS):
            begin = perf_counter()
            python_of("-m", "msmpetsc", *words)
            times.append(perf_counter() - begin)
        warm = times[1:]
        return f"{median(warm):.2f} ({min(warm):.2f} to {max(warm):.2f})"

    with tempfile.TemporaryDirectory() as temporary:
        step = [
            "run",
            beam,
            "-o",
            f"{temporary}/x.h5",
            "--overwrite",
            "--frames",
            "1",
            "--set",
            "cages.cell_size=0.0675",
        ]
        frames = re.findall("frames: (.*)", python_of("-c", FRAMES, *step))
        yield "frames from the command to SNESSolve", f"{len(frames[0].split(' > '))}: {frames[0]}" if frames else "?"
        yield "--help [s]", seconds("--help")
        yield "first step, about 1,000 cells [s]", seconds(*step)


def measures(folder: Path, quick: bool) -> dict[str, object]:
    """Return all measures of a tree by their names."""
    modules = trees(folder)
    rows = dict(state(modules)) | dict(rooms(folder, modules)) | dict(documents(folder))
    return rows if quick else rows | dict(findings(folder)) | dict(runs(folder))


def main() -> None:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, default=ROOT, metavar="FOLDER", help="a clone (this one)")
    options.add_argument("--before", type=Path, metavar="FOLDER", help="an older clone for the first column")
    options.add_argument("--quick", action="store_true", help="read files only")
    args = options.parse_args()
    folders = {"before": args.before, "after": args.folder} if args.before else {"": args.folder}
    columns = {title: measures(folder.resolve(), args.quick) for title, folder in folders.items()}
    print("| measure |", " | ".join(columns), "|\n|---" + "|---" * len(columns) + "|")
    for name in next(iter(columns.values())):
        print("|", name, "|", " | ".join(str(column[name]).strip() for column in columns.values()), "|")


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""Measure the source of msmpetsc: rooms, functions, names, density of lines.

    scripts/house.py [FOLDER]

FOLDER is a clone, by default this clone. A walk counts the functions, and their modules, that take
a certain type of argument: a Scene, or a request of type Namespace or Request.
"""

import ast
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

import lab
from clone import ROOT

# pattern of the argument's type of each walk
WALKS = {"scene": r"\bScene\b", "request": r"\bNamespace\b|Request\b"}
# limits: lines of a function without its docstring, arguments, columns
LONGEST, MOST_ARGUMENTS, WIDE = 35, 6, 100
Facts = Iterator[tuple[str, object]]


class Tree:
    """The package of a clone: its modules by dotted name, without "msmpetsc."."""

    def __init__(self, folder: Path):
        self.folder = folder
        package = folder / "msmpetsc"
        self.paths = {
            ".".join(path.relative_to(package).with_suffix("").parts): path
            for path in sorted(package.rglob("*.py"))
        }
        self.modules = {name: ast.parse(path.read_text()) for name, path in self.paths.items()}
        self.lines = {name: path.read_text().splitlines() for name, path in self.paths.items()}

    @cached_property
    def functions(self) -> list[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
        """All functions, each with its module's name."""
        kinds = ast.FunctionDef | ast.AsyncFunctionDef
        return [(name, node) for name, node in self.nodes() if isinstance(node, kinds)]

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """The package's modules that each module imports, also in functions and TYPE_CHECKING."""
        imported: dict[str, set[str]] = {name: set() for name in self.modules}
        for name, node in self.nodes():
            if isinstance(node, ast.ImportFrom):
                words = {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
            elif isinstance(node, ast.Import):
                words = {alias.name for alias in node.names}
            else:
                continue
            imported[name] |= {word.removeprefix("msmpetsc.") for word in words} & set(
                self.modules
            ) - {name}
        return imported

    def nodes(self) -> Iterator[tuple[str, ast.AST]]:
        """Yield each syntax node of the package with its module's name."""
        for name, module in self.modules.items():
            for node in ast.walk(module):
                yield name, node


def listed(names: Iterable[object]) -> str:
    """Return the number of names, and the first ten names."""
    every = list(names)
    return f"{len(every)} {', '.join(map(str, every[:10]))}".strip()


# ---- files


def rooms(tree: Tree) -> Facts:
    """Yield measures of folders and files."""
    own = [name for name in tree.paths if not name.endswith("__init__")]
    of_rooms: Counter[str] = Counter()
    for name in tree.paths:
        of_rooms[name.partition(".")[0]] += len(tree.lines[name])
    files = Counter(name.partition(".")[0] for name in own)
    yield "lines, files", f"{of_rooms.total():,}, {len(own)}"
    yield (
        "lines/files by room",
        ", ".join(f"{room} {lines:,}/{files[room]}" for room, lines in of_rooms.items()),
    )
    for folder in ("scripts", "tests"):
        paths = [path for path in (tree.folder / folder).rglob("*.py") if path.is_file()]
        yield f"lines of {folder}", f"{sum(len(path.read_text().splitlines()) for path in paths):,}"
    users = Counter(target for targets in tree.imports.values() for target in targets)
    yield "files with one user", sum(users[name] == 1 for name in own)
    twice = Counter(tree.paths[name].name for name in own)
    yield "file names that stand twice", listed(name for name, count in twice.items() if count > 1)


# ---- functions and names


def arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    """Return the arguments of a function except self and cls."""
    given = function.args
    return [
        arg
        for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)
        if arg.arg not in ("self", "cls")
    ]


def height_of(node: ast.stmt) -> int:
    """Return the number of lines of a statement."""
    return (node.end_lineno or node.lineno) - node.lineno + 1


def shape(tree: Tree) -> Facts:
    """Yield measures of functions and classes."""
    long = []
    for module, function in tree.functions:
        documented = ast.get_docstring(function) is not None
        if height_of(function) - (height_of(function.body[0]) if documented else 0) > LONGEST:
            long.append(f"{module}.{function.name}")
    yield f"functions over {LONGEST} lines", listed(long)
    many = [name for name, function in tree.functions if len(arguments(function)) > MOST_ARGUMENTS]
    yield f"functions over {MOST_ARGUMENTS} arguments", len(many)
    for walk, pattern in WALKS.items():
        taking = [
            name
            for name, function in tree.functions
            if re.search(pattern, ast.unparse(function.args))
        ]
        yield f"functions, modules on the walk of {walk}", f"{len(taking)}, {len(set(taking))}"
    kinds = Counter(node.name for _, node in tree.nodes() if isinstance(node, ast.ClassDef))
    yield "class names that stand twice", listed(name for name, count in kinds.items() if count > 1)
    inside = {node for _, function in tree.functions for node in ast.walk(function)}
    yield (
        "imports inside functions",
        sum(isinstance(node, ast.Import | ast.ImportFrom) for node in inside),
    )
    yield (
        "tuned module constants",
        sum(is_number(node) for module in tree.modules.values() for node in module.body),
    )


def is_number(node: ast.stmt) -> bool:
    """Return whether a statement assigns a number, or a tuple of numbers."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return False
    try:
        value = ast.literal_eval(node.value)
    except ValueError:
        return False
    values = value if isinstance(value, tuple) else (value,)
    return all(type(number) in (int, float) for number in values)


def density(tree: Tree) -> Facts:
    """Yield measures of the density of lines."""
    lines = [line for of_file in tree.lines.values() for line in of_file]
    tuples = choices = 0
    for _, node in tree.nodes():
        choices += isinstance(node, ast.IfExp)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            tuples += any(isinstance(target, ast.Tuple) for target in node.targets)
    wide = sum(len(line) > WIDE for line in lines)
    counts = {
        f"lines over {WIDE}": wide,
        "conditional expressions": choices,
        "tuple assignments": tuples,
    }
    for name, count in counts.items():
        yield f"{name}: all, in 1,000 lines", f"{count:,}, {1000 * count / len(lines):.1f}"


def main() -> None:
    """Print the table of all measures."""
    options = lab.parser(__doc__)
    options.add_argument(
        "folder", nargs="?", type=Path, default=ROOT, metavar="FOLDER", help="a clone (this one)"
    )
    args = options.parse_args()
    tree = Tree(args.folder.resolve())
    lab.table(
        {"measure": name, "now": value}
        for facts in (rooms, shape, density)
        for name, value in facts(tree)
    )


if __name__ == "__main__":
    main()

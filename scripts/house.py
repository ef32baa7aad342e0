#!/usr/bin/env python3
"""Measure the source of a clone: lines of its folders, long functions, tuned numbers.

scripts/house.py [FOLDER]
"""

import ast
from collections import Counter
from pathlib import Path

import lab
from clone import ROOT

# most lines of a function without its docstring
LONGEST = 35


def lines_of(node: ast.stmt) -> int:
    """Return the number of lines of a statement, without its docstring."""
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) is not None:
        lines -= lines_of(node.body[0])
    return lines


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


def rows(folder: Path) -> lab.Rows:
    """Yield the measures of the clone in a folder."""
    rooms: Counter[str] = Counter()
    long: list[str] = []
    numbers = 0
    for path in sorted((folder / "msmpetsc").rglob("*.py")):
        text = path.read_text()
        rooms[path.relative_to(folder).parts[1]] += len(text.splitlines())
        module = ast.parse(text)
        numbers += sum(map(is_number, module.body))
        functions = [node for node in ast.walk(module) if isinstance(node, ast.FunctionDef)]
        long += [f"{path.stem}.{each.name}" for each in functions if lines_of(each) > LONGEST]
    yield {"measure": "lines", "now": f"{rooms.total():,}"}
    yield {
        "measure": "lines of rooms",
        "now": ", ".join(f"{room} {lines:,}" for room, lines in rooms.items()),
    }
    yield {"measure": f"functions over {LONGEST} lines", "now": f"{len(long)}: {', '.join(long)}"}
    yield {"measure": "tuned module constants", "now": numbers}


def main() -> None:
    """Print the table of all measures."""
    options = lab.parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, default=ROOT, help="a clone (this one)")
    lab.table(rows(options.parse_args().folder))


if __name__ == "__main__":
    main()

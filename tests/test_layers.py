"""Layers import downwards only, and PETSc, argparse and printing stay in their places."""

import ast
from collections.abc import Iterator
from pathlib import Path

# each layer imports from earlier layers only
LAYERS = (
    "errors",
    "scene comm backend extensions fields checkpoint",
    "geometry",
    "lattice",
    "elasticity",
    "constraints",
    "contact",
    "build",
    "environment",
    "solve",
    "results",
    "view export",
    "app",
    "study",
    "cli __main__",
)
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names.split()}
PACKAGE = Path(__file__).parent.parent / "msmpetsc"
ONLY_IN = {"petsc4py": {"solve", "app", "cli"}, "slepc4py": {"solve"}, "argparse": {"cli"}}
# results can be read and drawn without PETSc
NEVER = {("results", "solve"), ("view", "solve"), ("export", "solve")}


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield the dotted names of all imports, also in functions and under TYPE_CHECKING."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = "." * node.level + (node.module or "")
            yield from (f"{start}.{alias.name}" for alias in node.names)


def violations(layer: str, source: str) -> list[str]:
    """Return the forbidden imports and prints of a file.

    layer : file or folder name within the package
    """
    tree, found = ast.parse(source), []
    for name in imported(tree):
        top, _, rest = name.partition(".")
        other = rest.partition(".")[0]
        if not top:
            found.append(f"relative import {name}")
        if layer not in ONLY_IN.get(top, {layer}):
            found.append(f"{top} in {layer}")
        if top == "msmpetsc" and (HEIGHT.get(other, 0) > HEIGHT[layer] or (layer, other) in NEVER):
            found.append(f"{layer} imports {other}")
    if layer != "cli" and any(map(prints_to_stdout, ast.walk(tree))):
        found.append(f"print in {layer}")
    return found


def prints_to_stdout(node: ast.AST) -> bool:
    """Return whether a call prints to standard output; print(..., file=stream) does not."""
    is_print = (
        isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    )
    return is_print and "file" not in [keyword.arg for keyword in node.keywords]


def test_every_file_keeps_to_its_layer():
    files = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    assert len(files) > 30
    layers = {path: path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in files}
    assert set(layers.values()) <= set(HEIGHT), "a file or folder that LAYERS does not know"
    found = {
        str(path.relative_to(PACKAGE)): violations(layers[path], path.read_text()) for path in files
    }
    assert {path: wrong for path, wrong in found.items() if wrong} == {}

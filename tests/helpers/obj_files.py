"""Meshes with named groups, written as OBJ files."""

from pathlib import Path

import numpy as np
import trimesh


def write_obj(path: Path, mesh: trimesh.Trimesh, groups: dict[str, np.ndarray]) -> None:
    """Write a mesh with the faces of each group, given by a mask."""
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + ["o block"]
    for name, own in groups.items():
        lines += [f"g {name}", f"usemtl paint of {name}"]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces[own] + 1]
    path.write_text("\n".join([*lines, ""]))


def write_parts(path: Path, meshes: dict[str, trimesh.Trimesh]) -> None:
    """Write meshes as the objects of one file."""
    lines, count = [], 1
    for name, mesh in meshes.items():
        lines += [f"o {name}", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + count]
        count += len(mesh.vertices)
    path.write_text("\n".join([*lines, ""]))

"""The mesh and the scene of a tube bent to a U whose arms close on each other."""

from pathlib import Path

import numpy as np
import tomli_w
import trimesh

# radius of the tube, length of its straight arms, distance of the arms from the U's
# axis [m]
RADIUS, ARM, HALF = (
    0.02,
    0.12,
    0.05,
)


def u_tube(around: int = 16, along: int = 60) -> trimesh.Trimesh:
    """Return a closed tube along a U in the plane y = 0: the arms point up, the bend is below."""
    lengths = np.array([ARM, np.pi * HALF, ARM])
    s = np.linspace(0, lengths.sum(), along)
    angle = np.clip((s - ARM) / HALF, 0, np.pi)
    beyond = np.clip(s - ARM - lengths[1], 0, None)
    middle = np.stack(
        [-HALF * np.cos(angle), 0 * s, np.clip(ARM - s, 0, None) + beyond - HALF * np.sin(angle)],
        axis=1,
    )
    normal = np.stack([-np.cos(angle), 0 * s, -np.sin(angle)], axis=1)
    turn = 2 * np.pi * np.arange(around) / around
    ring = (
        normal[:, None] * np.cos(turn)[None, :, None]
        + np.array([0, 1, 0]) * np.sin(turn)[None, :, None]
    )
    points = np.concatenate([(middle[:, None] + RADIUS * ring).reshape(-1, 3), middle[[0, -1]]])
    row, column = np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij")
    a, b = row * around + column, row * around + (column + 1) % around
    sides = np.concatenate(
        [np.stack([a, b, a + around], -1), np.stack([b, b + around, a + around], -1)]
    ).reshape(-1, 3)
    first, second = np.arange(around), np.roll(np.arange(around), -1)
    last, end = (along - 1) * around, around * along
    caps = [np.stack([second, first, np.full(around, end)], 1)]
    caps += [np.stack([last + first, last + second, np.full(around, end + 1)], 1)]
    mesh = trimesh.Trimesh(points, np.concatenate([sides, *caps]), process=False)
    mesh.fix_normals()
    return mesh


def pinch_scene(folder: Path, **tables: dict) -> Path:
    """Write the tube's scene; forces close its arms. ``tables`` replace or extend its tables."""
    u_tube().export(folder / "u.ply")
    upper = {"relative": True}
    left = {"box": [[0, 0, 0.7], [0.3, 1, 1]]} | upper
    right = {"box": [[0.7, 0, 0.7], [1, 1, 1]]} | upper
    scene = {
        "mesh": {"source": "u.ply"},
        "cages": {"cell_size": 0.0125},
        "material": {"young_modulus": 1e5, "density": 1000, "law": "linear"},
        "time": {"step": 0.01, "duration": 0.3},
        "pin": [{"region": {"box": [[0, 0, 0], [1, 1, 0.15]]} | upper}],
        "force": [{"region": left, "total": [1.0, 0, 0]}, {"region": right, "total": [-1.0, 0, 0]}],
        "solver": {"preset": "newton", "error": 1e-4},
        "self_contact": {"distance": 1e-3},
    }
    path = folder / "pinch.toml"
    path.write_text(tomli_w.dumps(scene | tables))
    return path

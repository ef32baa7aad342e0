"""Regions and probes at slits narrower than a cell: those on one prong ignore the other prong."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import model_of, play, solid_of, write_scene
from obj_files import write_obj
from test_copies import DEPTH, FORCE, LENGTH, WIDTH, YOUNG, H, fork

# the tip of the upper prong begins here [m]
BEYOND = (LENGTH - 1.5) * H
# width and shift of slits [cells]: within cells, and around a plane of the grid
SLITS = [(0.2, 0.0), (0.2, 0.5), (0.4, 0.2)]


def upper_tip(middle: float, mesh: trimesh.Trimesh, region: str) -> dict:
    """Return a region of the upper prong's tip, and write the mesh's group of it."""
    if region == "box":
        return {"box": [[BEYOND, middle, -1], [3, 3, 3]]}
    if region == "group":
        return {"group": "tip"}
    points = mesh.vertices
    return {"painted": np.flatnonzero((points[:, 0] > BEYOND) & (points[:, 1] > middle)).tolist()}


@pytest.mark.parametrize("region", ["box", "group", "painted"])
@pytest.mark.parametrize(("slit", "shift"), SLITS)
def test_a_force_on_a_prong_leaves_the_other_alone(
    tmp_path: Path, slit: float, shift: float, region: str
):
    """The other prong only turns with the base, by far less."""
    mesh, middle = fork(slit, shift), (WIDTH / 2 + shift) * H
    ends = mesh.triangles_center
    group = (ends[:, 0] > LENGTH * H - 1e-3) & (ends[:, 1] > middle)
    write_obj(tmp_path / "fork.obj", mesh, {"tip": group, "rest": ~group})
    probes = {
        name: {
            "name": name,
            "point": [(LENGTH - 0.5) * H, middle + side * (slit / 2 + 0.02) * H, 0.1],
        }
        for name, side in (("lower", -1), ("upper", 1))
    }
    scene = write_scene(
        tmp_path,
        mesh={"source": "fork.obj"},
        cages={"cell_size": H},
        material=solid_of(YOUNG, 0.3),
        time={"step": 1.0, "duration": 1.0, "integrator": "static"},
        pin=[{"region": {"box": [[-1, -1, -1], [1e-3, 3, 3]]}}],
        force=[{"region": upper_tip(middle, mesh, region), "total": [0, FORCE, 0]}],
        output={"probe": list(probes.values())},
    )
    model, frames = play(scene)
    assert model.surface is not None
    rest = model.surface.points
    moved = frames[-1].surface[:, 1] - rest[:, 1]
    at_tip = rest[:, 0] > LENGTH * H - 1e-3
    lower, upper = (
        moved[at_tip & own].mean() for own in (rest[:, 1] < middle, rest[:, 1] > middle)
    )
    assert upper > 0.02 * H and abs(lower) < 0.1 * upper
    lower_probe, upper_probe = (frames[-1].probe - frames[0].probe)[:, 1]
    assert upper_probe == pytest.approx(upper, rel=0.1)
    assert lower_probe == pytest.approx(lower, abs=0.02 * upper)


@pytest.mark.parametrize(("slit", "shift"), SLITS)
def test_a_pin_of_a_prong_holds_no_node_of_the_other(tmp_path: Path, slit: float, shift: float):
    """Each prong's pin holds whole faces of cells across its end, and no node twice."""
    mesh, middle = fork(slit, shift), (WIDTH / 2 + shift) * H
    mesh.export(tmp_path / "fork.ply")
    held = []
    for side in ([-1, middle], [middle, 3]):
        region = {"box": [[LENGTH * H - 1e-3, side[0], -1], [3, side[1], 3]]}
        scene = write_scene(
            tmp_path,
            mesh={"source": "fork.ply"},
            cages={"cell_size": H},
            material=solid_of(YOUNG, 0.3),
            time={"step": 1.0, "duration": 1.0},
            pin=[{"region": region}],
        )
        held.append(np.flatnonzero(model_of(scene).lattice.pinned))
    assert not len(np.intersect1d(*held))
    at_end = np.flatnonzero(model_of(scene).lattice.nodes[:, 0] > (LENGTH - 0.5) * H)
    np.testing.assert_array_equal(np.union1d(*held), at_end)
    assert len(at_end) == (DEPTH + 1) * (WIDTH + (3 if shift != 0.5 else 2))

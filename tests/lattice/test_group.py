"""Regions by the names in a mesh: in every format, after every step of prepare, on any ranks."""

from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
import trimesh
from block_scene import CELL, SIDES, YOUNG, block_scene, model_of
from conftest import run
from obj_files import write_obj, write_parts

from msmpetsc.cli.main import main
from msmpetsc.errors import InputError
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import examine
from msmpetsc.lattice.probes import probe_points
from msmpetsc.scene.schema import Probe

LEFT = {"box": [[-1, -1, -1], [1e-3, 1, 1]]}
ONCE = {"step": 0.01, "duration": 0.01}


def block(
    sides: np.ndarray = SIDES, low: float = 0.0
) -> tuple[trimesh.Trimesh, dict[str, np.ndarray]]:
    """Return a block and its faces by name: two at its ends along x, and all."""
    box = trimesh.creation.box(bounds=[[low, 0, 0], [low + sides[0], *sides[1:]]])
    along = box.face_normals[:, 0]
    return box, {"left": along < -0.5, "right": along > 0.5, "side": np.abs(along) < 0.5}


def write_ply(path: Path, mesh: trimesh.Trimesh, names: dict[str, np.ndarray]) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(mesh.vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\n"
    head += "property uchar red\nproperty int label\nend_header\n"
    label = np.sum([number * own for number, own in enumerate(names.values())], axis=0)
    rows = [f"{x} {y} {z}" for x, y, z in mesh.vertices]
    rows += [
        f"3 {a} {b} {c} 255 {number}" for (a, b, c), number in zip(mesh.faces, label, strict=True)
    ]
    path.write_text(head + "\n".join(rows) + "\n")


def write_glb(path: Path, mesh: trimesh.Trimesh, names: dict[str, np.ndarray]) -> None:
    """Write a glTF file in which the ends are children of the side's node, and move with it."""
    scene = trimesh.Scene()
    moved = trimesh.transformations.translation_matrix([1, 2, 3])
    parts = {name: mesh.submesh([np.flatnonzero(own)], append=True) for name, own in names.items()}
    for part in parts.values():
        part.apply_translation([-1, -2, -3])
    scene.add_geometry(parts["side"], node_name="side", transform=moved)
    scene.add_geometry(parts["left"], node_name="left", parent_node_name="side")
    scene.add_geometry(parts["right"], node_name="right", parent_node_name="side")
    scene.export(path)


def write_vtu(path: Path, mesh: trimesh.Trimesh, names: dict[str, np.ndarray]) -> None:
    label = np.sum([number * own for number, own in enumerate(names.values())], axis=0)
    meshio.Mesh(mesh.vertices, [("triangle", mesh.faces)], cell_data={"region": [label]}).write(
        path
    )


WRITERS = {"obj": write_obj, "ply": write_ply, "glb": write_glb, "vtu": write_vtu}
NAMES = {"obj": ["left", "paint of left"], "ply": [0, "0"], "glb": ["left"], "vtu": [0]}


def grouped(
    folder: Path, sides: np.ndarray = SIDES, end: str = "obj", mesh: dict | None = None, **tables
) -> Path:
    """Write the scene of a block whose mesh names its ends."""
    WRITERS[end](folder / f"block.{end}", *block(sides))
    return block_scene(
        folder, sides, mesh={"source": f"block.{end}"} | (mesh or {}), time=ONCE, **tables
    )


@pytest.mark.parametrize(("end", "name"), [(end, name) for end in WRITERS for name in NAMES[end]])
def test_a_group_is_where_its_triangles_are(end: str, name: str | int, tmp_path: Path):
    """A face in a plane of the grid selects the nodes in it, as a box around it does."""
    of_box = model_of(block_scene(tmp_path, name="box", time=ONCE, pin=[{"region": LEFT}])).lattice
    lattice = model_of(grouped(tmp_path, end=end, pin=[{"region": {"group": name}}])).lattice
    assert np.array_equal(lattice.pinned, of_box.pinned) and np.array_equal(
        lattice.nodes, of_box.nodes
    )


def test_nodes_of_a_group_are_those_nearest_to_its_points(tmp_path: Path):
    """Askew in the grid, each point of the triangles selects only the node nearest to it."""
    turn = {
        "prepare": [{"rotate": {"axis": [1.0, 2.0, 3.0], "degrees": 50.0}}],
        "base": [0.3, 0.1, 0.2],
    }
    model = model_of(grouped(tmp_path, mesh=turn, pin=[{"region": {"group": "left"}}]))
    lattice, surface = model.lattice, model.bodies[0].surface
    group = surface.groups["left"]
    corners = group.points[group.triangles]
    a, b = np.meshgrid(np.linspace(0, 1, 200), np.linspace(0, 1, 200))
    weights = np.array([(1 - a) * (1 - b), (1 - a) * b, a])[..., None, None]
    points = (weights * corners.swapaxes(0, 1)[:, None, None]).sum(axis=0).reshape(-1, 3)
    nearest = np.unique(np.rint((points - lattice.nodes[0]) / CELL), axis=0)
    pinned = np.rint((lattice.nodes[lattice.pinned] - lattice.nodes[0]) / CELL)
    assert {*map(tuple, nearest)} == {*map(tuple, pinned)} and len(pinned) > 10


def test_a_group_smaller_than_a_cell_has_a_node(tmp_path: Path):
    mesh, _ = block()
    fine = mesh.subdivide_to_size(CELL / 4)
    tip = np.arange(len(fine.faces)) == 7
    write_obj(tmp_path / "fine.obj", fine, {"tip": tip, "rest": ~tip})
    scene = block_scene(
        tmp_path, mesh={"source": "fine.obj"}, time=ONCE, pin=[{"region": {"group": "tip"}}]
    )
    assert model_of(scene).lattice.pinned.sum() >= 1


STEPS = ["merge", "largest_part", "orient", "union", "repair", {"refine": 0.1}, {"simplify": 30}]


@pytest.mark.parametrize("step", STEPS, ids=str)
def test_a_group_stays_where_it_is_whatever_prepares_the_mesh(step, tmp_path: Path):
    if step == "repair":
        pytest.importorskip("pymeshfix")
    here = {"size": 1.0, "base": [1.0, 2.0, 3.0]}
    plain, prepared = (
        model_of(
            grouped(tmp_path, mesh=here | {"prepare": steps}, pin=[{"region": {"group": "left"}}])
        )
        for steps in ([], [{"refine": 0.2}, step])
    )
    assert np.array_equal(prepared.lattice.pinned, plain.lattice.pinned)
    assert np.ptp(prepared.bodies[0].surface.groups["left"].points[:, 0]) == 0


def test_a_group_turns_with_the_mesh(tmp_path: Path):
    turn = {"prepare": [{"rotate": {"axis": [0.0, 0.0, 1.0], "degrees": 90.0}}]}
    group = model_of(grouped(tmp_path, mesh=turn)).bodies[0].surface.groups["right"]
    assert np.allclose(group.points[:, 1], SIDES[0])


def test_a_closed_group_is_all_that_it_encloses(tmp_path: Path):
    """Two blocks in a file, each its own part and half of the body."""
    halves = {
        name: block(SIDES / [2, 1, 1], low)[0] for name, low in (("near", 0), ("far", 2 * CELL))
    }
    write_parts(tmp_path / "two.obj", halves)
    part = {"region": {"group": "far"}, "density": 3000.0}
    scene = block_scene(
        tmp_path, mesh={"source": "two.obj", "prepare": ["union"]}, time=ONCE, part=[part]
    )
    lattice = model_of(scene).lattice
    assert lattice.mass.sum() >= 2000 * SIDES.prod()
    assert lattice.mass[lattice.nodes[:, 0] > 3 * CELL].sum() == pytest.approx(
        0.5 * 3000 * CELL * SIDES[1] * SIDES[2]
    )
    inner = model_of(scene, 'pin=[{region={group="far"}}]').lattice
    assert (
        inner.pinned[inner.nodes[:, 0] >= 2 * CELL].all()
        and not inner.pinned[inner.nodes[:, 0] < CELL].any()
    )


def test_a_part_of_an_open_group_is_the_cells_that_it_cuts(tmp_path: Path):
    part = {"region": {"group": "left"}, "young_modulus": 5 * YOUNG, "density": 3000.0}
    lattice = model_of(grouped(tmp_path, part=[part])).lattice
    layer = CELL * SIDES[1] * SIDES[2]
    assert lattice.mass.sum() == pytest.approx(1000 * SIDES.prod() + 2000 * layer)


def test_groups_of_several_bodies(tmp_path: Path):
    """A scene's table means the group of every body that has it, a body's table its own group."""
    write_obj(tmp_path / "block.obj", *block())
    far, plain = {"source": "block.obj", "base": [3.0, 0, 0]}, tmp_path / "plain.stl"
    block()[0].export(plain)
    bodies = [{"mesh": {"source": "block.obj"}}, {"mesh": {"source": plain.name}}, {"mesh": far}]
    scene = block_scene(tmp_path, time=ONCE, body=bodies)
    text = scene.read_text().replace('[mesh]\nsource = "scene.ply"\n', "")
    scene.write_text(text)
    pin = 'pin=[{region={group="left"}}]'
    for key, pinned in ((pin, {0, 2}), (f"body.2.{pin}", {2})):
        lattice = model_of(scene, key).lattice
        assert set(lattice.body[lattice.pinned]) == pinned
    with pytest.raises(
        InputError, match=r"body.1.pin.0.region.group: .* no group 'left': it names none"
    ):
        model_of(scene, f"body.1.{pin}")


def test_a_name_that_the_mesh_does_not_have_is_told_with_the_nearest(tmp_path: Path):
    scene = grouped(tmp_path, pin=[{"region": {"group": "lift"}}])
    with pytest.raises(InputError) as refused:
        model_of(scene)
    assert "pin.0.region.group: the mesh has no group 'lift', did you mean 'left'?: it has " in str(
        refused.value
    )
    assert all(
        name in str(refused.value) for name in ("left", "right", "side", "block", "paint of side")
    )
    with pytest.raises(InputError, match=r"pin.0.region.relative: has no meaning for a group"):
        model_of(scene, "pin.0.region.relative=true")
    with pytest.raises(InputError, match="must give exactly one of"):
        model_of(scene, "pin.0.region.painted=[1]")


def test_a_probe_of_a_group_is_at_its_middle(tmp_path: Path):
    model = model_of(grouped(tmp_path))
    probe = Probe.model_validate({"name": "end", "group": "right"})
    assert np.allclose(
        probe_points(model.bodies, [probe]), [[SIDES[0], SIDES[1] / 2, SIDES[2] / 2]]
    )
    with pytest.raises(InputError, match=r"output.probe.0.group: the mesh has no group 'x'"):
        probe_points(model.bodies, [Probe.model_validate({"name": "end", "group": "x"})])


def test_pins_forces_anchors_and_probes_take_groups_on_any_ranks(tmp_path: Path, msmpetsc):
    anchored = {"region": {"group": "right"}, "path": [{"time": 0.01, "by": [0.01, 0.0, 0.0]}]}
    pull = {"region": {"group": "side"}, "total": [0.0, 1.0, 0.0]}
    output = {"surface": False, "probe": [{"name": "end", "group": "right"}]}
    scene = grouped(
        tmp_path,
        pin=[{"region": {"group": "left"}}],
        anchor=[anchored],
        force=[pull],
        output=output,
    )
    for ranks in (1, 3):
        run(ranks, "-m", "msmpetsc", "run", scene, "-o", tmp_path / f"{ranks}.h5", status=0)
    with h5py.File(tmp_path / "1.h5") as one, h5py.File(tmp_path / "3.h5") as three:
        assert np.array_equal(one["lattice/pinned"], three["lattice/pinned"])
        np.testing.assert_allclose(one["frames/position"], three["frames/position"], atol=1e-9)
        end = [SIDES[0] + 0.01, SIDES[1] / 2, SIDES[2] / 2]
        np.testing.assert_allclose(one["frames/probe"][-1, 0], end, atol=1e-3)
    refused = msmpetsc(2, "run", scene, "-o", tmp_path / "x.h5", "--set", "pin.0.region.group=lift")
    assert (
        refused.returncode == 2 and refused.stderr.count("msmpetsc: error: pin.0.region.group") == 1
    )


def test_inspect_lists_groups(tmp_path: Path, capsys):
    assert main(["inspect", str(grouped(tmp_path))]) == 0
    said = capsys.readouterr().out
    assert (
        "groups of block.obj: " in said
        and "left (2 triangles)" in said
        and "block (12 triangles)" in said
    )


def test_labels_of_a_binary_ply_are_groups(tmp_path: Path):
    mesh, names = block()
    mesh.face_attributes = {
        "label": np.where(names["left"], 7, -1).astype("i4"),
        "of": np.arange(12, dtype="i4"),
    }
    mesh.export(tmp_path / "x.ply")
    groups = read_surface(tmp_path / "x.ply").groups
    assert {"label:7", "label:-1", "of:0", "of:11"} < groups.keys() and len(groups) == 14
    assert examine(groups["label:7"]).area == pytest.approx(SIDES[1] * SIDES[2])


def test_a_glb_node_has_what_hangs_at_it(tmp_path: Path):
    write_glb(tmp_path / "x.glb", *block())
    surface = read_surface(tmp_path / "x.glb")
    assert examine(surface.groups["side"]).closed and examine(surface).volume == pytest.approx(
        SIDES.prod()
    )

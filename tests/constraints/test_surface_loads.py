"""Tractions and pressures on the surface: resultants, closed forms, energy, ranks, bad input."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, EPS, SIDES, block_scene, half_space, model_of, play, roller, solid_of
from obj_files import write_obj
from one_process import command_error

from msmpetsc.elasticity.pressure import Pressures

YOUNG, NU = 1e5, 0.3
SOLID = solid_of(YOUNG, NU)
STATIC = {"integrator": "static"}
ALL = {"box": [[0, 0, 0], [1, 1, 1]], "relative": True}
END = half_space(0, 1 - EPS, 1)
VOLUME = SIDES.prod()
CORNER = [roller(0), roller(1), roller(2)]


def test_a_traction_has_resultant_moment_and_stretch_of_a_bar(tmp_path: Path):
    """A bar of 1 x 0.25 x 0.25 m is pulled by 1e-3 of Young's modulus."""
    pull = np.array([100.0, 0, 0])
    scene = block_scene(
        tmp_path, np.array([1.0, 0.25, 0.25]), material=SOLID, time=STATIC, pin=CORNER,
        traction=[{"region": END, "value": pull.tolist()}], cages={"cell_size": 1 / 16},
    )  # fmt: skip
    model, frames = play(scene)
    share, rest, end = model.loads[-1].share, model.lattice.nodes, frames[-1]
    assert share.sum() == pytest.approx(1 / 16, rel=1e-12)
    np.testing.assert_allclose(share[:, 0] @ rest, np.array([1, 1 / 8, 1 / 8]) / 16, rtol=1e-12)
    np.testing.assert_allclose(end.surface_load, [pull / 16], rtol=1e-12)
    np.testing.assert_allclose(end.reaction.sum(axis=0), -pull / 16, atol=1e-7)
    moved = (end.position - rest)[:, 0]
    strain = pull[0] / YOUNG
    middle = np.isclose(rest[:, 0], 0.5)
    # The law is softer than Hooke's by an amount of the order of the strain.
    assert moved[middle].mean() == pytest.approx(0.5 * strain, rel=2e-3)
    assert moved @ share[:, 0] * 16 == pytest.approx(strain, rel=2e-3)


def pressed_block(folder: Path, **tables) -> Path:
    return block_scene(
        folder, material=SOLID,
        **{"time": {"step": 0.01, "duration": 0.03}, "pressure": [{"region": ALL, "value": 3e3}]}
        | tables,
    )  # fmt: skip


def test_a_load_is_the_same_wherever_the_body_lies(tmp_path: Path):
    """Edges of exactly half a cell are never halved, whatever their rounding."""
    shares = []
    for x in (0.25, 0.1, 0.3, 5.3):
        place = {"source": "scene.ply", "base": [x, x, x]}
        moved = block_scene(
            tmp_path, material=SOLID, mesh=place, time=STATIC, pin=[{"region": ALL, "fix": ["x"]}],
            traction=[{"region": ALL, "value": [0, 1, 0]}],
        )  # fmt: skip
        shares.append(model_of(moved).loads[-1].share)
    np.testing.assert_allclose(shares, shares[:1] * 4, rtol=1e-9)


def test_a_closed_pressure_has_the_potential_p_times_volume(tmp_path: Path):
    model = model_of(pressed_block(tmp_path))
    (part,), rest = model.lattice.pressed, model.lattice.nodes
    law, rng = Pressures([part], [3e3]), np.random.default_rng(1)
    base, q = (rest + 0.02 * rng.standard_normal(rest.shape) for _ in range(2))

    def volume(at: np.ndarray) -> float:
        a, b, c = part(at)
        return (np.cross(a, b) * c).sum() / 6

    assert volume(rest) == pytest.approx(VOLUME, rel=1e-12)
    change = 3e3 * (volume(q) - volume(base))
    assert law.change(q, base) == pytest.approx(change, rel=1e-11)
    gradient, before, after = np.zeros((3, *rest.shape))
    law.add_gradient(q, gradient)
    assert np.abs(gradient.sum(axis=0)).max() < 1e-12 * np.abs(gradient).max() * len(rest)
    assert (
        np.abs(np.cross(q, gradient).sum(axis=0)).max() < 1e-12 * len(rest) * np.abs(gradient).max()
    )
    way = rng.standard_normal(rest.shape)
    # V is a polynomial of degree 3, so differences along a path are exact.
    law.add_gradient(q - way, before)
    law.add_gradient(q + way, after)
    product, other = np.zeros((2, *rest.shape))
    law.hessian_at(q, False)(way, product)
    np.testing.assert_allclose(product, (after - before) / 2, atol=1e-12 * np.abs(after).max())
    law.hessian_at(q, False)(q, other)
    assert np.vdot(other, way) == pytest.approx(np.vdot(product, q), rel=1e-9)
    bound = np.zeros(len(rest))
    law.add_concavity(q, bound)
    assert np.vdot(product, way) + bound @ (way**2).sum(axis=1) > 0


def test_only_long_edges_are_halved(tmp_path: Path):
    """A capsule of 512 triangles, 32 of them long, stays closed; all cut alike would be 131,072."""
    trimesh.creation.capsule(0.6, 0.2, count=[16, 16]).export(tmp_path / "capsule.ply")
    model = model_of(pressed_block(tmp_path, mesh={"source": "capsule.ply"}))
    (part,) = model.lattice.pressed
    a, b, c = part(model.lattice.nodes)
    assert np.linalg.norm(part.rest - np.roll(part.rest, 1, axis=0), axis=2).max() <= CELL / 2
    assert np.abs(np.cross(b - a, c - a).sum(axis=0)).max() < 1e-14
    volume = trimesh.load(tmp_path / "capsule.ply").volume
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(volume, rel=1e-12)
    assert len(a) < 8000


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_a_free_body_under_pressure_stays_and_keeps_its_energy(tmp_path: Path, integrator: str):
    """The body oscillates in volume: its momentum is zero, and its total energy does not grow."""
    step = 5e-5 if integrator == "verlet" else 1e-3
    time = {"step": step, "duration": 20 * step, "integrator": integrator}
    _, frames = play(pressed_block(tmp_path, time=time, solver={"error": 1e-8}))
    total = np.array([f.kinetic + f.elastic + f.potential for f in frames])
    pressed = max(abs(f.potential) for f in frames)
    assert pressed > 1e-3
    assert max(np.abs(f.momentum).max() for f in frames) < 1e-9
    assert max(np.abs(f.load).max() for f in frames) < 1e-8
    assert (np.diff(total) < 2e-3 * pressed).all()
    if integrator == "verlet":
        assert np.abs(total).max() < 2e-2 * pressed
    assert sum(f.energy_gained for f in frames) < 2e-3 * pressed


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_a_step_takes_the_mean_of_a_pressure(tmp_path: Path, integrator: str):
    """A ramp from 0 to 6e3 Pa in the last half of a step acts as a constant quarter of 6e3 Pa."""
    time = {"step": 0.01, "duration": 0.01, "integrator": integrator}
    ramp = {"value": {"times": [0.005, 0.01], "values": [0, 6e3]}, "start": 0.005}
    (_, ramped), (_, constant) = (
        play(pressed_block(tmp_path, time=time, pressure=[{"region": ALL} | load]))
        for load in (ramp, {"value": 1.5e3})
    )
    size = np.abs(constant[-1].position - constant[0].position).max()
    np.testing.assert_allclose(ramped[-1].position, constant[-1].position, atol=1e-7 * size)
    assert size > 1e-4


def test_a_half_takes_the_pressure_of_the_whole(tmp_path: Path):
    """The edge of the half's open surface may move in the plane of symmetry y = 0.25."""
    tables = {"material": SOLID, "time": STATIC, "solver": {"error": 1e-8}}
    half = SIDES * [1, 0.5, 1]
    clamp = {"region": roller(0)["region"]}
    value = {"times": [0, 1], "values": [0, 4e3]}
    tables["time"] = STATIC | {"step": 0.5, "duration": 1.0}
    (model, frames), (of_half, ends) = (
        play(
            block_scene(
                tmp_path, sides, name, **tables, pin=pins,
                pressure=[{"region": {"box": [[-1, -1, -1], [1, top, 1]]}, "value": value}],
            )
        )
        for sides, name, pins, top in (
            (SIDES, "whole", [clamp], 1), (half, "half", [clamp, roller(1, 0.25 - EPS, 1)], 0.24)
        )
    )  # fmt: skip
    rest = model.lattice.nodes
    twins = np.linalg.norm(of_half.lattice.nodes[:, None] - rest, axis=2).argmin(axis=1)
    size = np.abs(frames[-1].position - rest).max()
    # The meshes have different diagonals, and quadrature is as fine as half a cell.
    assert np.abs(frames[-1].position[twins] - ends[-1].position).max() < 0.08 * size
    (force,), (plane,) = ends[-1].surface_load, ends[-1].reaction[1:]
    assert force[1] == pytest.approx(4e3 * 0.125, rel=0.1)
    np.testing.assert_allclose(force + ends[-1].reaction.sum(axis=0), 0, atol=1e-4)
    assert plane[1] < -300 and (plane[[0, 2]] == 0).all()


@pytest.mark.parametrize(
    ("kind", "table", "message"),
    [
        ("pressure", {"region": END, "value": 1.0}, "pressure.0.region: the surface in it is open"),
        (
            "traction",
            {"region": {"sphere": {"center": [0.2, 0.2, 0.1], "radius": 0.01}}, "value": [1, 0, 0]},
            "traction.0.region holds the centre of no triangle of the surface: the body is",
        ),
        (
            "pressure",
            {"region": {"painted": [0]}, "value": 1.0},
            "pressure.0.region: must be a box, sphere, half_space or group",
        ),
        ("pressure", {"region": ALL, "value": "1"}, "pressure.0.value: must be a valid number"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, kind: str, table: dict, message: str):
    region = table["region"] | (
        {}
        if "half_space" not in table["region"]
        else {"half_space": {"point": [0.49, 0, 0], "normal": [1, 0, 0]}}
    )
    scene = block_scene(
        tmp_path, material=SOLID, time={"step": 0.01, "duration": 0.01},
        **{kind: [table | {"region": region}]},
    )  # fmt: skip
    assert message in command_error("run", scene)


def test_a_group_has_its_own_triangles(tmp_path: Path):
    """The named group of an OBJ file is the end of a block."""
    box = trimesh.creation.box(bounds=[[0, 0, 0], SIDES])
    is_end = np.isclose(box.triangles_center[:, 0], SIDES[0])
    write_obj(tmp_path / "grouped.obj", box, {"rest": ~is_end, "end": is_end})
    scene = block_scene(
        tmp_path, mesh={"source": "grouped.obj"}, material=SOLID, pin=CORNER, time=STATIC,
        traction=[{"region": {"group": "end"}, "value": [10, 0, 0]}],
    )  # fmt: skip
    model, frames = play(scene)
    np.testing.assert_allclose(frames[-1].surface_load, [[10 * 0.125, 0, 0]], rtol=1e-12)
    ends = model.lattice.nodes[model.loads[-1].share[:, 0] > 1e-12]
    assert (ends[:, 0] == SIDES[0]).all()
    message = "traction.0.region.group: the mesh has no group 'and'"
    assert message in command_error("run", scene, "--set", 'traction.0.region.group="and"')
    # a part that mesh.prepare removes
    with (tmp_path / "grouped.obj").open("a") as file:
        file.write("v 3 3 3\nv 3.1 3 3\nv 3 3.1 3\ng away\nf 9 10 11\n")
    prepared = 'mesh.prepare=["largest_part"]', 'traction.0.region.group="away"'
    said = command_error("run", scene, "--set", prepared[0], "--set", prepared[1])
    assert "traction.0.region: its triangles leave the cells" in said

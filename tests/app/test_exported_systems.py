"""Exported linear systems equal the systems of the steps, on any number of ranks."""

# ruff: noqa: F811 (fixtures are imported)
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from block_scene import (
    CLAMP,
    EPS,
    GROUND,
    ROUGH_GROUND,
    block_scene,
    clamped_beam,
    half_space,
    loop_of,
    model_of,
    roller,
    solid_of,
)
from conftest import ROOT, python, run
from one_process import command_error
from petsc4py import PETSc
from pinch import pinch_scene
from scipy.sparse import csr_array
from scipy.sparse.linalg import spsolve
from study_files import own_log  # noqa: F401 (a fixture)

import msmpetsc
from msmpetsc.solve.linear.assembled_hessian import assembled, blocks_of

SOLID = solid_of(1e5, 0.3)
SWING = {"step": 0.05, "duration": 0.15}
LINEAR = {"material": {"law": "linear", "young_modulus": 1e5, "density": 1000.0}}
# [-] relative tolerance of the matrix and of CG: well above rounding, and below any
# term of the matrix
EXACT = 1e-9


def read(path: Path, *kinds: type) -> list[PETSc.Object]:
    """Return the PETSc objects in a file; remove the block-size options that PETSc then sets."""
    viewer = PETSc.Viewer().createBinary(str(path), "r", PETSc.COMM_SELF)
    found = [kind().create(PETSc.COMM_SELF).load(viewer) for kind in kinds]
    for name in ("matload_block_size", "vecload_block_size"):
        PETSc.Options().delValue(name)
    return found


def vectors(path: Path, count: int) -> np.ndarray:
    return np.array([each.array for each in read(path, *[PETSc.Vec] * count)])


def vector(folder: Path, name: str) -> np.ndarray:
    return vectors(folder / f"{name}.bin", 1)[0]


def rows_of(matrix: PETSc.Mat) -> csr_array:
    return csr_array(matrix.getValuesCSR()[::-1])


def matrix(path: Path) -> csr_array:
    return rows_of(*read(path, PETSc.Mat))


@pytest.mark.parametrize("law", ["neo-hookean", "linear"])
def test_a_system_solves_to_the_steps_own_correction(tmp_path: Path, law: str):
    """With a budget of a single iteration the step ends at x - y, which gives the solution y."""
    material = SOLID if law == "neo-hookean" else LINEAR["material"]
    path = clamped_beam(tmp_path, material=material, time=SWING, solver={"max_iterations": 1})
    result = msmpetsc.run(
        path, tmp_path / "x.h5", export=tmp_path, export_steps="2", quiet=True,
        petsc_options="-ksp_rtol 1e-12",
    )  # fmt: skip
    folder = tmp_path / "step_2"
    assert [each.name for each in tmp_path.glob("step_*")] == ["step_2"]
    hessian, right = matrix(folder / "hessian.bin"), vector(folder, "residual")
    y = spsolve(hessian.tocsc(), right)
    with h5py.File(result) as file:
        position = file["frames/position"][2]
        free = ~model_of(path).lattice.pinned
    began = vector(folder, "coordinates")
    moved = np.abs(y).max()
    assert moved > 1e-3, "a step that hardly moves tests nothing"
    np.testing.assert_allclose(began - y, position[free].ravel(), rtol=0, atol=EXACT * moved)
    np.testing.assert_allclose(vector(folder, "correction"), y, rtol=0, atol=EXACT * moved)
    facts = json.loads((folder / "system.json").read_text())
    assert (facts["step"], 3 * facts["nodes"]) == (2, len(y))
    assert facts["nonzeros"] == hessian.nnz and facts["multigrid"]["status"] == "ok"


VISCOUS = {"material": SOLID | {"retardation_time": 0.01}}
PRESSED = {"gravity": {"acceleration": [1.0, 0, -20.0]}, "obstacle": [ROUGH_GROUND]}
TOUCHES = {"self_contact": {"friction": 0.3}}
STATIC = {"time": {"step": 1.0, "duration": 1.0, "integrator": "static"}}


LOW = {"region": {"box": [[0, 0, 0], [1, 1, 0.15]], "relative": True}}
ARMS = {"region": {"box": [[0, 0, 0.3], [1, 1, 1]], "relative": True}, "fix": ["y"]}
# rollers on the sides of a block whose top is open: the edge of the top stays in the
# sides
SIDES = [roller(axis, 0.5 - EPS, 1) for axis in (0, 1)]
ROLLERS = {"pin": [*map(roller, range(3)), *SIDES]}
TOP = half_space(2, 0.24, 1)
SQUEEZED = {"material": SOLID, "pressure": [{"region": TOP, "value": 3e4}]}
BLOWN = {"material": SOLID, "pressure": [{"region": {"box": [[-1] * 3, [1] * 3]}, "value": 1e4}]}


@pytest.mark.parametrize(
    ("tables", "bodies"),
    [
        (VISCOUS | {"time": SWING | {"integrator": "bdf2"}}, clamped_beam),
        (LINEAR | PRESSED | {"time": {"step": 0.01, "duration": 0.05}}, block_scene),
        (TOUCHES | {"time": {"step": 0.02, "duration": 0.3}}, pinch_scene),
        (TOUCHES | {"time": {"step": 0.02, "duration": 0.3}, "pin": [LOW, ARMS]}, pinch_scene),
        (STATIC, clamped_beam),
        (STATIC | ROLLERS | SQUEEZED, block_scene),
        (BLOWN | {"time": {"step": 0.01, "duration": 0.03}}, clamped_beam),
    ],
    ids=["viscous", "friction", "self-contact", "held-self-contact", "static", "rollers", "blown"],
)
def test_the_matrix_multiplies_as_the_products_do(tmp_path: Path, tables: dict, bodies):
    """The matrix has all terms: viscosity, friction, self-contact, rollers, pressure."""
    checked = []

    def check(step, now, jacobian):
        hessian = jacobian.hessian
        whole = assembled(jacobian.unknowns, blocks_of(hessian))
        x, y = now.x.duplicate(), now.x.duplicate()
        x.array[:] = np.random.default_rng(step).normal(size=x.size)
        jacobian.unknowns.project(x)
        jacobian.operator.mult(x, y)
        by_node, product = whole.createVecs()
        by_node.array[:] = jacobian.unknowns.columns(x).T.ravel()
        whole.mult(by_node, product)
        found = product.array.reshape(-1, 3).T
        expected = jacobian.unknowns.columns(y)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        checked.append((bool(hessian.contact and hessian.contact.parts), bool(hessian.surface)))

    with loop_of(bodies(tmp_path, **tables), system_monitor=check) as loop:
        for _ in loop.frames():
            pass
    assert checked
    if "obstacle" in tables:
        assert any(contact for contact, _ in checked)
    if "self_contact" in tables:
        assert any(surface for _, surface in checked)


def test_rigid_modes_are_those_of_the_free_body(tmp_path: Path):
    """A body that falls freely has H v = M v for a rigid mode v, because E resists none."""
    # this force hardly strains the body, but the step has a system to solve
    force = [{"region": {"box": [[-1, -1, -1], [0.1, 1, 1]]}, "total": [1e-6, 0, 0]}]
    path = block_scene(tmp_path, material=SOLID, time=SWING, force=force)
    msmpetsc.run(path, tmp_path / "x.h5", frames=1, export=tmp_path, quiet=True)
    folder = tmp_path / "step_1"
    hessian = matrix(folder / "hessian.bin")
    mass = np.repeat(model_of(path).lattice.mass, 3)
    modes = vectors(folder / "rigid_modes.bin", 6)
    np.testing.assert_allclose(modes @ modes.T, np.eye(6), atol=1e-12)
    stiff = np.abs(hessian.diagonal()).max()
    np.testing.assert_allclose(hessian @ modes.T, (mass * modes).T, rtol=0, atol=1e-10 * stiff)


@pytest.mark.parametrize("loads", [{}, BLOWN], ids=["weight", "pressure"])
def test_ranks_write_the_same_system(tmp_path: Path, loads: dict):
    """Two ranks write the system of a serial run; the body has an end on rollers."""
    # these short steps start from free fall on any number of ranks
    short = {"material": SOLID, "time": {"step": 0.01, "duration": 0.01}} | loads
    path = clamped_beam(tmp_path, pin=[CLAMP, roller(0, 1 - EPS, 1)], **short)
    for ranks in (1, 2):
        words = ["--export", tmp_path / str(ranks), "--frames", 1, "--quiet"]
        run(ranks, "-m", "msmpetsc.cli.main", "run", path, "-o", tmp_path / f"{ranks}.h5", *words,
            status=0)  # fmt: skip
    one, two = (tmp_path / str(ranks) / "step_1" for ranks in (1, 2))
    hessian = matrix(one / "hessian.bin")
    largest = np.abs(hessian.data).max()
    assert np.abs((matrix(two / "hessian.bin") - hessian).toarray()).max() < 1e-12 * largest
    for name in ("residual", "correction"):
        expected = vector(one, name)
        atol = EXACT * np.abs(expected).max()
        np.testing.assert_allclose(vector(two, name), expected, rtol=0, atol=atol)
    solvers = ["-pc_type jacobi -ksp_max_it 1", "-pc_type gamg"]
    script, table = ROOT / "scripts/solve_systems.py", tmp_path / "table"
    done = python(script, one, "--options", *solvers, "-o", table)
    ours, short, gamg, report = done.stdout.splitlines()
    assert "our multigrid" in ours and Path(report).is_file(), done.stderr
    # Options of a solver do not reach the next solver
    assert [line.split()[3] for line in (ours, short, gamg)] == ["ok", "failed", "ok"]
    assert float(gamg.split()[4]) < 1e-6


def test_a_held_component_has_its_diagonal_alone(tmp_path: Path):
    """The diagonal of held components makes the solution of a body on rollers unique."""
    path = block_scene(tmp_path, **STATIC, **ROLLERS, **SQUEEZED)
    result = msmpetsc.run(path, tmp_path / "x.h5", export=tmp_path, quiet=True)
    folder = tmp_path / "step_1"
    hessian, right = matrix(folder / "hessian.bin"), vector(folder, "residual")
    with h5py.File(result) as file:
        lattice = model_of(path).lattice
        begun = file["frames/position"][0]
    free = ~lattice.pinned
    held = lattice.fixed[free].ravel()
    assert held.any() and not held.all()
    np.testing.assert_allclose(vector(folder, "coordinates"), begun[free].ravel(), atol=1e-12)
    rows, diagonal = hessian.toarray(), hessian.diagonal()
    assert np.all(diagonal[held] > 0) and np.all(right[held] == 0)
    rest = rows - np.diag(diagonal)
    assert not rest[held].any() and not rest[:, held].any()
    y = spsolve(hessian.tocsc(), right)
    atol = EXACT * np.abs(y).max()
    np.testing.assert_allclose(vector(folder, "correction"), y, rtol=0, atol=atol)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--export", "y", "--export-steps", "0"], "numbers like 1,5,20, not '0'"),
        (["--export", "y", "--export-steps", "4"], "the last step of the run is 3"),
        (["--export-steps", "4"], "--export DIR, which is missing"),
        (["--export", "y", "--preset", "anderson"], "newton's presets; anderson solves none"),
        (["--export", "y", "--set", "time.integrator=verlet"], "verlet solves none"),
        (["--export", "scene.ply/y"], "scene.ply/y cannot be written"),
    ],
)
def test_an_export_that_cannot_be_is_one_line(
    tmp_path: Path, monkeypatch, own_log, words: list[str], said: str
):
    path = block_scene(tmp_path, time=SWING, obstacle=[GROUND])
    monkeypatch.chdir(tmp_path)
    assert said in command_error("run", path, "-o", "x.h5", *words)
    assert not Path("x.h5").exists()


@pytest.mark.parametrize("integrator", ["implicit-euler", "static"])
def test_an_export_changes_no_frame_and_no_count(tmp_path: Path, integrator: str):
    path = clamped_beam(tmp_path, material=SOLID, time=SWING | {"integrator": integrator})
    exports = {"export": tmp_path / "y", "export_steps": "1,3"}
    results = [
        msmpetsc.run(path, tmp_path / f"{n}.h5", quiet=True, **given)
        for n, given in enumerate(({}, exports if integrator != "static" else {"export": tmp_path}))
    ]
    with h5py.File(results[0]) as plain, h5py.File(results[1]) as exported:
        for name in ("position", "iterations", "ksp_its", "products"):
            expected = plain["frames"][name][:]
            np.testing.assert_array_equal(exported["frames"][name][:], expected, name)
            assert expected.any()


def test_a_resumed_run_exports_the_steps_that_are_left(tmp_path: Path, caplog):
    """The run resumes from the checkpoint of step 20."""
    path = clamped_beam(tmp_path, material=SOLID, time={"step": 0.05, "duration": 1.05})
    first = msmpetsc.run(path, tmp_path / "x.h5", frames=20, checkpoint_every=20, quiet=True)
    longer = {"set": {"time.duration": 1.05}, "force": True}
    msmpetsc.run(resume=first, export=tmp_path / "y", export_steps="1,21", **longer)
    assert [each.name for each in (tmp_path / "y").iterdir()] == ["step_21"]
    assert "no linear system was solved in step 1" in caplog.text

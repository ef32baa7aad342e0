"""Iterations of CG with multigrid, to newton's tolerance, for solids at rest by Poisson's ratio.

The bodies are whole cells, and scans that the grid cuts. With -s it prints the table of
scripts/results/multigrid.md.
"""

import os
from pathlib import Path

import pytest
import trimesh
from hierarchies import COMM, SHAPES, hierarchy

import msmpetsc
from msmpetsc.build import build_model
from msmpetsc.errors import InputError

# needs manifold3d
study = pytest.importorskip("solid_runs")

# -ksp_rtol of newton's presets
TOLERANCE = 3e-2
# time step [s] so long that inertia is negligible
STATIC = 1e3
# Poisson's ratios; None for springs
POISSON = (None, 0.25, 0.45, 0.49, 0.499)
# most iterations at each Poisson's ratio
WHOLE, CUT = (4, 4, 4, 8, 16), (3, 3, 5, 8, 22)
WANTED = {"beam": WHOLE, "long beam": WHOLE, "bunny": CUT, "rod": CUT}


def body(name: str) -> tuple[trimesh.Trimesh, dict]:
    """Return the surface of a body that the plane z = 0 cuts, and its cells."""
    if name == "bunny":
        try:
            return study.bunny(), {"count": 10_000}
        except InputError as missing:
            pytest.skip(str(missing))
    if name == "rod":
        path = Path(os.environ.get("MSMPETSC_SOLID", "")) / "rod_cut.ply"
        return trimesh.load(path, process=False) if path.exists() else pytest.skip(f"no {path}"), {
            "count": 10_000
        }
    return study.box(1, 1, 8 if name == "beam" else 30), {"cell_size": 1 / 8}


@pytest.mark.parametrize("name", WANTED)
def test_iterations_of_solids_at_rest(name: str, tmp_path: Path):
    mesh, cages = body(name)
    mesh.export(tmp_path / "body.obj", digits=17)
    tables = {
        "mesh": {"source": str(tmp_path / "body.obj")},
        "cages": cages,
        "pin": [study.held(2, 0, -1)],
    }
    found = []
    for poisson in POISSON:
        law = {"law": "neo-hookean", "poisson_ratio": poisson} if poisson else {"law": "linear"}
        material = {"young_modulus": 1e9, "density": 1000} | law
        time = {"integrator": "static"}
        lattice = build_model(
            COMM, msmpetsc.Scene.of(tables | {"material": material, "time": time})
        ).lattice
        with hierarchy(COMM, lattice, SHAPES["rest"], STATIC) as case:
            found.append(case.iterations(TOLERANCE, rough=False))
    print(f"\n| {name} | {len(lattice.cells)} |", " | ".join(map(str, found)), "|")
    assert all(its <= most for its, most in zip(found, WANTED[name], strict=True)), found

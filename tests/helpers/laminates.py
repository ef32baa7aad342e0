"""Bars of layers, along the grid and askew, against quadratic finite elements in the plane.

Poisson's ratio is 0, so the plane's solution is that of the bar. Run as a script it prints the
table of errors in `scripts/results/solid.md`.
"""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
import skfem
import trimesh
from scipy.spatial.transform import Rotation
from skfem.helpers import ddot, grad, transpose
from small_strain import SPRINGS
from solid_runs import E, run

# length [m] of a bar 1 m thick between its clamp and its stiff cap, and the length of
# both ends
LENGTH, END = 8.0, 1.0
# small traction on the cap [Pa]
PULL = 1e-2


class Bar(NamedTuple):
    """A bar of layers of E and of ``ratio`` E.

    edges : heights z of the interfaces [m], or x if ``along``. The first layer has E, then layers
            alternate. Clamp and cap have ratio E.
    along : whether the layers follow each other along the bar
    """

    edges: tuple[float, ...]
    ratio: float
    bends: bool
    along: bool = False


@cache
def compliance(bar: Bar) -> float:
    """Return the work of a unit traction on the cap over its square, by finite elements [m^3/N]."""
    ends = [0.0, *bar.edges, LENGTH if bar.along else 1.0]
    places = np.unique(np.concatenate([np.linspace(*pair, 7) for pair in pairwise(ends)]))
    fine = LENGTH * (1 - np.cos(np.linspace(0, np.pi, 121))) / 2
    cap = LENGTH + np.linspace(0, END, 9)[1:]
    x = np.concatenate([places if bar.along else fine, cap])
    mesh = skfem.MeshQuad.init_tensor(x, np.linspace(0, 1, 7) if bar.along else places)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=4)
    middle = mesh.p[:, mesh.t].mean(axis=1)
    layer = np.searchsorted(bar.edges, middle[0 if bar.along else 1])
    young = E * np.where((layer % 2 == 1) | (middle[0] > LENGTH), bar.ratio, 1.0)

    @skfem.BilinearForm
    def energy(u, v, w):
        strain = (grad(u) + transpose(grad(u))) / 2
        return w["young"] * ddot(strain, grad(v))

    of_cells = basis.with_element(skfem.ElementQuad0()).interpolate(young)
    end = mesh.facets_satisfying(lambda x: np.isclose(x[0], LENGTH + END), boundaries_only=True)
    face = skfem.FacetBasis(mesh, basis.elem, facets=end, intorder=4)
    load = skfem.LinearForm(lambda v, _: v[1 if bar.bends else 0]).assemble(face)
    fixed = basis.get_dofs(mesh.facets_satisfying(lambda x: np.isclose(x[0], 0)))
    K = energy.assemble(basis, young=of_cells)
    return float(load @ skfem.solve(*skfem.condense(K, load, D=fixed)))


def error(bar: Bar, degrees: float, across: int, poisson: float | None = 0.0) -> float:
    """Return the relative error of the stiffness of a bar turned in the plane of its layers.

    across  : cells across the bar
    poisson : Poisson's ratio of the solid; SPRINGS for springs
    """
    turn = Rotation.from_euler("y", degrees, degrees=True)
    mesh = trimesh.creation.box(bounds=[[-END, 0, 0], [LENGTH + END, 1, 1]])
    mesh.vertices = turn.apply(mesh.vertices)

    def beyond(point: Sequence[float], normal: Sequence[float]) -> dict:
        return {"half_space": {"point": [*turn.apply(point)], "normal": [*turn.apply(normal)]}}

    axis = [1, 0, 0] if bar.along else [0, 0, 1]
    parts = [
        {"region": beyond(edge * np.array(axis), axis), "young_modulus": E * of_layer}
        for edge, of_layer in zip(bar.edges, [bar.ratio, 1.0] * len(bar.edges), strict=False)
    ]
    parts += [
        {"region": beyond([x, 0, 0], [side, 0, 0]), "young_modulus": E * bar.ratio}
        for x, side in ((0, -1), (LENGTH, 1))
    ]
    pull = PULL * np.array([0, 0, 1] if bar.bends else [1, 0, 0])
    frame = run(
        mesh,
        poisson,
        cages={"cell_size": 1 / across},
        part=parts,
        pin=[{"region": beyond([0, 0, 0], [-1, 0, 0])}],
        traction=[
            {"region": beyond([LENGTH + END - 1e-6, 0, 0], [1, 0, 0]), "value": [*turn.apply(pull)]}
        ],
    ).frames[-1]
    return compliance(bar) * PULL**2 / (2 * frame.elastic) - 1


THREE, TWO, COATS = (0.3, 0.7), (0.4,), (0.1, 0.9)
# layers across the pull: of 0.7 m each, and two soft layers of 0.1 m
ROW, GLUE = (0.7, 1.4, 2.1, 2.8, 3.5, 4.2, 4.9, 5.6, 6.3, 7.0), (2.3, 2.4, 5.4, 5.5)
BARS = {
    "three layers, bent": (THREE, True, False),
    "three layers, pulled": (THREE, False, False),
    "two layers, bent": (TWO, True, False),
    "two layers, pulled": (TWO, False, False),
    "coats of 0.1, bent": (COATS, True, False),
    "coats of 0.1, pulled": (COATS, False, False),
    "layers across the pull": (ROW, False, True),
    "glue of 0.1 across the pull": (GLUE, False, True),
}


def main() -> None:
    """Print a table: errors at 2 and 4 cells across."""
    print("| bar | ratio | law | 0 degrees | 20 | 45 |", "|---|---|---|---|---|---|", sep="\n")
    for (name, (edges, bends, along)), ratio in product(BARS.items(), (10, 100)):
        # the first layer is stiff
        inner = edges in (THREE, COATS, GLUE)
        for law, poisson in {"solid": 0.0, "springs": SPRINGS}.items():
            bar = Bar((0.0, *edges) if inner else edges, ratio, bends, along)
            cells = [
                " / ".join(f"{100 * error(bar, angle, n, poisson):+.0f}" for n in (2, 4))
                for angle in (0, 20, 45)
            ]
            print(f"| {name} | {ratio} | {law} | {' | '.join(cells)}% |", flush=True)


if __name__ == "__main__":
    main()

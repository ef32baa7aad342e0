# ruff: noqa: RUF003
# %% [markdown]
# # A beam against theory
#
# A clamped beam bends under its weight. Timoshenko's theory gives the deflection of
# its free end, so the error of the lattice is known. The tutorial takes half a minute
# on a single core and needs the extra `run`. As a script of cells it opens in Jupyter,
# VS Code or Spyder: [beam.py](beam.py).

# %%
from pathlib import Path

import numpy as np
import trimesh

import msmpetsc as msm

out = Path("out/tutorial")
out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The deflection that theory gives
#
# The beam has length L and a square section of side H. Its weight per length is ρ g
# H². Let I = H⁴ / 12, G = E / 2(1 + ν) the shear modulus and κ Cowper's shear
# coefficient. The free end then sinks by
#
#     w = ρ g H² L⁴ / (8 E I) + ρ g L² / (2 κ G)
#
# (Timoshenko and Goodier, *Theory of Elasticity*; Cowper 1966.) The second term is the
# shear, 1% of the first term.

# %%
# [m]
L, H = 1.0, 0.1
# [Pa], [-], [kg/m^3], [m/s^2]
E, nu, rho, g = 1e9, 0.25, 1000.0, 9.81
kappa = 10 * (1 + nu) / (12 + 11 * nu)
shear_modulus = E / (2 * (1 + nu))
bending = rho * g * H**2 * L**4 / (8 * E * H**4 / 12)
theory = bending + rho * g * L**2 / (2 * kappa * shear_modulus)
print(f"theory: {1e3 * theory:.3f} mm, of which {1e3 * bending:.3f} mm is bending")

# %% [markdown]
# ## The scene
#
# A box is a closed surface of 12 triangles. Its end at x = 0 is pinned, gravity acts,
# and the static state is sought. Each table is as in a scene file.

# %%
trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [L, H, H]]).export(out / "beam.obj")
tables = {
    "mesh": {"source": "beam.obj"},
    "cages": {"cell_size": H / 2},
    "material": {"young_modulus": E, "poisson_ratio": nu, "density": rho},
    "time": {"integrator": "static"},
    "gravity": {"acceleration": [0, 0, -g]},
    "pin": [{"region": {"box": [[0, 0, 0], [0.001, 1, 1]], "relative": True}}],
    "solver": {"error": 1e-6},
}
scene = msm.Scene.of(tables, folder=out)
print(scene)

# %% [markdown]
# ## Refine the cells
#
# Two, four and six cells across the section. The deflection is the mean over the nodes
# of the free end.

# %%
cells_across = (2, 4, 6)
errors = []
for count in cells_across:
    simulation = msm.Simulation(scene.changed({"cages.cell_size": H / count}))
    rest, state = simulation.frames()
    end = np.isclose(rest.position[:, 0], L)
    sinks = np.mean(rest.position[end, 2] - state.position[end, 2])
    errors.append(sinks / theory - 1)
    print(f"{count} cells across: {1e3 * sinks:.2f} mm, {100 * errors[-1]:+.2f}%")

# %% [markdown]
# It prints:
#
#     2 cells across: 1.46 mm, -1.49%
#     4 cells across: 1.47 mm, -1.19%
#     6 cells across: 1.47 mm, -1.09%
#
# Two cells across are within 2% of theory. The beam stays a little too stiff because a
# pinned section can neither shrink nor warp, unlike the section in theory. The error of
# the cells themselves is the distance between the lattices: 0.4%.

# %%
assert abs(errors[-1]) < 0.02, "six cells across should be within 2% of theory"
assert abs(errors[2] - errors[1]) < abs(errors[1] - errors[0]), "refinement should converge"

# %% [markdown]
# ## Next
#
# Change `law` to `"linear"` for springs, or `poisson_ratio` to 0.45. [Choose cells by
# an error](../how-to/cells.md) lets the program find the number of cells for a surface
# of any shape.

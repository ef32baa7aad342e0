# ruff: noqa: RUF003
# %% [markdown]
# # A beam against theory and a measurement
#
# A clamped beam bends under its weight. Timoshenko's theory gives the deflection of
# its free end, so the error of the lattice is known. A beam of silicone bends far
# beyond that theory; cameras have measured it. The tutorial takes half a minute on a
# single core and needs the extra `run`. As a script of cells it opens in Jupyter, VS
# Code or Spyder: [beam.py](beam.py).

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
# ## A measured beam
#
# Dubied and others clamped a beam of silicone and hung weights on the upper edge of
# its tip ([Sim-to-real for soft robots using differentiable
# FEM](https://arxiv.org/abs/2201.12560)). Cameras recorded how far a marker sank, up
# to a quarter of the length. The authors fitted Young's modulus to the heaviest
# weight, so the two smaller loads test the simulation. The static integrator finds an
# equilibrium at each time; the force is larger each time.

# %%
L, H = 0.1, 0.03
# [N], [mm]; the first is the mean of two runs, which differ by 1.2%
weights = [0.0, 0.51012, 1.00062]
measured = [6.68, 17.47, 27.60]
trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [L, H, H]]).export(out / "silicone.obj")
silicone = {
    "mesh": {"source": "silicone.obj"},
    "cages": {"cell_size": H / 6},
    "material": {"young_modulus": 263824.0, "poisson_ratio": 0.499, "density": 1070.0},
    "time": {"integrator": "static", "step": 1.0, "duration": 3.0},
    "gravity": {"acceleration": [0, 0, -g]},
    "pin": [{"region": {"half_space": {"point": [1e-6, 0, 0], "normal": [-1, 0, 0]}}}],
    "force": [
        {
            "region": {"box": [[0.99999 * L, -1, 0.99999 * H], [1, 1, 1]]},
            "total": {"times": [1, 2, 3], "values": [[0, 0, -weight] for weight in weights]},
        }
    ],
    "solver": {"error": 1e-5},
}
rest, *states = msm.frames(msm.Scene.of(silicone, folder=out))
marker = np.argmin(np.linalg.norm(rest.position - [L, H / 2, H], axis=1))
ratios = []
for state, weight, sunk in zip(states, weights, measured, strict=True):
    ours = 1e3 * (rest.position[marker, 2] - state.position[marker, 2])
    ratios.append(ours / sunk)
    print(f"{weight:.2f} N: {ours:.1f} mm, measured {sunk:.1f} mm, ratio {ratios[-1]:.2f}")

# %% [markdown]
# It prints:
#
#     0.00 N: 6.7 mm, measured 6.7 mm, ratio 1.00
#     0.51 N: 17.0 mm, measured 17.5 mm, ratio 0.97
#     1.00 N: 27.2 mm, measured 27.6 mm, ratio 0.99
#
# Bending of six cells across is off by (1 / 6)² = 3% at most. Twelve cells across come
# within 2% ([published
# values](../../../results/yardstick.md#against-published-values)).

# %%
assert np.abs(np.array(ratios) - 1).max() < 0.03, "six cells across should be within 3%"

# %% [markdown]
# ## Next
#
# Change the first beam's `law` to `"linear"` for springs, or its `poisson_ratio` to
# 0.45. [Choose cells by an error](../how-to/cells.md) lets the program find the number
# of cells for a surface of any shape.

# %% [markdown]
# # An organ from a scan
#
# A heart with its vessels, segmented from a scan, is pulled at its tip. The tutorial
# goes from the surface mesh to a curve of force over displacement, stresses and a
# picture. It takes half a minute on a single core and needs the extras `run` and
# `render`: [organ.py](organ.py).

# %%
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

import msmpetsc as msm

out = Path("out/tutorial")
out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The scene
#
# `heart_vessels` is a mesh that `msmpetsc fetch --list` knows; it is fetched at the
# first use. You may give the path of your own mesh instead. The mesh lies on its back,
# so `prepare` turns it. A mesh from a segmentation may need `merge`, `largest_part` or
# `repair` first ([your own mesh](../get-started/own-mesh.md)).
#
# Tissue is nearly incompressible, hence Poisson's ratio 0.47. The vessels are pinned.
# The tip of the chambers moves down by 15 mm in three static states.

# %%
vessels = {"half_space": {"point": [0, 0, 0.82], "normal": [0, 0, 1]}, "relative": True}
tip = {"sphere": {"center": [0.62, 0.4, 0.02], "radius": 0.12}, "relative": True}
tables = {
    "mesh": {
        "source": "heart_vessels",
        "prepare": [{"rotate": {"axis": [1, 0, 0], "degrees": 90}}],
        "size": 0.12,
    },
    "cages": {"count": 600},
    "material": {"young_modulus": 2e4, "poisson_ratio": 0.47, "density": 1000},
    "time": {"integrator": "static", "step": 1.0, "duration": 3.0},
    "pin": [{"region": vessels}],
    "anchor": [{"region": tip, "path": [{"time": 3.0, "by": [0, 0, -0.015]}]}],
    "output": {"stress": True},
}
scene = msm.Scene.of(tables, folder=out)
path = msm.run(scene, out / "heart.h5", overwrite=True, quiet=True)

# %% [markdown]
# ## Force over displacement
#
# `reaction` has the force on the body of each pin and then of each anchor. The anchor
# has index 1.

# %%
with msm.open(path) as result:
    time = result.frames.time[:]
    # of the anchor, along z [N]
    force = result.frames.reaction[:, 1, 2]
    # at the nodes [Pa]
    von_mises = result.frames.von_mises[-1]
    surface = result.frames.surface[:]
    triangles = result.surface.triangles[:]

for displacement, pull in zip(0.015 * time / 3.0, force, strict=True):
    print(f"{1e3 * displacement:.0f} mm: {pull:.1f} N")

# %% [markdown]
# It prints:
#
#     0 mm: 0.0 N
#     5 mm: -1.9 N
#     10 mm: -3.8 N
#     15 mm: -5.6 N
#
# ## Stress and volume
#
# A material of Poisson's ratio 0.47 changes its volume little. So the change of volume
# checks cells and law at once.

# %%
volumes = [trimesh.Trimesh(points, triangles, process=False).volume for points in surface]
change = volumes[-1] / volumes[0] - 1
median, largest = np.median(von_mises), von_mises.max()
print(f"von Mises' stress: median {median:.0f} Pa, largest {largest:.0f} Pa")
print(f"volume: {1e6 * volumes[0]:.0f} ml, {100 * change:+.1f}% at the end")

# %%
assert force[1] < 0 and force[-1] < 2 * force[1], "the anchor should pull down, ever harder"
assert abs(change) < 0.03, "tissue should keep its volume"

# %% [markdown]
# ## A picture

# %%
words = ["render", path, "-o", out / "heart.png", "--colour", "stress", "--count", "3"]
subprocess.run([sys.executable, "-m", "msmpetsc", *map(str, words)], check=True)

# %% [markdown]
# ![Von Mises' stress of a heart whose tip is moved down](heart.png)
#
# `out/tutorial/heart.png` shows the rest shape and two states.
# `out/tutorial/heart.xdmf` opens in ParaView with the stresses.
#
# The largest stress belongs to the edge of the pinned region. It grows with the number
# of cells, as in any finite element code. Compare medians or a region, not the largest
# value.

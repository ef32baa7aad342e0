# %% [markdown]
# # A solver study, read by pandas
#
# Which preset reaches which error of a step at least cost? A study runs the cases,
# and pandas reads its table. The tutorial takes a minute or two on a single core and
# needs the extras `run` and `study`: [solvers.py](solvers.py).

# %%
import subprocess
import sys
from pathlib import Path

import pandas as pd
import trimesh

out = Path("out/tutorial")
out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Scene and study
#
# A soft beam of 10 x 4 x 4 cells swings under its weight. `true_error = 1` also solves
# each step to rounding, so that the true error of each step is known.

# %%
trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [1.25, 0.5, 0.5]]).export(out / "soft_beam.obj")
(out / "soft_beam.toml").write_text("""
[mesh]
source = "soft_beam.obj"
[cages]
cell_size = 0.125                      # [m]
[material]
young_modulus = 2e5                    # [Pa]
density = 1000                         # [kg/m^3]
[time]
step = 0.02                            # [s]
duration = 0.2                         # [s]
[gravity]
acceleration = [0, 0, -9.81]
[[pin]]
region = { box = [[0, 0, 0], [0.001, 1, 1]], relative = true }
""")
(out / "solvers.toml").write_text("""
repeats = 1
timeout = 120                          # [s]
[[scene]]
name = "soft beam"
file = "soft_beam.toml"
true_error = 1
[[sweep]]
presets = ["newton", "anderson", "lbfgs"]
errors = [1e-1, 1e-2, 1e-3]
""")
study = ["study", str(out / "solvers.toml")]
subprocess.run([sys.executable, "-m", "msmpetsc", *study], check=True)

# %% [markdown]
# ## Read the table
#
# A row is a case. [Study table](../reference/study-table.md) explains the columns.

# %%
table = pd.read_csv("out/solvers/table.csv")
table = table[table.status == "ok"]
columns = ["preset", "error", "true_error", "iterations", "ksp_its", "products", "time_frame"]
print(table[columns].to_string(index=False, float_format="{:.3g}".format))

# %% [markdown]
# ## Cost of an error
#
# KSP iterations do not depend on the machine; times do. A pivot has a row for each
# error and a column for each preset.

# %%
cost = table.pivot(index="error", columns="preset", values="ksp_its")
print(cost.to_string(float_format="{:.0f}".format))

# %% [markdown]
#     preset  anderson  lbfgs  newton
#     error
#     0.001        131    132      18
#     0.010        115    114      13
#     0.100        103    103      11
#
# Each preset meets the error asked for. The iterations of `anderson` and `lbfgs` do
# not use the Hessian, so they need more iterations for each digit than `newton`,
# whose convergence is quadratic.

# %%
assert (table.true_error <= table.error).all(), "each step should meet its error"
growth = cost.loc[1e-3].sub(cost.loc[1e-1])
assert growth.idxmin() == "newton", "digits should cost newton least"

# %% [markdown]
# `out/solvers/report.html` has the charts. The shipped studies compare
# presets on larger scenes: [their results](../../../results/studies.md).

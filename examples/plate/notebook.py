# %% [markdown]
# # Four coils for three forces, and one of them fails
#
# A plate with a coil under each corner, modelled in plate.py: height, roll and pitch take three forces, so one coil is
# to spare.
#
# **Question:** what is lost when a coil opens, and what does a law that knows of it win back?

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import malta
from malta.model.machines import machine

# The folder of the machine, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), Path.cwd() / "examples" / "plate") if (p / "plate.py").is_file()))
Path("build").mkdir(exist_ok=True)
plate = machine("plate.py")
specs = {n: malta.read_design(f"design/{name}.toml") for n, name in ((4, "plate"), (3, "three_coils"))}
laws = {n: malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())) for n, spec in specs.items()}
for n, law in laws.items():
    most = ", ".join(f"{v:.3g} {u.unit}" for v, u in zip(law.limits.force, law.forces, strict=True))
    print(f"{n} coils make at most {most}")

# %% [markdown]
# The coil that is open takes the coil across with it: their torques balance each other, so that lift alone is made by
# the other pair. Beyond that the forces trade against each other. The largest forces within the limits of the currents:

# %%
fig, ax = plt.subplots(figsize=(5.5, 3.6))
angles = np.linspace(0, 2 * np.pi, 181)
for n, style in ((4, "-"), (3, "--")):
    par = specs[n].parameters
    coils = plate.coils(par)
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    reach = np.array([coils.largest(d, par.I_max) for d in directions])[:, None] * directions * par.k_f
    ax.plot(
        reach[:, 0], 1e3 * par.b * reach[:, 1], style, color="black", label=f"{n} coils, ±{par.I_max:g} A"
    )
ax.set(xlabel="F_z [N]", ylabel="T_x [mN m]")
ax.legend(loc="upper right")
fig.tight_layout()
fig.savefig("build/forces.png", dpi=150)

# %% [markdown]
# The law for four coils on the plate with three: its currents make other forces than it commands. It stays stable, with
# less of a margin; currents that are allocated anew give it back.

# %%
for label, n_plant, n_law in (("all coils", 4, 4), ("one open, unknown", 3, 4), ("one open, known", 3, 3)):
    spec, law = specs[n_plant], laws[n_law]
    found = malta.robust_margin(malta.loop(spec.plant, law), {"k_f": 0.1, "k_z": 0.2})
    step = malta.experiment("step", spec.plant, law, size=50e-6)
    assert step.cases[0].run.verdict.completed
    print(f"{label:18s} {found}")

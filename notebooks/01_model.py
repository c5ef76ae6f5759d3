# %% [markdown]
# # The model: from the machine's data to Table I
#
# MALTA is a magnetically levitated tubular actuator: a mover of 0.36 kg between two stator modules, held without
# contact in x, y, alpha and beta and driven along z. The permanent magnets pull it to the wall like springs of negative
# stiffness, so it is open-loop unstable. Source: Miric et al., IEEE Trans. Ind. Electron. 68(1), 2021.
#
# **Question:** does the Newton–Euler model reproduce the published poles, and how far do they move over the travel?

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import malta
from malta.machines.tubular import plant as tubular

# The project's root, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "design").is_dir()))
Path("build").mkdir(exist_ok=True)

# %% [markdown]
# ## Parameters
# Every value stands in `data/tubular.toml` with its unit and source. Table I does not follow from Table IV, so there
# are two presets: `table1` meets the poles, `table4` is Table IV as printed.

# %%
par = malta.read("data/tubular.toml", preset="table1")
printed = malta.read("data/tubular.toml", preset="table4")
print(f"K_A = {par.K_A} N/m (table1), {printed.K_A} N/m (table4)")

# %% [markdown]
# ## Model
# Six degrees of freedom, exact trigonometry, gravity, attraction, cogging. `plant.at(z=...)` is an operating point
# without preload, as the paper's: v0(z) cancels gravity and cogging.

# %%
plant = tubular.plant(par)
model = malta.linearize(plant, plant.at(z=0.0))
print(model.sys.poles().real.round(2))

# %% [markdown]
# ## Check: Table I, to every printed digit

# %%
table = malta.model.read_published("data/tubular.toml")["table_I"]["poles"]
expected = np.sort([sign * pole for pole in table.values() for sign in (-1, 1)])
assert np.abs(np.sort(model.sys.poles().real) - expected).max() < 0.005

# %% [markdown]
# ## Check: the poles "do not vary significantly" over the travel
# Radial and tilting modes couple off the centre; the product of their poles is constant.

# %%
z = np.linspace(-15e-3, 15e-3, 61)
poles = np.array([np.sort(malta.linearize(plant, plant.at(z=at)).sys.poles().real)[-4:] for at in z])
for at in (0, 5e-3, 10e-3, 15e-3):
    tilt, radial = poles[np.argmin(abs(z - at))][[0, 2]]
    print(f"z_ss = {at * 1e3:4.1f} mm   {radial:.2f} / {tilt:.2f} 1/s   product {radial * tilt:.1f}")
assert np.ptp(poles[:, 2]) / poles[30, 2] < 0.054
assert np.ptp(poles[:, 0] * poles[:, 2]) < 1e-6 * poles[30, 0] * poles[30, 2]

# %% [markdown]
# ## Exact and small-angle equations
# The paper puts sin a = a and cos a = 1. The error in the tilting acceleration grows with the square of the tilt; where
# the mover touches the wall, at 6 mrad, it is some 1e-5, and the linear model is the same.

# %%
small = tubular.plant(par, small_angle=True)
tilts = np.geomspace(1e-4, 6e-3, 30)
rates = {
    p: np.array([np.array(p.f(p.at(alpha=a).x, np.zeros(5), np.zeros(6))).ravel() for a in tilts])
    for p in (plant, small)
}
error = np.abs(rates[small][:, 9] / rates[plant][:, 9] - 1)
assert error.max() < 5e-5
assert abs(np.log(error[-1] / error[0]) / np.log(tilts[-1] / tilts[0]) - 2) < 0.05

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
left.plot(z * 1e3, poles[:, 2], color="black", label="x, y")
left.plot(z * 1e3, poles[:, 0], color="0.5", linestyle="--", label="alpha, beta")
left.axhline(table["x"], color="0.7", linewidth=0.8)
left.axhline(table["alpha"], color="0.7", linewidth=0.8)
left.set(xlabel="operating point z_ss [mm]", ylabel="unstable pole [rad/s]", ylim=(130, 250))
left.legend(frameon=False)
right.loglog(tilts * 1e3, error, color="black")
right.set(xlabel="tilt alpha [mrad]", ylabel="error of alpha'' with small angles [1]")
for axes in (left, right):
    axes.grid(color="0.9")
figure.savefig("build/01_model.png", dpi=120)

# %% [markdown]
# ## Judgement
# Table I is reproduced to every digit with 2 K_A / m = 218.92^2 (K_A attraction of a module, N/m; m mass, kg). With
# Table IV as printed the radial poles are 215.12 rad/s, which neither rounding nor discretization explains. Over the
# whole travel the poles move by 5 %, so one controller designed at the centre is a fair start; what that costs in
# margin is a question for verification, not for belief.

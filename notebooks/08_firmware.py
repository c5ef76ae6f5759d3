# %% [markdown]
# # From a gain file to the bench: the controller as C
#
# The paper's controller is C on a Cortex-A9 at 20 kHz. Here the flagship becomes a folder of C99 that computes the same
# bits on every processor, in double or in single precision, with its test and a report of what it costs.
#
# **Question:** is it the controller that was proven, does single precision do, and how much of 50 µs does it take?

# %%
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

import malta
from malta.firmware.cost import CLOCK, costs, operations, rounded_margin, rounding_noise, smallest_error
from malta.firmware.flight import differences
from malta.firmware.signals import Target
from malta.simulation.engine.compiled import compiler

# The project's root, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "design").is_dir()))
Path("build").mkdir(exist_ok=True)
GAINS = "design/gains/robust.json"
c = malta.gains.read(GAINS)
plant = malta.plant_of(c.parameters)
STYLES = malta.report.STYLES

# %% [markdown]
# ## A folder, and its test
# `malta export design/gains/robust.json --to c` writes the same. The folder is written without a C compiler too.

# %%
folder = Path(tempfile.mkdtemp()) / "robust_c"
files = malta.export_c(GAINS, folder, proof=False)
for file in files:
    print(f"{file.name:20} {len(file.read_text().splitlines()):6} lines")
can_build = compiler() is not None and shutil.which("make") is not None
if can_build:
    said = subprocess.run(
        ["make", "-s", "-C", str(folder), "test"], check=True, capture_output=True, text=True
    )
    print(said.stdout)
    assert said.stdout.splitlines()[-1].startswith("pass: 4 vectors")

# %% [markdown]
# **Judgement.** The recorded test vectors have a stroke, saturation, invalid readings and lift-off; then faults make
# every monitor of the supervisor act, in each state in which it watches, and all transitions are taken. The checksum
# is of every bit of the outputs and the state after each sample; it is the same on x86, a Cortex-A9 and a Cortex-M4F.

# %% [markdown]
# ## It flies
# The compiled C takes the place of the law in the simulation: a noisy stroke with phase currents and duty cycles.

# %%
scenario = malta.Scenario.stroke(10e-3, fidelity="phase", noise=1.0)
own = malta.simulate(plant, c, scenario)
if can_build:
    flown = {
        p: malta.simulate(plant, c, scenario, engine=malta.firmware.engine_of_c(p))
        for p in ("double", "float")
    }
    for double, single in zip(*(differences(own, run) for run in flown.values()), strict=True):
        print(f"{double.name:8} double {double.share:.0e}, float {single.share:.0e} of its range")
        assert double.share < 1e-12
        assert single.share < 1e-4
    z = [s.name for s in plant.outputs].index("z")
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4.5), layout="constrained")
    for (precision, run), style in zip(flown.items(), STYLES, strict=False):
        apart = np.abs(run.p - own.p)
        for axis, columns in zip(axes, ([k for k in range(5) if k != z], [z]), strict=True):
            most = np.maximum(apart[:, columns].max(axis=1), 1e-22)
            axis.semilogy(1e3 * own.t, most, **(style | {"linewidth": 0.8}), label=f"C, {precision}")
    for axis, name in zip(axes, ("radial sensors", "z"), strict=True):
        axis.set_ylabel(f"{name}: apart [m]")
    axes[0].legend(loc="center right")
    axes[1].set_xlabel("t [ms]")

# %% [markdown]
# **Judgement.** In double precision the C is the simulation's law; single precision follows it to nanometres, far below
# the sensors' noise.

# %% [markdown]
# ## What single precision does
# The margin is proven again with the coefficients rounded to 24 bits. Sums of errors keep their rounding errors
# beside them.

# %%
margin = rounded_margin(c, dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2))
assert margin is not None
assert margin.lower is not None
noise = rounding_noise(Target(c, "float", "phase"))
share = float((noise.rounding / noise.sensors).max())
print(
    f"proven with rounded coefficients: {margin.proven.percent()} of the box, lost at {margin.lost.percent()}"
)
print(f"noise of rounding in the forces: at most {share:.0e} of what the sensors' noise makes")
print(f"a plain sum at 1e-4 m s stands still for errors below {1e9 * smallest_error(c, 1e-4):.0f} nm")
assert margin.lower > 3.5
assert share < 1e-5

# %% [markdown]
# ## What a step costs

# %%
for kind, count in operations(Target(c, "float", "phase")).items():
    print(f"{count:5} {kind}")
rows = [
    (precision, cost) for precision in ("double", "float") for cost in costs(Target(c, precision, "phase"))
]
if rows:
    figure, axis = plt.subplots(figsize=(7, 0.6 + 0.45 * len(rows)), layout="constrained")
    labels = [f"{cost.processor}, {precision}" for precision, cost in rows]
    shares = [100 * cost.instructions / CLOCK / c.sample_time for _, cost in rows]
    axis.barh(labels, shares, color=["0.45" if cost.calls == 0 else "0.8" for _, cost in rows])
    for k, (_, cost) in enumerate(rows):
        soft = f" ({cost.calls} calls)" if cost.calls else ""
        axis.text(shares[k], k, f" {cost.instructions}{soft}, stack {cost.stack} B", va="center")
    axis.set_xlim(0, 2.2 * max(shares))
    axis.invert_yaxis()
    axis.set_xlabel("instructions as a share of 50 µs at 667 MHz, one a clock [%]")
    small = [k for k, (p, cost) in enumerate(rows) if cost.processor == "Cortex-A9"]
    assert all(shares[k] < 10 for k in small)

# %% [markdown]
# **Judgement.** The whole control period, from readings to duty cycles, takes less than a tenth of 50 µs on the paper's
# processor. Light bars call arithmetic that the processor does not have: single precision is for the Cortex-M4F.

# %% [markdown]
# ## The supervisor
# The folder has a machine of states around the controller: current offsets, sensors, lift-off, settling, operation,
# landing. It flies here, from the bearing and back, with a stroke in between.

# %%
if can_build:
    commissioning = malta.experiment("commissioning", plant, c)
    for merit in commissioning.merits:
        print(merit)
    display(malta.report.experiment_figure(commissioning, path="build/robust_commissioning.png"))
    assert commissioning.run.verdict.completed
    by_label = {merit.label: merit.value for merit in commissioning.merits}
    assert by_label["in operation after"] < 0.1

# %% [markdown]
# `malta simulate design/gains/robust.json --scenario supervised-faults` flies each fault with it and without it.

# %% [markdown]
# # Your machine in an hour
#
# A machine is a Python module with two names: `Parameters`, a record of numbers with units, and `plant`, a function
# that makes equations of motion of them. Everything else follows: the linear model, an LQG or PID controller, the proof
# of its margin, a simulation with noise and limits, campaigns, gain files. `malta new NAME` writes such a module, with
# its data, designs, tests and a notebook; this page walks through that folder.
#
# **Question:** what has to be written down about a machine, and what does malta compute from it?

# %%
import os
import shutil
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import malta
from malta.files import shipped_path

# A folder as `malta new` writes it, outside of malta.
folder = Path(tempfile.mkdtemp())
shutil.copytree(shipped_path("examples", "ball"), folder, dirs_exist_ok=True)
os.chdir(folder)
print(
    *sorted(str(path.relative_to(folder)) for path in folder.rglob("*.*") if path.suffix != ".pyc"), sep="\n"
)

# %% [markdown]
# ## The equations
# A steel sphere hovers between two electromagnets. The upper one pulls with the square of its current over the square
# of its gap, the lower one pulls back. `forces(x, i)` has both forces; `f` is Newton's law for their sum; `h` is the
# sensor. Nothing is linearized by hand.

# %%
text = Path("ball.py").read_text(encoding="utf-8")
print(text[text.index("def plant") :])
assert len(text.splitlines()) <= 80

# %% [markdown]
# ## The numbers
# Each value has a unit of its own choice and says where it comes from. malta converts to SI, refuses a wrong kind of
# unit, an unknown name, and values that no machine has.

# %%
par = malta.read("ball.toml")
ball = malta.plant_of(par)
print(Path("ball.toml").read_text(encoding="utf-8"))
try:
    malta.machine("missing.py")
except malta.InputError as error:
    print(error)

# %% [markdown]
# ## The linear model
# By CasADi's exact derivatives at the middle, where the bias current makes a negative stiffness: one pole is unstable.
# The stiffness by hand is a second way to the same number.

# %%
model = malta.linearize(ball, ball.at())
k_s = 4 * par.C * par.I_0**2 / par.s**3
print("A =", model.A.tolist(), " poles", np.sort(model.sys.poles().real), "rad/s")
assert np.isclose(model.A[1, 0] * par.m, k_s, rtol=1e-12)

# %% [markdown]
# ## The controller
# `design/ball.toml` holds weights on bases, the deviations that are acceptable (Bryson's rule), noise as standard
# deviations of a sample, and how far parameters vary. The filter's model has the dead time; integrals cancel constant
# loads.

# %%
spec = malta.read_design("design/ball.toml")
controller = malta.synthesize(spec, model)
margins = malta.verify(model, controller, spec.uncertainty)
print(controller)
print(margins)

# %% [markdown]
# ## The proof
# The margin is the factor by which the box of uncertain parameters may grow, all parameters at once, before a loop is
# unstable. `lower` is proven for every combination and every frequency; at `upper` one machine, the witness, is
# unstable. Between both bounds nothing is known; here they agree.

# %%
robust = margins.robust
assert robust is not None
assert robust.lower is not None
assert robust.witness is not None
share = ", ".join(f"{name} +-{100 * one:g} %" for name, one in spec.uncertainty.items())
print(f"proven {robust.proven.percent()} of {share}, lost at {robust.lost.percent()}")
print("a machine that is lost:", {name: float(f"{value:.4g}") for name, value in robust.witness.items()})
assert robust.lower > 0.999 * robust.upper

# %% [markdown]
# ## The flight
# The same controller now runs on the nonlinear machine with its limits, dead time and noise. Every machine has three
# experiments: `hold`, `step`, `disturbance`. A list EXPERIMENTS beside `plant` adds a machine's own.

# %%
push = malta.experiment("disturbance", ball, controller, size=0.1)
rest = malta.experiment("hold", ball, controller)
print(push)
print(rest)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(push.run.t * 1e3, push.run.p[:, 0] * 1e6, color="black")
left.set(xlabel="time [ms]", ylabel="q [µm]", title="a force of 0.1 N from outside")
right.plot(push.run.t * 1e3, push.run.current[:, 0], color="black")
right.set(xlabel="time [ms]", ylabel="commanded current [A]", title="what the magnets take")
plt.show()
furthest, end = np.abs(push.run.p).max(), abs(push.run.p[-1, 0])
print(f"moved by {furthest * 1e6:.1f} µm, {end * 1e6:.2f} µm left at the end")
assert end < 0.1 * furthest

# %% [markdown]
# ## PID beside it
# Another design file gives the same machine a PID; the questions are the same.

# %%
pid = malta.read_design("design/ball_pid.toml")
other = malta.synthesize(pid, model)
judged = malta.verify(model, other, pid.uncertainty)
pushed = malta.experiment("disturbance", ball, other, size=0.1)
for name, m, run in (("LQG", margins, push.run), ("PID", judged, pushed.run)):
    peak = m.peak_sensitivity["sigma_max"]
    print(f"{name}: peak |S| {peak:.2f}, {m.robust}, load moves it by {np.abs(run.p).max() * 1e6:.1f} µm")
assert judged.stable

# %% [markdown]
# ## The gain file
# A gain file is all that a digital implementation needs. It names the machine, but no path: the reader of the file says
# where the machine's module is, so that reading a file runs no code that nobody named. On the command line,
# `--machine ball.py` names the module.

# %%
malta.gains.write(controller, margins, "ball.json")
again = malta.gains.read("ball.json")
assert np.array_equal(again.K, controller.K)
print("L =", again.L.round(4).tolist(), " K =", again.K.round(4).tolist())

# %% [markdown]
# ## What next
# Replace first the equations in a folder of `malta new`, then its numbers, and run `malta design` after each change:
# it says in one sentence what does not fit. `examples/rotor` is a machine of four degrees of freedom that was made
# this way.

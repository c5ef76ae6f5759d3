# %% [markdown]
# # A machine that nobody knows: identify, prove, learn, measure, compare
#
# A lab switches a machine on whose parameters are not those of the data file. This page does not use the true
# parameters before its last cell: it has only the gain file, and the signals that a bench would log.
#
# **Question:** do the intervals, the margin and the measured sensitivity tell the truth?

# %%
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from IPython.display import Markdown, display

import malta
from malta.report.figures import measured_figure

# The project's root, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "design").is_dir()))
controller = malta.gains.read("design/gains/robust.json")
believed = malta.plant_of(controller.parameters)
loop = malta.loop(believed, controller)

# %% [markdown]
# ## The unknown machine
# Four parameters at random within 10 %: `hidden` is used to simulate, and by nothing else before the last cell.

# %%
random = np.random.default_rng(9)
names = ("K_A", "K_B", "K_D", "I_xx")
off = dict(zip(names, random.uniform(0.9, 1.1, 4), strict=True))
values = {name: share * getattr(controller.parameters, name) for name, share in off.items()}
hidden = believed.variant(replace(controller.parameters, **values, I_yy=values["I_xx"]))

# %% [markdown]
# ## Excite and identify
# The widths of the intervals are predicted before the run; the parameters follow from measured currents.

# %%
plan = malta.excite(loop, motion=40e-6, periods=4)
run = malta.simulate(hidden, controller, malta.Scenario.excited(plan.signal, plan.duration))
log = malta.identification.log_of(run)
found = malta.identify(controller, log, parameters=names)
display(plan, found)
assert found.refusal == ""
told = ", ".join(
    f"{name} to ±{100 * half / value:.2g} %"
    for name, value, half in zip(found.names, found.values, found.half_widths, strict=True)
)
display(Markdown(f"**Judgement.** {plan.duration:g} s of motion below 40 µm tell {told}."))

# %% [markdown]
# ## Prove
# The margin is given in multiples of the intervals' half widths about the identified machine; a box `joint` times as
# wide holds all parameters at once with 95 %.

# %%
shares = found.half_widths / found.values
box = {name: share for name, share in zip(names, shares.tolist(), strict=True) if name != "I_xx"}
margin = malta.robust_margin(malta.loop(found.plant, controller), box)
assert margin.lower is not None
assert margin.lower > 10 * found.joint
display(
    Markdown(
        f"**Judgement.** Proven stable at {margin.proven.text()} times these intervals, where "
        f"{found.joint:.2f} times hold all parameters together."
    )
)

# %% [markdown]
# ## Learn
# The first stroke uses the gain file as it is; the second uses the force constant learned from the first.

# %%
stroke = malta.Scenario.stroke(10e-3, noise=1.0, quantize=True)
first = malta.simulate(hidden, controller, stroke)
taught = malta.learn(controller, malta.identification.log_of(first))
second = malta.simulate(hidden, taught.controller, stroke)
errors = [1e6 * malta.simulation.stroke_figures(one).axial_error for one in (first, second)]
assert errors[1] < errors[0]
display(
    Markdown(
        f"**Judgement.** The stroke took {taught.factor:.3f} times the thrust expected; the largest axial error goes "
        f"from {errors[0]:.0f} to {errors[1]:.0f} µm."
    )
)

# %% [markdown]
# ## Measure
# The same log gives the sensitivity at every sensor with 95 % bands, beside that of the identified machine. The
# measurement contradicts the prediction of the gain file, which is of another machine, and agrees with that of the
# identified one.

# %%
joint = {name: found.joint * share for name, share in zip(names, shares.tolist(), strict=True)}
as_believed = malta.measure(controller, log)
measured = malta.measure(controller, log, parameters=found.plant.parameters, uncertainty=joint)
display(measured, measured_figure(measured))
assert as_believed.refusal
assert measured.refusal == ""
peak, high, _ = max(measured.peaks.values())
display(
    Markdown(
        f"**Judgement.** Beside the gain file's machine: {as_believed.refusal}. Beside the identified machine all "
        f"lines are within their bands. The largest |S| is {peak:.2f}, below {high:.2f} with 95 %: zone "
        f"{max(measured.zones.values())}."
    )
)

# %% [markdown]
# ## Compare with the truth
# Only now the parameters that flew.

# %%
truth = np.array([values[name] for name in names])
deviations = (found.values - truth) / found.half_widths
assert (np.abs(deviations) < 2).all()
true_loop = malta.loop(hidden, controller)
S = np.abs(np.einsum("kpp->kp", true_loop.sensitivity(measured.w)))
inside = float((np.abs(measured.S.size - S) < 1.96 * measured.S.deviation).mean())
assert inside > 0.9
K_D = values["K_D"]
display(
    Markdown(
        f"**Judgement.** The largest error is {np.abs(deviations).max():.2f} of half an interval, and "
        f"{100 * inside:.0f} % of the bands hold the true |S|. The stroke told K_D = {taught.after:.3f} N/A, where "
        f"{K_D:.3f} N/A flew."
    )
)
assert abs(taught.after / K_D - 1) < 0.02

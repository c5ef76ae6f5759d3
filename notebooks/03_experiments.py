# %% [markdown]
# # Experiments: the paper's Figs 12 to 16 beside ours
#
# The controllers run on a simulation of the whole drive: exact mover, PI current loops on the windings, half-bridges
# at 45 V, sensors with noise and 1 µm steps. Source: Miric et al., Sec. V and VI.
#
# **Question:** which of the published measurements does this machine show, and where does it differ?

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

import malta

# The project's root, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "design").is_dir()))
Path("build").mkdir(exist_ok=True)

# %% [markdown]
# ## Parameters
# Three gain files: the printed weights as plain SI numbers, the same weights on bases that the claims ask for, and our
# own design for the loop as it is.

# %%
NAMES = ("table2", "calibrated", "robust")
controllers = {name: malta.gains.read(f"design/gains/{name}.json") for name in NAMES}
published = malta.model.read_published("data/tubular.toml")
plants = {name: malta.plant_of(c.parameters) for name, c in controllers.items()}

# %% [markdown]
# ## Figs 12 and 13: the stroke
# The first-order lag that linear models put in place of the current loops costs tracking error; PI loops follow a ramp
# better. The paper measures up to 0.6 mm, with a cogging that its look-up table met only on average.

# %%
strokes = {}
for key, controller in controllers.items():
    e = strokes[key] = malta.experiment("stroke", plants[key], controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_stroke.png"))
    print(f"{key}, {e}")
lagged = malta.experiment("stroke", plants["calibrated"], controllers["calibrated"], fidelity="force")
figures = malta.simulation.stroke_figures(lagged.run)
with_pi = malta.simulation.stroke_figures(strokes["calibrated"].run).axial_error
print(
    f"calibrated: axial error {figures.axial_error * 1e3:.2f} mm with first-order lags, {with_pi * 1e3:.2f} mm with PI"
)
assert figures.axial_error > 2 * with_pi
for e in strokes.values():
    f = malta.simulation.stroke_figures(e.run)
    assert f.overshoot < 0.015
    assert f.axial_error < 0.6e-3
    assert max(f.radial.values()) < 20e-6
    assert max(f.radial["x1"], f.radial["x2"]) < 1e-12  # as in the paper's simulation

# %% [markdown]
# **Judgement.** All bounds of Figs 12 and 13 are met. x1 and x2 do not move at all, as in the paper's own
# simulation: what it measured there is of the prototype's tolerances, which no model of Table IV can show. The
# weight stands on module 2 at z = +5 mm, the nearer one; the text of Fig. 13 has it the other way round.

# %% [markdown]
# ## Fig. 14 and Table III: 2000 samples at rest

# %%
rests = {}
for key, controller in controllers.items():
    e = rests[key] = malta.experiment("hold", plants[key], controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_hold.png"))
    print(f"{key}, {e}")
table = np.array([published["table_III"]["std"][name]["value"] for name in ("x1", "y1", "x2", "y2")])
print("Table III", table.round(2), "µm")
for e in rests.values():
    measured = e.run.y[-2000:, :4].std(axis=0) * 1e6
    true = e.run.p[-2000:, :4].std(axis=0) * 1e6
    print("measured ", measured.round(2), "true", true.round(2), "µm")
    assert (abs(measured / table - 1) < 0.25).all()
    assert (true < 0.5 * measured).all()

# %% [markdown]
# **Judgement.** The measured statistics are those of Table III because the sensors' noise was chosen for that. The
# simulation also shows what the table cannot: how still the mover really stands:

# %%
for key, e in rests.items():
    stiller = e.run.y[-2000:, :4].std(axis=0) / e.run.p[-2000:, :4].std(axis=0)
    print(f"{key}: {stiller.min():.1f} to {stiller.max():.1f} times stiller than its sensors say")
    assert stiller.min() > 2

# %% [markdown]
# ## Fig. 15: a drifting support, compensated
# 65 µm in a minute, run thirty times as fast.

# %%
drifts = {}
for key, controller in controllers.items():
    e = drifts[key] = malta.experiment("thermal", plants[key], controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_thermal.png"))
    print(f"{key}, {e}")
for e in drifts.values():
    left, raw = (case.merits[0].value for case in e.cases)
    assert left < 2e-6 < 60e-6 < raw

# %% [markdown]
# **Judgement.** The concept holds. The remaining error is the lag of the outer loop, which shrinks with the speed, and
# noise.

# %%
for key, e in drifts.items():
    lag, slow = (next(m.value for m in e.merits if m.label.startswith(word)) for word in ("lag", "the same"))
    print(f"{key}: lag {lag * 1e6:.2f} µm, {slow * 1e6:.3f} µm at the true speed")

# %% [markdown]
# ## Fig. 16: tilting about sensor plane 2

# Beside the three designs flies `calibrated_slow`, which differs from `calibrated` in one number: its error integrals
# are ten times as slow.

# %%
tilts = {}
other = {"calibrated_slow": malta.gains.read("design/gains/calibrated_slow.json")}
for key, controller in (controllers | other).items():
    e = tilts[key] = malta.experiment("tilt", malta.plant_of(controller.parameters), controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_tilt.png"))
    print(f"{key}, {e}")
for key, e in tilts.items():
    as_printed, held = (case.merits[0].value * 1e6 for case in e.cases)
    print(
        f"{key}: SP2 deviates by {as_printed:.1f} µm as printed, {held:.2f} µm with the attraction fed forward"
    )
    assert held < 1.0 < 4.0
    assert (as_printed < 4.0) == (key == "calibrated")

# %% [markdown]
# **Judgement.** Fig. 16 is reproduced. With the control law as printed the state feedback pulls a mover that the
# attraction pulls too: it goes to K1 / (K1 - k) of its reference until the integrals correct it. The figure shows how
# fast they do. Table II prints their weights, and not what these stand for, so `calibrated` is fitted here: 0.1 s of
# the base of x keep plane 2 within 4 µm. One second, of `calibrated_slow`, leaves 12 µm, plain SI units 7. The price
# of the fit is the peak of |S|: 2.31 in place of 2.07, and over the uncertainty up to 4.9 in place of 3.9. The law's
# own feedforward, which the paper keeps for "known radial disturbances", leaves less than 1 µm with any of them,
# since the attraction at the reference is known.

# %%
for key, e in tilts.items():
    off = {merit.label: merit.value for merit in e.cases[0].merits}
    print(
        f"{key}, as printed: SP1 {off['SP1: largest tracking error, true'] * 1e6:.0f} µm off its circle of 200 µm, SP2 "
        f"{off['SP2: largest deviation, true'] / 4e-6:.1f} times the published 4 µm"
    )

# %% [markdown]
# ## Lift-off, payload, faults
# The paper does not show these experiments, or describes them only in words.

# %%
others: dict[str, dict[str, malta.simulation.Experiment]] = {}
for name in ("lift-off", "payload", "faults"):
    others[name] = {}
    for key, controller in controllers.items():
        e = others[name][key] = malta.experiment(name, plants[key], controller)
        display(malta.report.experiment_figure(e, published, f"build/03_{key}_{name}.png"))
        print(f"{key}, {e}")

# %% [markdown]
# **Judgement.** Every estimator lifts the mover; a filter that knows it lies on its bearing needs somewhat more
# current than statics ask for. The design of plain SI weights drops a payload of 0.2 kg; the other designs carry it,
# less precisely than the empty stroke. All designs survive lost samples and control steps where the stroke
# accelerates most. A stuck radial sensor and a link at a tenth of its voltage end in the touchdown bearing:

# %%
for key in controllers:
    lift, load, fault = (others[name][key] for name in ("lift-off", "payload", "faults"))
    amperes = {case.label: case.merits[-1].value for case in lift.cases}
    aware = max(amperes["kalman"], amperes["extended"])
    print(
        f"{key}: lift-off takes {aware:.2f} A, {aware / lift.merits[0].value:.2f} times what statics ask for"
    )
    heaviest = load.cases[-1]
    error = {merit.label: merit.value for merit in heaviest.merits}["stroke: axial error"] * 1e3
    print(
        f"{key}: with {heaviest.label} {heaviest.run.verdict.name}, axial error {error:.2f} mm (published: 0.6 mm)"
    )
    lost = {c.label: c.merits[1].value * 1e3 for c in fault.cases if not c.run.verdict.completed}
    touched = {c.label: c.merits[1].value * 1e3 for c in fault.cases if np.isfinite(c.merits[1].value)}
    print(f"{key}: touchdown", ", ".join(f"{label} after {ms:.0f} ms" for label, ms in touched.items()))
    assert len(lift.cases) == sum(case.run.verdict.completed for case in lift.cases)
    assert heaviest.run.verdict.completed == (key != "table2")
    assert error > 0.6 or key == "robust"
    assert set(lost) <= set(touched)
    assert not any("lost" in label or "missed" in label for label in touched)
    assert "y1 stuck" in touched

# %% [markdown]
# ## How stiff, how fast
# The paper leaves disturbance rejection to future work, and says nothing of the drive's limits.

# %%
stiff = {}
for key, controller in controllers.items():
    e = stiff[key] = malta.experiment("disturbance", plants[key], controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_disturbance.png"))
    print(f"{key}, {e}")
limits = {}
for key, controller in controllers.items():
    e = limits[key] = malta.experiment("drive-limits", plants[key], controller)
    display(malta.report.experiment_figure(e, published, f"build/03_{key}_drive-limits.png"))
    print(f"{key}, {e}")
fastest, sigmoid = (case.merits[0].value for case in limits["calibrated"].cases)
print(f"rise {fastest * 1e3:.1f} ms against {sigmoid * 1e3:.1f} ms of the sigmoid at the same peak current")
assert fastest < 0.85 * sigmoid

# %% [markdown]
# **Summary.** Every bound of Figs 12 and 13 is met. The noise of Table III is that of the simulated sensors. Fig. 16
# is reproduced by integrals that are fitted on it, with the law as printed. The payload and the margin of 300 % need
# other bases than SI units, and the payload costs precision. `malta claims` computes all claims of the paper.

# %%
fig, ax = plt.subplots()
for (key, e), style in zip(stiff.items(), ("-", "--", ":"), strict=True):
    ax.loglog(e.curves["frequency"], e.curves["compliance"] * 1e6, style, color="black", label=key)
    ax.loglog(e.curves["tones"], e.curves["simulated"] * 1e6, "o", color="black", fillstyle="none")
ax.set_xlabel("frequency [Hz]")
ax.set_ylabel("compliance, x1 to F_x [µm/N]")
ax.legend(frameon=False)
fig.savefig("build/03_compliance.png")
np.testing.assert_allclose(stiff["calibrated"].curves["compliance"][-1], 0, atol=1e-6)

# %% [markdown]
# # Robustness: where the margin goes, and how to keep it
#
# The paper lets m, K_A, K_D and K_B vary by 20 % and reports that its LQR stands "up to around 300 %" of that. An LQR
# that measures every state is not what runs on the machine: there are an observer, current loops, a hold and a sample
# of delay.
#
# **Question:** how much of the margin is left on the machine, and which design has all of it?

# %%
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

import malta

# The project's root, wherever Jupyter was started.
os.chdir(next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "design").is_dir()))
Path("build").mkdir(exist_ok=True)

# %% [markdown]
# ## Parameters

# %%
NAMES = ("table2", "calibrated", "robust")
BOX = {"m": 0.2, "K_A": 0.2, "K_D": 0.2, "K_B": 0.2}  # either way; 100 % is this box
controllers = {name: malta.gains.read(f"design/gains/{name}.json") for name in NAMES}
plant = malta.plant_of(controllers["robust"].parameters)

# %% [markdown]
# ## The chain
# The stages lead from full state feedback to the sampled loop. Every bar is proven: no set of parameters inside it
# makes the loop unstable, at any frequency. Every red mark is a set of parameters that does, by the eigenvalues of
# the loop.

# %%
found = {
    name: malta.verify(plant, controller, BOX, stages=True, worst_case=False)
    for name, controller in controllers.items()
}
for name, result in found.items():
    display(malta.report.chain_figure(result, f"build/04_{name}_margins.png"))
    print(name)
    for link in result.chain:
        print(f"  {link.name:16} {link.margin};  peak |S| {link.peak:.2f} at the {link.broken_at}")
    print(f"  {'all travel':16} {result.travel}")

lqr = {name: result.chain[0].margin.upper for name, result in found.items()}
machine = {name: result.travel for name, result in found.items()}
assert abs(lqr["table2"] - 5 / 3) < 1e-3 * 5 / 3
assert abs(lqr["calibrated"] - 3) < 0.03
assert machine["table2"].upper == 0
assert found["table2"].chain[-1].margin.upper < 0.15
assert machine["robust"].lower is not None
assert machine["robust"].lower >= 3.5

# %% [markdown]
# **Judgement.** The claimed 300 % is that of full state feedback with a gain four times as stiff as the attraction
# pulls (`calibrated`). The observer takes half of it, and with the printed noise (`table2`) it takes all but a third
# of the box. `robust` has a fast observer for the bearings and a slow one for the noisy axial sensor. It was tuned
# with first-order lags in place of the current controllers, and keeps the claim with these lags (`sampled`) and with
# the PI controllers of the machine (`machine`).
#
# From `sampled` on the machine rests under its loads, against v0(z). `table2` holds the axis z with 10.8 N/m, and a
# force constant K_D that is off by 2.8 % leaves 6 N/m of the 209 N/m of the cogging: 14 % of the box are left in
# the middle. Between the corners of v0(z) up to 10.96 N/m are left without any error: over the travel it has no
# margin at all.

# %% [markdown]
# ## A witness flies
# The nonlinear machine should agree with the eigenvalues: just inside the boundary of stability the answer to a small
# step dies out, just beyond the boundary it grows. The simulation has the current controllers of the gain file, as
# the proof does, and no loads: these witnesses are lost at a radial axis, which cogging does not touch, and a weight
# that differs from v0 would hide the step.

# %%
nominal: Any = plant.parameters
for name in ("calibrated", "robust"):
    moved = found[name].chain[-1].margin.moved  # from the nominal machine to the witness
    c = controllers[name]
    alone = replace(c, feedforward=replace(c.feedforward, v0=0 * c.feedforward.v0))
    left = []
    for share in (0.97, 1.03):
        far = {k: getattr(nominal, k) + share * moved[k] for k in BOX}
        true = malta.plant_of(replace(nominal, **far, F_c=0.0, g=0.0))
        scenario = malta.Scenario(
            "witness", 3.0, malta.references.hold, {"x": 1e-7, "z": 1e-7, "alpha": 1e-6}
        )
        run = malta.simulate(true, alone, scenario)
        left.append(float(np.abs(run.p[-2000:]).max()))
    inside, outside = left
    print(f"{name}: {inside * 1e6:.2g} um are left inside the boundary, {outside * 1e6:.2g} um beyond")
    assert inside < 2e-8 < 1e-6 < outside

# %% [markdown]
# ## Machines by the hundred
# A proof holds for the linear loop. Here nonlinear machines, with gravity, cogging, saturation and sensor noise, are
# drawn from larger and larger boxes, and each makes the stroke. The figure shows the share of completed strokes over
# the size of the box:

# %%
SIZES = np.array([0.25, 0.5, 1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5])
RUNS = 256
yields = {}
for name, controller in controllers.items():
    shares = []
    for size in SIZES:
        rng = np.random.default_rng(7)
        changes = {
            k: getattr(plant.parameters, k) * (1 + size * share * rng.uniform(-1, 1, RUNS))
            for k, share in BOX.items()
        }
        scenario = malta.Scenario.stroke(noise=1.0)
        shares.append(
            float(malta.simulation.simulate_many(plant, controller, scenario, changes).completed.mean())
        )
    yields[name] = np.array(shares)

figure, axes = plt.subplots(figsize=(7.5, 4), layout="constrained")
for (name, completed), style in zip(yields.items(), malta.report.STYLES, strict=False):
    axes.plot(100 * SIZES, 100 * completed, marker="o", markersize=4, label=name, **style)
    axes.axvline(100 * (machine[name].lower or 0), **style | {"linewidth": 0.8})
axes.set_xlabel("size of the box [%]; thin lines: proven over the travel")
axes.set_ylabel(f"strokes completed of {RUNS} [%]")
axes.legend(frameon=False)
figure.savefig("build/04_yield.png", dpi=120)
for name, completed in yields.items():
    told = "  ".join(f"{size:.0%} {share:.0%}" for size, share in zip(SIZES, completed, strict=True))
    print(f"{name:10} {told}")
    assert (completed[(machine[name].lower or 0) >= SIZES] == 1).all()

# %% [markdown]
# **Judgement.** Inside its proven box every machine flies. Beyond it machines fall one by one, not all at once: the
# proof is about the worst combination, which few machines have. That is why sampling reports margins that are too
# large.

# %% [markdown]
# ## The worst machines
# These machines of the modelled box come closest to the touchdown bearings.

# %%
plan = malta.campaigns.Plan(
    controllers["calibrated"], "stroke", BOX, samples=1024, options={"fidelity": "force"}
)
folder = f"build/04_campaign_{plan.identity[:8]}"
campaign = malta.campaign(plan, folder)
display(malta.report.campaign(campaign, folder, malta.model.read_published("data/tubular.toml")))
assert campaign.completed.all()

# %% [markdown]
# ## The plane of two parameters
# Blue: proven stable anywhere in the travel, with the other parameters anywhere in the box. Line: where eigenvalues
# become unstable, computed another way. Dots: the machines of the campaign, all within the dashed box.

# %%
plant = malta.plant_of(controllers["calibrated"].parameters)
display(
    malta.report.margin_map(
        plant, controllers["calibrated"], x="K_A", y="K_B", uncertainty=BOX, campaigns=[campaign]
    )
)

# %% [markdown]
# ## What it costs
# A larger margin costs force noise. `malta tune` computes the front of both: the least noise at each margin, with all
# other requirements met (design/figures/robust_front.svg).

# %%
front = Path("design/figures/robust_front.md").read_text(encoding="utf-8")
print(front)
rows = [line.strip("|").split("|") for line in front.splitlines()[2:]]
margin, noise = np.array([[float(row[0]), float(row[1])] for row in rows if "*" not in row[-1]]).T
least = np.array([noise[k] <= noise[margin >= margin[k]].min() for k in range(len(margin))])
margin, noise = margin[least], noise[least]  # the others have less motion
assert len(margin) > 5

# %% [markdown]
# **Judgement.** The front has a bend: below it every percent of margin costs little noise, above it the noise grows
# fast. The shipped design (*) lies above the front: it uses the noise that its requirements allow, to carry loads
# better.

# %%
order = np.argsort(margin)
costs = np.diff(noise[order]) / np.diff(margin[order])  # N of noise for a percent of margin
for low, high, cost in zip(margin[order][:-1], margin[order][1:], costs, strict=True):
    print(f"{low:.0f} to {high:.0f} %: {cost * 1e3:.2g} mN a percent")
assert costs[-1] > 5 * costs[0]

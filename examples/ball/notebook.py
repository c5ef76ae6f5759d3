# %% [markdown]
# # A levitated sphere
#
# From the equations in `ball.py` and the numbers in `ball.toml` to gains that are proven and flown.

# %%
from pathlib import Path

import malta

HERE = Path(__file__).parent if "__file__" in globals() else Path()
spec = malta.read_design(HERE / "design" / "ball.toml")
ball = spec.plant
model = malta.linearize(ball, ball.at())
print("open-loop poles, rad/s:", model.sys.poles().real)
print(ball.check())

# %% [markdown]
# The controller, and the margin of its sampled loop: how far m and C may go at once, in multiples of the box in the
# design file.

# %%
controller = malta.synthesize(spec, model)
margins = malta.verify(model, controller, spec.uncertainty)
print(margins)

# %% [markdown]
# The same controller on the nonlinear machine: a step of the reference, and a force from outside.

# %%
step = malta.experiment("step", ball, controller, size=0.2e-3)
push = malta.experiment("disturbance", ball, controller, size=0.1)
print(step)
print(push)

# %%
malta.report.experiment_figure(push, path=HERE / "build" / "push.png")

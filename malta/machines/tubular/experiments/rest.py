"""MALTA at rest: sensor noise, a tilt about one sensor plane, and a support that drifts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    rms,
    scenario_of,
)
from malta.simulation.noise import keys, normals
from malta.simulation.scenario import Correction
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def hold(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Rest at the middle with sensor noise: statistics of the last 2000 measured samples, and the true motion."""
    cases, cut = fly(plant, controller, hold_cases(plant, controller, **options), progress, options)
    return Experiment("hold", "How still does it stand?", cases, cases[0].merits, interrupted=cut)


def hold_cases(_: Plant, controller: Controller, **options: Any) -> list[PlannedRun]:
    """The run of `hold`."""
    scenario = scenario_of("hold", (RESTING + 6000) * controller.sample_time, references.hold, options)
    return [PlannedRun("hold", scenario, _rest_merits)]


RESTING = 2000  # samples of the statistics, Table III


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Statistics of the last RESTING samples: measured, true, and of the bearing forces."""
    plant, y, p, v = run.plant, run.y[-RESTING:], run.p[-RESTING:], run.v[-RESTING:]
    names = [signal.name for signal in plant.outputs]
    bearings = [k for k in range(len(plant.inputs)) if k != plant.thrust_input]
    return (
        *(
            Merit(f"measured {n}, std", float(y[:, k].std()), "um", f"table_III.std.{n}")
            for k, n in enumerate(names)
        ),
        *(
            Merit(f"measured {n}, mean", float(y[:, k].mean()), "um", f"table_III.mean.{n}")
            for k, n in enumerate(names)
        ),
        *(Merit(f"true {n}, rms", rms(p[:, k]), "um") for k, n in enumerate(names)),
        Merit("bearing force, rms about its mean", rms((v - v.mean(axis=0))[:, bearings]), "N"),
    )


def tilt(
    plant: Plant,
    controller: Controller,
    *,
    radius: float = 200e-6,
    frequency: float = 2.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Eq. (21): a circle of `radius` (m) at `frequency` (Hz) in sensor plane 1, the other plane held at its centre.

    As the paper, and with the attraction at the reference fed forward.
    """
    wanted = tilt_cases(plant, controller, radius=radius, frequency=frequency, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("tilt", "Does it tilt about sensor plane 2?", cases, (), interrupted=cut)


def tilt_cases(
    _: Plant, __: Controller, *, radius: float, frequency: float, **options: Any
) -> list[PlannedRun]:
    """The runs of `tilt`: one for each feedforward."""
    kinds = [options["feedforward"]] if "feedforward" in options else ["axial", "attraction"]
    reference = partial(references.circle, radius=radius, frequency=frequency)
    merits = partial(_tilt_merits, settled=1 / frequency)
    return [
        PlannedRun(
            f"feedforward {kind}",
            scenario_of(
                "tilt", 2 / frequency, reference, {"start": AT_REST} | options | {"feedforward": kind}
            ),
            merits,
        )
        for kind in kinds
    ]


AT_REST = dict.fromkeys(("x", "y", "alpha", "beta", "x_dot", "y_dot", "alpha_dot", "beta_dot"), 0.0)


def _tilt_merits(run: Trajectory, settled: float) -> tuple[Merit, ...]:
    """Deviation of plane 2 and error of plane 1 from `settled` (s) on, and the largest bearing force."""
    late = run.t >= min(settled, run.t[-1])
    error, bound = (run.p - run.reference)[late], ("um", "figure_16.deviation", "at most")
    return (
        Merit("SP2: largest deviation, true", float(np.hypot(error[:, 2], error[:, 3]).max()), *bound),
        Merit("SP2: largest deviation, measured", float(np.abs(run.y[late][:, 2:4]).max()), *bound),
        Merit("SP1: largest tracking error, true", float(np.hypot(error[:, 0], error[:, 1]).max()), "um"),
        Merit("largest bearing force", float(np.abs(run.v[:, :4]).max()), "N"),
    )


def thermal(
    plant: Plant,
    controller: Controller,
    *,
    drift: float = 65e-6,
    minute: float = 60.0,
    faster: float = 30.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The support drifts sideways by `drift` (m) over `minute` (s), run `faster` times as fast.

    A laser on a fixed support reads the mover's position in sensor plane 2 every 10 ms with 0.1 um of noise; half of
    each reading is subtracted from the reference of both planes.
    """
    duration, every, gain = minute / faster, 10e-3, 0.5
    moved = partial(_drift, drift=drift, duration=duration)
    merits = partial(_thermal_merits, moved=moved, late=duration / 10)
    wanted = []
    for label, share in (("compensated", gain), ("not compensated", 0.0)):
        laser = _Laser(moved, share, [0, 2], len(plant.outputs))
        scenario = scenario_of(
            "thermal", duration, references.hold, {"correction": Correction(every, laser)} | options
        )
        wanted.append(PlannedRun(label, scenario, merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    lag = drift / duration * every / gain
    found = (
        Merit("drift of the support", drift, "um", "thermal.drift"),
        Merit("lag if the mover goes where it is sent", lag, "um"),
        Merit("the same at the true speed", lag / faster, "um", key="lag_at_true_speed"),
    )
    curves = {"drift": moved(cases[0].run.t)}
    return Experiment("thermal", "Does it hold its place in space?", cases, found, curves, interrupted=cut)


def _thermal_merits(run: Trajectory, moved: Callable[[Any], Any], late: float) -> tuple[Merit, ...]:
    """Deviation in space from `late` (s) on."""
    outside = (run.p[:, 2] + moved(run.t))[run.t >= min(late, run.t[-1])]
    return (
        Merit("largest deviation in space", float(np.abs(outside).max()), "um"),
        Merit("rms deviation in space", rms(outside), "um"),
    )


def _drift(t: Any, drift: float, duration: float) -> Any:
    """Displacement of the support, m, at the times t."""
    return drift * np.asarray(t) / duration


class _Laser:
    """The outer loop of `thermal`: it integrates the laser's readings into an offset of the reference."""

    def __init__(self, moved: Callable[[Any], Any], gain: float, columns: list[int], size: int) -> None:
        self.moved, self.gain, self.columns = moved, gain, columns
        self.offset, self.readings = np.zeros(size), 0

    def __call__(self, t: float, p: FloatArray) -> FloatArray:
        noise = 0.1e-6 * float(normals(keys(0, np.array([self.readings]))[0], 1, 1)[0, 0])
        self.readings += 1
        self.offset[self.columns] -= self.gain * (p[2] + float(self.moved(t)) + noise)
        return self.offset.copy()

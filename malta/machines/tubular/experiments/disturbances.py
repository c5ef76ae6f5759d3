"""Outer forces on MALTA: steps, vibration of the housing, and compliance over frequency."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    NO_NOISE,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    amplitude,
    compliance,
    experiment_of,
    fly,
    merits_of_first,
    rms,
    scenario_of,
    sine_wrench,
    step_wrench,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller


def disturbance(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Steps of force and torque, vibration of the housing, sines of force; the linear loop's compliance beside them."""
    wanted = disturbance_cases(plant, controller, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    steps, sines = cases[:4], cases[4:]
    w = np.geomspace(0.01, 2000, 600) * 2 * math.pi
    curve = compliance(plant, controller, w)
    worst = int(curve.argmax())
    found = (
        Merit("largest compliance, x1 to F_x", float(curve[worst]), "um/N", key="largest_compliance"),
        Merit("at", float(w[worst] / (2 * math.pi)), "Hz", key="compliance_frequency"),
        Merit("smallest dynamic stiffness", float(1 / curve[worst]), "N/um", better="high"),
    )
    curves = {
        "frequency": w / (2 * math.pi),
        "compliance": curve,
        "tones": np.array(TONES[: len(sines)]),
        "simulated": np.array(
            [case.merits[0].value / TONE_FORCE if case.run.verdict.completed else np.nan for case in sines]
        ),
    }
    return Experiment("disturbance", "How stiff is it?", steps, found, curves, interrupted=cut)


def disturbance_cases(plant: Plant, _: Controller, **options: Any) -> list[PlannedRun]:
    """The runs of `disturbance`: steps, vibration, and sines of TONES."""
    names = [s.name for s in plant.disturbances]
    outputs = [s.name for s in plant.outputs]
    wanted: list[PlannedRun] = []
    for name, size, seen in (("F_x", 1.0, "x1"), ("F_z", 1.0, plant.stroke.name), ("T_y", 0.05, "x1")):
        push = partial(step_wrench, column=names.index(name), size=size, at=0.02, width=len(names))
        scenario = scenario_of(
            "disturbance", 0.4, references.hold, NO_NOISE | {"disturbance": push} | options
        )
        unit = plant.disturbances[names.index(name)].unit
        merits = partial(_step_merits, output=outputs.index(seen))
        wanted.append(PlannedRun(f"step of {size:g} {unit} {name}", scenario, merits))
    shake = partial(
        sine_wrench, column=names.index("F_y"), size=plant.stroke.mass, frequency=50.0, width=len(names)
    )
    vibration = scenario_of("vibration", 0.3, references.hold, NO_NOISE | {"disturbance": shake} | options)
    shaken = partial(_sine_merits, output=outputs.index("y1"), frequency=50.0)
    wanted.append(PlannedRun("housing shaken by 1 m/s2 at 50 Hz along y", vibration, shaken))
    for f in TONES:
        push = partial(sine_wrench, column=names.index("F_x"), size=TONE_FORCE, frequency=f, width=len(names))
        scenario = scenario_of(
            "sine", 2 * max(0.1, 4 / f), references.hold, NO_NOISE | {"disturbance": push} | options
        )
        found = partial(_sine_merits, output=outputs.index("x1"), frequency=f)
        wanted.append(PlannedRun(f"{f:g} Hz", scenario, found))
    return wanted


TONES, TONE_FORCE = (5.0, 20.0, 60.0, 150.0, 400.0), 0.5  # Hz, N: the sines of force


def _step_merits(run: Trajectory, output: int) -> tuple[Merit, ...]:
    """Largest and last deflection of an output."""
    error = np.abs(run.p[:, output])
    return (
        Merit(f"largest deflection of {run.plant.outputs[output].name}", float(error.max()), "um"),
        Merit("left at the end", float(error[-1]), "um"),
    )


def _sine_merits(run: Trajectory, output: int, frequency: float) -> tuple[Merit, ...]:
    """Amplitude of an output at a frequency (Hz)."""
    return (Merit(f"amplitude of {run.plant.outputs[output].name}", amplitude(run, output, frequency), "um"),)


# MALTA at rest: sensor noise, and a tilt about one sensor plane.


def hold_cases(_: Plant, controller: Controller, **options: Any) -> list[PlannedRun]:
    """Rest at the middle with sensor noise: statistics of the last 2000 measured samples, and the true motion."""
    scenario = scenario_of("hold", (REST_SAMPLES + 6000) * controller.sample_time, references.hold, options)
    return [PlannedRun("hold", scenario, _rest_merits)]


hold = experiment_of("hold", "How still does it stand?", hold_cases, merits_of_first)
REST_SAMPLES = 2000  # samples of the statistics, Table III


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Statistics of the last REST_SAMPLES samples: measured, true, and of the bearing forces."""
    plant, y, p, v = run.plant, run.y[-REST_SAMPLES:], run.p[-REST_SAMPLES:], run.v[-REST_SAMPLES:]
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


def tilt_cases(
    _: Plant, __: Controller, *, radius: float = 200e-6, frequency: float = 2.0, **options: Any
) -> list[PlannedRun]:
    """Eq. (21): a circle of `radius` (m) at `frequency` (Hz) in sensor plane 1, the other plane held at its centre.

    As the paper, and with the attraction at the reference fed forward.
    """
    kinds = [options["feedforward"]] if "feedforward" in options else ["axial", "attraction"]
    reference = partial(references.circle, radius=radius, frequency=frequency)
    merits = partial(_tilt_merits, settled=1 / frequency)
    return [
        PlannedRun(
            f"feedforward {kind}",
            scenario_of(
                "tilt", 2 / frequency, reference, {"start": REST_STATE} | options | {"feedforward": kind}
            ),
            merits,
        )
        for kind in kinds
    ]


REST_STATE = dict.fromkeys(("x", "y", "alpha", "beta", "x_dot", "y_dot", "alpha_dot", "beta_dot"), 0.0)


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

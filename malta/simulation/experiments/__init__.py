"""Experiments: simulated runs of a machine, and their figures of merit.

An experiment is a function (plant, controller, *, progress=None, **options) -> Experiment, made of the records and
functions of this file. Its options are fields of Scenario that replace the experiment's own (fidelity, noise, seed,
estimator, ...), and the keywords of its signature: numbers in SI, words, true or false, or tuples of numbers, as their
defaults are. catalogue.py finds a machine's experiments by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import InputError
from malta.interrupts import watch_interrupts
from malta.merits import Merit as Merit, figure
from malta.model.linearize import linearize
from malta.model.parts import attribute_of
from malta.model.plant import Plant, Signal
from malta.simulation.inputs import MAX_SAMPLES
from malta.simulation.layout import fidelities
from malta.simulation.references import Reference
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.work import cut_error, is_stopped

Progress = Callable[[float], None]

# Sensors as built, without systematic errors; and exact sensors.
AS_BUILT: dict[str, Any] = {"noise": 1.0, "quantize": True, "sensor_errors": {}}
NO_NOISE: dict[str, Any] = {"noise": 0.0, "quantize": False, "sensor_errors": None}


class Case(NamedTuple):
    """A run of an experiment with its figures of merit."""

    label: str
    run: Trajectory
    merits: tuple[Merit, ...]


class PlannedRun(NamedTuple):
    """A run that an experiment is going to simulate, and the function that evaluates its trajectory."""

    label: str
    scenario: Scenario
    merits: Callable[[Trajectory], tuple[Merit, ...]]


@display
@dataclass(frozen=True, eq=False)
class Experiment:
    """The result of an experiment.

    name : of the experiment
    question : which it answers
    cases : runs, each with its label, its Trajectory and its figures of merit
    merits : figures of merit of the experiment as a whole, in SI, with a unit for display
    curves : arrays that are drawn beside the runs
    interrupted : whether Ctrl-C, or the end of its time, ended the experiment; it has the cases up to then
    controller : a controller that the experiment has found, for a gain file; None: none

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> found = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> found.failed, found.cases[0].label, found.run.p.shape
    (False, 'w', (2000, 1))
    >>> str(found.cases[0].merits[0])
    'y moves by 34.3 um'
    """

    name: str
    question: str
    cases: tuple[Case, ...]
    merits: tuple[Merit, ...]
    curves: Mapping[str, FloatArray] = field(default_factory=dict)
    interrupted: bool = False
    controller: Controller | None = None

    def __str__(self) -> str:
        cases = ("; ".join([case.label, *map(str, case.merits)]) for case in self.cases)
        return "\n  ".join([f"{self.name}: {self.outcome}", *cases])

    @property
    def run(self) -> Trajectory:
        """The first run."""
        return self.cases[0].run

    @property
    def failed(self) -> bool:
        """Whether a run ended early, except in experiments in which a touchdown is an expected result."""
        ends = {case.run.verdict.name for case in self.cases}
        findings = setting(self.run.plant, "FINDINGS", ())
        return self.name not in findings and not ends <= {"completed", "interrupted"}

    @property
    def cut(self) -> bool:
        """Whether Ctrl-C or the clock ended the experiment or its last run: no figure is final."""
        return self.interrupted or any(case.run.verdict.name == "interrupted" for case in self.cases)

    @property
    def outcome(self) -> str:
        """How the runs ended, in words."""
        ends = [case for case in self.cases if not case.run.verdict.completed]
        if not ends and self.interrupted:
            return f"interrupted after {len(self.cases)} runs"
        if not ends:
            return f"completed at {self.run.verdict.time:.4g} s"
        verdicts = [f"{case.run.verdict}" for case in ends]
        if len(self.cases) == 1:
            return verdicts[0]
        return f"{len(ends)} of {len(self.cases)} runs not completed ({ends[0].label}: {verdicts[0]})"

    @property
    def figures(self) -> tuple[Merit, ...]:
        """The share of the runs that were completed, then the figures of merit: of the whole, or else of each run."""
        rows = [("", merit) for merit in self.merits]
        if len(self.cases) > 1 and [m.label for m in self.merits] == [m.label for m in self.cases[0].merits]:
            rows = [(case.label, merit) for case in self.cases for merit in case.merits]
        completed = float(np.mean([case.run.verdict.completed for case in self.cases]))
        ended = figure("job", f"{self.name} completed", f"{self.name}: runs completed", completed, "percent")
        found = [ended._replace(better="high")]
        for case, merit in rows:
            label = f"{case}: {merit.label}" if case else merit.label
            found.append(merit._replace(label=label, key=f"{self.name} {case} {merit.key or merit.label}"))
        return tuple(found)

    @property
    def description(self) -> Description:
        """How it ended, and the figures of merit of the whole and of each run."""
        own = self.merits if len(self.cases) > 1 else ()
        rows = [("in all", "; ".join(map(str, own)))] if own else []
        rows += [(case.label, "; ".join(map(str, case.merits))) for case in self.cases]
        return Description(f"Experiment {self.name!r}: {self.outcome}", tuple(rows))


def scenario_of(
    name: str, duration: float, reference: Callable[[Plant], Reference], options: Mapping[str, Any]
) -> Scenario:
    """The scenario of an experiment, with sensors as built unless the options differ."""
    fields = AS_BUILT | {key: value for key, value in options.items() if key != "engine"}
    return replace(Scenario(name, duration, reference), **fields)


def with_fidelity(plant: Plant, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with the default fidelity: "dq" for machines with windings, else "force"."""
    return {"fidelity": "dq" if "dq" in fidelities(plant) else "force"} | dict(options)


def with_exact_sensors(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with sensors that have no noise and no steps, where they do not say otherwise."""
    return {"noise": 0.0, "quantize": False} | dict(options)


def choose_signals(signals: Sequence[Signal], name: str, option: str) -> list[int]:
    """The index of a signal, or all indices for "all". Raises InputError for an unknown name."""
    names = [s.name for s in signals]
    if name == "all":
        return list(range(len(names)))
    if name not in names:
        raise InputError("simulate", option, repr(name), "all, or one of " + " ".join(names))
    return [names.index(name)]


def fly(
    plant: Plant,
    controller: Controller,
    planned: Sequence[PlannedRun],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """Simulate runs one after the other: the cases, and whether Ctrl-C or the clock ended the series before its end."""
    return fly_all([(plant, controller, one) for one in planned], progress, options)


def fly_all(
    flights: Sequence[tuple[Plant, Controller, PlannedRun]],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """`fly` for runs with different machines and controllers. Raises InputError for more than MAX_SAMPLES samples."""
    cases: list[Case] = []
    samples = sum(one.scenario.samples(controller.sample_time) for _, controller, one in flights)
    if samples > MAX_SAMPLES:
        where, found = (flights[0][2].scenario.where, f"{len(flights)} of {samples:.4g} samples in all")
        raise InputError(where, "runs", found, f"at most {MAX_SAMPLES} samples")
    for n, (plant, controller, (label, scenario, merits)) in enumerate(flights):
        share = end_in_time(progress_of_part(progress, n, len(flights)))
        if cases and is_stopped():
            return tuple(cases), True
        try:
            with watch_interrupts():
                run = simulate(
                    plant, controller, scenario, engine=options.get("engine", "auto"), progress=share
                )
        except KeyboardInterrupt:
            if not cases:
                raise
            return tuple(cases), True
        cases.append(Case(label, run, merits(run)))
        if run.verdict.name == "interrupted":
            return tuple(cases), True
    return tuple(cases), False


def experiment_of(
    name: str,
    question: str,
    cases: Callable[..., list[PlannedRun]],
    merits: Callable[[Sequence[Case]], tuple[Merit, ...]] = lambda _: (),
) -> Callable[..., Experiment]:
    """The experiment that flies the runs which `cases` lists: with its options, its docstring and its refusals.

    merits : the figures of merit of the whole
    """

    @wraps(cases)
    def fly_cases(
        plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
    ) -> Experiment:
        flown, cut = fly(plant, controller, cases(plant, controller, **options), progress, options)
        return Experiment(name, question, flown, merits(flown), interrupted=cut)

    return fly_cases


def merits_of_first(cases: Sequence[Case]) -> tuple[Merit, ...]:
    """The figures of merit of the first run."""
    return cases[0].merits


def end_in_time(progress: Progress | None) -> Progress:
    """The progress function of a run that ends as by Ctrl-C where the clock ended the question that it is part of."""

    def report(share: float) -> None:
        if progress is not None:
            progress(share)
        if share < 1 and is_stopped():
            raise KeyboardInterrupt

    return report


def whole_experiment(found: Experiment) -> Experiment:
    """An experiment that was not cut short. Raises WorkUp where the clock ended it, KeyboardInterrupt after Ctrl-C."""
    if found.cut:
        raise cut_error()
    return found


def progress_of_part(progress: Progress | None, n: int, total: int) -> Progress | None:
    """The progress function of part n of `total` equal parts."""
    return None if progress is None else lambda share: progress((n + share) / total)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def setting(plant: Plant, name: str, default: Any) -> Any:
    """The value of a name that the machine's module may define, see the list in catalogue.py."""
    return attribute_of(plant, "experiments", name, default)


# Forces and readings that experiments of several machines use: steps and sines, amplitudes, compliance.


def compliance(
    plant: Plant, controller: Controller, w: FloatArray, output: int = 0, wrench: str = "F_x"
) -> FloatArray:
    """|S(j w) G_w(j w)|, m/N: from a force on the centre of gravity to an output, on the linear loop of the machine.

    S is the sampled loop's sensitivity at the sensors, G_w the open machine's response to the force between samples.
    """
    from malta.loops.loop import loop_along  # here: most experiments need no linear loop

    point = plant.point(controller.operating_point[0])
    model = linearize(plant, point)
    loop = loop_along(plant, controller)
    x, w_ext = ca.SX.sym("x", len(plant.states)), ca.SX.sym("w", len(plant.disturbances))
    rate = plant.f(x, ca.SX(point.u), w_ext)
    column = [s.name for s in plant.disturbances].index(wrench)
    B = np.array(ca.Function("B", [x, w_ext], [ca.jacobian(rate, w_ext)])(point.x, 0))[
        list(plant.controlled), column
    ]
    S = loop.sensitivity(w)
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(1j * wk * eye - model.A, B) for wk in w])
    return np.asarray(np.abs(np.einsum("kij,kj->ki", S, G)[:, output]))


def step_wrench(t: FloatArray, column: int, size: float, at: float, width: int) -> FloatArray:
    """A wrench, k x width, whose entry `column` steps to `size` (N or N m) at `at` (s)."""
    wrench = np.zeros((len(t), width))
    wrench[t >= at, column] = size
    return wrench


def sine_wrench(t: FloatArray, column: int, size: float, frequency: float, width: int) -> FloatArray:
    """A wrench, k x width, whose entry `column` is a sine of amplitude `size` (N or N m) at `frequency` (Hz)."""
    wrench = np.zeros((len(t), width))
    wrench[:, column] = size * np.sin(2 * math.pi * frequency * t)
    return wrench


def amplitude(run: Trajectory, output: int, frequency: float) -> float:
    """Amplitude of an output at a frequency (Hz): a fit to the last whole periods in the second half of a run."""
    Ts = run.controller.sample_time
    period = 1 / frequency
    periods = max(1, int(len(run.t) / 2 * Ts / period))
    last = round(periods * period / Ts)
    t, p = run.t[-last:], run.p[-last:, output]
    basis = np.column_stack(
        [
            np.sin(2 * math.pi * frequency * t),
            np.cos(2 * math.pi * frequency * t),
            np.ones(len(t)),
            t - t.mean(),
        ]
    )
    fit = np.linalg.lstsq(basis, p, rcond=None)[0]
    return float(math.hypot(fit[0], fit[1]))

"""Experiments: simulated runs of a machine, and their figures of merit.

An experiment is a function (plant, controller, *, progress=None, **options) -> Experiment, made of the records and
functions of this file. Its options are fields of Scenario that replace the experiment's own (fidelity, noise, seed,
estimator, ...), and the keywords of its signature: numbers in SI, words, true or false, or tuples of numbers, as their
defaults are. catalogue.py finds a machine's experiments by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.display import Description, display
from malta.errors import InputError
from malta.identifiers import identifier
from malta.margins.figures import Better
from malta.model.machines import attribute_of
from malta.model.plant import Plant
from malta.simulation.inputs import LONGEST
from malta.simulation.references import Reference
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

Progress = Callable[[float], None]

# Sensors as built, without systematic errors; and exact sensors.
REAL: dict[str, Any] = {"noise": 1.0, "quantize": True, "sensor_errors": {}}
QUIET: dict[str, Any] = {"noise": 0.0, "quantize": False, "sensor_errors": None}


class Merit(NamedTuple):
    """A figure of merit: value in SI, unit for display, the key of the paper's value, and which way is better."""

    label: str
    value: float
    unit: str
    published: str = ""  # key of data/published/
    relation: str = "about"  # of ours to the published: "about" or "at most"
    key: str = ""  # its name in documents, without a unit; "": the words of the label
    better: Better = "low"  # "high", or "" where neither is

    @property
    def identifier(self) -> str:
        """The key of the figure in JSON documents, with its SI unit: `rise_s`."""
        return identifier(self.key or self.label, self.unit)

    def __str__(self) -> str:
        unit = "%" if self.unit == "percent" else self.unit
        return f"{self.label} {in_unit(self.value, self.unit):.3g} {unit}"


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
    interrupted : whether Ctrl-C ended the experiment; it has the cases up to then
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
        """Whether Ctrl-C ended the experiment or its last run: no figure is final."""
        return self.interrupted or any(case.run.verdict.name == "interrupted" for case in self.cases)

    @property
    def outcome(self) -> str:
        """How the runs ended, in words."""
        ends = [case for case in self.cases if not case.run.verdict.completed]
        if not ends and self.interrupted:
            return f"interrupted after {len(self.cases)} runs"
        if not ends:
            return f"completed at {self.run.verdict.time:.4g} s"
        verdicts = [f"{case.run.verdict.name} at {case.run.verdict.time:.4g} s" for case in ends]
        if len(self.cases) == 1:
            return verdicts[0]
        return f"{len(ends)} of {len(self.cases)} runs not completed ({ends[0].label}: {verdicts[0]})"

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
    fields = REAL | {key: value for key, value in options.items() if key != "engine"}
    return replace(Scenario(name, duration, reference), **fields)


def fly(
    plant: Plant,
    controller: Controller,
    planned: Sequence[PlannedRun],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """Simulate runs one after the other: the cases, and whether Ctrl-C ended the series before its last run."""
    return fly_all([(plant, controller, one) for one in planned], progress, options)


def fly_all(
    flights: Sequence[tuple[Plant, Controller, PlannedRun]],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """`fly` for runs with different machines and controllers. Raises InputError for more than LONGEST samples."""
    cases: list[Case] = []
    samples = sum(one.scenario.samples(controller.sample_time) for _, controller, one in flights)
    if samples > LONGEST:
        where, found = (
            f"scenario {flights[0][2].scenario.name}",
            f"{len(flights)} of {samples:.4g} samples in all",
        )
        raise InputError(where, "runs", found, f"at most {LONGEST} samples")
    for n, (plant, controller, (label, scenario, merits)) in enumerate(flights):
        share = progress_of_part(progress, n, len(flights))
        try:
            run = simulate(plant, controller, scenario, engine=options.get("engine", "auto"), progress=share)
        except KeyboardInterrupt:
            if not cases:
                raise
            return tuple(cases), True
        cases.append(Case(label, run, merits(run)))
        if run.verdict.name == "interrupted":
            return tuple(cases), True
    return tuple(cases), False


def progress_of_part(progress: Progress | None, n: int, total: int) -> Progress | None:
    """The progress function of part n of `total` equal parts."""
    return None if progress is None else lambda share: progress((n + share) / total)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def setting(plant: Plant, name: str, default: Any) -> Any:
    """The value of a name that the machine's module may define, see the list in catalogue.py."""
    return attribute_of(plant, "experiments", name, default)

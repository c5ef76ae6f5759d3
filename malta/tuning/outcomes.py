"""What a design has of what it is asked for: requirements measured on its verified loop and simulated machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from malta.errors import InputError
from malta.loops.loop import Loop, loop_of_model
from malta.loops.noise import noise_of
from malta.loops.time_domain import bounded_deviation, worst_along
from malta.loops.waveforms import largest_load
from malta.margins.loop_report import BANDWIDTHS, LoopReport
from malta.margins.outcome import Outcome
from malta.margins.verify import linear_report
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import Parameters, Plant
from malta.simulation.experiments import Experiment, whole_experiment
from malta.simulation.experiments.catalogue import experiment
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.requirements import Figure, NoiseRms, Requirement, base_of, requirements_for
from malta.tuning.pid_loop import loads_of, loop_figures, whole_machine
from malta.work import WorkUp, is_stopped

if TYPE_CHECKING:
    from malta.synthesis.recovery import RecoveryBound
    from malta.synthesis.spec import Spec


@dataclass(frozen=True, eq=False)
class SynthesizedDesign:
    """A design with its controller: what requirements are measured on (synthesis.requirements.Design)."""

    spec: Spec
    model: LinearModel
    controller: Controller
    verified: LoopReport | None = None  # where it is known: with the margin over the spec's own uncertainty

    @property
    def plant(self) -> Plant:
        """The machine that the controller is designed for."""
        return self.spec.plant

    @property
    def loop(self) -> Loop:
        """The machine's loop at the design's operating point."""
        return loop_of_model(self.model, self.controller)

    @cached_property
    def margins(self) -> LoopReport:
        """The verified loop, with the proven robust margin where one is asked for."""
        if self.verified is not None:
            return self.verified
        box = self.spec.uncertainty if "margin" in self.spec.specification else None
        return linear_report(self.model, self.controller, box)

    @property
    def bandwidth(self) -> Figure:
        """The smallest by the definitions of verify, rad/s, and which one it is."""
        bandwidths = self.margins.bandwidth
        narrow = min(bandwidths, key=lambda key: bandwidths[key])
        return Figure(bandwidths[narrow], BANDWIDTHS[narrow])

    @cached_property
    def noise(self) -> NoiseRms:
        """Motion and commanded forces at rest, rms, by the covariance of the machine's linear loop."""
        return noise_of(self.loop.sampled, self.plant)

    @cached_property
    def load_figures(self) -> Mapping[str, float]:
        """Of a PID under the loads of [cost], by name and output; none where its loop is unstable."""
        whole = whole_machine(self.model, self.controller, loads_of(self.spec))
        return loop_figures(self.spec, whole, self.loop.sampled)

    def deviation(self, bound: RecoveryBound) -> Figure:
        """Under a constant load from outside, at the operating point or at the worst of some places of the travel."""
        if bound.anywhere:
            worst, position = worst_along(self.plant, self.controller, bound)
            return Figure(worst, f"linear loop, at {1e3 * position:.3g} mm")
        return Figure(bounded_deviation(self.plant, self.controller, bound), "linear loop")

    def largest_load(self, disturbance: str, limit: float) -> Figure:
        """The largest load of any waveform that uses no more of a clearance, at the operating point."""
        size, contact = largest_load(self.loop, disturbance, limit)
        return Figure(size, f"linear loop, to {contact}")

    def fly(self, name: str, **options: Any) -> Experiment:
        """Run an experiment of the machine. Raises as `whole_experiment` where it was cut short."""
        return whole_experiment(experiment(name, self.plant, self.controller, **options))

    def simulate(self, parameters: Parameters, scenario: Scenario) -> Trajectory:
        """Run a scenario on a machine with other parameters. Raises KeyboardInterrupt as `fly`."""
        run = simulate(self.plant.variant(parameters), self.controller, scenario)
        if run.verdict.name == "interrupted":
            raise KeyboardInterrupt
        return run


def judge_controller(
    spec: Spec,
    controller: Controller,
    names: Collection[str],
    verified: LoopReport | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Outcome, ...]:
    """Measure requirements of a design with a controller, those for which there is time: see judging.judge."""
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    design = SynthesizedDesign(spec, model, controller, verified)
    outcomes = _load_errors(design) if spec.pid else []
    for k, name in enumerate(names):
        if is_stopped():
            break
        if progress is not None:
            progress(k / len(names))
        try:
            found = outcomes_of(design, name)
        except WorkUp:
            break
        is_open = is_stopped() and base_of(name) == "margin" and design.margins.stable
        outcomes += [] if is_open and not found[0].found else found
    return tuple(outcomes)


def open_entries(names: Collection[str], outcomes: Collection[Outcome]) -> list[str]:
    """The requirements among these entries that were not judged, for lack of time."""
    judged = {one.name for one in outcomes}
    return list(dict.fromkeys(base_of(name) for name in names if name not in judged))


def entries_without_flights(spec: Spec) -> list[str]:
    """List the entries of a specification that are measured on the linear loop, without flights of the machine."""
    known = requirements_for(spec.plant)
    return [name for name in spec.specification if base_of(name) in known and not known[base_of(name)].flown]


def outcomes_of(design: SynthesizedDesign, name: str) -> list[Outcome]:
    """Measure one entry of the specification: a figure for each way to measure the requirement.

    Raises InputError for a requirement that the machine does not have.
    """
    spec, known = design.spec, requirements_for(design.plant)
    if base_of(name) not in known:
        raise InputError(
            spec.path, f"specification.{name}", "an unknown requirement", "one of " + " ".join(known)
        )
    requirement, signal, asked = known[base_of(name)], name.partition(" ")[2], spec.specification[name]
    unit = requirement.unit_of(spec, signal)
    return [
        Outcome(name, asked, figure.value, unit, figure.source, requirement.at_least, figure.interval)
        for figure in _measure(requirement, design, asked, signal)
    ]


def _measure(requirement: Requirement, design: SynthesizedDesign, asked: float, signal: str) -> list[Figure]:
    """The figures of a requirement; the worst there is where the loop is unstable and so has none."""
    if requirement.needs_stability and not design.margins.stable:
        return [Figure(0.0 if requirement.at_least else math.inf, "unstable loop")]
    return list(requirement.measure(design, asked, signal))


def _load_errors(design: SynthesizedDesign) -> list[Outcome]:
    plant, outcomes = design.plant, []
    for output, force, size in zip(plant.outputs, plant.inputs, loads_of(design.spec).load, strict=True):
        name = f"load_error {output.name}"
        how = f"constant force, {size:g} {force.unit} at {force.name}"
        found = design.load_figures.get(name, math.inf)
        outcomes.append(Outcome(name, None, found, f"{output.unit} s^0.5", how))
    return outcomes

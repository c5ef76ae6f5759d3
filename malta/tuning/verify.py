"""`malta.verify`, in its order: what is linear, the proven margin, stage by stage if asked, the requirements."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.arguments import by_name, is_pair
from malta.errors import CheckError, InputError
from malta.files import locate
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.loops.loop import Loop, loop_of_model
from malta.loops.sampled_loops import LAST_STAGE
from malta.loops.time_domain import bounded_deviation, noise_of, worst_along
from malta.loops.windings import CurrentLoops
from malta.margins.loop_report import BANDWIDTHS, LoopReport, Outcome
from malta.margins.schedule_rates import schedule_rate
from malta.margins.travel import LoopAlong
from malta.margins.verify import linear_report, staged_report
from malta.margins.worst_case import worst_sensitivities
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import Parameters, Plant
from malta.model.plants import plant_of
from malta.model.soundness import unproven
from malta.proof.margin import Progress, Ranges
from malta.simulation.experiments import Experiment
from malta.simulation.experiments.catalogue import experiment, payload
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.requirements import Figure, NoiseRms, Requirement, base_of, requirements_for
from malta.tuning.pid_loop import loads_of, loop_figures, whole_machine

if TYPE_CHECKING:
    from malta.synthesis.recovery import RecoveryBound
    from malta.synthesis.spec import Spec

# What a design has of what it is asked for: requirements measured on its verified loop and simulated machine.


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

    def fly(self, name: str, **options: Any) -> Experiment:
        """Run an experiment of the machine. Raises KeyboardInterrupt when Ctrl-C cut the experiment short."""
        e = experiment(name, self.plant, self.controller, **options)
        if e.interrupted or any(case.run.verdict.name == "interrupted" for case in e.cases):
            raise KeyboardInterrupt
        return e

    def simulate(self, parameters: Parameters, scenario: Scenario) -> Trajectory:
        """Run a scenario on a machine with other parameters. Raises KeyboardInterrupt as `fly`."""
        run = simulate(self.plant.variant(parameters), self.controller, scenario)
        if run.verdict.name == "interrupted":
            raise KeyboardInterrupt
        return run


def judge_controller(
    spec: Spec, controller: Controller, names: Collection[str], verified: LoopReport | None = None
) -> tuple[Outcome, ...]:
    """Measure requirements of a design with a controller: see judging.judge."""
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    design = SynthesizedDesign(spec, model, controller, verified)
    outcomes = _load_errors(design) if spec.pid else []
    for name in names:
        outcomes += outcomes_of(design, name)
    return tuple(outcomes)


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


MARGIN_SHARE = 0.5  # of the time of a verification, which the margins take


def verify(
    loop: str | Path | Controller | Plant | LinearModel,
    controller: Controller | None = None,
    uncertainty: Ranges | None = None,
    *,
    stages: bool | None = None,
    spec: Spec | None = None,
    flights: bool = False,
    current_loops: CurrentLoops = LAST_STAGE,
    proof: bool = True,
    worst_case: bool | None = None,
    time: float | None = None,
    progress: Callable[[float], None] | None = None,
    bounds: Progress | None = None,
) -> LoopReport:
    """Verify a controller on a machine: poles, peak sensitivities, bandwidths, margins with proof, requirements.

    loop : a gain file, a controller on its own machine, or a machine: its plant, or its model from `malta.linearize`
    controller : of a machine; None: the first argument has it
    uncertainty : relative half range of each parameter, the unit of margins, as {"m": 0.2}, or its interval (low, high)
        in SI; None: that of the gain file
    stages : whether everything is asked for that `malta verify` prints: the margin of each stage and of each parameter
        alone, worst cases, payload, requirements; otherwise the linear figures and the margin over the travel, in a
        fraction of the time; None: of a gain file
    spec : the design, whose [specification] is judged with `stages`; None: none
    flights : whether requirements are judged that have to be flown
    current_loops : of the last stage: "pi", the controllers of the gain file on the windings, where a machine has some;
        "lag" ends at the stage `sampled`, with first-order lags at the crossover
    proof : False: without margins of parameters
    worst_case : whether the largest `|S|` of each sensor is searched; None: where one proof covers the travel
    time : s, longest search of a margin over the travel; None: 120
    progress : called with the share of the work that is done, 0 to 1
    bounds : called with the lower and upper bound of the margin over the travel so far

    Returns a LoopReport, which prints as a short table; its `figures` lists all figures of merit with their meaning.

    Raises InputError for unknown parameters, and for what is no loop; CheckError when numbers overflow, no input holds
    the machine, or its linear model at rest is not the machine's (`malta.inspect`). An unstable loop raises nothing: it
    is not `stable`, and its peak sensitivities are NaN.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> print(malta.verify(model, controller, spec.uncertainty))
    stable with hold
    peak |S|, sampled: y 1.71, zone A  all 1.71 (4.7 dB)
    peak |S|, + current loops: y 1.71, zone A  all 1.71 (4.7 dB)
    peak |S|, machine: y 1.57, zone A  all 1.57 (3.9 dB)
    bandwidth, last -3 dB of sigma_max(T): 103.82 Hz (652.3 rad/s)
    bandwidth, first -3 dB of sigma_min(T): 103.82 Hz (652.3 rad/s)
    bandwidth, last 0 dB of sigma_max(L): 46.29 Hz (290.8 rad/s)
    bandwidth, regulator's fastest natural frequency: 39.37 Hz (247.4 rad/s)
    bandwidth, regulator's slowest natural frequency: 39.37 Hz (247.4 rad/s)
    uncertainty: m C ±20 %
    robust: proven 320... %, lost at 320.62 % at 1047 rad/s
    >>> found = malta.verify(model, controller, {"m": 0.2}, stages=True)
    >>> down, up = found.tolerance["m"]
    >>> f"the sphere may lose {down.lower * 0.2:.0%} of its mass"
    'the sphere may lose 78% of its mass'
    """
    if isinstance(loop, str | Path):
        stages = True if stages is None else stages
        uncertainty = content_of(locate(loop))[0].uncertainty if uncertainty is None else uncertainty
        loop = read_stable(loop)
    if uncertainty is not None:
        by_name("verify", "uncertainty", uncertainty, '{"m": 0.2} or {"m": (0.1, 0.3)}')
        sides: Mapping[str, Any] = uncertainty
        uncertainty = {name: tuple(side) if is_pair(side) else side for name, side in sides.items()}
    model, controller = _model_and_controller(loop, controller)
    if why := unproven(model.plant, tuple(model.operating_point.x.tolist())):
        raise CheckError(f"{model.plant.name}: its linear model is not the machine's: {why}")
    if not stages:
        box = uncertainty if proof else None
        return linear_report(model, controller, box, current_loops, time=time)
    reach = progress or (lambda _: None)
    found, box = linear_report(model, controller, None, current_loops), dict(uncertainty or {})
    if box:
        found = staged_report(
            found,
            box,
            progress=lambda share: reach(MARGIN_SHARE * share),
            bounds=bounds,
            time=time,
            proof=proof,
        )
    if controller.schedule is not None:
        found = replace(
            found, notes=(*found.notes, _schedule_note(model.plant, controller, time, proof=proof))
        )
    plant = model.plant
    if worst_case is None:
        whole = controller.schedule is None and bool(box)
        worst_case = proof and whole and LoopAlong(plant, controller, tuple(box), current_loops).covers_travel
    worst = worst_sensitivities(plant, controller, box, current_loops, time=time) if worst_case else {}
    reach((1 + MARGIN_SHARE) / 2)
    carried = payload(plant, controller) if found.stable and proof else None
    return with_requirements(replace(found, worst=worst, payload=carried), spec, proof=proof, flights=flights)


def _schedule_note(plant: Plant, controller: Controller, time: float | None, *, proof: bool) -> str:
    """What the margins of a scheduled law are of, and how fast its reference may move."""
    assert controller.schedule is not None
    of = f"scheduled over the reference of {controller.schedule.variable}: margins are those of constant references, "
    of += "figures without a place those of the operating point"
    if not proof:
        return of
    bound = schedule_rate(plant, controller, time=time)
    unit = next(s.unit for s in plant.outputs if s.name == bound.name)
    if bound.rate is None:
        return f"{of}; nothing is proven of a reference that moves ({bound.reason})"
    return f"{of}; with the machine at its reference, nominal: {bound} {unit}/s"


def with_requirements(found: LoopReport, spec: Spec | None, *, proof: bool, flights: bool) -> LoopReport:
    """Add the requirements of a design file; a note says where they cannot be judged.

    proof : whether the margin is among them, where flights are not
    """
    if spec is None:
        return found
    spec = replace(spec, parameters=found.plant.parameters)
    names = (
        [*spec.specification]
        if flights
        else [n for n in entries_without_flights(spec) if proof or n != "margin"]
    )
    same = found.current_loops == LAST_STAGE and dict(found.uncertainty) == dict(spec.uncertainty)
    known = "margin" not in names or (same and found.robust is not None)
    try:
        outcomes = judge_controller(spec, found.controller, names, found if known else None)
    except (InputError, CheckError) as error:
        if isinstance(error, CheckError) and not flights:
            raise
        return replace(found, notes=(*found.notes, f"the requirements were not judged: {error}"))
    return replace(found, requirements=outcomes)


def _model_and_controller(
    loop: Controller | Plant | LinearModel, controller: Controller | None
) -> tuple[LinearModel, Controller]:
    """The machine at its operating point, and its controller. Raises InputError for one too many or too few."""
    if isinstance(loop, Controller) and controller is None:
        return _model_and_controller(plant_of(loop.parameters), loop)
    if isinstance(loop, Controller) or controller is None:
        found = "no controller" if controller is None else "two controllers"
        raise InputError("verify", "", found, "a gain file, a controller, or a machine and its controller")
    if isinstance(loop, LinearModel):
        return loop, controller
    return linearize(loop, loop.point(controller.operating_point[0])), controller

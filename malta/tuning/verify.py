"""`malta.verify`, in its order: what is linear, the proven margin, stage by stage if asked, the requirements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.arguments import by_name, is_pair
from malta.errors import CheckError, InputError
from malta.files import locate
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.loops.windings import LAST_STAGE, CurrentLoops
from malta.margins.loop_report import LoopReport
from malta.margins.schedule_rates import schedule_rate
from malta.margins.travel import LoopAlong
from malta.margins.verify import linear_report, staged_report
from malta.margins.worst_case import worst_sensitivities
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import Plant, given_plant
from malta.model.plants import plant_of
from malta.model.soundness import unproven
from malta.proof.margin import Progress, Ranges
from malta.simulation.experiments.payloads import payload
from malta.synthesis.controller import Controller, given_law, require_law_of
from malta.synthesis.requirements import Payload
from malta.tuning.outcomes import entries_without_flights, judge_controller, open_entries
from malta.work import NO_TIME, WorkUp, is_stopped, without_limit

if TYPE_CHECKING:
    from malta.synthesis.spec import Spec

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
    flights : whether requirements are judged that need a simulation
    current_loops : of the last stage: "pi", the controllers of the gain file on the windings, where a machine has some;
        "lag" ends at the stage `sampled`, with first-order lags at the crossover
    proof : False: without margins of parameters
    worst_case : whether the largest `|S|` of each sensor is searched; None: where one proof covers the travel
    time : s, longest search of a margin over the travel; None: 120
    progress : called with the share of the work that is done, 0 to 1
    bounds : called with the lower and upper bound of the margin over the travel so far

    Returns a LoopReport, which prints as a short table; its `figures` lists all figures of merit with their meaning.

    Raises InputError for unknown parameters, and for what is no loop. Raises CheckError when numbers overflow, no input
    holds the machine, or its linear model at rest is not the machine's (`malta.inspect`). An unstable loop raises
    nothing: it is not `stable`, and its peak sensitivities are NaN.

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
    plant, stopped = model.plant, is_stopped()
    if worst_case is None and not stopped:
        whole = controller.schedule is None and bool(box)
        worst_case = proof and whole and LoopAlong(plant, controller, tuple(box), current_loops).covers_travel
    asked = worst_case and not stopped
    worst = worst_sensitivities(plant, controller, box, current_loops, time=time) if asked else {}
    reach((1 + MARGIN_SHARE) / 2)
    carried = _payload_in_time(plant, controller) if found.stable and proof else None
    found = replace(found, worst=worst, payload=carried)
    if proof and is_stopped() and (found.robust is None or found.robust.lower is None):
        ended = "the search of the margin ended early: what is asked of it was not judged"
        proof, found = False, replace(found, notes=(*found.notes, ended))
    with nullcontext() if flights else without_limit():  # without flights it takes no time
        return with_requirements(found, spec, proof=proof, flights=flights)


def _payload_in_time(plant: Plant, controller: Controller) -> Payload | None:
    """The payload; None where there is no time for it."""
    try:
        return None if is_stopped() else payload(plant, controller)
    except WorkUp:
        return None


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


def with_requirements(
    found: LoopReport,
    spec: Spec | None,
    *,
    proof: bool,
    flights: bool,
    progress: Callable[[float], None] | None = None,
) -> LoopReport:
    """Add the requirements of a design file; a note says where they cannot be judged, or are not for lack of time.

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
        outcomes = judge_controller(spec, found.controller, names, found if known else None, progress)
    except (InputError, CheckError) as error:
        if isinstance(error, CheckError) and not flights:
            raise
        return replace(found, notes=(*found.notes, f"the requirements were not judged: {error}"))
    left = open_entries(names, outcomes)
    notes = (*found.notes, *([f"not judged, {NO_TIME}: {' '.join(left)}"] if left else []))
    return replace(found, requirements=outcomes, notes=notes)


def _model_and_controller(
    loop: Controller | Plant | LinearModel, controller: Controller | None
) -> tuple[LinearModel, Controller]:
    """The machine at its operating point, and its controller. Raises InputError for one too many or too few."""
    if isinstance(loop, Controller) and controller is None:
        return _model_and_controller(plant_of(loop.parameters), loop)
    if isinstance(loop, Controller) or controller is None:
        found = "no controller" if controller is None else "two controllers"
        raise InputError("verify", "", found, "a gain file, a controller, or a machine and its controller")
    plant, controller = given_plant("verify", loop), given_law("verify", controller)
    require_law_of("verify", controller, plant, by_name=False)
    if isinstance(loop, LinearModel):
        return loop, controller
    return linearize(plant, plant.point(controller.operating_point[0])), controller

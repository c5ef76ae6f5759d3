"""`malta.verify`: all that is known of a loop, as one record, with the requirements of its design file judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from malta.errors import CheckError, InputError
from malta.files import locate
from malta.gains.file import content_of, read
from malta.loops.sampled_loops import LAST
from malta.margins.loop_report import LoopReport
from malta.margins.stages import staged_report
from malta.margins.travel import covers_travel, worst_sensitivities
from malta.margins.verify import linear_report
from malta.model.data import plant_of
from malta.model.linearize import LinearModel, linearize
from malta.simulation.payload import payload
from malta.synthesis.controller import Controller
from malta.tuning.outcomes import judge, unflown

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.proof.machine.windings import CurrentLoops
    from malta.proof.margin import Progress
    from malta.synthesis.spec import Spec

MOST = 0.5  # of the time of a verification, which the margins take


def verify(
    loop: str | Path | Controller | Plant | LinearModel,
    controller: Controller | None = None,
    uncertainty: Mapping[str, float] | None = None,
    *,
    stages: bool | None = None,
    spec: Spec | None = None,
    flights: bool = False,
    current_loops: CurrentLoops = LAST,
    proof: bool = True,
    worst_case: bool | None = None,
    time: float | None = None,
    progress: Callable[[float], None] | None = None,
    bounds: Progress | None = None,
) -> LoopReport:
    """Verify a controller on a machine: poles, peak sensitivities, bandwidths, margins with proof, requirements.

    loop : a gain file, a controller on its own machine, or a machine: its plant, or its model from `malta.linearize`
    controller : of a machine; None: the first argument has it
    uncertainty : relative half range of each parameter, the unit of margins, as {"m": 0.2}; None: that of the gain file
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

    Raises InputError for unknown parameters, and for what is no loop; CheckError when numbers overflow or no input
    holds the machine. An unstable loop raises nothing: it is not `stable`, and its peak sensitivities are NaN.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> print(malta.verify(model, controller, spec.uncertainty))
    stable with hold, delay and current loops
    peak |S|, sampled: y 1.71 A  all 1.71 (4.7 dB)
    peak |S|, + current loops: y 1.71 A  all 1.71 (4.7 dB)
    peak |S|, machine: y 1.57 A  all 1.57 (3.9 dB)
    bandwidth, last -3 dB of sigma_max(T): 652.0 rad/s (103.76 Hz)
    bandwidth, first -3 dB of sigma_min(T): 652.0 rad/s (103.76 Hz)
    bandwidth, last 0 dB of sigma_max(L): 290.8 rad/s (46.29 Hz)
    bandwidth, regulator's fastest natural frequency: 247.4 rad/s (39.37 Hz)
    bandwidth, regulator's slowest natural frequency: 247.4 rad/s (39.37 Hz)
    uncertainty: m +-20 %  C +-20 %
    robust: proven 320... %, lost at 320.61 % at 1047 rad/s
    >>> found = malta.verify(model, controller, {"m": 0.2}, stages=True)
    >>> down, up = found.tolerance["m"]
    >>> f"the sphere may lose {down.lower * 0.2:.0%} of its mass"
    'the sphere may lose 78% of its mass'
    """
    if isinstance(loop, str | Path):
        stages = True if stages is None else stages
        uncertainty = content_of(locate(loop))[0].uncertainty if uncertainty is None else uncertainty
        loop = read(loop)
    model, controller = _model_and_controller(loop, controller)
    if not stages:
        box = uncertainty if proof else None
        return linear_report(model, controller, box, current_loops, time=time)
    reach = progress or (lambda _: None)
    found, box = linear_report(model, controller, None, current_loops), dict(uncertainty or {})
    if box:
        found = staged_report(
            found, box, progress=lambda share: reach(MOST * share), bounds=bounds, time=time, proof=proof
        )
    plant = model.plant
    if worst_case is None:
        worst_case = proof and bool(box) and covers_travel(plant, controller, tuple(box), current_loops)
    worst = worst_sensitivities(plant, controller, box, current_loops, time=time) if worst_case else {}
    reach((1 + MOST) / 2)
    carried = payload(plant, controller) if found.stable and proof else None
    return with_requirements(replace(found, worst=worst, payload=carried), spec, proof=proof, flights=flights)


def with_requirements(found: LoopReport, spec: Spec | None, *, proof: bool, flights: bool) -> LoopReport:
    """Add the requirements of a design file; a note says where they cannot be judged.

    proof : whether the margin is among them, where flights are not
    """
    if spec is None:
        return found
    spec = replace(spec, parameters=found.plant.parameters)
    names = [*spec.specification] if flights else [n for n in unflown(spec) if proof or n != "margin"]
    same = found.current_loops == LAST and dict(found.uncertainty) == dict(spec.uncertainty)
    known = "margin" not in names or (same and found.robust is not None)
    try:
        outcomes = judge(spec, found.controller, names=names, verified=found if known else None)
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

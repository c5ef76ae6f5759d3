"""All that the pages show of a loop, computed once: margins, loads, noise, the machine's main job, requirements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

from malta.errors import CheckError, InputError
from malta.loops.classical import Classical
from malta.loops.curves import loop_curves
from malta.loops.loop import Loop, loop_along
from malta.loops.recovery import recovery
from malta.loops.sampled_loops import LAST
from malta.margins.stages import robustness
from malta.margins.travel import covers_travel, worst_sensitivities
from malta.margins.verify import verify
from malta.model.data import plant_of
from malta.model.linearize import linearize
from malta.simulation.catalogue import experiment, main_job
from malta.simulation.payload import payload
from malta.tuning.noise import noise_of
from malta.tuning.outcomes import judge

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.loops.curves import LoopCurves
    from malta.loops.recovery import Recovery
    from malta.margins.stages import Robustness
    from malta.margins.verify import Margins
    from malta.model.linearize import LinearModel
    from malta.model.plant import Parameters, Plant
    from malta.proof.blocks.gain import Gain
    from malta.proof.machine.windings import CurrentLoops
    from malta.proof.margin import Margin
    from malta.simulation.experiments import Experiment
    from malta.simulation.payload import Payload
    from malta.synthesis.controller import Controller
    from malta.synthesis.requirements import Noise
    from malta.synthesis.spec import Spec
    from malta.tuning.outcomes import Outcome

Share = Callable[[float], None]  # takes the share of the work that is done, 0 to 1


class Subject(NamedTuple):
    """A controller on a machine, with what a page needs to know beside them."""

    controller: Controller
    parameters: Parameters  # of the machine, which need not be those of the controller
    box: Mapping[
        str, float
    ] = {}  # parameter -> share, either way, at margin 1; empty: no margin of parameters
    spec: Spec | None = None  # the design file, whose [specification] is judged
    source: str = ""  # the gain file, as the user named it
    changes: Sequence[str] = ()  # of the machine, as "m=0.56"
    provenance: Sequence[
        tuple[str, str]
    ] = ()  # of the gain file: its seal, and versions that it was written with
    current_loops: CurrentLoops = LAST

    @property
    def written_from(self) -> Spec | None:
        """The design file that the gains were synthesized from; None where it is not known, or was changed since."""
        same = self.spec is not None and self.spec.sha256 == self.controller.spec_sha256
        return self.spec if same else None

    @property
    def plant(self) -> Plant:
        """The machine."""
        return plant_of(self.parameters)

    @property
    def model(self) -> LinearModel:
        """The machine's linear model at the controller's operating point."""
        plant = self.plant
        return linearize(plant, plant.point(self.controller.operating_point[0]))

    @property
    def loop(self) -> Loop:
        """The machine's loop at the controller's operating point."""
        return loop_along(self.plant, self.controller, current_loops=self.current_loops)


@dataclass(frozen=True, eq=False)
class Analysis:
    """The results for one subject. What an unstable loop or a machine does not have is None or empty."""

    subject: Subject
    plant: Plant
    model: LinearModel
    margins: Margins
    robust: Robustness | None  # None without uncertain parameters
    margin: (
        Margin | None
    )  # of all parameters at once, anywhere in the travel; None where it was not asked for
    classical: Classical | None  # at the operating point
    worst: Mapping[str, Gain]
    recovered: Sequence[Recovery]
    payload: Payload | None
    noise: Noise | None
    job: Experiment | None
    outcomes: Sequence[Outcome]
    campaigns: Sequence[Summary]
    notes: Sequence[str]  # what could not be computed, and why

    @cached_property
    def curves(self) -> LoopCurves:
        """The curves of the machine's loop."""
        return loop_curves(self.subject.loop)


def analyse(
    subject: Subject,
    *,
    proof: bool = True,
    stages: bool = True,
    campaigns: Sequence[Summary] = (),
    progress: Share | None = None,
) -> Analysis:
    """Compute all that the pages show of a subject.

    proof : whether margins of the parameters are proven
    stages : whether every stage and each parameter alone has its margin, and |S| its worst case; otherwise the margin
        of all parameters at once is the only one
    progress : takes the share of the work that is done

    Raises CheckError when numbers overflow or no input holds the machine.
    """
    plant, model, controller = subject.plant, subject.model, subject.controller
    steps = _Steps(progress)
    margins = verify(model, controller, subject.box if proof and not stages else None)
    robust = _robust(subject, steps.part(0.0, 0.5), proof=proof and stages)
    steps.reach(0.5)
    covered = stages and proof and bool(subject.box)
    covered = covered and covers_travel(plant, controller, tuple(subject.box), subject.current_loops)
    worst = worst_sensitivities(plant, controller, subject.box, subject.current_loops) if covered else {}
    carried = payload(plant, controller) if margins.stable and stages and proof else None
    steps.reach(0.7)
    notes: list[str] = []
    job = _main_job(subject, notes, steps.part(0.7, 0.8))
    margin = margins.robust if robust is None or not stages else robust.travel if proof else None
    outcomes = _outcomes(subject, replace(margins, robust=margin), notes)
    steps.reach(1.0)
    return Analysis(
        subject,
        plant,
        model,
        margins,
        robust,
        margin=margin,
        classical=subject.loop.classical if margins.stable else None,
        worst=worst,
        recovered=recovery(plant, controller) if margins.stable and plant.disturbances else (),
        payload=carried,
        noise=noise_of(subject.loop.sampled, plant) if margins.stable else None,
        job=job,
        outcomes=outcomes,
        campaigns=tuple(campaigns),
        notes=tuple(notes),
    )


class _Steps(NamedTuple):
    """The work of an analysis, in parts that each take about their share of the time."""

    progress: Share | None

    def reach(self, share: float) -> None:
        """Say that a share of the work is done."""
        if self.progress is not None:
            self.progress(share)

    def part(self, low: float, high: float) -> Share:
        """The function that takes the share done of a part of the work."""
        return lambda share: self.reach(low + (high - low) * share)


def _robust(subject: Subject, progress: Share, *, proof: bool) -> Robustness | None:
    """Margins of the parameters and along the travel; None without uncertain parameters."""
    if not subject.box:
        return None
    return robustness(
        subject.plant, subject.controller, subject.box,
        current_loops=subject.current_loops, progress=progress, proof=proof,
    )  # fmt: skip


def _main_job(subject: Subject, notes: list[str], progress: Share) -> Experiment | None:
    """The machine's main job; None, with a note, where it cannot be simulated."""
    plant = subject.plant
    name = main_job(plant)
    try:
        found = experiment(name, plant, subject.controller, progress=progress)
    except (InputError, CheckError) as error:
        notes.append(f"{name} was not simulated: {error}")
        return None
    if found.interrupted or any(case.run.verdict.name == "interrupted" for case in found.cases):
        raise KeyboardInterrupt
    return found


def _outcomes(subject: Subject, margins: Margins, notes: list[str]) -> tuple[Outcome, ...]:
    """What the design file asks for, measured with the gains of the gain file; none without a design file.

    margins : of the subject, with the margin over its uncertainty where that is proven
    """
    if subject.spec is None:
        return ()
    spec = replace(subject.spec, parameters=subject.parameters)
    same = subject.current_loops == LAST and dict(subject.box) == dict(spec.uncertainty)
    verified = margins if same and margins.robust is not None else None
    try:
        return judge(spec, subject.controller, verified=verified)
    except (InputError, CheckError) as error:
        notes.append(f"the requirements were not judged: {error}")
        return ()

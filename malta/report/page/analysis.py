"""What a page shows of a design: the record of its loop, the machine's main job, campaigns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.errors import CheckError, InputError
from malta.loops.curves import loop_curves
from malta.loops.sampled_loops import LAST
from malta.margins.figures import figure
from malta.margins.loop_report import in_groups
from malta.model.data import plant_of
from malta.simulation.catalogue import experiment, main_job
from malta.simulation.experiments import progress_of_part
from malta.tuning.verify import verify, with_requirements

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.loops.curves import LoopCurves
    from malta.margins.figures import LoopFigure
    from malta.margins.loop_report import LoopReport
    from malta.model.plant import Parameters, Plant
    from malta.proof.machine.windings import CurrentLoops
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

Share = Callable[[float], None]  # takes the share of the work that is done, 0 to 1
JOBS = {"low": "job_lower", "high": "job_higher", "": "job"}  # kinds of figures by which way is better


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


@dataclass(frozen=True, eq=False)
class Analysis:
    """What is shown of one subject."""

    subject: Subject
    report: LoopReport
    job: Experiment | None  # None where it could not be simulated
    campaigns: Sequence[Summary]
    notes: Sequence[str]  # what could not be computed, and why

    @property
    def plant(self) -> Plant:
        """The machine."""
        return self.report.plant

    @cached_property
    def curves(self) -> LoopCurves:
        """The curves of the machine's loop."""
        return loop_curves(self.report.loop)

    @cached_property
    def figures(self) -> tuple[LoopFigure, ...]:
        """The figures of merit of the loop and of the main job, in the order of their groups."""
        return in_groups([*self.report.figures, *_job_figures(self.job)])


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
    found = verify(
        subject.plant, subject.controller, subject.box, stages=stages, proof=proof,
        current_loops=subject.current_loops, progress=progress_of_part(progress, 0, 2),
    )  # fmt: skip
    notes: list[str] = []
    job = _main_job(subject, notes, progress_of_part(progress, 1, 2))
    found = with_requirements(found, subject.spec, proof=proof, flights=True)
    return Analysis(subject, found, job, tuple(campaigns), (*notes, *found.notes))


def _main_job(subject: Subject, notes: list[str], progress: Share | None) -> Experiment | None:
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


def _job_figures(job: Experiment | None) -> Iterator[LoopFigure]:
    if job is None:
        return
    several = len(job.cases) > 1
    rows = [("", merit) for merit in job.merits]
    if several and [m.label for m in job.merits] == [m.label for m in job.cases[0].merits]:
        rows = [(case.label, merit) for case in job.cases for merit in case.merits]
    completed = float(np.mean([case.run.verdict.completed for case in job.cases]))
    yield figure("job_higher", f"{job.name} completed", f"{job.name}: runs completed", completed, "percent")
    for case, merit in rows:
        label = f"{case}: {merit.label}" if case else merit.label
        name = f"{job.name} {case} {merit.key or merit.label}"
        yield figure(JOBS[merit.better], name, label, merit.value, merit.unit)

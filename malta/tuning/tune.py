"""Specification -> design: the numbers of [search] that reach what a design file asks for in [specification].

The weights of an LQG are searched by tuning.lqg, the gains of a PID by tuning.pid; what is found is judged as the file
that will be written.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from tomlkit.items import Item

from malta.display import Description, display
from malta.errors import InputError
from malta.model.parameters import describe
from malta.tuning import groups, lqg, pid
from malta.tuning.search import DIGITS, Effort, Journal, apply_trial
from malta.tuning.verify import judge

if TYPE_CHECKING:
    from malta.margins.loop_report import Outcome
    from malta.synthesis.spec import Spec
    from malta.tuning.search import Progress, Trial


@display
@dataclass(frozen=True, eq=False)
class Tuned:
    """What a search found."""

    spec: Spec  # with the weights that were found
    trial: Trial
    requirements: tuple[Outcome, ...]
    front: tuple[Trial, ...]  # by margin: least bearing force noise, least motion; and the trial itself
    trials: int

    @property
    def reached(self) -> bool:
        """Whether every requirement holds."""
        return all(r.holds for r in self.requirements)

    @property
    def binding(self) -> Outcome:
        """What is nearest to its limit, or furthest beyond it."""
        return max(self.requirements, key=lambda r: r.ratio)

    @property
    def description(self) -> Description:
        """What was asked for, and what was found."""
        rows = tuple((outcome.verdict, str(outcome)) for outcome in self.requirements)
        word = "reached" if self.reached else "not reached"
        return Description(f"Tuned {self.spec.name!r} in {self.trials} trials: {word}", rows)


def tune(
    spec: Spec,
    journal: Path | None = None,
    *,
    effort: Effort = Effort(),  # noqa: B008
    restart: bool = False,
    progress: Progress | None = None,
) -> Tuned:
    """Search the numbers of [search] in a design file for the figures of [specification].

    spec : the design, from `malta.read_design`
    journal : file of the trials; what is in it is not computed again; None: none is written
    effort : generations of the search, trials that polish its best, and trials for the Pareto front
    restart : forget what is in the journal
    progress : called with the share of the work that is done, 0 to 1

    Returns a Tuned: the `spec` with the numbers that were found, its `requirements`, and the Pareto `front`.

    Raises InputError when the design file asks for nothing or lets nothing vary, for a machine whose sensors read late,
    and when the journal is another search's.

    >>> import malta
    >>> from malta.tuning.search import Effort
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> tuned = malta.tune(spec, effort=Effort(generations=4, polish=10, front=0))
    >>> tuned.reached, [requirement.name for requirement in tuned.requirements]
    (True, ['margin', 'peak_sensitivity', 'motion y', 'force_noise f'])
    """
    if not spec.specification:
        raise InputError(spec.path, "specification", "nothing", "a table of what the design shall reach")
    if spec.plant.sensors is not None:
        found = "sensors that read late"
        raise InputError(spec.path, "machine", found, "sensors without lag: verify takes the lag of a design")
    if not spec.search:
        raise InputError(spec.path, "search", "nothing", "a table of the numbers that may vary")
    trials = Journal(journal, problem_sha256(spec), restart=restart)
    search = pid.search_gains if spec.pid else lqg.search_weights
    trial, front = search(spec, trials, effort, progress)
    chosen = apply_trial(spec, trial)
    requirements = judge(chosen)
    if progress is not None:
        progress(1.0)
    return Tuned(chosen, trial, requirements, front, len(trials.known))


def problem_sha256(spec: Spec) -> str:
    """Digest everything that the figures of a trial depend on, and what is searched."""
    asked, searched = dict(spec.specification), (spec.search, spec.delays)
    loads = asdict(spec.loads) if spec.loads else None
    pushes = [asdict(bound) for bound in spec.recovery.values()]
    settings = (lqg.FRONT, DIGITS, groups.STEP, groups.NEAR)
    content = [describe(spec.parameters), asked, loads, pushes, searched, spec.sha256, *settings]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# Trial -> design file: the file that was given with other numbers, all else as it stands.


def design_text(spec: Spec, trial: Trial, target: Path) -> str:
    """Write the text of the design file with the numbers of a trial, for another folder.

    Comments, the order of keys and all other values stay as they stand in spec.path.
    """
    document = tomlkit.parse(spec.path.read_text(encoding="utf-8"))
    document["machine"] = Path(
        os.path.relpath(spec.machine_file.resolve(), target.resolve().parent)
    ).as_posix()
    if spec.pid is None:
        document["delay"] = trial.delay
    for variable, value in zip(spec.search, trial.values, strict=True):
        for entry in variable.entries:
            *tables, name = entry.split(".")
            table: Any = document
            for key in tables:
                table = table[key]
            if isinstance(table[name], dict):
                table[name]["value"] = _number(value)
                table[name]["unit"] = variable.unit
            else:
                table[name] = _number(value)
    return tomlkit.dumps(document)


def _number(value: float) -> Item:
    """A number as the file shall hold it, in as many digits as were tried."""
    return tomlkit.value(f"{value:.{DIGITS}g}")

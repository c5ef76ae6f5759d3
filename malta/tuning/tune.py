"""Specification -> design: the numbers of [search] that reach what a design file asks for in [specification].

The weights of an LQG are searched by `tune_lqg`, the gains of a PID by `tune_pid`; what is found is judged as the file
that will be written.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from malta.errors import InputError
from malta.synthesis.spec import Specification
from malta.tuning import lqg as tune_lqg
from malta.tuning import pid as tune_pid
from malta.tuning.search import (
    DIGITS,
    Effort,
    Journal,
    Tuned,
    found_spec,
)

if TYPE_CHECKING:
    from pathlib import Path

    from malta.synthesis.spec import Spec
    from malta.tuning.search import Progress, Requirement


def tune(
    spec: Spec,
    journal: Path | None = None,
    *,
    effort: Effort = Effort(),  # noqa: B008
    restart: bool = False,
    progress: Progress | None = None,
) -> Tuned:
    """Search the numbers of [search] for the figures of [specification].

    journal : file of the trials; what is in it is not computed again

    Raises InputError when the design file asks for nothing or lets nothing vary, or the journal is another search's.
    """
    if spec.specification == Specification():
        raise InputError(spec.path, "specification", "nothing", "a table of what the design shall reach")
    if not spec.search:
        raise InputError(spec.path, "search", "nothing", "a table of the numbers that may vary")
    kept = Journal(journal, problem_sha256(spec), restart=restart)
    searched = tune_pid.searched if spec.pid else tune_lqg.searched
    trial, front = searched(spec, kept, effort, progress)
    chosen = found_spec(spec, trial)
    requirements = judged(chosen)
    if progress is not None:
        progress(1.0)
    return Tuned(chosen, trial, requirements, front, len(kept.known))


def judged(spec: Spec) -> tuple[Requirement, ...]:
    """Every requirement of a design, and what it has."""
    return tune_pid.judged(spec) if spec.pid else tune_lqg.judged(spec)


def problem_sha256(spec: Spec) -> str:
    """Of everything that the figures of a trial depend on, and of what is searched."""
    asked, searched = asdict(spec.specification), (spec.search, spec.delays)
    loads = asdict(spec.loads) if spec.loads else None
    settings = (tune_lqg.FRONT, DIGITS, tune_lqg.STEP)
    content = [repr(spec.parameters), asked, loads, searched, spec.sha256, *settings]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

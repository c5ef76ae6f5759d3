"""Judging a design: its requirements, measured on its verified loop and its simulated machine."""

from __future__ import annotations

from collections.abc import Collection

from malta.margins.loop_report import LoopReport
from malta.margins.outcome import Outcome
from malta.synthesis.controller import Controller
from malta.synthesis.spec import Spec
from malta.tuning.outcomes import judge_controller
from malta.tuning.search import model_and_controller


def judge(
    spec: Spec,
    controller: Controller | None = None,
    *,
    names: Collection[str] | None = None,
    verified: LoopReport | None = None,
) -> tuple[Outcome, ...]:
    """Measure requirements of a design: proven margin, verified loop, covariance, simulated experiments.

    controller : of a gain file, in place of the one that the design file is synthesized to
    names : entries of the specification; None: all
    verified : what `malta.verify` found of the controller, with the margin where one is asked for; None: computed

    A PID's load errors come first, which no bound is asked of. What an unstable loop does not have fails.

    Raises InputError for a PID without [cost], and for a requirement that the machine does not have.
    """
    own = model_and_controller(spec)[1] if controller is None else controller
    return judge_controller(spec, own, spec.specification if names is None else names, verified)

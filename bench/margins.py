"""Proven margins beside what others report of them: the flagship's, and those of published problems."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import peer_margin as peer
from peer_published import Asked, OfLoop, OfPolynomial, Unfit, blocks
from published_cases import CASES, Loop, Polynomial
from timing import Result, medians, optional

import malta
from malta.loops.sampled_laws import machine_law
from malta.margins.travel import travel_margin
from malta.proof.robust import problem_of

ROOT = Path(__file__).parents[1]
SAMPLES, BATCH = 10_000, 100


def margin(runs: int) -> list[Result]:
    """The margin of the flagship's loop on the machine at z = 0, and what others report of it."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    plant = malta.plant_of(controller.parameters)
    box = dict.fromkeys(("m", "K_A", "K_D", "K_B"), peer.SHARE)
    problem = peer.Problem(malta.uncertain(plant, list(box)), machine_law(plant, controller))
    ours = malta.robust_margin(problem.system, problem.law, box)
    travel = travel_margin(plant, controller, box)
    of, most = (problem.lost, len(box)), peer.MACHINE_MOST
    calls: dict[str, Callable[[], float]] = {
        "gridding": lambda: peer.gridding(*of, most),
        "Monte-Carlo for 2 s": lambda: peer.monte_carlo(*of, most, peer.for_seconds(2.0, 16)),
    }
    if optional("slycot"):
        calls["AB13MD on 300 frequencies"] = lambda: peer.machine_ab13md(problem)
    answers = {name: call() for name, call in calls.items()}

    def anew() -> object:  # without what is remembered of the loop
        problem_of.cache_clear()
        return malta.robust_margin(problem.system, problem.law, box)

    def along() -> object:
        problem_of.cache_clear()
        return travel_margin(plant, controller, box)

    seconds, everywhere, *theirs = medians(anew, along, *calls.values(), runs=runs, what="margin")
    told = f"margin at z = 0: {ours.lower:.4f} .. {ours.upper:.4f}"
    rows = [
        Result(told, seconds, f"{name}: {answers[name]:.3f}", took, "")
        for name, took in zip(calls, theirs, strict=True)
    ]
    return [
        *rows,
        Result(f"all the travel: {travel.lower:.4f} .. {travel.upper:.4f}", everywhere, "z = 0", seconds, ""),
    ]


def published(runs: int) -> list[Result]:
    """Problems whose margin is published: our bounds, and the number of boxes that each peer reports.

    A grid and samples can only report too much. So does AB13MD where the critical frequency falls between those of its
    grid, though at that frequency its bound is the margin; it needs even ranges and each parameter once.
    """
    with_slycot = bool(optional("slycot"))
    return [row for case in CASES for row in _rows(case, runs, with_slycot)]


def _proven(case: Polynomial | Loop) -> malta.proof.Margin:
    """Without what is remembered of the loop."""
    problem_of.cache_clear()
    if isinstance(case, Polynomial):
        return malta.proof.margin_of_polynomial(case.coefficients, case.box, case.nominal)
    system = malta.uncertain(case.matrices, case.nominal, limits=case.limits)
    if case.dynamics:
        return malta.dynamic_margin(system, case.law, case.box, malta.proof.Dynamic(case.dynamics))
    return malta.robust_margin(system, case.law, case.box)


def _rows(case: Polynomial | Loop, runs: int, with_slycot: bool) -> list[Result]:
    """A row for each peer; what is reported is in boxes, as the margin."""
    asked: Asked = OfPolynomial(case) if isinstance(case, Polynomial) else OfLoop(case)
    of, n = (asked.lost, len(asked.kinds), asked.most), len(asked.kinds)
    points = 9 if n < 4 else 5
    calls: dict[str, Callable[[], float]] = {
        f"grid of {points}": lambda: peer.gridding(*of, points=points, bisections=14),
        "1e4 samples": lambda: peer.monte_carlo(*of, [BATCH] * (SAMPLES // BATCH)),
    }
    last = "AB13MD at 300 w"
    try:
        blocks(asked)
        if with_slycot:
            calls[last] = lambda: peer.ab13md(blocks(asked), asked.kinds)
        else:
            last = "AB13MD: no slycot"
    except Unfit as error:
        last = f"AB13MD: {error}"
    answers = [call() for call in calls.values()]
    ours = _proven(case)
    assert ours.lower is not None, f"{case.name}: {ours.reason}"
    assert ours.lower <= case.margin * (1 + 1e-6), case.name
    assert ours.upper >= case.margin * (1 - 1e-6), case.name
    seconds, *theirs = medians(lambda: _proven(case), *calls.values(), runs=runs, what=case.name)
    told = (
        case.name,
        f"  {ours.lower:.6g} .. {ours.upper:.6g}",
        f"  relative gap {ours.upper / ours.lower - 1:.0e}",
    )
    names = [f"{name}: {answer:.4g}" for name, answer in zip(calls, answers, strict=True)]
    if last not in calls:
        names, theirs = [*names, last], [*theirs, math.nan]
    rows = zip(told, names, theirs, strict=True)
    return [Result(mine, seconds, peer_and_answer, took, "") for mine, peer_and_answer, took in rows]

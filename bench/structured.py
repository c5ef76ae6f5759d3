"""Structured laws and H-infinity beside what a Python user has for them: a general search, and SLICOT's synthesis.

    differential evolution    the same figures of the same loops, with a penalty for what is hard or unstable
    control.hinfsyn           SLICOT's SB10AD, where slycot is installed

What a peer finds is shown: its largest figure, or its gamma, beside ours.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import control
import numpy as np
from scipy import optimize
from timing import Result, medians, optional

from malta import structured as own
from malta.structured.loops import models_of_systems
from malta.structured.search import Task, random_starts, rate_of, search
from malta.synthesis.structure import Structure, places_of

if TYPE_CHECKING:
    from malta.arrays import FloatArray

LOST = 1e3  # the merit of an unstable loop
WIDE = 3.0  # of x, either way: factors of 20


def _positioning() -> Task:
    """The positioning system of docs/howto/structured.md at nominal parameters: a lead and a notch, order 3."""
    J1, J2, b1, b2, b12, k = 1e-6, 1.15e-7, 1e-6, 1e-6, 5e-7, 0.013
    A = [
        [0, 1, 0, 0],
        [-k / J1, -(b1 + b12) / J1, k / J1, b12 / J1],
        [0, 0, 0, 1],
        [k / J2, b12 / J2, -k / J2, -(b2 + b12) / J2],
    ]
    (model,) = models_of_systems(control.ss(A, [[0], [1 / J1], [0], [0]], [[0, 0, 1, 0]], 0))
    law = own.gain("k", 5e-5) * own.lead("lead", 5.0, 500.0) * own.notch("notch", 380.0, 0.05, 0.8)
    goals = own.sensitivity(1.3), own.poles(fastest=1e3), own.soft(own.tracking(0.04, peak=1.3))
    return Task(Structure(places_of(law, model.inputs, model.outputs)), goals, (model,), rate_of(model))


def structured(runs: int) -> list[Result]:
    """A law of six numbers, and a general plant of eight states."""
    task, found = _positioning(), {}
    n = len(task.structure.parameters)

    def merit(x: FloatArray) -> float:
        look = task.look(x)
        return LOST if look is None else look.merit

    def ours() -> None:
        found["ours"] = search(task, random_starts(task.structure, 1, 0)).merit

    def evolution() -> None:
        bounds = optimize.Bounds(-WIDE * np.ones(n), WIDE * np.ones(n))
        found["theirs"] = optimize.differential_evolution(merit, bounds, maxiter=25, popsize=8, rng=0).fun

    seconds, theirs = medians(ours, evolution, runs=min(runs, 2), what="structured")
    peer = f"differential evolution, 25 generations: {found['theirs']:.3f}"
    rows = [Result(f"lead and notch: {found['ours']:.3f}", seconds, peer, theirs, "at least 1")]
    if not optional("slycot"):
        return rows
    rng = np.random.default_rng(0)
    P = control.ss(*(rng.normal(size=s) for s in ((8, 8), (8, 5), (5, 8), (5, 5))))
    gamma, known = own.h_infinity(P, 2, 2).gamma, control.hinfsyn(P, 2, 2)[2]
    assert abs(gamma / known - 1) < 1e-4, (gamma, known)
    seconds, theirs = medians(
        lambda: own.h_infinity(P, 2, 2), lambda: control.hinfsyn(P, 2, 2), runs=runs, what="H-infinity"
    )
    return [*rows, Result(f"H-infinity, 8 states: {gamma:.5f}", seconds, f"hinfsyn: {known:.5f}", theirs, "")]

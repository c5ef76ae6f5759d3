"""What a proof by multipliers keeps is checked again in balls, and refused when anything of it is changed."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from test_many_parameters import asked, chain, ranges

import malta
from malta.proof.multipliers import BlockSizes, Multiplier
from malta.proof.multipliers.checked import refusal
from malta.proof.multipliers.structured import MultiplierProof, Shown, worst
from malta.work import WorkUp, work_limit


@cache
def proven(n: int, T: float | None, target: float = 1.0) -> MultiplierProof:
    s = asked(chain(n, T))
    with work_limit(30.0), suppress(WorkUp):
        s.raise_bound(target, 30.0)
    assert s.lower >= 0.5 * target
    assert s.proof().layers[-1].t == s.lower
    return s.proof()


@pytest.mark.slow
@pytest.mark.parametrize("T", [None, 1.5])
def test_what_is_kept_confirms_the_proof(T: float | None) -> None:
    assert refusal(proven(1, T)) == ""


@pytest.mark.slow
def test_what_is_kept_confirms_longer_proofs() -> None:
    assert refusal(proven(2, None, 0.7)) == ""


@pytest.mark.slow
def test_a_margin_keeps_its_proof() -> None:
    loop = chain(3, None)
    found = malta.robust_margin(*loop, ranges(loop[0]), budget=malta.proof.Budget(20.0))
    (whole,) = found.certificate
    assert whole.multipliers is not None
    assert whole.multipliers.layers[-1].t == found.lower
    assert refusal(whole.multipliers, time.monotonic() + 3) in ("", "time was up")


def with_cells(proof: MultiplierProof, change: Callable[[list[Shown]], list[Shown]]) -> MultiplierProof:
    last = proof.layers[-1]
    return replace(proof, layers=(*proof.layers[:-1], last._replace(cells=tuple(change(list(last.cells))))))


def with_multipliers(proof: MultiplierProof, change: Callable[[Any], Any]) -> MultiplierProof:
    def turn(shown: Shown) -> Shown:
        m = shown.multiplier
        return shown if m is None else shown._replace(multiplier=change(m))

    return with_cells(proof, lambda cells: [turn(shown) for shown in cells])


TAMPERED: dict[str, Callable[[MultiplierProof], MultiplierProof]] = {
    "a cell less": lambda p: with_cells(p, lambda cells: cells[:-1]),
    "a narrower cell": lambda p: with_cells(
        p, lambda cells: [c._replace(cell=replace(c.cell, high=c.cell.low + 0.9 * (c.cell.high - c.cell.low)))
                          for c in cells]
    ),
    "no multipliers": lambda p: with_cells(p, lambda cells: [c._replace(multiplier=None) for c in cells]),
    "negative D": lambda p: with_multipliers(p, lambda m: m._replace(D=-m.D)),
    "another D": lambda p: with_multipliers(p, lambda m: m._replace(D=m.D * np.diag([1e-9, 1]), slopes=None)),
    "a larger box": lambda p: replace(p, layers=(p.layers[-1]._replace(t=1.001 * p.layers[-1].t),)),
    "a box with more": lambda p: replace(p, box=replace(p.box, up=1.001 * p.box.up)),
    "another loop": lambda p: replace(p, rows=tuple(asked(chain(1, 0.1)).rows)),
    "cells of another group": lambda p: with_cells(
        p, lambda cells: [c._replace(cell=replace(c.cell, rows=1)) for c in cells]
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", TAMPERED)
def test_whatever_is_changed_is_refused(what: str) -> None:
    assert refusal(TAMPERED[what](proven(1, None))) != ""


def test_a_box_with_an_unstable_loop_is_refused() -> None:
    """The multipliers of a proof over the sides of a box twice as large as what is stable."""
    proof = proven(1, None)
    upper = malta.robust_margin(*chain(1, None), ranges(chain(1, None)[0])).upper
    t = 1.01 * upper
    assert np.isfinite(t)
    sides = proof.box.sides(t)
    whole = with_cells(proof, lambda cells: [c._replace(cell=replace(c.cell, sides=sides)) for c in cells])
    assert "a cell from" in refusal(replace(whole, layers=(whole.layers[-1]._replace(t=t),)))


def test_no_parameter_is_worst_where_none_has_an_effect() -> None:
    N, D = np.diag([2.0, 1.0]) + 0j, np.eye(2) + 0j
    m = Multiplier(D, np.zeros((2, 2), dtype=complex), BlockSizes((1, 1)))
    assert worst(N, m, np.array([1, 0]), 2, 7) == 1  # the direction of the larger gain
    assert worst(N, m, np.array([-1, -1]), 2, 7) == 7

"""The routes of a proof: one list, in its order, and nothing is proven beside it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import malta
from malta.budget import Budget
from malta.proof import routes, search
from malta.proof.box import box_of
from malta.proof.exclusion.witness import nearest, starts
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.robust import problem_of
from malta.proof.routes import Attempt, Route

BOX = {"m": 0.1, "k": 0.1}


def spring(damping: float = 0.2) -> Any:
    def matrices(m: Any, k: Any) -> Any:
        return [[0, 1], [-k / m, -damping / m]], [[0], [1 / m]], [[1, 0]]

    return malta.uncertain(matrices, {"m": 1.0, "k": 4.0})


def watched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the routes that are tried from now on."""
    tried: list[str] = []

    def watching(route: Route) -> Route:
        def prove(q: Any, a: Attempt) -> Attempt:
            tried.append(route.name)
            return route.prove(q, a)

        return Route(route.name, route.is_due, prove)

    for name in ("ROUTES", "ROUTES_WITHOUT_FAMILIES"):
        monkeypatch.setattr(routes, name, tuple(watching(route) for route in getattr(routes, name)))
    return tried


def test_cells_settle_a_plain_question(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = watched(monkeypatch)
    found = malta.robust_margin(spring(), [[1.0]], BOX)
    assert tried == ["first cells"]
    assert found.lower == pytest.approx(7.5, rel=1e-3)


def test_light_damping_is_left_to_the_determinant(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = watched(monkeypatch)
    found = malta.robust_margin(spring(1e-9), [[1.0]], BOX, budget=Budget(work=20))
    assert tried == ["first cells", "Hurwitz's determinant"]
    assert found.lower == pytest.approx(7.5, rel=1e-3)


def test_what_cannot_be_enclosed_has_routes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> Any:
        raise Unproven("no families here")

    tried = watched(monkeypatch)
    monkeypatch.setattr("malta.proof.search.parts_over", refused)
    found = malta.robust_margin(spring(), [[1.0]], BOX)
    assert tried == ["Hurwitz's determinant"]
    assert found.lower == pytest.approx(7.5, rel=1e-3)


def test_nothing_is_proven_beside_the_routes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "ROUTES", ())
    monkeypatch.setattr(search, "LAST_ROUTES", ())
    found = malta.robust_margin(spring(), [[1.0]], BOX)
    assert found.lower is None
    assert found.upper == pytest.approx(7.5, rel=1e-6)  # the witness is found, not proven
    assert math.isfinite(found.upper)


def test_a_loss_in_the_middle_of_an_interval_is_found_from_the_ends_of_one_parameter() -> None:
    """s^2 + (1 + 5 z^2 - p) s + 1: lost at p = 1 and z = 0, beyond the box at the ends of z."""

    def matrices(p: Any, z: Any) -> Any:
        return [[0, 1], [-1, p - 1 - 5 * z * z]], [[0], [1]], [[1, 0]]

    system = malta.uncertain(matrices, {"p": 0.5, "z": 0.0})
    box = box_of(
        system.names, system.nominal, system.limits, {"p": (0.5, 1.5)}, {"z": (-1.0, 1.0)}, caller="test"
    )
    law = malta.proof.Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
    (part,) = search.parts_over(problem_of(system, law), box, 1.2, math.inf)
    t, _, x, u = starts(part.family, part.growth)[0]
    assert t == pytest.approx(0.5, rel=5e-2)
    assert u[1] == 0.5
    zero = nearest(part.family, part.growth, 0, x, u, math.inf)
    assert zero is not None
    assert zero.t == pytest.approx(0.5, rel=1e-9)

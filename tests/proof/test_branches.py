"""Currents with the position, a root and a guard in them are proven on the branch that is active at rest."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import pytest
from flint import arb, fmpq

import malta
from malta.checker.check import check, require_conditions
from malta.checker.file import read
from malta.checker.loop import Refused
from malta.linear.balls import POINTS
from malta.linear.branches import INTERVALS, Interval, resolve_branches, without_branches
from malta.linear.expressions import NotAnalytic, program
from malta.linear.uncertain import DOMAIN_END_TEXT, UncertainSystem
from malta.loops.parametric_plants import of_plant
from malta.model import Actuator, Plant, Signal, si
from malta.proof.box import SEARCH_LIMIT, box_of, within_branches

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True)
class Par:
    m: float = si("kg", above=0)
    C: float = si("N m^2/A^2", above=0)  # of the magnet
    gap: float = si("m", above=0)  # in the middle
    lift: float = si("N", at_least=0)  # of a permanent magnet
    preset: str = "custom"


def levitated(par: Par, guarded: bool = True) -> Plant:
    """A body below a magnet, q downwards: m q'' = w - u, u = C i^2 / (gap + q)^2, which currents invert."""

    def currents(y: Any, v: Any) -> Any:
        return ca.sqrt((ca.fmax(v, 0) if guarded else v) / par.C) * (par.gap + y)

    return Plant(
        name="levitated",
        parameters=par,
        variant=lambda other: levitated(other, guarded),
        states=(Signal("q", "m"), Signal("q_dot", "m/s")),
        inputs=(Signal("f", "N"),),
        outputs=(Signal("y", "m"),),
        f=lambda x, u, _: ca.vertcat(x[1], -u / par.m),
        h=lambda x, _: x[0],
        preload=lambda _: 9.81 * par.m - par.lift,
        actuator=Actuator(
            (Signal("i", "A"),),
            (2.0,),
            current_limit=5.0,
            forces=lambda x, i: par.C * (i / (par.gap + x[0])) ** 2,
            currents=currents,
        ),
    )


PAR = Par(0.1, 2e-5, 5e-3, 0.0)
LAW = control.ss(control.tf([60, 3000], [1 / 3000, 1]))
SAMPLED = control.c2d(LAW, 1e-4, "tustin")
RANGES = {"m": 0.1, "C": 0.1, "gap": 0.1}


def slopes(p: Any, lift: float = 0.0) -> tuple[float, float]:
    """A21 and B2 at the command at which the weight is held, by hand; the controller believes PAR."""
    m, C, gap = p
    ratio = C / PAR.C * (PAR.gap / gap) ** 2
    held = 9.81 * m - lift
    return 2 * held / m * (1 / gap - 1 / PAR.gap), -ratio / m


@pytest.mark.parametrize("guarded", [False, True])
def test_roots_and_guards_leave_short_rational_matrices(guarded: bool) -> None:
    plant = levitated(PAR, guarded)
    system = of_plant(plant, list(RANGES), believed=plant, loaded=False)
    assert program(system.matrices).rational
    assert system.matrices.n_instructions() < 60
    rng = np.random.default_rng(3)
    for p in system.nominal * rng.uniform(0.3, 1.7, (20, 3)):
        A, B, _ = (matrix[0] for matrix in system.at(p))
        assert (A[1, 0], B[1, 0]) == pytest.approx(slopes(p), rel=1e-9, abs=1e-9)
        assert system.positive is not None
        assert np.array(system.positive(p)).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize("law", [LAW, SAMPLED])
@pytest.mark.parametrize("guarded", [False, True])
def test_the_margin_is_proven_up_to_the_witness(law: Any, guarded: bool) -> None:
    plant = levitated(PAR, guarded)
    m = malta.robust_margin(of_plant(plant, list(RANGES), believed=plant, loaded=False), law, RANGES)
    assert m.lower is not None
    assert m.lower > 0.998 * m.upper
    sign = np.array(list(itertools.product((-1, 1), repeat=3)))
    rng = np.random.default_rng(1)
    for share in [*sign, *rng.uniform(-1, 1, (40, 3))]:
        p = np.array([PAR.m, PAR.C, PAR.gap]) * (1 + 0.1 * m.lower * share)
        assert poles_are_stable(p, law)
    assert m.witness is not None
    lost = np.array(list(m.witness.values()))
    assert not poles_are_stable(
        np.array([PAR.m, PAR.C, PAR.gap]) + 1.001 * (lost - [PAR.m, PAR.C, PAR.gap]), law
    )


def poles_are_stable(p: Any, law: Any) -> bool:
    """By the poles of the loop that is written down by hand."""
    stiffness, gain = slopes(p)
    plant = control.ss([[0, 1], [stiffness, 0]], [[0], [gain]], [[1, 0]], [[0]])
    if law.dt:
        plant = control.c2d(plant, law.dt, "zoh")
    A = np.block([
        [plant.A + plant.B @ law.D @ plant.C, plant.B @ law.C], [law.B @ plant.C, law.A],
    ])  # fmt: skip
    poles = np.linalg.eigvals(A)
    return bool((np.abs(poles) < 1).all() if law.dt else (poles.real < 0).all())


def test_the_margin_ends_where_the_branch_does() -> None:
    """With a permanent magnet of 0.49 N the command is zero at half the mass, where the guard begins to act."""
    plant = levitated(replace(PAR, lift=0.4905))
    m = malta.robust_margin(of_plant(plant, ["m"], believed=plant, loaded=False), LAW, {"m": (0.08, 0.12)})
    assert m.lower == pytest.approx(2.5, rel=1e-3)
    assert m.lower is not None
    assert m.lower < 2.5
    assert str(m).endswith(f"no unstable machine found up to t = 2.5, where {DOMAIN_END_TEXT}")


@pytest.mark.slow
def test_a_certificate_says_where_its_branch_ends(tmp_path: Path) -> None:
    """The checker shows that the guard does not act on the box; beyond it the certificate does not hold."""
    plant = levitated(replace(PAR, lift=0.4905))
    system, box = of_plant(plant, ["m"], believed=plant, loaded=False), {"m": (0.08, 0.12)}
    m = malta.robust_margin(system, LAW, box)
    path = malta.proof.write_certificate(tmp_path / "c.json", [(system, LAW)], box, None, m)
    assert check(path).ok
    (loop,) = read(path).loops
    assert len(loop.conditions.above) == 4  # guards of the matrices and of their slopes
    require_conditions(loop.conditions, [(fmpq(51, 1000), fmpq(1, 10))])
    with pytest.raises(Refused, match="not shown to have a rest"):
        require_conditions(loop.conditions, [(fmpq(49, 1000), fmpq(1, 10))])


def conditioned(positive: ca.Function | None) -> UncertainSystem:
    """A system of which these conditions alone count."""
    return UncertainSystem(("x", "y"), np.zeros(2), None, positive=positive)


def test_branches_of_any_model_are_those_at_the_nominal_place() -> None:
    """Of fmax, fmin, fabs, sign, comparisons and their derivatives, with what has to stay above zero."""
    p = ca.SX.sym("p", 2)
    x, y = p[0], p[1]
    one = (
        ca.fmax(x, y) * ca.fmin(x, 3 * y)
        + ca.fabs(x - 4 * y)
        + ca.if_else(ca.logic_and(x > 1, y < 1), x**2, 7)
    )
    both = ca.vertcat(one, ca.gradient(one, p))
    f = ca.Function("f", [p], [both])
    g, positive = without_branches(f, [2.0, 0.9])
    assert not program(g).foreign
    assert positive is not None
    rng = np.random.default_rng(0)
    inside = 0
    for place in np.array([2.0, 0.9]) + rng.uniform(-1.2, 1.2, (200, 2)):
        if np.array(positive(place)).min() > 0:
            assert np.array(g(place)) == pytest.approx(np.array(f(place)), rel=1e-12)
            inside += 1
    assert 20 < inside < 180
    whole = box_of(("x", "y"), np.array([2.0, 0.9]), (), {"x": 0.1, "y": 0.1}, {})
    ended = within_branches(whole, conditioned(positive))
    assert ended.ends == DOMAIN_END_TEXT
    assert ended.most == pytest.approx(10 / 9, rel=1e-6)  # y < 1
    assert within_branches(whole, conditioned(None)).limit == SEARCH_LIMIT


def test_what_has_no_branch_is_left_as_it_is() -> None:
    p = ca.SX.sym("p")
    f = ca.Function("f", [p], [p**2])
    assert without_branches(f, [1.0]) == (f, None)
    for unknown in (ca.fabs(p), ca.floor(p) + ca.fabs(p - 1)):  # at the kink; without a resolution
        g = ca.Function("g", [p], [unknown])
        assert without_branches(g, [0.0]) == (g, None)
    made, count = resolve_branches(program(ca.Function("r", [p], [ca.sqrt(p) * ca.fabs(p)])), [2.0])
    assert (count, made.shapes[-1]) == (1, (2, 1))


def test_conditions_of_places_without_a_branch_leave_nothing() -> None:
    """Conditions that fail within intervals that do not grow."""
    p = ca.SX.sym("p", 2)
    positive = ca.Function("positive", [p], [p[1] - 0.5])
    box = box_of(("x", "y"), np.array([2.0, 1.0]), (), {"x": 0.1}, {"y": (0.4, 1.5)})
    assert within_branches(box, conditioned(positive)).most == 0.0


def test_intervals_contain_what_is_computed_in_them() -> None:
    rng = np.random.default_rng(2)
    p = ca.SX.sym("p", 3)
    x, y, z = ca.vertsplit(p)
    f = ca.Function(
        "f", [p], [ca.vertcat(x * y - z**3, x / (y + 4), ca.sqrt(z + 5) * -x, ca.exp(x - y), 1 / (z + 3))]
    )
    model = program(f)
    for _ in range(50):
        low = rng.uniform(-2, 2, 3)
        high = low + rng.uniform(0, 0.5, 3)
        (found,) = model.run(
            [Interval(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True)], INTERVALS
        )
        (exact,) = model.run([arb(x) for x in rng.uniform(low, high).tolist()], POINTS)
        for (_, _, one), (_, _, two) in zip(found, exact, strict=True):
            assert one.low <= float(two.mid()) <= one.high
    with pytest.raises(NotAnalytic):
        1.0 / Interval(-1.0, 1.0)
    with pytest.raises(NotAnalytic):
        Interval(1e308, 1e308) * Interval(10.0, 10.0)
    assert (Interval(1.0, 3.0) ** 3).low > 0.999

"""Machines with held currents anywhere in their travel: their enclosure, and axes whose couplings are bounded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from flint import arb
from scipy import linalg

from malta import gains
from malta.linear.closed_loops import closed_loop, instability
from malta.linear.expressions import NotAnalytic, program
from malta.loops.parametric_plants import model_of
from malta.margins.travel import NOT_BETWEEN_TEXT, LoopAlong, margin_anywhere, travel_margin
from malta.model.plants import plant_of
from malta.proof.box import box_of
from malta.proof.weak_coupling import HeldLoop, coupling_bounds, taylor
from malta.proof.weak_coupling.axes import members_of, state_matrix
from malta.proof.weak_coupling.held_currents import HeldMachine, dominating_solution, held_machine
from malta.proof.weak_coupling.taylor import Evaluation, Laurent

NAMES = ("m", "I_x", "I_z", "B_r", "r_z")
BOX = {"m": 0.05, "I_x": 0.1, "I_z": 0.1, "B_r": 0.05, "r_z": 0.2}


@cache
def machine(name: str = "planar") -> tuple[Any, Any, HeldLoop]:
    controller = gains.read(f"design/gains/{name}.json")
    plant = plant_of(controller.parameters)
    found = margin_anywhere(LoopAlong(plant, controller, NAMES, "lag"))
    assert found is not None
    return plant, controller, found


def box_at(problem: HeldLoop) -> Any:
    h = problem.machine
    return box_of(h.names, h.nominal, [(0.0, math.inf)] * len(h.names), BOX, {})


def sampled(name: str, y: float, p: np.ndarray) -> tuple[np.ndarray, ...]:
    """Z, E, B in floating point, at a position and at parameters."""
    plant, _, _ = machine(name)
    of: Any = model_of(plant, plant_of(plant.parameters), NAMES)
    n = len(plant.inputs)
    A, B, C, E, made, ratio, acting = (np.array(x) for x in of(p, y, np.zeros(n)))
    v = np.linalg.solve(ratio, acting - made)
    A, B, C, E = (np.array(x) for x in of(p, y, v)[:4])
    assert np.array_equal(C[:, :n], np.eye(n))
    return A[n:, :n], E[n:], B[n:]


def values(leads: Any, p: np.ndarray) -> np.ndarray:
    """The monomials' values at p."""
    return np.array([c * np.prod(p ** np.array(m)) for c, m in leads])


def test_taylor_models_hold_what_they_enclose() -> None:
    """Every operation on intervals of y, against numpy at points of them."""
    y = taylor.variable(-1.0, 2.0, 40)
    one = taylor.constant(3.5, 40)
    wave = taylor.multiply(taylor.sine(taylor.scale(y, 5.0)), taylor.cosine(y))
    cases: dict[str, tuple[taylor.Taylor, Callable[[Any], Any]]] = {
        "wave": (wave, lambda x: np.sin(5 * x) * np.cos(x)),
        "inverse": (taylor.inverse(taylor.add(one, wave)), lambda x: 1 / (3.5 + np.sin(5 * x) * np.cos(x))),
        "root": (taylor.root(taylor.subtract(one, wave)), lambda x: np.sqrt(3.5 - np.sin(5 * x) * np.cos(x))),
    }
    u = np.linspace(-1, 1, 21)
    for name, (model, f) in cases.items():
        x = y.c[0] + y.c[1] * u[:, None]
        value = np.polynomial.polynomial.polyval(u, model.c, tensor=True).T
        left = np.abs(value - f(x)).max(axis=0)
        assert (left <= model.radius).all(), name
        assert model.radius.max() < 2e-4, name  # and says something
        low, high = model.bounds()
        assert low <= f(x).min() <= f(x).max() <= high, name


@pytest.mark.parametrize("bad", ["inverse", "root"])
def test_taylor_models_refuse_what_may_be_zero(bad: str) -> None:
    y = taylor.variable(-1.0, 1.0, 10)
    with pytest.raises(NotAnalytic):
        getattr(taylor, bad)(y)


def test_laurent_polynomials_of_a_program() -> None:
    """(a^2 sin y + b / a) / (a b) as sums of monomials whose coefficients are enclosed over y."""
    q = ca.SX.sym("q", 3)
    a, b, y = q[0], q[1], q[2]
    f = ca.Function("f", [q], [(a**2 * ca.sin(3 * y) + b / a) / (a * b)])
    run = Evaluation(2, 0.0, 1.0, 16)
    (((_, _, found),),) = run.run(program(f), [run.parameter(0), run.parameter(1), run.y])
    assert isinstance(found, Laurent)
    assert set(found.terms) == {(1, -1), (-2, 0)}
    assert found.terms[1, -1].bounds() == pytest.approx((0.0, 1.0), abs=1e-2)
    assert found.terms[-2, 0].bounds() == pytest.approx((1.0, 1.0), abs=1e-12)


def test_no_laurent_polynomial() -> None:
    q = ca.SX.sym("q", 2)
    for expression in (1 / (1 + q[0]), ca.sin(q[0])):
        run = Evaluation(1, 0.0, 1.0, 4)
        with pytest.raises(NotAnalytic):
            run.run(program(ca.Function("f", [q], [expression])), [run.parameter(0), run.y])


def test_dominating_bounds_every_power() -> None:
    rng = np.random.default_rng(1)
    M, r = rng.uniform(0, 0.15, (5, 5)), rng.uniform(0, 1, (5, 2))
    assert (dominating_solution(M, r) >= np.linalg.solve(np.eye(5) - M, r)).all()
    with pytest.raises(NotAnalytic):
        dominating_solution(8 * M, r)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar", "planar_pid"])
def test_the_machine_lies_within_its_enclosure(name: str) -> None:
    """Z, E and B of the model at random positions and parameters, beside the bounds over the box and the travel."""
    plant, _, problem = machine(name)
    h, box, rng = problem.machine, box_at(problem), np.random.default_rng(2)
    sides = box.sides(3.5)
    Z, beside, E, shares, b = h.bounds([arb(low).union(arb(high)) for low, high in sides.tolist()])
    closest = 0.0
    for _ in range(60):
        y, p = rng.uniform(-plant.stroke.travel, plant.stroke.travel), rng.uniform(*sides.T)
        z, e, B = sampled(name, y, p)
        own = values(h.lead, p)
        assert (np.abs(z) <= Z + 1e-9 * Z.max()).all()
        assert (np.abs(z - np.diag(values(h.stiff, p))) <= beside + 1e-9 * Z.max()).all()
        assert (np.abs(e) <= E + 1e-9 * E.max()).all()
        assert (np.abs(B / own - np.eye(len(b))) <= shares + 1e-12).all()
        assert (own <= b).all()
        closest = max(closest, float(np.abs(e).max() / E.max()))
    assert closest > 0.6  # the bounds are not far away
    near, proven = h.bounds_near(p), h.bounds([arb(x) for x in p.tolist()])
    for one, two in zip(near, proven, strict=True):
        assert one == pytest.approx(two, rel=1e-6, abs=1e-12)


def sampled_deviation(
    T: float, z: complex, Z: np.ndarray, E: np.ndarray, over: np.ndarray, k: np.ndarray
) -> tuple[np.ndarray, complex]:
    """e on q, q', a in the form that its bounds are of, without k, and the determinant of what it was multiplied by."""
    n = len(Z)
    eye, none = np.eye(n), np.zeros((n, n))
    whole = np.block([[none, eye, none], [Z - E, none, eye], [none, none, none]])
    Phi = linalg.expm(whole * T)[: 2 * n]
    G = Phi[:, 2 * n :]  # Gamma(X)
    free = np.block([[eye, T * eye], [none, eye]])
    lead = np.vstack([T**2 / 2 * eye, T * eye])
    e = np.hstack([G @ Z, (Phi[:, : 2 * n] - free)[:, n:], G @ over - lead])
    moved = np.hstack([none, T * eye, T**2 / 2 * eye])
    late = G[:n] @ E / z
    first = np.linalg.solve(eye + late, e[:n] - late @ moved)
    found = np.vstack([first, e[n:] - G[n:] @ E / z @ (moved + first)])
    return found - lead @ np.hstack([np.diag(k), none, none]), complex(np.linalg.det(eye + late))


@pytest.mark.slow
def test_the_loop_is_what_is_bounded() -> None:
    """det(z - loop at a position) = det(M0 - e) det(1 + Gamma E / z) z^n; e within its bounds, entry by entry."""
    plant, controller, problem = machine()
    h, n, T = problem.machine, 6, problem.T
    rng, sides = np.random.default_rng(3), box_at(problem).sides(3.5)
    bounds = h.bounds([arb(low).union(arb(high)) for low, high in sides.tolist()])
    none = [np.zeros(s) for s in ((24, 24), (24, 6), (6, 24), (6, 6))]
    W, V, _ = coupling_bounds(bounds, T, tuple(none))
    assert (bounds.beside[3:, 3:].diagonal() < 0.75 * bounds.Z[3:, 3:].diagonal()).all()  # k is most of these
    gamma = np.vstack([T**2 / 2 * np.eye(n), T * np.eye(n)])
    law = problem.law
    for y in (0.0, 0.031, -0.0873):
        system, own_law = LoopAlong(plant, controller, NAMES).at(y)
        p = rng.uniform(*sides.T)
        Z, E, B = sampled("planar", y, p)
        b, k = values(h.lead, p), values(h.stiff, p)
        (true,) = closed_loop(system, own_law, p)
        A0 = state_matrix(law, range(n), range(len(law.A)), b.tolist(), k.tolist())
        for w in (30.0, 900.0, 2541.0, 15000.0):
            z = complex(np.exp(1j * w * T))
            e, factor = sampled_deviation(T, z, Z, E, B / b, k)
            assert (np.abs(e) <= (gamma @ W + np.vstack([V, 0 * V]))[:, : 3 * n] * (1 + 1e-6) + 1e-14).all()
            M = z * np.eye(len(A0)) - A0
            M[: 2 * n, : 3 * n] -= e
            sign, size = np.linalg.slogdet(M)
            turned, whole = np.linalg.slogdet(z * np.eye(len(true)) - np.eye(len(true)) - T * true)
            left = size + math.log(abs(factor)) - whole  # |z| = 1, whatever the power
            assert left == pytest.approx(0, abs=2e-5)
            phase = sign * factor / abs(factor) / turned
            assert min(abs(phase - z**k) for k in range(-12, 13)) < 2e-5


@pytest.mark.slow
def test_adjugates_and_determinants_of_axes() -> None:
    """The polynomials over a box, at its middle, beside numpy's inverse of z - A0."""
    _, _, problem = machine()
    h, box = problem.machine, box_at(problem)
    sides = box.sides(1e-9)
    for g in problem.groups:
        det, _, N, _ = g.over(sides)
        b, k = (values([leads[i] for i in g.axes], h.nominal).tolist() for leads in (h.lead, h.stiff))
        A = state_matrix(problem.law, g.axes, g.own, b, k)
        assert len(members_of(g, 6)) == len(A)
        for w in (100.0, 2000.0, 9000.0):
            z = np.exp(1j * w * problem.T)
            v = 1j * math.tan(w * problem.T / 2)
            powers = v ** np.arange(len(det)) * np.exp2(np.array(g.heights))
            inverse = np.tensordot(powers, N[..., 0], axes=1) / (powers @ det[:, 0])
            wanted = np.linalg.inv(z * np.eye(len(A)) - A)
            scale = np.abs(wanted).max(axis=1, keepdims=True) * np.abs(wanted).max(axis=0, keepdims=True)
            assert (np.abs(inverse - wanted) <= 1e-6 * np.sqrt(scale) + 1e-6 * np.abs(wanted)).all()


def test_a_side_without_width_has_one_node() -> None:
    """The polynomials over such a box are the restrictions of those over the whole box, at the ends of the others."""
    _, _, problem = machine()
    sides = box_at(problem).sides(0.5)
    for axis in range(len(sides)):
        thin = np.tile(problem.machine.nominal[:, None], 2)
        thin[axis] = sides[axis]
        for g in problem.groups:
            det, radius, N, slack = g.over(thin)
            shape = g.degrees_over(thin)
            assert [d for k, d in enumerate(shape) if k != axis] == [0] * (len(sides) - 1)
            assert det.shape[1] == N.shape[3] == shape[axis] + 1
            for end, node in ((0, 0), (1, -1)):
                point = np.tile(thin[:, [end]], 2)
                at, also, N_at, _ = g.over(point + [[-1e-12, 1e-12]] * point)
                assert (np.abs(det[:, node] - at[:, 0]) <= 1e-9 * np.abs(at[:, 0]) + radius + also).all()
                assert (np.abs(N[..., node] - N_at[..., 0]) <= 1e-9 * np.abs(N_at[..., 0]) + 2 * slack).all()


@pytest.mark.slow
def test_the_planar_motor_is_proven_between_places() -> None:
    """One proof for the whole travel, within a percent of what is lost; random machines in the box are stable."""
    plant, controller, problem = machine()
    found = travel_margin(plant, controller, BOX, names=NAMES)
    assert found.lower is not None
    assert NOT_BETWEEN_TEXT not in found.reason
    assert 1 < found.upper / found.lower < 1.01
    assert found.upper == pytest.approx(3.702, abs=2e-3)
    box, rng = box_at(problem), np.random.default_rng(4)
    sides = box.sides(found.lower)
    corners = np.array(list(itertools.product(*sides)))
    for y in rng.uniform(-plant.stroke.travel, plant.stroke.travel, 3):
        system, law = LoopAlong(plant, controller, NAMES).at(float(y))
        assert (
            instability(
                system,
                law,
                np.vstack([corners, sides[:, 0] + rng.uniform(0, 1, (100, 5)) * (sides[:, 1] - sides[:, 0])]),
            ).max()
            < 0
        )


@pytest.mark.slow
def test_couplings_are_bounded_where_a_cell_is() -> None:
    """A law whose weakest corner has the least coupling: nearly all of what is true is proven, and no more."""
    controller = gains.read("design/gains/planar_pid.json")
    found = travel_margin(plant_of(controller.parameters), controller, BOX, names=NAMES)
    assert found.lower is not None
    assert NOT_BETWEEN_TEXT not in found.reason
    assert 1 < found.upper / found.lower < 1.01
    assert found.upper == pytest.approx(4.587, abs=2e-3)


@pytest.mark.slow
def test_a_stronger_coupling_proves_less() -> None:
    """The bound follows what couples the axes: ten times the stiffness of held currents costs some of it."""
    from malta.budget import Budget
    from malta.proof.robust import ProofEffort, margin_of

    _, _, problem = machine()
    h = problem.machine

    def grown(table: Any) -> Any:
        return {
            at: x._replace(terms=tuple((m, 10 * a, 10 * b) for m, a, b in x.terms)) for at, x in table.items()
        }

    stiff = replace(problem, machine=replace(h, Z=grown(h.Z), E=grown(h.E)))
    one, ten = (margin_of(x, box_at(problem), ProofEffort(budget=Budget(20))).lower for x in (problem, stiff))
    assert one is not None
    assert ten is not None
    assert 0.5 * one < ten < 0.99 * one


@pytest.mark.slow
def test_parameters_of_no_such_form_are_left_to_places() -> None:
    """The coil pitch enters through sines of the place of each coil: of that nothing is claimed."""
    controller = gains.read("design/gains/planar.json")
    plant = plant_of(controller.parameters)
    of = model_of(plant, plant, ("coil_pitch",))
    with pytest.raises(NotAnalytic):
        held_machine(of, ("coil_pitch",), np.array([0.04]), (-plant.stroke.travel, plant.stroke.travel))


def test_at_a_position_the_bounds_are_narrower() -> None:
    _, _, problem = machine()
    h: HeldMachine = problem.machine
    p = [arb(x) for x in h.nominal.tolist()]
    everywhere, here = h.bounds(p), h.at(0.0173).bounds(p)
    for name in ("Z", "E", "shares"):
        assert (getattr(here, name) <= getattr(everywhere, name) * (1 + 1e-12)).all()
    assert (here.beside.diagonal()[3:] < 0.3 * everywhere.beside.diagonal()[3:]).all()
    Z, E, _ = sampled("planar", 0.0173, h.nominal)
    assert (np.abs(Z) <= here[0] + 1e-9).all()
    assert (np.abs(E) <= here.E + 1e-9).all()

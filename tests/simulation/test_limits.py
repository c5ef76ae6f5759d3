"""A limit is a limit with any compiler: whatever is limited last is not computed with afterwards.

Products by reciprocals, contraction and approximate divisions move last digits. Here each operation errs by up to four
of them, at random, in the expressions that simulations and exported C are made of: forces, currents and duty cycles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.arrays import FloatArray
from malta.machines.halbach import electronics
from malta.simulation.current_control import duty_cycles
from malta.simulation.period import limited_currents
from malta.synthesis.law import command_forces, gains_of

CASES = 400
EPS = np.finfo(float).eps
# Operations that round; all others are exact. Sums and products whose result is a double are exact too.
ROUNDING: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.multiply,  # by the reciprocal
    ca.OP_INV: np.reciprocal,
    ca.OP_SQ: np.square,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_EXP: np.exp,
    ca.OP_SQRT: np.sqrt,
}
PLAIN: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: np.copy,
    ca.OP_NEG: np.negative,
    ca.OP_TWICE: lambda x: 2 * x,
    ca.OP_FABS: np.abs,
    ca.OP_FLOOR: np.floor,
    ca.OP_SIGN: np.sign,
    ca.OP_FMIN: np.minimum,
    ca.OP_FMAX: np.maximum,
    ca.OP_NOT: np.logical_not,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_IF_ELSE_ZERO: lambda x, y: np.where(x != 0, y, 0),
}
UNARY = {
    ca.OP_ASSIGN,
    ca.OP_NEG,
    ca.OP_TWICE,
    ca.OP_FABS,
    ca.OP_FLOOR,
    ca.OP_SIGN,
    ca.OP_NOT,
    ca.OP_INV,
    ca.OP_SQ,
}
UNARY |= {ca.OP_SIN, ca.OP_COS, ca.OP_EXP, ca.OP_SQRT}


def roughly(f: ca.Function, inputs: list[FloatArray], rng: np.random.Generator) -> list[FloatArray]:
    """The outputs of an SX function for columns of inputs, where what rounds errs by up to four last digits."""
    cases = inputs[0].shape[1]

    def rough(op: int, *of: FloatArray) -> FloatArray:
        exact = np.asarray(ROUNDING[op](*(np.longdouble(x) for x in of)))
        value = exact.astype(float)
        errors = np.where(value == exact, 0, rng.integers(-4, 5, cases)) * EPS
        return np.asarray(value * (1 + errors))

    work: dict[int, FloatArray] = {}
    found = [np.zeros((f.nnz_out(k), cases)) for k in range(f.n_out())]
    for k in range(f.n_instructions()):
        op, into, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if op == ca.OP_INPUT:
            work[into[0]] = inputs[of[0]][of[1]]
        elif op == ca.OP_OUTPUT:
            found[into[0]][into[1]] = work[of[0]]
        elif op == ca.OP_CONST:
            work[into[0]] = np.full(cases, f.instruction_constant(k))
        else:
            given = [work[j] for j in (of[:1] if op in UNARY else of)]
            if op == ca.OP_DIV:
                given[1] = rough(ca.OP_INV, given[1])
            work[into[0]] = rough(op, *given) if op in ROUNDING else 1.0 * PLAIN[op](*given)
    return found


def scattered(rng: np.random.Generator, rows: int, size: float) -> FloatArray:
    """Columns about and far beyond a size, of both signs; some of one size in every row, as at a limit."""
    found = rng.choice([-1.0, 1.0], (rows, CASES)) * size * 10 ** rng.uniform(-2, 2, (rows, CASES))
    found[:, ::7] = rng.choice([-1.0, 1.0], (rows, found[:, ::7].shape[1])) * size
    return np.asarray(found)


@pytest.mark.parametrize("machine", ["tubular", "halbach", "planar"])
def test_currents_are_within_their_limits(machine: str) -> None:
    """Those of the machine and of the gain file, also where a machine scales all of its currents."""
    rng = np.random.default_rng(1)
    plant = malta.plant_of(malta.read(f"data/{machine}.toml"))
    most = plant.actuator.current_limit
    coils = len(plant.actuator.coils)
    i, limit = ca.SX.sym("i", coils), ca.SX.sym("limit", coils)
    f = ca.Function("limited", [i, limit], [limited_currents(plant, i, limit)])
    own = most * rng.uniform(0.5, 1.5, (coils, CASES))
    (found,) = roughly(f, [scattered(rng, coils, most), own], rng)
    assert (np.abs(found) <= np.minimum(own, most)).all()
    assert (np.abs(found) == np.minimum(own, most)).any(axis=1).all()


@pytest.mark.parametrize("real_pwm", [False, True])
@pytest.mark.parametrize("limited", [False, True])
def test_duty_cycles_are_from_0_to_1(*, real_pwm: bool, limited: bool) -> None:
    """Of half-bridges on a link of any voltage, with a limit of the voltage or without; both ends are reached."""
    rng = np.random.default_rng(2)
    drive = malta.plant_of(malta.read("data/tubular.toml")).drive
    names = [ca.SX.sym("u", 18), ca.SX.sym("V"), ca.SX.sym("i", 18), ca.SX.sym("limit")]
    u, V, i, limit = names
    found, _ = duty_cycles(drive, u, V, i, real_pwm=real_pwm, limit=limit if limited else None)
    f = ca.Function("duty", names, [found])
    voltages = [scattered(rng, 18, 6.0), rng.uniform(5, 60, (1, CASES)), scattered(rng, 18, 1.0)]
    (d,) = roughly(f, [*voltages, rng.uniform(20, 40, (1, CASES))], rng)
    assert (d.min(), d.max()) == (0.0, 1.0)


@pytest.mark.parametrize(("pwm", "dead_ends"), [("exact", 0), ("plain", 0), ("fine", 0), ("fine", 3)])
def test_duty_cycles_of_the_servo_are_from_0_to_1(pwm: Any, dead_ends: int) -> None:
    rng = np.random.default_rng(3)
    par = malta.read("data/halbach.toml")
    V = ca.SX.sym("V", 3)
    f = ca.Function("duty", [V], [electronics.modulate(par, V, pwm, dead_ends)[0]])
    (d,) = roughly(f, [scattered(rng, 3, par.V_dc / 2)], rng)
    assert d.min() >= 0
    assert 1 - 1e-6 < d.max() <= 1  # of steps that do not end at 1


@pytest.mark.parametrize("name", ["robust", "halbach_pid", "planar"])
def test_forces_are_within_their_limits(name: str) -> None:
    """v of the law, for states and sums of errors that ask for more."""
    rng = np.random.default_rng(4)
    c = malta.gains.read(f"design/gains/{name}.json")
    g = gains_of(c)
    (m, n), p = g["K"].shape, g["Ki"].shape[1]
    names = [ca.SX.sym(f"a{k}", size) for k, size in enumerate((n, p, n, m, m))]
    f = ca.Function("commanded", names, [command_forces(g, *names)[2]])
    most = float(c.limits.force.max())
    (v,) = roughly(f, [scattered(rng, f.nnz_in(k), most) for k in range(5)], rng)
    assert (np.abs(v) <= c.limits.force[:, None]).all()
    assert (np.abs(v) == c.limits.force[:, None]).any(axis=1).all()

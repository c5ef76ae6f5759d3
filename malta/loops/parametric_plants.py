"""The design model of a plant at a position along its stroke, or along all of it, in parameters by name."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arguments import describe
from malta.arrays import FloatArray, readonly
from malta.errors import InputError, require_known
from malta.linear import rational
from malta.linear.branches import without_branches
from malta.linear.expressions import NotAnalytic, program
from malta.linear.rational import Ratio, Symbolic, TooLarge, symbolic as rational_functions
from malta.linear.systems import from_source
from malta.linear.uncertain import UncertainSystem
from malta.loops.windings import WindingModel, with_windings
from malta.model.equilibrium import with_command
from malta.model.inspection import unproven
from malta.model.linearize import is_commutated, jacobians, linearize
from malta.model.parameters import shape_parameters, twins_of, units_of
from malta.model.plant import Plant, position_in, symbolic
from malta.model.sensors import Sensors, with_lags
from malta.work import check_clock

# The command at which a machine's preload acts, as a function of its parameters.
#
#     forces(x, currents(h(x), v)) = preload(x)
#
# defines v implicitly. A proof needs it exactly: a model at another command is a model of another machine. It is exact
#
#   * where a command of the preload, or of zero, makes the preload, as in most machines,
#   * where the forces are affine in v, as those of a commutation with other parameters,
#   * where, with squares of roots resolved, each is a polynomial of degree 2 in a command of its own, or all are
#     affine.
#
# Elsewhere v comes from a fixed number of Newton steps, which is good enough to search for unstable machines and not
# for a proof: an operation that no enclosure knows keeps every proof away from such a model.


MAX_FORCE_OPERATIONS = 5_000  # operations up to which the forces are expanded
NEWTON_STEPS = 8
COMMAND_TOLERANCE = 1e-6  # of the command, between its formula and the nominal one
INEXACT_COMMAND = "the command that makes the preload is no formula of the parameters"


class CommandExpression(NamedTuple):
    """The command as an expression; `why` says why it is not exact, "" where it is."""

    v: Any
    why: str = ""


def is_affine(made: Any, v: Any) -> bool:
    """Whether an expression is affine in v, by its structure."""
    return not any(ca.which_depends(ca.vec(made), v, 2, False))


def command_of(
    chain: ca.Function, p: Any, acting: Any, nominal: FloatArray, wanted: FloatArray
) -> CommandExpression:
    """Find v with chain(p, v) = acting as a function of p.

    chain : (p, v) -> inputs that the currents of v make
    acting : the inputs that shall act, an expression of p
    nominal : values of p
    wanted : v at these, which chooses between the solutions
    """
    q = ca.SX.sym("v", chain.size1_in(1))
    made = chain(p, q)
    left = _simplify(acting - chain(p, acting), p)
    none = ca.SX.zeros(q.numel())
    for v, rest in ((acting, left), (none, _simplify(acting - chain(p, none), p))):
        if rest.is_zero() and _is_near(v, p, nominal, wanted):
            return CommandExpression(v)
    if is_affine(made, q):
        slope, start = ca.substitute([ca.jacobian(made, q), made], [q], [none])
        return CommandExpression(acting + ca.solve(slope, acting - start - slope @ acting))
    both = ca.Function("both", [ca.vertcat(p, q)], [ca.densify(made - acting), ca.densify(left)])
    if both.n_instructions() <= MAX_FORCE_OPERATIONS:
        try:
            v = _exact_command(rational_functions(program(both)), p, acting, wanted, nominal)
        except (TooLarge, NotAnalytic, ZeroDivisionError):
            v = None
        if v is not None and _is_near(v, p, nominal, wanted):
            return CommandExpression(v)
    return CommandExpression(_newton(chain, p, acting, wanted), INEXACT_COMMAND)


def _simplify(expression: Any, p: Any) -> Any:
    """The expression built again from its common subexpressions, where equal terms cancel."""
    return ca.SX(ca.Function("left", [p], [ca.cse(ca.densify(expression))])(p))


def _is_near(v: Any, p: Any, nominal: FloatArray, wanted: FloatArray) -> bool:
    found = np.array(ca.Function("v", [p], [ca.densify(v)])(nominal)).ravel()
    return bool(np.abs(found - wanted).max() <= COMMAND_TOLERANCE * np.abs(wanted).max())


def _newton(chain: ca.Function, p: Any, acting: Any, wanted: FloatArray) -> Any:
    """Steps of Newton's method from the nominal command. No enclosure knows copysign(v, v) = v: nothing is proven."""
    q = ca.SX.sym("v", len(wanted))
    made = chain(p, q)
    step = ca.Function("step", [p, q], [q - ca.solve(ca.jacobian(made, q), made - acting)])
    v = ca.SX(ca.DM(wanted))
    for _ in range(NEWTON_STEPS):
        v = step(p, v)
        v = ca.copysign(v, v)
    return v


def _exact_command(s: Symbolic, p: Any, acting: Any, wanted: FloatArray, nominal: FloatArray) -> Any | None:
    """The command from the exact rational equations; None where they have no such form."""
    equations, left = s.entries
    m, first = len(wanted), p.numel()
    zero = Ratio(s.context.constant(0))
    if all(_resolve_roots(s, r).is_zero() for r in left.values()):
        return acting
    polynomials = [_resolve_roots(s, equations.get((i, 0), zero)).num for i in range(m)]
    if any(any(monomial[s.inputs :]) for n in polynomials for monomial in n.monoms()):
        return None  # a sine, or a root that no square resolves
    powers = [
        [tuple(int(e) for e in monomial[first : first + m]) for monomial in n.monoms()] for n in polynomials
    ]
    if all(sum(e) <= 1 for one in powers for e in one):
        matrix, right = {}, {}
        for i, n in enumerate(polynomials):
            for power, c in _coefficients(s, n, first, m).items():
                if sum(power):
                    matrix[i, power.index(1)] = c
                else:
                    right[i] = -c
        return ca.vertcat(*(rational.expression(r, p) for r in rational.solution(s, matrix, right, m)))
    own = [all(not any(e[:i] + e[i + 1 :]) and e[i] <= 2 for e in one) for i, one in enumerate(powers)]
    if not all(own):
        return None
    roots = []
    for i, n in enumerate(polynomials):
        by_power = {power[i]: c for power, c in _coefficients(s, n, first, m).items()}
        terms = [rational.expression(by_power[k], p) if k in by_power else ca.SX(0) for k in range(3)]
        roots.append(_root(terms, p, nominal, float(wanted[i])))
    return ca.vertcat(*roots)


def _root(terms: list[Any], p: Any, nominal: FloatArray, wanted: float) -> Any:
    """The root of c + b v + a v^2 that is the wanted one at the nominal values, as a formula.

    It is continuous in p while its root is real and its divisor is not zero, and so stays on its branch.
    """
    c, b, a = terms
    if a.is_zero():
        return -c / b
    values = ca.Function("terms", [p], [b])
    sign = 1.0 if float(values(nominal)) >= 0 else -1.0
    far = -(b + sign * ca.sqrt(b**2 - 4 * a * c)) / 2
    near_root, far_root = c / far, far / a
    both = [float(ca.Function("root", [p], [r])(nominal)) for r in (near_root, far_root)]
    return near_root if abs(both[0] - wanted) <= abs(both[1] - wanted) else far_root


def _coefficients(s: Symbolic, polynomial: Any, first: int, m: int) -> dict[tuple[int, ...], Ratio]:
    """The coefficients of powers of v in a polynomial of (p, v)."""
    parts: dict[tuple[int, ...], dict[Any, Any]] = {}
    for monomial, c in polynomial.to_dict().items():
        power = tuple(int(e) for e in monomial[first : first + m])
        rest = tuple(0 if first <= k < first + m else e for k, e in enumerate(monomial))
        parts.setdefault(power, {})[rest] = c
    return {power: Ratio(s.context.from_dict(terms)) for power, terms in parts.items()}


def _resolve_roots(s: Symbolic, r: Ratio) -> Ratio:
    """The ratio with squares of roots replaced by what the roots are of."""
    steps = [s.program.steps[step] for step in s.atoms]
    is_root = (name == "sqrt" or (name == "constpow" and power == 0.5) for name, _, _, power in steps)
    roots = {s.inputs + k: s.arguments[k] for k, root in enumerate(is_root) if root}
    return rational.replace_squares(s, r, roots)


MAX_MODEL_OPERATIONS = 20_000  # operations up to which a model is expanded


def of_plant(
    plant: Plant,
    names: Sequence[str],
    *,
    at: Mapping[str, float] | None = None,
    states: bool = False,
    believed: Plant | None = None,
    held: FloatArray | None = None,
    late: bool = False,
    windings: WindingModel | None = None,
) -> UncertainSystem:
    """The design model of a plant at a position, in parameters by name, where its preload acts at every value of them.

    names : parameters; the stroke itself may be one of them, with the position as its nominal value
    at : the states that are not zero, SI
    states : whether y contains the states after the outputs
    believed : the machine with the controller's parameters; None: the plant itself
    held : the gain H of currents that are held between samples (`held_gain`): the inputs are v + H y, and the reading y
        is a further input when the parameters change its gain
    late : whether the outputs are read behind the lags of the plant's sensors, as further states
    windings : these are states, too: inputs are their voltages, and their currents are further outputs (windings.py)

    The inputs are commanded forces: the controller commutates with its own parameters, and the currents produce forces
    with the plant's parameters. The command at which the preload acts is a function of the parameters (see below);
    where it is none that a proof could use, the system says so (`approximate`).

    Raises InputError for unknown names and for parameters that set the size of the model.
    """
    par = plant.parameters
    _check_names(plant, names)
    if believed is not None and believed.actuator.tabulated:
        found = "a controller that looks up a table"
        raise InputError("uncertain", "believed", found, "one whose currents are a formula")
    x0 = plant.at(**(at or {})).x
    position = position_in(plant, x0)
    own_states = tuple((name, x) for name, x in (at or {}).items() if name != plant.stroke.name)
    of = model_of(
        plant, believed or plant, tuple(name for name in names if name != plant.stroke.name), own_states
    )
    check_clock()
    p = ca.SX.sym("p", len(names))
    own = [k for k, name in enumerate(names) if name != plant.stroke.name]
    symbols = {names[k]: p[k] for k in own}
    z = p[names.index(plant.stroke.name)] if plant.stroke.name in names else position
    nominal = [position if name == plant.stroke.name else getattr(par, name) for name in names]
    short, positive, why = None, None, ""
    if is_commutated(plant) or not program(of).rational:
        short = _expanded_matrices(of, p, z, np.array(nominal, dtype=float), held)
    check_clock()
    if short is not None:
        A, B, C, above = short
        positive = ca.Function("positive", [p], [above]) if above.numel() else None
    else:
        acting = of(p[own], z, ca.DM.zeros(len(plant.inputs)))[-1]
        q = ca.SX.sym("v", len(plant.inputs))
        chain = ca.Function("chain", [p, q], [of(p[own], z, q)[4]])
        wanted = with_command(plant, plant.at(**(at or {})), believed).v
        v, why = command_of(chain, p, acting, np.array(nominal, dtype=float), np.asarray(wanted))
        A, B, C, E = of(p[own], z, v)[:4]
        if held is not None:
            A, left = A - E @ C, E - B @ ca.DM(held)
            B = ca.horzcat(B, left)
    if late:
        A, B, C = with_lags(_sensors_in(plant, symbols), A, B, C)
    if windings is not None:
        point = ca.SX(x0)
        if plant.has_stroke:
            point[plant.stroke_state] = z
        A, B, C = with_windings(in_symbols(plant, symbols), windings, point, A, B, C)
    if states:
        C = ca.vertcat(C, ca.DM.eye(len(plant.controlled)))
    bounds = {f.name: limits_of(f.metadata) for f in fields(par)}
    limits = tuple(bounds.get(name, (-math.inf, math.inf)) for name in names)
    matrices = ca.Function("matrices", [p], [A, B, C])
    if short is None:
        matrices, positive = without_branches(matrices, nominal)
    why = unproven(plant, tuple(x0.tolist())) or why
    return UncertainSystem(
        tuple(names), readonly(nominal), matrices, limits=limits, approximate=why, positive=positive
    )


def _sensors_in(plant: Plant, symbols: Mapping[str, Any]) -> Sensors:
    """The sensors of a plant in symbols of some parameters.

    Raises InputError for an uncertain lag whose nominal value is none.
    """
    if not plant.sensors.late and all(getattr(plant.parameters, name) for name in symbols):
        return plant.sensors  # no uncertain parameter is a lag of 0 s
    sensors = in_symbols(plant, symbols).sensors
    if sensors.lagging != plant.sensors.lagging:
        raise InputError(
            "uncertain", "sensors", "an uncertain lag of 0 s", "one above 0 s, set in the machine"
        )
    return sensors


def _check_names(plant: Plant, names: Any) -> None:
    """Raise InputError unless the names are those of parameters that may be symbols, or of the stroke."""
    known = [*units_of(plant.parameters), *((plant.stroke.name,) if plant.has_stroke else ())]
    if not isinstance(names, tuple | list):
        raise InputError("uncertain", "names", describe(names), "names of parameters, as a tuple or a list")
    require_known(names, known, "uncertain", found="an unknown parameter")
    for name in set(names) & set(shape_parameters(plant.parameters)):
        raise InputError("uncertain", name, "a parameter that shapes the model", "one that enters it")


def _expanded_matrices(
    of: ca.Function, p: Any, z: Any, nominal: FloatArray, held: FloatArray | None
) -> tuple[Any, Any, Any, Any] | None:
    """A, B and C of held currents as short rational functions of p, and what is above zero where these hold.

    None when they are not such functions.
    """
    k, m = p.numel(), of.numel_in(2)
    q = ca.SX.sym("q", k + m)
    fixed = isinstance(z, float)
    place = z if fixed else ca.substitute([z], [p], [q[:k]])[0]
    own = [i for i in range(k) if fixed or not ca.is_equal(p[i], z)]
    outputs = of(q[own], place, q[k:])
    model = ca.Function("model", [q], list(outputs))
    if model.n_instructions() > MAX_MODEL_OPERATIONS:
        return None
    scales = np.concatenate([nominal, np.array(model(np.r_[nominal, np.zeros(m)])[-1]).ravel()])
    try:
        s, tables, above = rational.expand_matrices(model, scales)
    except (TooLarge, NotAnalytic):
        return None
    A, B, C, E, made, ratio, preload = tables
    zero = Ratio(s.context.constant(0))
    acting = {k + i: preload.get((i, 0), zero) for i in range(m)}
    left = {i: acting[k + i] - rational.substitute(s, made.get((i, 0), zero), acting) for i in range(m)}
    slope = {at: rational.substitute(s, r, acting) for at, r in ratio.items()}
    if not all((slope[at] - r).is_zero() for at, r in ratio.items()):
        return None  # one step finds the command of a chain that is affine in it, and of no other
    ratio = slope
    moved = rational.solution(s, ratio, left, m)  # what is wanted beyond the preload for it to act
    wanted = {k + i: acting[k + i] + moved[i] for i in range(m)}
    A, B, C, E = ({at: rational.substitute(s, r, wanted) for at, r in t.items()} for t in (A, B, C, E))
    n, outputs = of.size1_out(0), of.size1_out(2)
    rest: rational.Table = {}
    if held is not None:
        carried = rational.product(E, C)
        A = rational.drop_rounding(s, rational.difference(A, carried), scales, A, carried)
        gains = {(i, j): s.constant(float(x)) for (i, j), x in np.ndenumerate(held) if x}
        rest = rational.drop_rounding(s, rational.difference(E, rational.product(B, gains)), scales, E)
    held_above = {(i, 0): rational.substitute(s, r, wanted) for i, r in enumerate(above)}
    if not rational.is_free_of_functions(s, (A, B, C, rest, held_above)):
        return None
    b = rational.matrix_of(B, (n, m), p)
    if rest:
        b = ca.horzcat(b, rational.matrix_of(rest, (n, outputs), p))
    a, c = rational.matrix_of(A, (n, n), p), rational.matrix_of(C, (outputs, n), p)
    return a, b, c, ca.vertcat(*(rational.expression(r, p) for r in held_above.values()))


def held_gain(plant: Plant, states: Mapping[str, float]) -> FloatArray:
    """The gain H of held currents at these states, from E = B H: v + H y acts (forces x sensors)."""
    check_clock()
    model = linearize(plant, plant.at(**states))
    return np.asarray(np.linalg.lstsq(model.B, model.E, rcond=None)[0])


def in_symbols(plant: Plant, symbols: Mapping[str, Any]) -> Plant:
    """The plant with symbols for some parameters; twins share a symbol."""
    twins = {name: symbols[twin] for name, twin in twins_of(plant.parameters).items() if twin in symbols}
    machine: Plant = plant.variant(symbolic(plant.parameters, {**twins, **symbols}))
    return machine


@lru_cache(maxsize=16)  # plants compare by identity, and are built once for their parameters
def model_of(
    plant: Plant, believed: Plant, names: tuple[str, ...], at: tuple[tuple[str, float], ...] = ()
) -> ca.Function:
    """The design model as a CasADi function of parameters, position along the stroke and commands v.

    at : the other states that are not zero

    Its outputs are those of `jacobians` on the controlled states (A, B, C, E, forces, their ratio) and the preload.
    """
    p, z, v = ca.SX.sym("p", len(names)), ca.SX.sym("z"), ca.SX.sym("v", len(plant.inputs))
    own = dict(zip(names, ca.vertsplit(p), strict=True)) if names else {}
    machine = in_symbols(plant, own)
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    point = ca.SX(plant.state(dict(at)))
    if plant.has_stroke:
        point[plant.stroke_state] = z
    preload = ca.SX(machine.preload(point))
    check_clock()
    found = jacobians(machine, believed, x, u, v, ca.SX.zeros(len(plant.disturbances)))
    check_clock()
    A, B, C, E, made, ratio = ca.substitute(list(found), [x, u], [point, preload])
    keep = list(plant.controlled)
    parts = [A[keep, keep], B[keep, :], C[:, keep], E[keep, :], made, ratio, preload]
    return ca.Function("model", [p, z, v], ca.cse([ca.densify(part) for part in parts]))


def limits_of(declared: Mapping[str, Any]) -> tuple[float, float]:
    """The exclusive limits of a declared parameter; for `at_least` the float just below."""
    above, least, below = (declared.get(key) for key in ("above", "at_least", "below"))
    found = [] if above is None else [float(above)]
    found += [] if least is None else [math.nextafter(float(least), -math.inf)]
    return max(found, default=-math.inf), math.inf if below is None else float(below)


def uncertain(source: Any, names: Any, **options: Any) -> UncertainSystem:
    """Make a linear system that depends on parameters by name.

        E(p) x' = A(p) x + B(p) u,  y = C(p) x + D(p) u

    source : a Plant, which is linearized with these parameters; a function of the parameters by name (or of one array
        p), of numpy and CasADi operations, that returns A, B, C, or with D, or with D and E; a casadi.Function of p; or
        matrices A0, B0, C0[, D0[, E0]]
    names : of a Plant the names of its parameters; else their nominal values by name, SI
    options : of a Plant `x`, the states to linearize at; of the others `terms`, the factors of each parameter beside
        matrices, as {"k": (A1, B1, C1)}; `limits` (above, below) of parameters; `sample_time` (s) of matrices that give
        x+ in place of x'

    Returns an UncertainSystem.

    Raises InputError for unknown options, and for names, shapes and values that do not fit.

    >>> import malta
    >>> def motor(J, b):
    ...     return [[0, 1], [0, -b / J]], [[0], [1 / J]], [[1, 0]]
    >>> system = malta.uncertain(motor, {"J": 2e-3, "b": 0.1})
    >>> system.names
    ('J', 'b')
    """
    made = of_plant if isinstance(source, Plant) else from_source
    known = [q.name for q in inspect.signature(made).parameters.values() if q.kind is q.KEYWORD_ONLY]
    require_known(options, known, "uncertain", found="an unknown option")
    return made(source, names, **options)

"""What holds a machine at rest, as formulas of its parameters: states, inputs under its loads, and commands.

    f(x, u, load(x)) = 0                         states and inputs, where the place is given and the rest is solved for
    forces(x, currents(h(x), v)) = u             the command v, whatever the controller believes

A proof needs them exactly: a model at another rest is a model of another machine. They are exact

  * where a command of u, or of zero, makes u, as in most machines,
  * where the equations are affine in what is unknown, as those of a commutation with other parameters,
  * where they can be solved one by one, each of degree 2 at most in an unknown of its own, squares of roots resolved.

  * elsewhere as the root of as many equations as there are unknowns, which interval Newton encloses (implicit.py).

Where equations are fewer, or have an operation without enclosure, a fixed number of Newton steps is good enough to
search for unstable machines and not for a proof: an operation that no enclosure knows keeps every proof away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from flint.utils.flint_exceptions import DomainError

from malta.arrays import FloatArray
from malta.linear import rational_tables as rational
from malta.linear.branches import SYMBOLS, resolve_branches
from malta.linear.expressions import MatrixProgram, NotAnalytic, program
from malta.linear.rational import Ratio, Symbolic, TooLarge, symbolic as rational_functions
from malta.linear.roots import call, implicit_function
from malta.model.equilibrium import rates_at_rest
from malta.model.parameters import symbolic_names
from malta.model.plant import OperatingPoint, Plant, symbolic

MAX_FORCE_OPERATIONS = 5_000  # operations up to which the forces are expanded
MAX_MINORS = 6  # unknowns up to which equations are solved by minors
NEWTON_STEPS = 8
COMMAND_TOLERANCE = 1e-6  # of what is found, between its formula and its nominal value
RANK_TOLERANCE = 1e-9  # of the largest singular value: what is solved for acts on what is left
INEXACT_COMMAND = "the command that makes the inputs at rest is no formula of the parameters"
INEXACT_REST = "the states and inputs at rest under the loads are no formula of the parameters"
NO_BALANCE_TEXT = "no command balances the machine"


class Condition(NamedTuple):
    """What is above zero where a formula holds, and what happens where it is not, in words."""

    above: Any
    ends: str = NO_BALANCE_TEXT


class Formula(NamedTuple):
    """Unknowns as expressions of the parameters; `why` says why they are not exact, "" where they are."""

    values: Any
    conditions: tuple[Condition, ...] = ()
    why: str = ""


class Unknowns(NamedTuple):
    """Symbols whose values are looked for, with the parameters on which these depend."""

    r: Any
    near: FloatArray  # r at nominal parameters, which chooses between solutions
    p: Any
    nominal: FloatArray


def command_of(chain: ca.Function, p: Any, acting: Any, nominal: FloatArray, wanted: FloatArray) -> Formula:
    """Find v with chain(p, v) = acting as a function of p.

    chain : (p, v) -> inputs that the currents of v make
    acting : the inputs that shall act, an expression of p
    nominal : values of p
    wanted : v at these, which chooses between the solutions
    """
    v = ca.SX.sym("v", chain.size1_in(1))
    unknowns = Unknowns(v, wanted, p, nominal)
    found = solve_rows(chain(p, v) - acting, unknowns, [acting, ca.SX.zeros(v.numel())])
    return found._replace(why=INEXACT_COMMAND) if found.why else found


def rest_of(
    plant: Plant, machine: Plant, x: Any, p: Any, nominal: FloatArray, point: OperatingPoint
) -> tuple[Any, Formula]:
    """All states at rest, and the inputs that hold the machine there under its loads, as expressions of p.

    The place that x gives stays. Where the inputs alone hold no rest, as those of a magnet whose current is a state,
    states are solved for with them: such that are not measured first, and never the stroke.

    plant : the machine
    machine : the same with symbols for some parameters
    x : its states, numbers but for a position along the stroke that is one of p
    nominal : values of p
    point : rest at nominal parameters
    """
    m = len(plant.inputs)
    u = ca.SX.sym("u", m)
    rows = _rates_left(machine, x, u, p)
    guess = machine.preload(x)
    if rows.numel() == 0 or _vanishes(ca.substitute([rows], [u], [guess])[0], p):
        return x, Formula(guess if rows.numel() else ca.SX.zeros(m))
    if _preload_holds(plant, x):
        return x, Formula(guess)
    free = free_states(plant, point)
    s = ca.SX.sym("s", len(free))
    moved = ca.SX(x)
    for k, index in enumerate(free):
        moved[index] = s[k]
    r = ca.vertcat(u, s)
    if free:
        rows = _rates_left(machine, moved, u, ca.vertcat(p, s))
    near = np.concatenate([point.u, point.x[list(free)]])
    found = solve_rows(rows, Unknowns(r, near, p, nominal), [])
    for k, index in enumerate(free):
        moved[index] = found.values[m + k]
    why = INEXACT_REST if found.why else ""
    return moved, found._replace(values=found.values[:m], why=why)


def _rates_left(machine: Plant, x: Any, u: Any, p: Any) -> Any:
    """The rates at rest that are not zero whatever u and p are."""
    rows = _simplify(rates_at_rest(machine, x, u), ca.vertcat(p, u))
    return rows[[k for k in range(rows.numel()) if not rows[k].is_zero()]]


def _preload_holds(plant: Plant, x: Any) -> bool:
    """Whether the preload holds the machine at x whatever its parameters are: all of them are symbols here.

    What cancels does so exactly then, where numbers leave their rounding: 0.0002^2 is not 4e-08.
    """
    names = symbolic_names(plant.parameters)
    q = ca.SX.sym("q", len(names))
    machine = plant.variant(symbolic(plant.parameters, dict(zip(names, ca.vertsplit(q), strict=True))))
    rows = ca.densify(rates_at_rest(machine, x, machine.preload(x)))
    return _vanishes(rows, ca.vertcat(q, *ca.symvar(x)))


def free_states(plant: Plant, point: OperatingPoint) -> tuple[int, ...]:
    """The states that rest has to be solved for: as few as make the rates of rest follow what is solved for.

    States that no output has come first, then those of the last outputs; never the stroke, never a speed.
    """
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    rate = rates_at_rest(plant, x, u)
    slopes = ca.Function(
        "slopes", [x, u], [ca.densify(ca.jacobian(rate, u)), ca.densify(ca.jacobian(rate, x))]
    )
    by_u, by_x = (np.array(M) for M in slopes(point.x, point.u))
    moving = range(plant.coordinates, len(plant.states)) if plant.second_order else ()
    kept = {plant.stroke_state} if plant.has_stroke else set()
    C = np.array(ca.Function("C", [x], [ca.densify(ca.jacobian(plant.h(x, 0), x))])(point.x))
    read = np.abs(C).max(axis=0, initial=0.0) > 0
    places = [k for k in plant.controlled if k not in moving and k not in kept]
    chosen, columns = list[int](), by_u
    for k in sorted(places, key=lambda k: (read[k], -k)):
        more = np.hstack([columns, by_x[:, [k]]])
        if _rank(more) > _rank(columns):
            chosen.append(k)
            columns = more
    return tuple(chosen)


def _rank(M: FloatArray) -> int:
    """The rank of a matrix whose rows have units of their own."""
    size = np.abs(M).max(axis=1, initial=0.0, keepdims=True)
    return int(np.linalg.matrix_rank(M / np.where(size > 0, size, 1.0), tol=RANK_TOLERANCE))


def limits_at_rest(machine: Plant, believed: Plant, x: Any, v: Any) -> list[Condition]:
    """What is above zero while the commands v at rest at the states x, and their currents, are within their limits.

    machine, x, v : in symbols of some parameters
    """
    i = believed.actuator.currents(machine.h(x, ca.SX.zeros(v.numel())), v)
    signals = [*zip(machine.inputs, ca.vertsplit(v), believed.actuator.force_limit, strict=False)]
    limit = machine.actuator.current_limit
    signals += [(s, one, limit) for s, one in zip(machine.actuator.coils, ca.vertsplit(i), strict=True)]
    found = []
    for s, value, most in signals:
        ends = f"nothing holds it at rest within the limit of {s.name}"
        room = [ca.SX(most) - value, ca.SX(most) + value]
        found += [Condition(one, ends) for one in room if not (one.is_constant() and not float(one) <= 0)]
    return found


def solve_rows(rows: Any, unknowns: Unknowns, guesses: Sequence[Any]) -> Formula:
    """Solve rows(p, r) = 0 for r as a function of p, by a guess, at once where they are affine, or one by one.

    rows : expressions of p and r
    guesses : expressions of p that are tried first
    """
    r, p = unknowns.r, unknowns.p
    for guess in guesses:
        if _is_near(guess, unknowns) and _vanishes(ca.substitute([rows], [r], [guess])[0], p):
            return Formula(guess)
    found, why = None, "several commands balance the machine"
    with suppress(TooLarge, NotAnalytic, ZeroDivisionError):
        found = _exact(rows, unknowns)
    if found is None and is_affine(rows, r) and rows.numel() <= MAX_MINORS:
        found = Formula(_by_minors(rows, r))
    if found is not None and _is_near(found.values, unknowns):
        return found
    if rows.numel() == r.numel():
        try:
            return _implicit(rows, unknowns)
        except NotAnalytic as error:
            why = f"the equations of rest have {error}, which has no enclosure"
    return Formula(_newton(rows, unknowns), why=why)


def _implicit(rows: Any, unknowns: Unknowns) -> Formula:
    """The root of as many equations as there are unknowns; rest ends where it does, or divides.

    What is a root itself in the equations is a parameter of theirs. Raises NotAnalytic for operations without
    enclosure.
    """
    r, near, p, nominal = unknowns
    model, count = program(ca.Function("rows", [ca.vertcat(p, r)], [ca.densify(rows)])), 0
    if model.foreign:
        model, count = resolve_branches(model, [*nominal, *near])
    if model.foreign:
        raise NotAnalytic(model.foreign[0])
    inner = {k: n for n, k in enumerate(k for k, (name, *_) in enumerate(model.steps) if name == "root")}
    steps = tuple(
        ("input", model.inputs + inner[k], (), 0.0) if k in inner else step
        for k, step in enumerate(model.steps)
    )
    outer, symbols = ca.vertsplit(ca.vertcat(p, r)), ca.SX.sym("a", len(inner))
    cells = MatrixProgram(steps, (), (), model.inputs + len(inner)).cells(
        [*outer, *ca.vertsplit(symbols)], SYMBOLS
    )
    left = ca.SX.zeros(r.numel())
    for i, _, k in model.entries[0]:
        left[i] = cells[k]
    before = model.cells(outer, SYMBOLS)
    own, at = ca.vertcat(p, symbols), ca.vertcat(p, *(before[k] for k in inner))
    acts = [k for k, yes in enumerate(ca.which_depends(left, own, 1, False)) if yes]
    values = np.array(ca.Function("at", [p], [ca.densify(at)])(nominal)).ravel()
    root = implicit_function(left, own[acts], r, values[acts], near)
    found = call(root, at[acts])
    if root.name() not in ca.Function("found", [p], [found]).get_function():
        raise NotAnalytic("a call that CasADi before 3.8 does not keep")  # its steps would pass for a formula
    branches = [ca.substitute([before[k]], [r], [found])[0] for i, _, k in model.entries[-1] if i < count]
    exists = ca.exp(ca.atan(found[0]))  # above zero wherever there is a root
    return Formula(found, (Condition(exists), *(Condition(one) for one in branches)))


def is_affine(made: Any, v: Any) -> bool:
    """Whether an expression is affine in v, by its structure."""
    return not any(ca.which_depends(ca.vec(made), v, 2, False))


def _by_minors(rows: Any, r: Any) -> Any:
    """The smallest r of equations that are affine in r."""
    slope, start = ca.substitute([ca.jacobian(rows, r), rows], [r], [ca.SX.zeros(r.numel())])
    across = ca.sparsify(slope @ slope.T) if slope.shape[0] < slope.shape[1] else ca.sparsify(slope)
    solved = -ca.inv_minor(across) @ start
    return slope.T @ solved if slope.shape[0] < slope.shape[1] else solved


def _simplify(expression: Any, p: Any) -> Any:
    """The expression built again from its common subexpressions, where equal terms cancel."""
    return ca.SX(ca.Function("left", [p], [ca.cse(ca.densify(expression))])(p))


def _vanishes(rows: Any, p: Any) -> bool:
    """Whether expressions of p are zero for all p, squares of roots resolved."""
    rows = _simplify(rows, p)
    if rows.is_zero():
        return True
    try:
        s = _rational(rows, p)
        return s is not None and all(_resolve_roots(s, one).is_zero() for one in s.entries[0].values())
    except (TooLarge, NotAnalytic, ZeroDivisionError):
        return False


def _rational(rows: Any, p: Any) -> Symbolic | None:
    """Expressions of p as rational functions; None for long ones."""
    f = ca.Function("rows", [p], [ca.cse(ca.densify(rows))])
    return rational_functions(program(f)) if f.n_instructions() <= MAX_FORCE_OPERATIONS else None


def _is_near(r: Any, unknowns: Unknowns) -> bool:
    found = np.array(ca.Function("r", [unknowns.p], [ca.densify(r)])(unknowns.nominal)).ravel()
    size = np.abs(unknowns.near).max(initial=0.0)
    return bool(np.abs(found - unknowns.near).max(initial=0.0) <= COMMAND_TOLERANCE * size)


def _newton(rows: Any, unknowns: Unknowns) -> Any:
    """Steps of Newton's method from nominal values. No enclosure knows copysign(r, r) = r: nothing is proven."""
    q, near, p, _ = unknowns
    slope = ca.jacobian(rows, q)
    wide = slope.shape[0] < slope.shape[1]
    change = slope.T @ ca.solve(slope @ slope.T, rows) if wide else ca.solve(slope, rows)
    step = ca.Function("step", [p, q], [q - change])
    r = ca.SX(ca.DM(near))
    for _ in range(NEWTON_STEPS):
        r = step(p, r)
        r = ca.copysign(r, r)
    return r


def _exact(rows: Any, unknowns: Unknowns) -> Formula | None:
    """The unknowns from exact rational equations: all that are affine at once, else one by one; None where neither."""
    r, near, p, _ = unknowns
    left, conditions, values = list(range(r.numel())), list[Condition](), ca.SX(r)
    while left:
        own = r[left]
        rows = _simplify(ca.substitute([rows], [r], [values])[0], ca.vertcat(p, own))
        equations = _RestEquations.of(rows, p, own)
        if equations is None:
            return None
        if equations.affine:
            for k, value in zip(left, equations.solve(), strict=True):
                values[k] = value
            return Formula(values, tuple(conditions))
        pair = equations.single()
        if pair is None:
            return None
        i, j = pair
        values[left[j]], found = equations.root(i, j, unknowns, float(near[left[j]]))
        conditions += found
        keep = [k for k in range(rows.numel()) if k != i]
        rows, left = rows[keep], [k for k in left if k != left[j]]
    return Formula(values, tuple(conditions))


class _RestEquations(NamedTuple):
    """Equations in some unknowns, as polynomials in p, the unknowns and foreign operations of p."""

    s: Symbolic
    tops: list[Any]
    variables: Any  # expressions of p for all variables of the polynomials; zeros for the unknowns
    first: int  # of the unknowns among the variables
    size: int  # how many

    @classmethod
    def of(cls, rows: Any, p: Any, r: Any) -> _RestEquations | None:
        """The equations; None where they are long, or a foreign operation has an unknown."""
        both = ca.vertcat(p, r)
        s = _rational(rows, both)
        if s is None:
            return None
        first, count = p.numel(), r.numel()
        if any(max(s.program.reach[k], default=-1) >= first for k in s.atoms):
            return None
        zero = Ratio(s.context.constant(0))
        tops = [_resolve_roots(s, s.entries[0].get((i, 0), zero)).num for i in range(rows.numel())]
        cells = s.program.cells([*ca.vertsplit(p), *[ca.SX(0)] * count], SYMBOLS)
        variables = ca.vertcat(p, ca.SX.zeros(count), *(cells[k] for k in s.atoms))
        return cls(s, [top for top in tops if len(top)], variables, first, count)

    def powers(self, top: Any) -> list[tuple[int, ...]]:
        """The exponents of the unknowns in each term."""
        return [tuple(int(e) for e in m[self.first : self.first + self.size]) for m in top.monoms()]

    @property
    def affine(self) -> bool:
        """Whether all are affine, and as many as there are unknowns."""
        most = (sum(e) for top in self.tops for e in self.powers(top))
        return len(self.tops) == self.size and all(e <= 1 for e in most)

    def solve(self) -> list[Any]:
        """The unknowns of affine equations."""
        matrix, right = {}, {}
        for i, top in enumerate(self.tops):
            for power, c in self._coefficients(top).items():
                if sum(power):
                    matrix[i, power.index(1)] = c
                else:
                    right[i] = -c
        found = rational.solution(self.s, matrix, right, self.size)
        return [rational.expression(r, self.variables) for r in found]

    def single(self) -> tuple[int, int] | None:
        """An equation of one unknown, of degree 2 at most, and this unknown; None without one."""
        for i, top in enumerate(self.tops):
            powers = self.powers(top)
            used = {j for e in powers for j in range(self.size) if e[j]}
            if len(used) == 1 and max(sum(e) for e in powers) <= 2:
                return i, used.pop()
        return None

    def root(self, i: int, j: int, unknowns: Unknowns, near: float) -> tuple[Any, list[Condition]]:
        """The root of equation i, c + b r + a r^2, that is near at the nominal values; and where there is one.

        It is continuous in p while its root is real and its divisor is not zero, and so stays on its branch.
        """
        zero = Ratio(self.s.context.constant(0))
        by_power = {power[j]: c for power, c in self._coefficients(self.tops[i]).items()}
        c, b, a = (by_power.get(k, zero) for k in range(3))
        if a.is_zero():
            return self._expression(-c / b), []
        square, conditions = self._square_root(
            _resolve_roots(self.s, b * b - self.s.constant(4.0) * a * c), unknowns
        )
        c, b, a = map(self._expression, (c, b, a))
        sign = 1.0 if float(ca.Function("b", [unknowns.p], [b])(unknowns.nominal)) >= 0 else -1.0
        far = -(b + sign * square) / 2
        roots = c / far, far / a
        off = [abs(float(ca.Function("r", [unknowns.p], [r])(unknowns.nominal)) - near) for r in roots]
        return roots[int(off[1] < off[0])], conditions

    def _square_root(self, r: Ratio, unknowns: Unknowns) -> tuple[Any, list[Condition]]:
        """sqrt(r), with powers of variables before the root: in balls C^2 + m C reaches below zero before C does."""
        top, below = r.num, r.den if r.den is not None else self.s.constant(1.0).num
        before, powers = ca.SX(1), [min(e) for e in zip(*(m for m in top.monoms()), strict=True)]
        powers_below = [min(e) for e in zip(*(m for m in below.monoms()), strict=True)]
        for k, (e, d) in enumerate(zip(powers, powers_below, strict=True)):
            x, power = self.variables[k], int(e) - int(d)
            if power:
                positive = float(ca.Function("x", [unknowns.p], [x])(unknowns.nominal)) > 0
                size = x if positive else -x
                before *= size ** (power // 2) * (ca.sqrt(size) if power % 2 else 1)
        top, below = (
            self.s.context.from_dict(
                {tuple(e - c for e, c in zip(m, least, strict=True)): x for m, x in part.to_dict().items()}
            )
            for part, least in ((top, powers), (below, powers_below))
        )
        size = top.leading_coefficient() / below.leading_coefficient()
        roots = [_perfect_root(part / part.leading_coefficient()) for part in (top, below)]
        if None not in roots and size > 0:
            whole = self._expression(Ratio(roots[0]) / Ratio(roots[1]))
            sign = 1 if float(ca.Function("x", [unknowns.p], [whole])(unknowns.nominal)) > 0 else -1
            found = before * math.sqrt(int(size.p) / int(size.q)) * sign * whole
            return found, [] if whole.is_constant() else [Condition(sign * whole)]
        rest = self._expression(Ratio(top) / Ratio(below))
        return before * ca.sqrt(rest), [] if rest.is_constant() else [Condition(rest)]

    def _expression(self, r: Ratio) -> Any:
        return ca.SX(0) if r.is_zero() else rational.expression(r, self.variables)

    def _coefficients(self, polynomial: Any) -> dict[tuple[int, ...], Ratio]:
        """The coefficients of powers of the unknowns."""
        parts: dict[tuple[int, ...], dict[Any, Any]] = {}
        first, end = self.first, self.first + self.size
        for monomial, c in polynomial.to_dict().items():
            power = tuple(int(e) for e in monomial[first:end])
            rest = tuple(0 if first <= k < end else e for k, e in enumerate(monomial))
            parts.setdefault(power, {})[rest] = c
        return {power: Ratio(self.s.context.from_dict(terms)) for power, terms in parts.items()}


def _perfect_root(polynomial: Any) -> Any | None:
    """The polynomial whose square this one is; None where it is none."""
    try:
        return polynomial.sqrt()
    except DomainError:
        return None


def _resolve_roots(s: Symbolic, r: Ratio) -> Ratio:
    """The ratio with squares of roots replaced by what the roots are of."""
    steps = [s.program.steps[step] for step in s.atoms]
    is_root = (name == "sqrt" or (name == "constpow" and power == 0.5) for name, _, _, power in steps)
    roots = {s.inputs + k: s.arguments[k] for k, root in enumerate(is_root) if root}
    return rational.replace_squares(s, r, roots)

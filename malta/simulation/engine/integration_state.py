"""The machine's state as the compiled engine carries it from one Runge–Kutta step to the next within a sample.

    machine -- enter --> working -- substep --> working -- ... --> working -- leave --> machine

It is another set of coordinates of the same motion, in which a step takes fewer operations:

- A rate that belongs to a conserved quantity G = x_k + s(q) x_j is not integrated: x_k = G - s(q) x_j. G is proven to
  be constant, whatever its value (find_conserved); a torque from outside leaves the rate among the others.
- Forces enter the motion as a few linear combinations of the coils' currents. Currents follow their commands as
  first-order lags, so the combinations do, and no step needs the currents themselves.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca

from malta.model.plant import Plant
from malta.simulation.layout import (
    LoopPlan,
    Setup,
    electronics_of,
    layout_of,
    numbers_of,
    signals_of,
    with_symbols,
)
from malta.simulation.period import SENSORS, Period, half_step_decay, motion, runge_kutta
from malta.simulation.readings import step_readings
from malta.synthesis.controller import Controller

# What CasADi's SX expressions prove of themselves: identities of polynomials, linear parts, and what is conserved.
#
# A proof here is an identity of polynomials with rational coefficients. Their unknowns are symbols and operations
# other than sums and products; two of them are one where they are the same operation on the same polynomials'
# expressions.


TERMS = 500  # of a polynomial; a longer one proves nothing
_SUMS = {ca.OP_ADD: (1, 1), ca.OP_SUB: (1, -1), ca.OP_NEG: (-1,), ca.OP_TWICE: (2,)}
_COMMUTING_OPERATIONS = (ca.OP_ADD, ca.OP_MUL)

Monomial = tuple[int, ...]
Polynomial = dict[Monomial, Fraction]


class Conserved(NamedTuple):
    """A quantity G = x_k + s x_j with dG/dt = 0, where s depends on positions only."""

    k: int
    j: int
    s: Any


class Identities:
    """Numbers for scalar SX expressions: equal ones have the same number."""

    def __init__(self) -> None:
        self._numbers: dict[Any, int] = {}
        self._known: dict[int, tuple[int, Any]] = {}  # by CasADi's hash; kept, so that it is unique

    def number(self, e: Any) -> int:
        mark = e.element_hash()
        if mark not in self._known:
            if e.is_constant():
                key: Any = ("constant", float(e))
            elif e.is_symbolic():
                key = ("symbol", mark)
            else:
                parts = [self.number(e.dep(i)) for i in range(e.n_dep())]
                key = (e.op(), *(sorted(parts) if e.op() in _COMMUTING_OPERATIONS else parts))
            self._known[mark] = self._numbers.setdefault(key, len(self._numbers)), e
        return self._known[mark][0]

    def polynomial(self, e: Any) -> Polynomial:
        """The expression as a sum of products. Raises OverflowError for more than TERMS of them."""
        if e.is_constant():
            return {(): Fraction(float(e))} if float(e) else {}
        op = -1 if e.is_symbolic() else e.op()
        if op in _SUMS:
            total: Polynomial = {}
            for i, factor in enumerate(_SUMS[op]):
                for monomial, value in self.polynomial(e.dep(i)).items():
                    total[monomial] = total.get(monomial, Fraction(0)) + factor * value
            return _check_length({monomial: value for monomial, value in total.items() if value})
        if op in (ca.OP_MUL, ca.OP_SQ):
            one, other = (self.polynomial(e.dep(i if op == ca.OP_MUL else 0)) for i in range(2))
            product: Polynomial = {}
            for a, x in one.items():
                for b, y in other.items():
                    both = tuple(sorted((*a, *b)))
                    product[both] = product.get(both, Fraction(0)) + x * y
                    _check_length(product)
            return {monomial: value for monomial, value in product.items() if value}
        return {(self.number(e),): Fraction(1)}

    def is_zero(self, e: Any) -> bool:
        """Whether an expression is proven to be zero whatever its symbols are."""
        try:
            return not self.polynomial(e)
        except (OverflowError, ValueError):  # too long, or a constant that is no number
            return False


def _check_length(p: Polynomial) -> Polynomial:
    if len(p) > TERMS:
        raise OverflowError
    return p


def find_conserved(x: Any, rate: Any) -> list[Conserved]:
    """Conserved quantities x_k + s(q) x_j of x' = rate with x = (q, q'), for rates x_k and x_j.

    The candidates are products s x_j' in the sum that x_k' is; each one is proven by differentiating it. The angular
    momentum of a round body about its own axis is one, where no torque acts about that axis.
    """
    half, same, found = x.numel() // 2, Identities(), []
    q, taken = x[:half], set[int]()
    for k in range(half, 2 * half):
        for sign, term in _terms(rate[k]):
            for j, s in _candidates(same, term, rate, k, half):
                s = -sign * s
                if taken & {k, j} or any(ca.depends_on(s, x[i]) for i in range(half, 2 * half)):
                    continue
                slope = rate[k] + s * rate[j] + ca.jtimes(s, q, x[half:]) * x[j]
                if same.is_zero(slope):
                    found.append(Conserved(k, j, s))
                    taken |= {k, j}
    return found


def _terms(e: Any) -> list[tuple[int, Any]]:
    """The terms of a sum of sums, with their signs."""
    if e.is_constant() or e.is_symbolic() or e.op() not in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG):
        return [(1, e)]
    signs = _SUMS[e.op()]
    return [(sign * inner, term) for i, sign in enumerate(signs) for inner, term in _terms(e.dep(i))]


def _candidates(same: Identities, term: Any, rate: Any, k: int, half: int) -> list[tuple[int, Any]]:
    """(j, s) of a term s x_j'."""
    if term.is_constant() or term.is_symbolic() or term.op() != ca.OP_MUL:
        return []
    found = []
    for j in set(range(half, 2 * half)) - {k}:
        terms = _terms(rate[j])
        sign, other = terms[0] if len(terms) == 1 else (1, rate[j])
        for factor, rest in ((term.dep(0), term.dep(1)), (term.dep(1), term.dep(0))):
            if not factor.is_constant() and same.number(factor) == same.number(other):
                found.append((j, sign * rest))
    return found


def linear_parts(e: Any, symbols: Any, fixed: Any) -> tuple[Any, Any, Any]:
    """(parts, names, rewritten): the largest subexpressions that are linear in the symbols, with fixed coefficients.

    fixed : symbols that coefficients may depend on
    parts : the subexpressions, a column; names : a new symbol for each; rewritten : e in terms of the names
    """
    walk = _LinearTerms(symbols, fixed)
    rewritten = ca.vertcat(*(walk.rewritten(e[i]) for i in range(e.numel())))
    parts = list(walk.parts.values())
    return ca.vertcat(*(p for p, _ in parts)), ca.vertcat(*(n for _, n in parts)), rewritten


class _LinearTerms:
    """Subexpressions by what they are: fixed, linear in the symbols, free of them, or mixed."""

    def __init__(self, symbols: Any, fixed: Any) -> None:
        kinds = (("linear", symbols), ("fixed", fixed))
        self.symbols = {v[i].element_hash(): kind for kind, v in kinds for i in range(v.numel())}
        self.parts: dict[int, tuple[Any, Any]] = {}  # by number: the part and its name
        self._same = Identities()
        self._kinds: dict[int, str] = {}
        self._done: dict[int, Any] = {}

    def kind(self, e: Any) -> str:
        mark = e.element_hash()
        if mark not in self._kinds:
            self._same.number(e)  # keeps e, so that its hash stays its own
            self._kinds[mark] = self._kind(e)
        return self._kinds[mark]

    def _kind(self, e: Any) -> str:
        if e.is_constant():
            return "fixed"
        if e.is_symbolic():
            return self.symbols.get(e.element_hash(), "free")
        kinds = {self.kind(e.dep(i)) for i in range(e.n_dep())}
        if kinds == {"fixed"}:
            return "fixed"
        if kinds <= {"fixed", "free"}:
            return "free"
        sum_of_linear = e.op() in _SUMS and kinds == {"linear"}
        return (
            "linear" if sum_of_linear or (e.op() == ca.OP_MUL and kinds == {"fixed", "linear"}) else "mixed"
        )

    def rewritten(self, e: Any) -> Any:
        """The expression with a name in place of every largest linear part."""
        mark = e.element_hash()
        if mark not in self._done:
            self._done[mark] = self._rewritten(e)
        return self._done[mark]

    def _rewritten(self, e: Any) -> Any:
        kind = self.kind(e)
        if kind == "linear":
            number = self._same.number(e)
            if number not in self.parts:
                self.parts[number] = e, ca.SX.sym(f"part{len(self.parts)}")
            return self.parts[number][1]
        if kind != "mixed":
            return e
        arguments = [self.rewritten(e.dep(i)) for i in range(e.n_dep())]
        return (ca.SX.unary if len(arguments) == 1 else ca.SX.binary)(e.op(), *arguments)


class Coordinates(NamedTuple):
    """Indices of the states (q, q'), and what replaces some of them."""

    half: int  # number of positions
    constants: list[Conserved]

    @property
    def free(self) -> list[int]:
        """Positions whose rates are integrated."""
        return [i for i in range(self.half) if self.half + i not in {g.k for g in self.constants}]

    @property
    def driven(self) -> list[int]:
        """Positions whose rates follow from a conserved quantity."""
        return [g.k - self.half for g in self.constants]

    def full(self, x: Any, moving: Any, G: Any) -> Any:
        """(q, q') of the moving coordinates: free positions, their rates, driven positions. x: symbols of (q, q')."""
        count, q = len(self.free), ca.SX.zeros(self.half)
        w = ca.SX.zeros(self.half)
        for i, k in enumerate(self.free):
            q[k], w[k] = moving[i], moving[count + i]
        for i, k in enumerate(self.driven):
            q[k] = moving[2 * count + i]
        for i, (k, j, s) in enumerate(self.constants):
            w[k - self.half] = G[i] - ca.substitute(s, x[: self.half], q) * w[j - self.half]
        return ca.vertcat(q, w)


def with_working_state(p: Period, plant: Plant, c: Controller, s: Setup) -> Period:
    """The same control period with a working state; unchanged for other fidelities than `force`, and where commands
    begin to act within a sample.

    p : with the numbers as the argument theta
    """
    own = s.fidelity != "force" or electronics_of(plant, s) is not None
    if own or s.fraction or not plant.second_order:
        return p
    plant, g, theta = with_symbols(plant, numbers_of(plant, c, 1))
    loop, signals = LoopPlan(plant, c, s, g), signals_of(layout_of(plant, c, s), ca.SX)
    machine, given = signals.machine, ca.vertcat(*signals.given.values())
    x, i, h = machine["x"], machine["i_coil"], g["substep"]
    rate = ca.cse(ca.densify(motion(loop, signals, x, plant.actuator.forces(x, i))))
    parts, names, slope = linear_parts(rate, i, theta)
    if parts.numel() > i.numel():
        parts, names, slope = i, i, rate
    at = Coordinates(x.numel() // 2, find_conserved(x, rate))
    held, jitter = ca.SX.sym("held", i.numel()), ca.SX.sym("jitter", 0)
    decay = half_step_decay(plant.actuator.crossover, h)

    # What a step begins with, and the symbols of it.
    G0 = ca.vertcat(*(x[k] + s * x[j] for k, j, s in at.constants))
    drawn = (1 - decay) * ca.substitute(parts, i, held)
    order = [*at.free, *(at.half + k for k in at.free), *at.driven]
    others = [machine[name] for name in machine if name in SENSORS]
    acting_first = drawn if decay.is_zero() else parts
    first = [x[order], acting_first, ca.SX(1), G0, drawn, *others]
    moving, acting, left, G, towards, *read = (ca.SX.sym("part", part.numel()) for part in first)
    working = ca.vertcat(moving, acting, left, G, towards, *read)

    middle = towards + decay * acting
    forces = [acting, middle, towards + decay * middle]
    law = ca.Function("slope", [x, names, given, theta], [slope])

    def change(z: Any, halves: int) -> Any:
        state = at.full(x, z, G)
        slopes = law(state, forces[halves], given, theta)
        return slopes[order]

    moved = runge_kutta(change, moving, h, len(at.free))
    full = at.full(x, moved, G)
    sensors = dict(zip([name for name in machine if name in SENSORS], read, strict=True))
    before = {**machine, **sensors, "x": at.full(x, moving, G)}
    after = step_readings(loop, before, full)
    stepped = [moved, forces[2], left * decay**2, G, towards, *(after[name] for name in sensors)]
    left_behind = [at.full(x, moving, G), held + left * (i - held), *read]
    symbols = ca.vertcat(*machine.values())
    return p._replace(
        enter=ca.Function("enter", [symbols, held, theta], _dense(first)),
        substep=ca.Function("substep", [working, held, given, jitter, theta], _dense(stepped)),
        leave=ca.Function("leave", [working, symbols, held, theta], _dense(left_behind)),
    )


def _dense(parts: list[Any]) -> list[Any]:
    return [ca.cse(ca.densify(ca.vertcat(*parts)))]

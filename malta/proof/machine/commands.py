"""The command at which a machine's preload acts, as a function of its parameters.

    forces(x, currents(h(x), v)) = preload(x)

defines v implicitly. A proof needs it exactly: a model at another command is a model of another machine. It is exact

  * where a command of the preload, or of zero, makes the preload, as in most machines,
  * where the forces are affine in v, as those of a commutation with other parameters,
  * where, with squares of roots resolved, each is a polynomial of degree 2 in a command of its own, or all are affine.

Elsewhere v comes from a fixed number of Newton steps, which is good enough to search for unstable machines and not for
a proof: an operation that no enclosure knows keeps every proof away from such a model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.proof.expressions import NotAnalytic, program
from malta.proof.polynomial import compact
from malta.proof.polynomial.rational import Ratio, Symbolic, TooLarge, symbolic

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

LONGEST = 5_000  # operations up to which the forces are expanded
NEWTON_STEPS = 8
CLOSE = 1e-6  # of the command, between its formula and the nominal one
NOT_EXACT = "the command that makes the preload is no formula of the parameters"


class Command(NamedTuple):
    """The command as an expression; `why` says why it is not exact, "" where it is."""

    v: Any
    why: str = ""


def is_affine(made: Any, v: Any) -> bool:
    """Whether an expression is affine in v, by its structure."""
    return not any(ca.which_depends(ca.vec(made), v, 2, False))


def command_of(chain: ca.Function, p: Any, acting: Any, nominal: FloatArray, wanted: FloatArray) -> Command:
    """Find v with chain(p, v) = acting as a function of p.

    chain : (p, v) -> inputs that the currents of v make
    acting : the inputs that shall act, an expression of p
    nominal : values of p
    wanted : v at these, which chooses between the solutions
    """
    q = ca.SX.sym("v", chain.size1_in(1))
    made = chain(p, q)
    left = _simplified(acting - chain(p, acting), p)
    none = ca.SX.zeros(q.numel())
    for v, rest in ((acting, left), (none, _simplified(acting - chain(p, none), p))):
        if rest.is_zero() and _is_near(v, p, nominal, wanted):
            return Command(v)
    if is_affine(made, q):
        slope, start = ca.substitute([ca.jacobian(made, q), made], [q], [none])
        return Command(acting + ca.solve(slope, acting - start - slope @ acting))
    both = ca.Function("both", [ca.vertcat(p, q)], [ca.densify(made - acting), ca.densify(left)])
    if both.n_instructions() <= LONGEST:
        try:
            v = _exact_command(symbolic(program(both)), p, acting, wanted, nominal)
        except (TooLarge, NotAnalytic, ZeroDivisionError):
            v = None
        if v is not None and _is_near(v, p, nominal, wanted):
            return Command(v)
    return Command(_newton(chain, p, acting, wanted), NOT_EXACT)


def _simplified(expression: Any, p: Any) -> Any:
    """The expression built again from its common subexpressions, where equal terms cancel."""
    return ca.SX(ca.Function("left", [p], [ca.cse(ca.densify(expression))])(p))


def _is_near(v: Any, p: Any, nominal: FloatArray, wanted: FloatArray) -> bool:
    found = np.array(ca.Function("v", [p], [ca.densify(v)])(nominal)).ravel()
    return bool(np.abs(found - wanted).max() <= CLOSE * np.abs(wanted).max())


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
    if all(_resolved(s, r).is_zero() for r in left.values()):
        return acting
    polynomials = [_resolved(s, equations.get((i, 0), zero)).num for i in range(m)]
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
        return ca.vertcat(*(compact.expression(r, p) for r in compact.solution(s, matrix, right, m)))
    own = [all(not any(e[:i] + e[i + 1 :]) and e[i] <= 2 for e in one) for i, one in enumerate(powers)]
    if not all(own):
        return None
    roots = []
    for i, n in enumerate(polynomials):
        by_power = {power[i]: c for power, c in _coefficients(s, n, first, m).items()}
        terms = [compact.expression(by_power[k], p) if k in by_power else ca.SX(0) for k in range(3)]
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


def _resolved(s: Symbolic, r: Ratio) -> Ratio:
    """The ratio with squares of roots replaced by what the roots are of, the outermost first."""
    for k, step in reversed(list(enumerate(s.atoms))):
        name, _, _, power = s.program.steps[step]
        if name == "sqrt" or (name == "constpow" and power == 0.5):
            r = _without_squares(s, r, s.inputs + k, s.arguments[k])
    return r


def _without_squares(s: Symbolic, r: Ratio, root: int, argument: Ratio) -> Ratio:
    def turn(polynomial: Any) -> Ratio:
        total = Ratio(s.context.constant(0))
        for monomial, c in polynomial.to_dict().items():
            squares, odd = divmod(int(monomial[root]), 2)
            rest = tuple(odd if k == root else e for k, e in enumerate(monomial))
            term = Ratio(s.context.from_dict({rest: c}))
            total = total + (term * argument**squares if squares else term)
        return total

    num = turn(r.num)
    return num if r.den is None else num / turn(r.den)

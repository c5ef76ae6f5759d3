"""The operations of a program over balls: real ones about points, and complex ones over a whole box.

A function is enclosed where it is analytic; at a cut or a pole it is refused (`NotAnalytic`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi as ca
from flint import acb, acb_mat, arb

from malta.linear.expressions import Arithmetic, NotAnalytic, exact, program
from malta.linear.implicit import ImplicitRoot, Slopes
from malta.linear.roots import RootEntry, root_equations, root_value


def _require_off_cut(z: Any) -> Any:
    """z. Raises NotAnalytic when its ball touches the negative real axis or zero."""
    if z.imag.contains(0) and not z.real > 0:
        raise NotAnalytic("a root or logarithm at zero or below")
    return z


def _require_within_unit(z: Any) -> Any:
    """z. Raises NotAnalytic when its real part reaches 1 or -1, from where the real axis is a cut."""
    if not abs(z.real) < 1:
        raise NotAnalytic("an inverse sine, cosine or hyperbolic tangent at 1 or beyond")
    return z


def _require_off_imaginary_cuts(z: Any) -> Any:
    """z. Raises NotAnalytic when its ball touches the imaginary axis at i or beyond, either way."""
    if z.real.contains(0) and not abs(z.imag) < 1:
        raise NotAnalytic("an inverse tangent or hyperbolic sine near a pole of its slope")
    return z


def _require_above_one(z: Any) -> Any:
    """z. Raises NotAnalytic when its real part reaches 1, from where the real axis to the left is a cut."""
    if not z.real > 1:
        raise NotAnalytic("an inverse hyperbolic cosine at 1 or below")
    return z


def _angle(y: Any, x: Any) -> Any:
    """The angle of a point, in the half plane where it lies. Raises NotAnalytic where that is not known."""
    if x.real > 0:
        return _require_off_imaginary_cuts(finite(y / x)).atan()
    if not (y.real > 0 or y.real < 0):
        raise NotAnalytic("an angle whose point may be at zero or cross the negative axis")
    half = acb.pi() / 2
    return (half if y.real > 0 else -half) - _require_off_imaginary_cuts(finite(x / y)).atan()


def _by_slope(function: Callable[[Any], Any], slope: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function by its value in the middle of a ball and its slope on it: f(z) is in f(m) + (z - m) f'(ball)."""

    def found(z: Any) -> Any:
        middle = acb(z.real.mid(), z.imag.mid())
        return function(middle) + (z - middle) * finite(slope(z))

    return found


_asinh = _by_slope(lambda z: z.asinh(), lambda z: 1 / _require_off_cut(z * z + 1).sqrt())
_acosh = _by_slope(lambda z: z.acosh(), lambda z: 1 / ((z - 1).sqrt() * (z + 1).sqrt()))
_atanh = _by_slope(lambda z: z.atanh(), lambda z: 1 / (1 - z * z))


def finite(z: Any) -> Any:
    """z. Raises NotAnalytic when it is not finite, after a division by a ball that contains zero."""
    if not z.is_finite():
        raise NotAnalytic("a division by what may be zero")
    return z


_BALLS: dict[str, Callable[..., Any]] = {
    "sin": lambda z: z.sin(),
    "cos": lambda z: z.cos(),
    "tan": lambda z: finite(z.tan()),
    "exp": lambda z: z.exp(),
    "expm1": lambda z: z.exp() - 1,
    "sinh": lambda z: z.sinh(),
    "cosh": lambda z: z.cosh(),
    "tanh": lambda z: finite(z.tanh()),
    "sqrt": lambda z: _require_off_cut(z).sqrt(),
    "log": lambda z: _require_off_cut(z).log(),
    "log1p": lambda z: _require_off_cut(z + 1).log(),
    "pow": lambda z, w: (_require_off_cut(z).log() * w).exp(),
    "asin": lambda z: _require_within_unit(z).asin(),
    "acos": lambda z: _require_within_unit(z).acos(),
    "atan": lambda z: _require_off_imaginary_cuts(z).atan(),
    "atan2": _angle,
    "asinh": lambda z: _asinh(_require_off_imaginary_cuts(z)),
    "acosh": lambda z: _acosh(_require_above_one(z)),
    "atanh": lambda z: _atanh(_require_within_unit(z)),
    "erf": lambda z: z.erf(),
    "hypot": lambda a, b: _require_off_cut(a * a + b * b).sqrt(),
}


def _ball(x: float) -> Any:
    exact(x)
    return acb(x)


class _Checked(Arithmetic):
    """The arithmetic of balls, in which quotients must be finite."""

    def apply(self, name: str, operands: list[Any], value: Any) -> Any:
        found = super().apply(name, operands, value)
        return finite(found) if name in ("div", "inv", "constpow", "pow") else found


_PLAIN_BALLS = _Checked(_ball, _BALLS)


_ROOTS: dict[str, ImplicitRoot] = {}  # by name, in which its equations are counted
MAX_KEPT_ROOTS = 64


def enclosed_root(function: ca.Function) -> ImplicitRoot:
    """The root that a function of `implicit_function` is, with its equations over balls; remembered by its name."""
    if function.name() not in _ROOTS:
        equations, nominal, near = root_equations(function)
        model = program(equations).only((0, 1, 2))

        def run(p: Sequence[Any], r: Sequence[Any]) -> Slopes | None:
            try:
                entries = model.run([*p, *r], _PLAIN_BALLS)
            except NotAnalytic:
                return None
            F, F_r, F_p = (acb_mat(*shape) for shape in model.shapes[:3])
            for matrix, own in zip((F, F_r, F_p), entries, strict=False):
                for i, j, x in own:
                    matrix[i, j] = x
            return F, F_r, F_p

        if len(_ROOTS) >= MAX_KEPT_ROOTS:
            _ROOTS.clear()
        _ROOTS[function.name()] = ImplicitRoot(run, partial(root_value, function), nominal, near)
    return _ROOTS[function.name()]


def _at_points(functions: dict[str, Callable[..., Any]]) -> dict[str, Callable[..., Any]]:
    """Functions of complex balls that return real balls for real arguments."""

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *z: function(*(acb(x) for x in z)).real

    return {name: wrap(function) for name, function in functions.items()}


def root_enclosure(entry: RootEntry, p: Sequence[Any], *, is_one: bool = True) -> Any:
    """Values of a root over complex balls of p: `ImplicitRoot.enclose`. Raises NotAnalytic where they are not known."""
    found = enclosed_root(entry.function).enclose(p, is_one=is_one)
    if found is None:
        raise NotAnalytic("a root of equations that may end or divide")
    return found[entry.place]


def _real_root(entry: RootEntry, p: Sequence[Any]) -> Any:
    return root_enclosure(entry, [acb(x) for x in p]).real


POINTS = _Checked(lambda x: arb(exact(x)), {**_at_points(_BALLS), "root": _real_root})
BALLS = _Checked(_ball, {**_BALLS, "root": root_enclosure})

"""The margin of a polynomial whose coefficients are functions of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from malta.arguments import by_name, interval, is_pair, number
from malta.errors import InputError
from malta.linear.expressions import program
from malta.linear.systems import polynomial_of
from malta.processes import on_one_thread
from malta.proof.box import box_of
from malta.proof.margin import Margin, Progress, Ranges
from malta.proof.problem import CoefficientPolynomial
from malta.proof.robust import ProofEffort, margin_of


@on_one_thread
def margin_of_polynomial(
    coefficients: Any,
    box: Ranges,
    nominal: Mapping[str, float] | None = None,
    *,
    over: Mapping[str, tuple[float, float]] | None = None,
    discrete: bool = False,
    tolerance: float | None = None,
    time: float | None = None,
    progress: Progress | None = None,
) -> Margin:
    """Prove the margin of a characteristic polynomial whose coefficients depend on parameters.

    coefficients : a function of the parameters by name (or of one array p), or a casadi.Function: the coefficients,
        highest power first
    box : intervals (low, high) by name, or shares of the nominal value
    nominal : values by name; the middle of the interval for a parameter without one
    over : intervals that do not grow with t, in SI
    discrete : whether stable roots lie in the unit disc, in place of the left half plane
    tolerance : relative distance between the proven bound and the witness; None: 9e-4, and less where that is cheap
    time, progress : as of `malta.robust_margin`

    Returns a Margin.

    Raises InputError as `malta.robust_margin` does.

    >>> import malta
    >>> def cubic(k):  # stable while k < 8
    ...     return [1, 3, 3, 1 + k]
    >>> found = malta.proof.margin_of_polynomial(cubic, {"k": (1, 2)}, {"k": 1})
    >>> f"{found.lower:.2f}, {found.upper:.2f}"
    '7.00, 7.00'
    """
    caller = "margin_of_polynomial"
    effort = ProofEffort(tolerance, time, None, progress, caller)
    outside = by_name(caller, "over", {} if over is None else over, '{"k": (1, 2)}')
    values = _middles({**by_name(caller, "box", box, '{"k": (1, 2)}'), **outside}, nominal)
    names = tuple(values)
    function = polynomial_of(coefficients, names)
    problem = CoefficientPolynomial(program(function), names, discrete)
    where = box_of(names, np.array(list(values.values())), (), box, outside, caller=caller)
    return margin_of(problem, where, effort)


def _middles(ranges: Mapping[str, Any], nominal: Any) -> dict[str, float]:
    """The nominal values of a polynomial's parameters: as given, else the middle of the interval."""
    caller = "margin_of_polynomial"
    given = by_name(caller, "nominal", {} if nominal is None else nominal, '{"k": 1.5}')
    for name in given:
        if name not in ranges:
            raise InputError(caller, name, "a nominal value without a range", "a range in box")
    if not ranges:
        raise InputError(caller, "box", "no parameters", "at least one uncertain parameter")
    values = {}
    for name, value in ranges.items():
        if name in given:
            values[name] = number(caller, name, given[name])
        elif is_pair(value):
            low, high = interval(caller, name, value)
            values[name] = low / 2 + high / 2
        else:
            raise InputError(caller, name, "a share without a nominal value", "nominal={...}")
    return values

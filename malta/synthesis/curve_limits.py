"""Where requirements bind on curves: what of [specification] bounds |S|, singular values of T, loads and errors.

A limit is a region that a curve may not enter: above `limit`, or below it, from `low` to `high` along the axis. The
judge finds that a design fails where its curve enters the region. Errors of a run are the exception: their requirement
is judged on machines that differ, so that their limits are lines.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from malta.synthesis.requirements import base_of, requirements_for
from malta.synthesis.spec import Spec

HALF_POWER = 1 / math.sqrt(2)  # of sigma_min(T), below which a bandwidth ends


class CurveLimit(NamedTuple):
    """A region that the size of a curve may not enter.

    entry : of [specification], as "recovery F_x largest"
    curve : "S" of a sensor, the smallest singular value of "T", the answer to a unit of `load`, the "error" of a run
    limit : SI, of the size of the curve
    signals : whose curves are bounded; () : of all
    low, high : where, rad/s or s
    at_least : whether the region is below the limit, not above
    """

    entry: str
    curve: Literal["S", "T", "load", "error"]
    limit: float
    signals: tuple[str, ...] = ()
    low: float = 0.0
    high: float = math.inf
    load: str = ""
    at_least: bool = False

    @property
    def words(self) -> str:
        """The requirement in words."""
        return " ".join([base_of(self.entry).replace("_", " "), *self.entry.split(" ")[1:]])


def curve_limits(spec: Spec | None) -> tuple[CurveLimit, ...]:
    """The limits that a specification sets to curves; none without one.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> [(one.words, one.curve, one.limit) for one in curve_limits(spec)][0]
    ('peak sensitivity', 'S', 1.6)
    """
    found = (
        [] if spec is None else [limit for entry in spec.specification for limit in _limits_of(spec, entry)]
    )
    return tuple(limit for limit in found if math.isfinite(limit.limit))


def _limits_of(spec: Spec, entry: str) -> list[CurveLimit]:
    asked, base, signal = spec.specification[entry], base_of(entry), entry.partition(" ")[2]
    if base == "peak_sensitivity":
        return [CurveLimit(entry, "S", asked)]
    if base == "bandwidth":
        return [CurveLimit(entry, "T", HALF_POWER, high=asked, at_least=True)]
    if base == "recovery":
        bound = spec.recovery[signal]
        sizes = {s.name: size for s, size in zip(spec.plant.disturbances, bound.load, strict=True) if size}
        if bound.anywhere or len(sizes) != 1 or any(bound.slope):
            return []  # a load of several forces, or places along the travel, have no curve
        ((load, size),) = sizes.items()
        return [CurveLimit(entry, "load", asked / abs(size), bound.outputs, bound.after or 0.0, load=load)]
    drawn = requirements_for(spec.plant)[base].error_of if base in requirements_for(spec.plant) else ()
    return [CurveLimit(entry, "error", asked, drawn)] if drawn else []

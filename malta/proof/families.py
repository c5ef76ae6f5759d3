"""The families of a problem over a box, one for each group of states and part of the box; and the nominal loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from flint import arb

from malta.proof.box_parts import Part, cut, merge_twins
from malta.proof.exclusion.exclusion import growth_over
from malta.proof.expressions import NotAnalytic, exact
from malta.proof.polynomial.characteristic import pair
from malta.proof.polynomial.enclosure import Polynomial, Unproven, over_box, precision
from malta.proof.polynomial.family import Family
from malta.proof.problem import Problem, hurwitz
from malta.proof.time_limit import TimeUp, time_limit

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.box import Box

REMEMBERED = 4_000_000  # numbers in the families of a polynomial, beyond which the oldest are forgotten
MOST_BITS = 5120  # of the ball arithmetic in which Routh's scheme is tried

FAMILIES: WeakKeyDictionary[Polynomial, dict[Any, Family]] = WeakKeyDictionary()


def parts_over(problem: Problem, box: Box, reach: float, last: float) -> list[Part]:
    """The families of all groups over box(reach), cut into parts where one expansion does not do.

    last : time.monotonic() at which the search gives up

    Raises Unproven when a matrix has no value on the box, or when time is up.
    """
    sides = box.sides(reach)
    parts: list[Part] = []
    try:
        with time_limit(last):
            if (enclose := problem.traits.enclose) is not None:
                return enclose(box, reach)
            for polynomial, moves in problem.parts([arb(a).union(arb(b)) for a, b in sides.tolist()]):
                parts += _parts_of(polynomial, box, sides, moves, last)
    except NotAnalytic as error:
        raise Unproven(f"the matrices have no value on the box: {error}") from error
    except TimeUp as error:
        raise Unproven("time was up before the coefficients were found") from error
    return merge_twins(parts)


def _parts_of(f: Polynomial, box: Box, sides: FloatArray, moves: tuple[Any, ...], last: float) -> list[Part]:
    """The parts of one polynomial."""

    def part_over(own: FloatArray) -> list[Part]:
        return [Part(f, own, family_over(f, own, moves, last), growth_over(own, f.inverted, box))]

    return cut(sides, box.nominal, last, part_over)


def family_over(f: Polynomial, sides: FloatArray, moves: tuple[Any, ...], last: float) -> Family:
    """The family of a polynomial over `sides`, remembered: several margins need it over the same box."""
    known = FAMILIES.setdefault(f, {})
    key = (sides.tobytes(), tuple(pair(m) for m in moves))
    if key not in known:
        family = over_box(f, sides, moves, last)
        while sum(other.values.size for other in known.values()) > REMEMBERED:
            known.pop(next(iter(known)))
        known[key] = family
    return known[key]


def is_nominal_stable(problem: Problem, box: Box) -> bool:
    """Whether the nominal loop is proven stable, by Routh's scheme in exact numbers or balls.

    No coupling is neglected: over a box that is proven, other couplings may be than at the nominal values.
    """
    for f, _ in problem.parts([arb(x) for x in box.nominal.tolist()], neglect=False):
        bits, stable = 160, None
        while stable is None and bits <= MOST_BITS:
            with precision(bits):
                v = [exact(x) for x in box.nominal.tolist()]
                v = [1 / x if inverted else x for x, inverted in zip(v, f.inverted, strict=True)]
                stable = hurwitz(f.at(v))
            bits *= 2
        if not stable:
            return False
    return True

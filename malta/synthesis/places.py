"""Where the elements of a law stand between errors and forces, and the law as a function of their numbers.

    v = K(s) (p* - y),    K = sum of L_k E_k(s) R_k        E_k: an element; R_k: what of the errors it takes,
                                                           L_k: the forces that it acts with

A law of errors is sampled by Tustin's rule, as malta.synthesis.controller_of recommends: with
z = (1 + s T/2) / (1 - s T/2) it has the same matrices in s as the continuous law.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy import linalg

from malta.errors import InputError
from malta.synthesis.elements import CALLER, Element, Parameter, Solve, side_by_side
from malta.synthesis.state_space import System

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class Place(NamedTuple):
    """Where an element stands: forces = left E (right errors).

    left : m x outputs of the element
    element : E
    right : inputs of the element x p

    >>> from malta import structured
    >>> axis = structured.gain("axis", 2e3)
    >>> structured.Place([[1.0], [1.0]], axis, [[0.5, 0.5]]).element.order  # of two
    0
    """

    left: FloatArray
    element: Element
    right: FloatArray


Layout = Mapping[str, Element] | Element | Sequence[Place]


def places_of(layout: Any, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[Place, ...]:
    """The places of a layout.

    layout : elements by the outputs whose errors they take, for the input of the same index; one element from all
        errors to all forces; or places, as of the coordinates of the centre of gravity

    Raises InputError for outputs that the machine does not have, for other shapes, and for two elements of one name.
    """
    m, p = len(inputs), len(outputs)
    if isinstance(layout, Element):
        found: tuple[Place, ...] = (Place(np.eye(m), layout, np.eye(p)),)
    elif isinstance(layout, Mapping):
        unknown = next((name for name in layout if name not in outputs), None)
        if unknown is not None or m != p:
            expected = (
                "one of " + " ".join(outputs)
                if m == p
                else "an element or places, where inputs are no outputs"
            )
            raise InputError(
                CALLER, "law", f"an element of {unknown}" if unknown else "elements by output", expected
            )
        one = np.eye(p)
        found = tuple(
            Place(one[:, [k]], layout[name], one[[k]]) for k, name in enumerate(outputs) if name in layout
        )
    else:
        found = tuple(Place(np.asarray(a, dtype=float), e, np.asarray(b, dtype=float)) for a, e, b in layout)
    known: dict[str, Element] = {}
    for left, element, right in found:
        if known.setdefault(element.name, element) is not element:
            raise InputError(CALLER, element.name, "two elements of one name", "names that tell them apart")
        rows, columns = element.system.D.shape
        if left.shape != (m, rows) or right.shape != (columns, p):
            shape = f"{left.shape}, {rows} x {columns}, {right.shape}"
            raise InputError(CALLER, element.name, shape, f"a product of {m} forces x {p} errors")
    if not found:
        raise InputError(CALLER, "law", "no element", "one at least")
    return found


@dataclass(frozen=True, eq=False)
class Structure:
    """A law of elements in their places, as a function of the numbers x of its parameters.

    x : parameters of all elements, an element in several places once; 0 is where the search starts
    """

    places: tuple[Place, ...]

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """Each element once, in the order of its first place."""
        return tuple({place.element.name: place.element for place in self.places}.values())

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of all elements."""
        return tuple(p for e in self.elements for p in e.parameters)

    @cached_property
    def bounds(self) -> FloatArray:
        """The bounds of x, parameters x 2."""
        return np.array([p.bounds for p in self.parameters]).reshape(-1, 2)

    @cached_property
    def order(self) -> int:
        """The number of states of the whole law."""
        return sum(place.element.order for place in self.places)

    @cached_property
    def _theta(self) -> ca.Function:
        """What the elements solve -> [D C; B A], and its derivative by that."""
        numbers = ca.SX.sym("numbers", sum(len(e.numbers) for e in self.elements))
        first, made = 0, {}
        for e in self.elements:
            own = [numbers[first + k] for k in range(len(e.numbers))]
            made[e.name] = [ca.SX(M) for M in e.matrices(own)]
            first += len(own)
        (m, _), (_, p) = self.places[0].left.shape, self.places[0].right.shape
        D, A, B, C = ca.SX(m, p), list[Any](), list[Any](), list[Any]()
        for left, element, right in self.places:
            a, b, c, d = made[element.name]
            D = D + left @ d @ right
            A, B, C = [*A, a], [*B, b @ right], [*C, left @ c]
        theta = ca.densify(ca.blockcat([[D, ca.horzcat(*C)], [ca.vertcat(*B), ca.diagcat(*A)]]))
        return ca.Function("theta", [numbers], [theta, ca.jacobian(theta, numbers)])

    @cached_property
    def _solve(self) -> Solve:
        return side_by_side(*self.elements)

    def theta(self, x: FloatArray) -> tuple[FloatArray, Any]:
        """[D C; B A] of the continuous law at x, and its derivative by x: entries, column by column, x parameters.

        Raises CheckError where an LQG has no solution.
        """
        pairs = list(zip(self.parameters, x.tolist(), strict=True))
        numbers, by_value = self._solve(np.array([p.value(one) for p, one in pairs]))
        theta, slope = self._theta(numbers)
        by_x = by_value * np.array([p.slope(one) for p, one in pairs])
        return np.array(theta), slope.sparse() @ by_x

    def system(self, x: FloatArray) -> System:
        """The continuous law at x."""
        theta, _ = self.theta(x)
        (m, _), (_, p) = self.places[0].left.shape, self.places[0].right.shape
        return System(theta[m:, p:], theta[m:, :p], theta[:m, p:], theta[:m, :p])

    def at(self, x: FloatArray) -> Structure:
        """The same structure with the values at x as its present ones."""
        values: dict[str, float] = {}
        first = 0
        for e in self.elements:
            k = len(e.parameters)
            own = x[first : first + k].tolist()
            numbers = (p.value(v) for p, v in zip(e.parameters, own, strict=True))
            values |= dict(zip(e.values, numbers, strict=True))
            first += k
        new = {e.name: e.at(values) for e in self.elements}
        return Structure(tuple(Place(p.left, new[p.element.name], p.right) for p in self.places))


def sample_law(law: System, Ts: float) -> System:
    """Sample a continuous law by Tustin's rule: s+ = A s + B e, v = C s + D e.

    Raises InputError for a law with a pole at 2 / Ts.
    """
    one, half = np.eye(len(law.A)), law.A * Ts / 2
    if not len(one):
        return law
    if np.abs(np.linalg.eigvals(one - half)).min() < 1e-12:
        raise InputError(CALLER, "law", "a pole at 2 / Ts", "poles that a sampled law can have")
    back = linalg.inv(one - half)
    return System(back @ (one + half), back @ law.B * Ts, law.C @ back, law.D + law.C @ back @ law.B * Ts / 2)

"""A linear system with uncertain parameters and its compensator: their records.

x' = A(p) x + B(p) u,  y = C(p) x        derived from a plant's CasADi model, parameters by name
u = H F y                                 a control law F, and the lag, hold and delay H before the plant
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from malta.arguments import number
from malta.arrays import FloatArray
from malta.errors import InputError, require_known
from malta.linear.system import System

DOMAIN_END_TEXT = "a root or a branch of the model ends"


@dataclass(frozen=True, eq=False)
class StateGroup:
    """States of the system and of the compensator that close a loop by themselves.

    inputs : the states on which inputs act, when these are fewer than the inputs; else None
    """

    states: tuple[int, ...]
    own: tuple[int, ...]
    inputs: tuple[int, ...] | None


@dataclass(frozen=True, eq=False)
class Derived:
    """Parameters that are functions of another one, whose values a proof takes apart: any within their intervals."""

    of: str  # the parameter that they follow
    values: Callable[[float], FloatArray]
    intervals: Mapping[str, tuple[float, float]]  # by name, over the whole range of that parameter

    def at(self, value: float) -> dict[str, float]:
        """Their values by name."""
        return dict(zip(self.intervals, self.values(value).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class UncertainSystem:
    """A linear system in parameters by name: E(p) x' = A(p) x + B(p) u, y = C(p) x + D(p) u.

    names : of the parameters, in the order of p
    nominal : their values, SI
    matrices : a casadi.Function p -> A, B, C, or with D, or with D and E; their structure is read from the expressions
    limits : of each parameter, (above, below), exclusive; none: infinite
    sample_time : s, of a discrete system, with x+ in place of x'; None: continuous
    approximate : why the matrices are no exact functions, so that nothing is proven of them; "": they are
    positive : a casadi.Function p -> values that are above zero wherever `matrices` hold; None: they hold everywhere
    ends : what happens where each of these is not, in words
    derived : the last parameters, where these follow another one
    left_out : what of a machine the matrices have not, in words; "": nothing

    >>> import malta
    >>> def motor(J, b):
    ...     return [[0, 1], [0, -b / J]], [[0], [1 / J]], [[1, 0]]
    >>> system = malta.uncertain(motor, {"J": 2e-3, "b": 0.1})
    >>> A, B, C = system.at([[1e-3, 0.1], [2e-3, 0.1]])  # at two rows of parameters
    >>> A[:, 1, 1].tolist()
    [-100.0, -50.0]
    """

    names: tuple[str, ...]
    nominal: FloatArray
    matrices: ca.Function
    limits: tuple[tuple[float, float], ...] = ()
    sample_time: float | None = None
    approximate: str = ""
    positive: ca.Function | None = None
    ends: tuple[str, ...] = ()
    derived: Derived | None = None
    left_out: str = ""

    def reason(self, own: str) -> str:
        """The reason of an answer about this system, with what the system leaves out of its machine.

        own : why nothing, or less than asked for, is proven; "": as much is
        """
        return "; ".join(filter(None, (self.left_out, own)))

    def spread(self, over: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        """The intervals of some parameters, with those of the parameters that follow one of them.

        over : intervals by name, SI
        """
        more = self.derived.intervals if self.derived is not None and self.derived.of in over else {}
        return {**more, **over}

    def at(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and C at k rows of parameters: arrays of k matrices each.

        p : k x parameters, in the order of `names`
        """
        A, B, C, *_ = self.every(p)
        return A, B, C

    def every(self, p: FloatArray) -> list[FloatArray]:
        """All matrices at k rows of parameters: D and E too, where there are any.

        p : k x parameters, in the order of `names`
        """
        rows, made = np.atleast_2d(p), []
        for i, found in enumerate(self.matrices.map(len(rows)).call([rows.T])):
            pattern = self.matrices.sparsity_out(i)
            matrix = np.zeros((len(rows), *pattern.shape))
            matrix[:, *pattern.get_triplet()] = np.reshape(found.nonzeros(), (len(rows), pattern.nnz()))
            made.append(matrix)
        return made

    def explicit(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """E^-1 A, E^-1 B, C and D at k rows of parameters.

        p : k x parameters, in the order of `names`

        Raises numpy.linalg.LinAlgError where E is singular.
        """
        A, B, C, *more = self.every(p)
        D = more[0] if more else np.zeros((len(A), C.shape[1], B.shape[2]))
        if len(more) > 1:
            both = np.linalg.solve(more[1], np.concatenate([A, B], axis=2))
            A, B = both[:, :, : A.shape[2]], both[:, :, A.shape[2] :]
        return A, B, C, D

    def state_space(self, **values: float) -> Any:
        """Make the known system at values of parameters, a control.StateSpace.

        values : by name, SI; nominal ones of the others

        Raises InputError for unknown parameters, values that are no numbers, and a system without a value there.

        >>> import malta
        >>> motor = malta.uncertain(lambda J: ([[-0.1 / J]], [[1 / J]], [[1]]), {"J": 2e-3})
        >>> motor.state_space(J=1e-3).poles().real.tolist()
        [-100.0]
        """
        p = self.nominal.copy()
        for name, value in values.items():
            require_known([name], self.names, "state_space", found="an unknown parameter")
            p[self.names.index(name)] = number("state_space", name, value)
        try:
            found = [M[0] for M in self.explicit(p)]
        except np.linalg.LinAlgError:  # E is singular
            found = [np.full((1, 1), np.nan)]
        if not all(np.isfinite(M).all() for M in found):
            raise InputError("state_space", "matrices", "no value there", "parameters within their limits")
        A, B, C, D = found
        return System(A, B, C, D, None, self.sample_time).to_control()


@dataclass(frozen=True, eq=False)
class Compensator:
    """A linear law u = F y: x+ = A x + B y, u = C x + D y, with positive feedback; x' for x+ in continuous time.

    Between u and the plant stand a delay, a zero-order hold when sampled, and a first-order lag
    w_c / (s + w_c) when `lag` is given. The last states are plain integrals.

    A : n x n
    B : n x p, measurements
    C : m x n, forces
    D : m x p
    integrals : number of the last states that are plain integrals
    sample_time : s; None: continuous
    delay : samples between u and the plant, also a fraction of one before a continuous plant
    lag : w_c, rad/s; None: no lag

    >>> import malta
    >>> import numpy as np
    >>> one, Ts = np.eye(1), 1e-3  # PI: u = -2 y - 50 sum of Ts y
    >>> law = malta.proof.Compensator(one, Ts * one, -50 * one, -2 * one, 1, Ts, delay=1)
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> f"{malta.robust_margin(motor, law, {'k': 0.2}).lower:.2f}"
    '5.00'
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    integrals: int = 0
    sample_time: float | None = None
    delay: float = 0
    lag: float | None = None

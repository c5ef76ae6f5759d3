"""Weights of a cost and variances of noise, what an LQG is designed for."""

from __future__ import annotations

from dataclasses import dataclass, field as dataclass_field, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from malta.arguments import describe, require_real
from malta.arrays import FloatArray, readonly
from malta.display import display
from malta.errors import InputError
from malta.model.parameters import replace_fields
from malta.model.signals import Coordinates
from malta.synthesis.controller import Controller


@display
@dataclass(frozen=True, eq=False)
class Weights:
    """Dimensionless weights of a cost with their bases, and the noise of one sample; n states, m inputs, p outputs.

        Q = diag(q / q_base^2),    R = diag(r / r_base^2),    Q_i = diag(q_i / q_i_base^2)

    All are in the order of the plant's signals. Where `coordinates` are positions, q_i is of the integrals of the first
    n / 2 states, q, and process_variance and drift_variance are of their accelerations.

    q : n, states
    q_base : n, SI unit of each state
    r : m, inputs
    r_base : m, N
    q_i : p, integrals of p* - p
    q_i_base : p, m s
    process_variance : m, N2, of the forces held over a sample
    sensor_variance : p, m2, of each sample
    drift_variance : m, N2: how far a constant force of disturbance goes in a sample; none: the filter observes none
    coordinates : "signals" or "positions"
    correlation : n / 2, of the noise of each position with the acceleration that led to it; none: no correlation

    Raises InputError for values that are not finite and above 0 (q and q_i may be 0), and for other numbers of bases
    than of weights.

    >>> import malta
    >>> import numpy as np
    >>> one = np.ones(1)
    >>> base = np.array([1e-4, 0.1])  # 0.1 mm and 0.1 m/s weigh as much as 1 N
    >>> weights = malta.synthesis.Weights(
    ...     np.ones(2), base, one, one, one, one, one, 1e-12 * one
    ... )
    >>> weights.Q.round(3).tolist(), weights.R.tolist()  # Bryson's rule
    ([[100000000.0, 0.0], [0.0, 100.0]], [[1.0]])
    """

    q: FloatArray
    q_base: FloatArray
    r: FloatArray
    r_base: FloatArray
    q_i: FloatArray
    q_i_base: FloatArray
    process_variance: FloatArray
    sensor_variance: FloatArray
    drift_variance: FloatArray = dataclass_field(default_factory=lambda: np.zeros(0))
    coordinates: Coordinates = "signals"
    correlation: FloatArray = dataclass_field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self._check_correlation()
        for name in self.__dataclass_fields__:
            if name in ("coordinates", "correlation"):
                continue
            value = readonly(getattr(self, name))
            zero_allowed = name in ("q", "q_i")
            if (
                value.ndim != 1
                or not (np.isfinite(value) & ((value > 0) | (zero_allowed & (value == 0)))).all()
            ):
                wanted = "finite and not negative" if zero_allowed else "finite and above 0"
                raise InputError("Weights", name, str(value.tolist()), f"a vector of numbers, {wanted}")
            object.__setattr__(self, name, value)
        if (
            len(self.q) != len(self.q_base)
            or len(self.r) != len(self.r_base)
            or len(self.q_i) != len(self.q_i_base)
        ):
            raise InputError(
                "Weights", "bases", "another length than the weights'", "one base for each weight"
            )
        with np.errstate(all="ignore"):
            for weight, base in ((self.q, self.q_base), (self.r, self.r_base), (self.q_i, self.q_i_base)):
                size = weight / base**2
                if not (np.isfinite(size) & ((size > 0) | (weight == 0))).all():
                    raise InputError("Weights", "bases", str(base.tolist()), "bases whose square is a number")

    def _check_correlation(self) -> None:
        """InputError unless the coordinates are known, and correlations are those of positions, between -1 and 1."""
        if self.coordinates not in get_args(Coordinates):
            expected = " or ".join(get_args(Coordinates))
            raise InputError("Weights", "coordinates", repr(self.coordinates), expected)
        value = readonly(self.correlation)
        object.__setattr__(self, "correlation", value)
        if value.size and (self.coordinates != "positions" or value.shape != np.shape(self.process_variance)):
            raise InputError(
                "Weights",
                "correlation",
                f"{value.size} entries",
                "one for each position, in their coordinates",
            )
        if not (np.abs(value) < 1).all():
            raise InputError("Weights", "correlation", str(value.tolist()), "numbers between -1 and 1")

    def replace(self, **fields: Any) -> Weights:
        """Return the weights with other fields.

        fields : of this record, by name

        Raises InputError for an unknown field, and as Weights does.

        >>> import malta
        >>> weights = malta.read_design("examples/ball/design/ball.toml").weights
        >>> weights.replace(r_base=[0.5]).R.tolist()
        [[4.0]]
        """
        return replace_fields(self, "Weights", fields)

    @property
    def Q(self) -> FloatArray:
        """State weight, n x n."""
        return np.diag(self.q / self.q_base**2)

    @property
    def R(self) -> FloatArray:
        """Input weight, m x m, 1/N2."""
        return np.diag(self.r / self.r_base**2)

    @property
    def Q_i(self) -> FloatArray:
        """Weight of the error integrals in their own coordinates, p x p, 1/(m s)2."""
        return np.diag(self.q_i / self.q_i_base**2)


def weights(
    q: ArrayLike, r: ArrayLike, w: ArrayLike, v: ArrayLike, *, q_i: ArrayLike | None = None
) -> Weights:
    """Make weights of a cost and variances of noise in SI units, without bases.

    A vector or a diagonal matrix each.

    q : n, of the states
    r : m, of the inputs
    w : m, variance of the forces held over a sample, N2
    v : p, variance of a sample of the sensors
    q_i : p, of the integrals of the errors; None: none

    Returns a Weights.

    Raises InputError for a matrix that is not diagonal, and for values below 0.

    >>> import malta
    >>> malta.synthesis.weights([1e8, 1e4], [1], [1e-2], [1e-12]).Q.tolist()
    [[100000000.0, 0.0], [0.0, 10000.0]]
    """
    of_states, of_inputs, forces, sensors = (
        _diagonal(name, value) for name, value in (("q", q), ("r", r), ("w", w), ("v", v))
    )
    integrals = np.zeros(len(sensors)) if q_i is None else _diagonal("q_i", q_i)
    return _without_bases(of_states, of_inputs, integrals, forces, sensors, np.zeros(0))


def _diagonal(name: str, value: ArrayLike) -> FloatArray:
    real = require_real("weights", name, value)
    try:
        found: FloatArray = np.atleast_1d(np.asarray(real, dtype=float))
    except (TypeError, ValueError) as error:
        expected = "a vector or a diagonal matrix of numbers"
        raise InputError("weights", name, describe(value), expected) from error
    if found.ndim == 1:
        return found
    if found.ndim != 2 or found.shape[0] != found.shape[1] or np.any(found - np.diag(np.diag(found))):
        raise InputError(
            "weights", name, f"shape {found.shape}, not diagonal", "a vector or a diagonal matrix"
        )
    return np.diag(found)


def weights_of(controller: Controller) -> Weights:
    """What an LQG was designed for, on bases of one SI unit. InputError for a PID, which was not."""
    cost, noise = controller.cost, controller.noise
    if cost is None or noise is None:
        raise InputError(controller.name, "cost", "none, as a PID has", "an LQG")
    found = _without_bases(cost.state, cost.input, cost.integral, noise.process, noise.sensor, noise.drift)
    return replace(found, coordinates=cost.coordinates, correlation=noise.correlation)


def _without_bases(
    q: FloatArray, r: FloatArray, q_i: FloatArray, w: FloatArray, v: FloatArray, drift: FloatArray
) -> Weights:
    one = np.ones_like
    return Weights(q, one(q), r, one(r), q_i, one(q_i), w, v, drift)

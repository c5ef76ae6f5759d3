"""The linear law: steps 1 to 3 and 6 of the control law, and what they are while no axis saturates or brakes."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.synthesis.controller import Controller, Tracks, summed_columns
from malta.synthesis.schedule import SCHEDULED_MATRICES

if TYPE_CHECKING:
    from malta.synthesis.filters import Gains


# How a sum takes what is added to it: plainly here, with what rounding loses in firmware of single precision.
Add = Callable[[Any, Any], Any]


class LinearLaw(NamedTuple):
    """The law without saturation: s+ = A s + B_y y + B_r r, v = C s + D_y y + D_r r.

    s = (xi_pred, e), without sums that are not fed back, and of a law of errors without the last error, which is new at
    every sample; r = (p*, xi*, v_ff, v0).
    """

    A: FloatArray
    B_y: FloatArray
    B_r: FloatArray
    C: FloatArray
    D_y: FloatArray
    D_r: FloatArray


def filter_reading(tracks: Tracks, y: Any, p_ref: Any) -> Any:
    """The reading that step 2 takes: y, or y - p* in a law of errors."""
    return y - p_ref if tracks == "errors" else y


def sum_errors(g: Mapping[str, Any], e: Any, frozen: Any, y: Any, p_ref: Any, add: Add = operator.add) -> Any:
    """Step 1: e, the sums of errors at this sample. add: how a sum takes what is added to it, see Add."""
    if "braking" in g:
        far = {k: ca.fabs(p_ref[k] - y[k]) > g["braking"][k] for k in braking_axes(g)}
        frozen = ca.vertcat(
            *(ca.if_else(far[k], 1, frozen[k]) if k in far else frozen[k] for k in range(y.numel()))
        )
    return add(e, g["control_time"] * (1 - frozen) * (p_ref - y))


def braking_axes(g: Mapping[str, Any]) -> list[int]:
    """The axes that brake."""
    return [k for k in range(g["braking"].numel()) if g["braking"].sparsity().has_nz(k, 0)]


def estimate_states(
    g: Mapping[str, Any], xi_pred: Any, y: Any, C: Any = None, add: Add = operator.add
) -> Any:
    """Step 2, the filter: xi_hat. C: in place of Cd where it is scheduled; add: see Add."""
    return add(xi_pred, g["L"] @ (y - (g["Cd"] if C is None else C) @ xi_pred))


def wanted_forces(g: Mapping[str, Any], xi_hat: Any, e: Any, xi_ref: Any, v_ff: Any, v0: Any) -> Any:
    # The first sum is the same for all machines under one reference: engines compute it once a sample.
    return (g["K"] @ xi_ref + v_ff) + (g["Ki"] @ e - g["K"] @ xi_hat) + v0


def predict_states(g: Mapping[str, Any], xi_hat: Any, v: Any, v0: Any) -> Any:
    return g["Ad"] @ xi_hat + g["Bd"] @ (v - v0)


@lru_cache(maxsize=8)  # every loop of a controller asks for it; records compare by identity
def linear_law(c: Controller) -> LinearLaw:
    """The control law linearized where no axis saturates or brakes: exact, from the steps that `law` is made of.

    Of a schedule it is the law at the operating point; `law_at` has those at other references.
    """
    gains = {name: getattr(c, name) for name in SCHEDULED_MATRICES}
    found = _without_limits(gains, c.sample_time, c.tracks, c.summed)
    k = len(c.states) - len(c.measurements)
    kept = any(M[k:].any() for M in (found.A, found.B_y, found.B_r))
    if c.tracks == "errors" and not kept:  # the last errors are new at every sample
        found = found._replace(A=found.A[:k, :k], B_y=found.B_y[:k], B_r=found.B_r[:k], C=found.C[:, :k])
    return LinearLaw(*map(readonly, found))


def linear_law_of(g: Gains, Ts: float) -> LinearLaw:
    """The same of gains alone, for a search that tries thousands: without references, so r is empty."""
    return _without_limits(g._asdict(), Ts, "states", summed_columns(g.Ki), references=False)


def _without_limits(
    gains: Mapping[str, FloatArray],
    Ts: float,
    tracks: Tracks,
    summed: tuple[int, ...],
    *,
    references: bool = True,
) -> LinearLaw:
    """The law of one sample, whose steps are linear without limits: what it makes of unit vectors are its matrices."""
    (n, m), p = gains["Bd"].shape, len(gains["Cd"])
    g = {name: ca.sparsify(ca.DM(M)) for name, M in gains.items()} | {"control_time": Ts}
    ends = np.cumsum([n, p, p, p, n, m, m]).tolist()
    units = ca.DM.eye(ends[-1])[:, : ends[-1] if references else ends[2]]
    xi_pred, e, y, p_ref, *given = ca.vertsplit(units, [0, *ends])
    xi_hat = estimate_states(g, xi_pred, filter_reading(tracks, y, p_ref))
    e_next = sum_errors(g, e, 0.0, y, p_ref)
    v = wanted_forces(g, xi_hat, e_next, *given)
    s_next = ca.vertcat(predict_states(g, xi_hat, v, given[-1]), e_next[list(summed), :])
    s = [*range(n), *(n + k for k in summed)]
    columns = (s, slice(ends[1], ends[2]), slice(ends[2], None))
    return LinearLaw(*(np.array(M)[:, of] for M in (s_next, v) for of in columns))


def with_slope(law: LinearLaw, slope: FloatArray) -> LinearLaw:
    """The same law with forces v0 that follow the reading: slope is dv0/dy, m x p."""
    columns = slice(-len(slope), None)  # of v0 in r
    return law._replace(B_y=law.B_y + law.B_r[:, columns] @ slope, D_y=law.D_y + law.D_r[:, columns] @ slope)


def with_forces_read(law: LinearLaw, forces: tuple[int, ...], count: int) -> LinearLaw:
    """The same law, which adds further readings to v0 of some of its `count` forces."""
    columns = [law.B_r.shape[1] - count + k for k in forces]  # of v0 in r
    return law._replace(
        B_y=np.hstack([law.B_y, law.B_r[:, columns]]), D_y=np.hstack([law.D_y, law.D_r[:, columns]])
    )


def with_readings(law: LinearLaw, readings: int | None = None) -> LinearLaw:
    """The same law with the reading itself as further outputs: what currents are commutated for.

    readings : how many of its inputs are readings of positions, the first; None: all
    """
    p, n, r = readings or law.B_y.shape[1], len(law.A), law.D_r.shape[1]
    return law._replace(
        C=np.vstack([law.C, np.zeros((p, n))]),
        D_y=np.vstack([law.D_y, np.eye(p, law.D_y.shape[1])]),
        D_r=np.vstack([law.D_r, np.zeros((p, r))]),
    )

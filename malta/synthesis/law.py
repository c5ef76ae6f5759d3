"""The steps of the control law with its anti-windup, of numbers or symbols; controller.py states the law."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import InputError
from malta.model.equations import note
from malta.model.plant import OperatingPoint, Plant, outputs_at
from malta.synthesis.controller import Controller, Tracks, summed_columns
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule

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


def gains_of(c: Controller) -> dict[str, ca.DM]:
    """What the law computes with, sparse: exact zeros cost nothing at run time."""
    if c.schedule is None:
        matrices = {name: ca.sparsify(ca.DM(getattr(c, name))) for name in SCHEDULED_MATRICES}
    else:
        matrices = c.schedule.numbers()
    matrices |= {"force_limit": ca.DM(c.limits.force), "control_time": ca.DM(c.sample_time)}
    if c.pause.any():
        matrices["pause"] = ca.sparsify(ca.DM(c.pause))
    if c.braking.any():
        matrices["braking"] = ca.sparsify(ca.DM(c.braking))
    if c.commutation is None:
        return matrices
    lead = c.commutation.lead
    return matrices | {"lead": ca.DM(lead), "ahead": ca.sparsify(ca.DM(lead * c.commutation.pull))}


def filter_reading(tracks: Tracks, y: Any, p_ref: Any) -> Any:
    """The reading that step 2 takes: y, or y - p* in a law of errors."""
    return y - p_ref if tracks == "errors" else y


def sum_errors(g: Mapping[str, Any], e: Any, frozen: Any, y: Any, p_ref: Any, add: Add = operator.add) -> Any:
    """Step 1: e, the sums of errors at this sample. add: how a sum takes what is added to it, see Add."""
    if "braking" in g:
        far = {k: ca.fabs(p_ref[k] - y[k]) > g["braking"][k] for k in _braking_axes(g)}
        frozen = ca.vertcat(
            *(ca.if_else(far[k], 1, frozen[k]) if k in far else frozen[k] for k in range(y.numel()))
        )
    return add(e, g["control_time"] * (1 - frozen) * (p_ref - y))


def _braking_axes(g: Mapping[str, Any]) -> list[int]:
    """The axes that brake."""
    return [k for k in range(g["braking"].numel()) if g["braking"].sparsity().has_nz(k, 0)]


def _braking_force(g: Mapping[str, Any], off: Any) -> Any:
    """What braking takes off the forces for errors xi* - xi_hat: exactly 0 within the errors from which axes brake."""
    found: Any = 0
    for k in _braking_axes(g):
        b = g["braking"][k]
        size = ca.fmax(ca.fabs(off[k]), b)
        found = found + g["K"][:, k] * ((ca.sqrt(b * (2 * size - b)) / size - 1) * off[k])
    note(
        "brake",
        "braked = K (sqrt(b (2 a - b)) / a - 1) (xi_ref - xi_hat), a = max(|xi_ref - xi_hat|, b)",
        braked=found,
    )
    return found


def estimate_states(
    g: Mapping[str, Any], xi_pred: Any, y: Any, C: Any = None, add: Add = operator.add
) -> Any:
    """Step 2, the filter: xi_hat. C: in place of Cd where it is scheduled; add: see Add."""
    return add(xi_pred, g["L"] @ (y - (g["Cd"] if C is None else C) @ xi_pred))


def command_forces(
    g: Mapping[str, Any], xi_hat: Any, e: Any, xi_ref: Any, v_ff: Any, v0: Any
) -> tuple[Any, Any, Any]:
    """Steps 3, 4 and 6: (xi_pred, forces that saturate, v) from the estimate and the sums of errors."""
    wanted = _wanted_forces(g, xi_hat, e, xi_ref, v_ff, v0)
    if "braking" in g:
        wanted = wanted + _braking_force(g, xi_ref - xi_hat)
    note("law", "w = K (xi_ref - xi_hat) + Ki e + v_ff + v0", w=wanted)
    v = ca.fmax(ca.fmin(wanted, g["force_limit"]), -g["force_limit"])
    saturated = v != wanted
    note("limit_forces", "v = w within +-limits.force; saturated: v is not w", v=v, saturated=saturated)
    return _predict_states(g, xi_hat, v, v0), saturated, v


def _wanted_forces(g: Mapping[str, Any], xi_hat: Any, e: Any, xi_ref: Any, v_ff: Any, v0: Any) -> Any:
    # The first sum is the same for all machines under one reference: engines compute it once a sample.
    return (g["K"] @ xi_ref + v_ff) + (g["Ki"] @ e - g["K"] @ xi_hat) + v0


def _predict_states(g: Mapping[str, Any], xi_hat: Any, v: Any, v0: Any) -> Any:
    return g["Ad"] @ xi_hat + g["Bd"] @ (v - v0)


def frozen_axes(g: Mapping[str, Any], saturated: Any) -> Any:
    """The axes that saturated, of p outputs, from those of m forces: see the head of controller.py."""
    m, p = g["Ki"].shape
    if m == p:
        return saturated
    of = g["Ki"].sparsity()
    driven = [[saturated[i] for i in range(m) if of.has_nz(i, k)] for k in range(p)]
    return ca.vertcat(*(reduce(ca.logic_or, forces) if forces else 0 for forces in driven))


def freeze_moving(g: Mapping[str, Any], frozen: Any, dp_ref: Any) -> Any:
    """The axes whose sums of errors wait: those that saturated, and where p*' is faster than the pause of a law."""
    if "pause" not in g:
        return frozen
    rows = [
        ca.if_else(ca.fabs(dp_ref[k]) > g["pause"][k], 1, frozen[k])
        if g["pause"].sparsity().has_nz(k, 0)
        else frozen[k]
        for k in range(frozen.numel())
    ]
    return ca.vertcat(*rows)


def look_ahead(g: Mapping[str, Any], xi_pred: Any, place: Any, dp_ref: Any) -> tuple[Any, Any]:
    """Steps 5 and 6 of a law with a `commutation`, else unchanged: (xi_pred, place) for a reference of rate p*'."""
    if "lead" not in g:
        return xi_pred, place
    return xi_pred + g["Bd"] @ (g["ahead"] @ dp_ref), place + g["lead"] * dp_ref


def law(c: Controller) -> ca.Function:
    """The control law of one sample as a CasADi function; with a `commutation` while p*' is zero.

    (xi_pred, e, frozen, y, p_ref, xi_ref, v_ff, v0) -> (xi_pred, e, frozen, v, xi_hat)
    """
    n, m, p = len(c.states), len(c.forces), len(c.measurements)
    args, outputs = _symbolic_law(gains_of(c), n, m, p, c.tracks, c.schedule)
    return ca.Function("law", list(args.values()), list(outputs.values()), list(args), list(outputs))


def _symbolic_law(
    g: Mapping[str, Any], n: int, m: int, p: int, tracks: Tracks = "states", schedule: Schedule | None = None
) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
    """Symbols of the law's arguments and expressions of its results, each by name; gains may be symbols too."""
    sizes = {"xi_pred": n, "e": p, "frozen": p, "y": p, "p_ref": p, "xi_ref": n, "v_ff": m, "v0": m}
    args = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    xi_pred, e, frozen, y, p_ref, *given = args.values()
    g = interpolate(g, schedule, p_ref)
    xi_hat = estimate_states(g, xi_pred, filter_reading(tracks, y, p_ref))
    e_next = sum_errors(g, e, frozen, y, p_ref)
    xi_pred_next, saturated, v = command_forces(g, xi_hat, e_next, *given)
    return args, {
        "xi_pred_next": xi_pred_next,
        "e_next": e_next,
        "frozen_next": frozen_axes(g, saturated),
        "v": v,
        "xi_hat": xi_hat,
    }


def law_at(c: Controller, plant: Plant, x: FloatArray) -> Controller:
    """The law that a controller has at rest at the states x of a plant: itself, or its schedule's matrices there."""
    if c.schedule is None:
        return c
    return _fix_schedule(c, float(outputs_at(plant, x)[c.schedule.output]))


@lru_cache(maxsize=64)  # records compare by identity: what is known of a fixed law is found again
def _fix_schedule(c: Controller, r: float) -> Controller:
    assert c.schedule is not None
    return replace(c, **c.schedule.at(r), schedule=None)


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
    v = _wanted_forces(g, xi_hat, e_next, *given)
    s_next = ca.vertcat(_predict_states(g, xi_hat, v, given[-1]), e_next[list(summed), :])
    s = [*range(n), *(n + k for k in summed)]
    columns = (s, slice(ends[1], ends[2]), slice(ends[2], None))
    return LinearLaw(*(np.array(M)[:, of] for M in (s_next, v) for of in columns))


def with_slope(law: LinearLaw, slope: FloatArray) -> LinearLaw:
    """The same law with forces v0 that follow the reading: slope is dv0/dy, m x p."""
    columns = slice(-len(slope), None)  # of v0 in r
    return law._replace(B_y=law.B_y + law.B_r[:, columns] @ slope, D_y=law.D_y + law.D_r[:, columns] @ slope)


def with_readings(law: LinearLaw) -> LinearLaw:
    """The same law with the reading itself as further outputs: what currents are commutated for."""
    p, n, r = law.B_y.shape[1], len(law.A), law.D_r.shape[1]
    return law._replace(
        C=np.vstack([law.C, np.zeros((p, n))]),
        D_y=np.vstack([law.D_y, np.eye(p)]),
        D_r=np.vstack([law.D_r, np.zeros((p, r))]),
    )


def interpolate(g: Mapping[str, Any], schedule: Schedule | None, p_ref: Any) -> Mapping[str, Any]:
    """The numbers of a law at a reference p*: as they are, or with the matrices that its schedule has there.

    g : numbers by name, constants or symbols, see controller.gains_of
    """
    if schedule is None:
        return g
    r, p = p_ref[schedule.output], g["places"]
    shares = [ca.fmax(ca.fmin((r - p[k]) / (p[k + 1] - p[k]), 1), 0) for k in range(len(schedule.cells))]
    meaning = f"shares: how far the reference of {schedule.variable} is from each place to the next, 0 to 1"
    note("schedule", meaning, shares=ca.vertcat(*shares))
    found = dict(g)
    for name in SCHEDULED_MATRICES:
        M = found[name]
        for share, step in zip(shares, ca.horzsplit(found.pop(f"{name}_steps"), M.shape[1]), strict=True):
            if step.nnz():  # what is equal at two places costs nothing
                M = M + share * step
        found[name] = M
    return found


def point_at(plant: Plant, x: FloatArray, variable: str, place: float) -> OperatingPoint:
    """The operating point at rest where an output is at a place, and the other outputs are as at the states x."""
    names = [s.name for s in plant.outputs]
    if variable not in names:
        raise InputError(plant.name, "schedule.variable", repr(variable), "an output: " + " ".join(names))
    y = outputs_at(plant, x)
    y[names.index(variable)] = place
    q = np.array(ca.DM(plant.position_of(ca.DM(y))), dtype=float).ravel()
    return plant.point(np.concatenate([q, np.zeros(len(plant.controlled) - len(q))]))

"""The steps of the control law with its anti-windup, of numbers or symbols; controller.py states the law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, reduce
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.equations import note
from malta.model.places import outputs_at
from malta.synthesis.controller import Controller, Tracks
from malta.synthesis.linear_law import (
    braking_axes,
    estimate_states,
    filter_reading,
    predict_states,
    sum_errors,
    wanted_forces,
)
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule

if TYPE_CHECKING:
    from malta.model.plant import OperatingPoint, Plant


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


def _braking_force(g: Mapping[str, Any], off: Any) -> Any:
    """What braking takes off the forces for errors xi* - xi_hat: exactly 0 within the errors from which axes brake."""
    found: Any = 0
    for k in braking_axes(g):
        b = g["braking"][k]
        size = ca.fmax(ca.fabs(off[k]), b)
        found = found + g["K"][:, k] * ((ca.sqrt(b * (2 * size - b)) / size - 1) * off[k])
    note(
        "brake",
        "braked = K (sqrt(b (2 a - b)) / a - 1) (xi_ref - xi_hat), a = max(|xi_ref - xi_hat|, b)",
        braked=found,
    )
    return found


def command_forces(
    g: Mapping[str, Any], xi_hat: Any, e: Any, xi_ref: Any, v_ff: Any, v0: Any
) -> tuple[Any, Any, Any]:
    """Steps 3, 4 and 6: (xi_pred, forces that saturate, v) from the estimate and the sums of errors."""
    wanted = wanted_forces(g, xi_hat, e, xi_ref, v_ff, v0)
    if "braking" in g:
        wanted = wanted + _braking_force(g, xi_ref - xi_hat)
    note("law", "w = K (xi_ref - xi_hat) + Ki e + v_ff + v0", w=wanted)
    v = ca.fmax(ca.fmin(wanted, g["force_limit"]), -g["force_limit"])
    saturated = v != wanted
    note("limit_forces", "v = w within +-limits.force; saturated: v is not w", v=v, saturated=saturated)
    return predict_states(g, xi_hat, v, v0), saturated, v


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

"""One step of the exported controller in Python: what the C computes, in the arithmetic of either precision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from malta.firmware.blocks import staged_program
from malta.firmware.calibration import law_values
from malta.firmware.pieces import parts_of
from malta.firmware.program import TYPES, Program, evaluate
from malta.firmware.signals import Target, reference_fields, state_fields
from malta.model.lookup import interpolate

Vectors = dict[str, Any]
Step = Callable[[Vectors, Mapping[str, Any], Mapping[str, Any]], tuple[Vectors, Vectors]]


@lru_cache(maxsize=16)
def programs_of(t: Target) -> dict[str, Program]:
    """The programs of all functions of an export, by name."""
    return {name: staged_program(s, t.precision) for name, s in parts_of(t).items()}


def look_up(t: Target, z: Any) -> Any:
    """v0(z), N, linear between the points of the gain file and constant beyond them."""
    real, ff = TYPES[t.precision], t.controller.feedforward
    grid, v0 = ff.z_grid.astype(real), ff.v0.astype(real)
    at = np.clip(real(z), grid[0], grid[-1])
    k = min(int(np.searchsorted(grid, at, side="right")) - 1, len(grid) - 2)
    share = (at - grid[k]) / (grid[k + 1] - grid[k])
    return (real(1) - share) * v0[k] + share * v0[k + 1]


def _v0(t: Target, outputs: Any) -> Any:
    """v0 where the outputs are; that of the first point for a machine without a stroke."""
    grid = t.controller.feedforward.z_grid
    return look_up(t, outputs[t.believed.stroke_output] if t.believed.has_stroke else grid[0])


def read_table(t: Target, places: Any) -> Any:
    """The values of the table at (u, v), (u, v), ..., one reading after the other; none without a table."""
    real = TYPES[t.precision]
    if not t.look_ups:
        return np.zeros(0, dtype=real)
    nodes = t.look_ups[0].nodes.astype(real)
    return np.concatenate([interpolate(nodes, u, v) for u, v in np.reshape(places, (-1, 2))])


def first_state(t: Target) -> Vectors:
    """The state that `init` leaves: at rest, knowing nothing."""
    real = TYPES[t.precision]
    state = {f.name: np.zeros(f.size, dtype=real) for f in state_fields(t) if f.size}
    if t.driven:
        state["link_last"] = np.array([t.believed.drive.link_voltage], dtype=real)
    return state


def started_state(t: Target, reference: Mapping[str, Any]) -> Vectors:
    """The state that `start` leaves: of a machine that follows the reference."""
    found = evaluate(programs_of(t)["state_at"], {**reference, "v0": _v0(t, reference["p"])}, t.precision)
    return {name.removesuffix("_next"): value for name, value in found.items() if value.size}


def step_of(t: Target) -> Step:
    """(state, reference, readings) -> (state, outputs): one step, by the names of signals.py."""
    sense, decide = programs_of(t)["sense"], programs_of(t)["decide"]
    none = {f.name: np.zeros(0) for f in state_fields(t) if not f.size}
    law = law_values(t)

    def step(
        state: Vectors, reference: Mapping[str, Any], readings: Mapping[str, Any]
    ) -> tuple[Vectors, Vectors]:
        known = {**none, **state, **reference, **readings, **law}
        sensed = evaluate(sense, known, t.precision)
        table = read_table(t, sensed.pop("table_at", None))
        decided = evaluate(
            decide, {**known, **sensed, "v0": _v0(t, sensed["y_used"]), "table": table}, t.precision
        )
        after = {
            name.removesuffix("_next"): v for name, v in decided.items() if name.endswith("_next") and v.size
        }
        return after, sensed | {name: v for name, v in decided.items() if not name.endswith("_next")}

    return step


def zero_reference(t: Target) -> Vectors:
    """A reference at rest at zero."""
    return {f.name: np.zeros(f.size) for f in reference_fields(t)}

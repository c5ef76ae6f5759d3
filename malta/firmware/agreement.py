"""Whether the exported step is the law of simulations: both answer the same readings, over their whole ranges.

A reading that one of them refuses, a function beyond what its lowering covers, or a table that ends elsewhere makes
forces of another machine than the one that was proven.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.firmware.program import evaluate
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.step import look_up, programs_of, step_function, zero_reference
from malta.simulation.engine import engines
from malta.simulation.layout import layout_of, numbers_of, places_of
from malta.simulation.period import period_of, state_reference

SHARES = np.repeat((1.0, 0.3, 0.1, 0.01), 4)  # of the ranges: readings of each size
TOLERANCE = 1e-9  # of a signal's largest value: rounding, in an order of its own
ANSWER_FIELDS = ("xi_hat", "v", "saturated", "current")
MEMORY_FIELDS = ("xi_pred", "e", "frozen")


def require_same_law(t: Target) -> None:
    """Raise CheckError where the export answers readings within their ranges otherwise than the simulated law.

    The readings of a machine near rest at any place are drawn, with sums and a filter that expects the place.
    """
    t = replace(
        t,
        precision="double",
        fidelity="force",
        tunable=False,
        gains=None,
        excited=False,
        logged=0.0,
        xcp=None,
    )
    own, exported = _law(t), step_function(t)
    reference, ranges, rng = zero_reference(t), reading_ranges(t.believed), np.random.default_rng(0)
    draws = [share * ranges * rng.uniform(-1, 1, len(ranges)) for share in SHARES]
    rows = []
    for y in draws:
        state = _state_near(t, y, rng)
        after, out = exported(state, reference, {"y": y, "y_valid": np.ones(len(y))})
        rows.append((own(state, y), {**after, **out}))
    for name in (*MEMORY_FIELDS, *ANSWER_FIELDS):
        one, two = (np.array([row[k][name] for row in rows]) for k in (0, 1))
        scale = np.abs(one).max(axis=0, initial=1e-300, where=np.isfinite(one))
        if name == "v":
            scale = np.maximum(scale, _forces_added(t, rows))
        wrong = (np.abs(one - two) > TOLERANCE * scale) | (np.isfinite(one) != np.isfinite(two))
        if wrong.any():
            row, k = np.argwhere(wrong)[0]
            _raise(t, name, int(k), one[row, k], two[row, k], draws[row])


def _law(t: Target) -> Any:
    """(state by name, y) -> the same signals of a control period of simulations, at rest at the reference zero."""
    c, plant = t.controller, t.believed
    sizes = layout_of(plant, c, t.setup)
    period = period_of(plant, c, t.setup, numbers_of(plant, c, 1), constant=True)
    state_places = places_of({**sizes.machine, **sizes.controller})
    given_places, row_places = places_of(sizes.given), places_of(sizes.row)
    after_places, reference = places_of(sizes.controller), zero_reference(t)
    v_ff = evaluate(programs_of(t)["feedforward"], reference, "double")["v_ff"]

    def law(state: dict[str, Any], y: FloatArray) -> dict[str, Any]:
        whole, given = np.zeros(period.decide.size1_in(0)), np.zeros(period.decide.size1_in(1))
        for name in MEMORY_FIELDS:
            whole[state_places[name]] = state[name]
        given[given_places["v_ff"]] = v_ff
        v0 = look_up(t, y[plant.stroke_output] if plant.has_stroke else c.feedforward.z_grid[0])
        after, _, row = (
            values.ravel() for values in engines.evaluate(period.decide, whole, given, y, v0, np.empty(0))
        )
        found = {name: after[after_places[name]] for name in MEMORY_FIELDS}
        return found | {name: row[row_places[name]] for name in ANSWER_FIELDS}

    return law


def _state_near(t: Target, y: FloatArray, rng: Any) -> dict[str, Any]:
    """A memory whose filter expects a machine near the place of these readings, with some sums of errors."""
    c = t.controller
    state: dict[str, Any] = {f.name: np.zeros(f.size) for f in t.state_fields if f.size}
    if c.tracks == "states":
        place = np.array(state_reference(t.believed)(y, 0 * y)).ravel()
        state["xi_pred"][: len(place)] = np.nan_to_num(place * rng.uniform(0.9, 1.1, len(place)))
    state["e"] = 10 * c.sample_time * y * rng.uniform(-1, 1, len(y))
    state["frozen"] = rng.integers(0, 2, len(y)).astype(float)
    return state


def _forces_added(t: Target, rows: list[Any]) -> FloatArray:
    """The largest sums of sizes that the forces consist of: they may cancel."""
    c = t.controller
    sizes = [np.abs(c.K) @ np.abs(own["xi_hat"]) + np.abs(c.Ki) @ np.abs(own["e"]) for own, _ in rows]
    return np.asarray(np.max(sizes, axis=0))


def _raise(t: Target, name: str, k: int, law: float, exported: float, y: FloatArray) -> None:
    c = t.controller
    of = {"xi_hat": c.states, "xi_pred": c.states, "e": c.measurements, "frozen": c.measurements}
    signals = of.get(name, t.believed.actuator.coils if name == "current" else c.forces)
    where = ", ".join(f"{s.name} = {value:.6g} {s.unit}" for s, value in zip(c.measurements, y, strict=True))
    raise CheckError(
        f"{c.name}: the exported C makes {name} of {signals[k].name} {exported:.6g} where the law makes {law:.6g}, "
        f"within the ranges of the readings, at {where}; nothing is written"
    )

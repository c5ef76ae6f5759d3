"""What the exported test tries beside its vectors: each monitor in each state, all transitions, pieces, and tables.

templates/trials.c flies the supervisor with the stand-in of the machine, and makes each row of the table of monitors
act by a fault, in each state in which it counts; templates/calls.c calls the other functions of the header.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.firmware.ctext import c_number
from malta.firmware.export import FUSED, call_text, piece_records
from malta.firmware.program import TYPES, Program, evaluate
from malta.firmware.sensor_loss import expected_readings
from malta.firmware.signals import Target
from malta.firmware.step import programs_of
from malta.firmware.supervisor import (
    JUMP,
    LONG,
    MONITORS,
    REACTIONS,
    STATES,
    TRANSITIONS,
    Monitor,
    State,
    absent_monitors,
    bounds_of,
    monitors_of,
    reference_limits,
)
from malta.firmware.vectors import checksum

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

LONGEST_TRIAL = 600  # samples until a row acts, the middle of long times left out
PIECE_SCALE = 2.0**-25  # of drawn whole numbers up to 2^15: 1e-3
PIECE_TIME = 0.02  # s, of a rise, and m, of a pole
STROKE_SAMPLES = 20.0  # of a rise


class OutOfReach(NamedTuple):
    """A row of the table of monitors that no fault makes act in a state, and why."""

    key: str
    state: State
    reason: str


def out_of_reach(t: Target) -> list[OutOfReach]:
    """Where a row counts but cannot act: a landing of a stroke alone ends at the first sample without its sensor."""
    if not _only_stroke(t):
        return []
    reason = "a stroke may end anywhere: it is off at the first sample without its sensor"
    return [OutOfReach(key, "LANDING", reason) for key in ("STUCK", "UNBELIEVED", "BLIND", "HELPLESS")]


def _only_stroke(t: Target) -> bool:
    return t.believed.has_stroke and len(t.controller.measurements) == 1


def trial_context(t: Target, name: str) -> dict[str, Any]:
    """What trials.c and calls.c are filled with. name : the controller's"""
    b, c = bounds_of(t), t.controller
    seen, per_unit = _shown_states(t)
    return {
        "states": list(STATES),
        "monitors": MONITORS,
        "reactions": REACTIONS,
        "transitions": TRANSITIONS,
        "only_stroke": _only_stroke(t),
        "coils": len(t.believed.actuator.coils),
        "estimated": len(c.states),
        "observed": c.observed,
        "tracks_errors": c.tracks == "errors",
        "over": _faults(t, per_unit),
        "moved": _moved(t),
        "seen": ", ".join(map(str, seen)),
        "stuck": ", ".join(map(str, b.stuck)),
        "stale": b.stale,
        "longest": LONG,
        "longest_trial": LONGEST_TRIAL,
        "sensors": ", ".join(f"{_sensors(row, t)}u" for row in monitors_of(t)),
        "out_of_reach": ", ".join(f"{_unreached_states(row, t)}u" for row in monitors_of(t)),
        "unreached": _unreached_lines(t),
        **_strokes(t),
        **_pieces(t, name),
    }


def _faults(t: Target, per_unit: FloatArray) -> dict[str, str]:
    """How large faults are, so that their monitors act and no stronger one before them."""
    b, c = bounds_of(t), t.controller
    signs = (-1.0) ** np.arange(len(b.settled))
    limits = np.asarray(c.limits.force, dtype=float)
    currents = np.broadcast_to(c.limits.current, len(t.believed.actuator.coils))
    sigma = np.where(np.isfinite(b.sigma), b.sigma, 0.0)
    numbers: dict[str, Any] = {
        "touch": 1.2 * b.touch,
        "range": 2 * b.range,
        "jump": 3 * b.jump,
        "settled": np.maximum(3 * b.settled, 2.5 * JUMP * sigma),
        "drift_step": np.where(np.isfinite(b.jump), 0.6 * b.jump, b.settled),
        "step": 0.5 * reference_limits(t).position,
        "rest": 3 * signs * b.settled,
        "per_unit": per_unit,
        "shift": 2.5 * JUMP * sigma * per_unit,
        "astray": 3 * b.range * per_unit,
        "coil": currents,
        "sum": [1e6],
        "observed": [2 * float(np.max(np.where(np.isfinite(limits), limits, 100.0)))],
    }
    if t.driven:
        largest = float(np.max(c.limits.current))
        numbers |= {
            "current": [1.5 * b.current],
            "offset": [3 * b.offset],
            "uneven": [3 * b.uneven],
            "link": [1.5 * t.believed.drive.link_voltage],
            "astray_current": [0.3 * largest],
            "lost_control": [0.9 * largest],
        }
    found = {key: _numbers(values, t) for key, values in numbers.items()}
    return found | {"missed": str(b.unbelieved + 1)}


def _numbers(values: Iterable[float], t: Target) -> str:
    """Numbers in C, those that are infinite as one that nothing reaches."""
    return ", ".join(c_number(float(np.clip(v, -1e18, 1e18)), t.precision) for v in values)


def _shown_states(t: Target) -> tuple[list[int], FloatArray]:
    """The state of the filter that each expected reading shows most, and how much of it is a unit of the reading."""
    if t.controller.tracks == "errors":
        return [0] * len(t.controller.measurements), np.ones(len(t.controller.measurements))
    xi = ca.SX.sym("xi", len(t.controller.states))
    slope = ca.Function("slope", [xi], [ca.densify(ca.jacobian(expected_readings(t)(xi), xi))])
    C = np.array(slope(0))
    seen = np.abs(C).argmax(axis=1)
    return seen.tolist(), 1 / C[np.arange(len(C)), seen]


def _sensors(row: Monitor, t: Target) -> int:
    """The position sensors that can make a row act, a bit for each."""
    b = bounds_of(t)
    able = {
        "TOUCH": np.isfinite(b.touch),
        "RATE": np.isfinite(b.jump),
        "INNOVATION": np.isfinite(b.sigma),
        "STUCK": np.array(b.stuck) < LONG,
    }
    mask = able.get(row.key, np.ones(len(b.range), dtype=bool))
    return sum(1 << k for k, yes in enumerate(mask) if yes)


def _unreached_states(row: Monitor, t: Target) -> int:
    """The states in which no fault makes a row act, a bit for each."""
    numbers = {state: k for k, state in enumerate(STATES)}
    found = [one for one in out_of_reach(t) if one.key == row.key and one.state in row.states]
    return sum(1 << numbers[one.state] for one in found)


def _unreached_lines(t: Target) -> list[str]:
    """What the test does not reach, for its reader: monitors that the machine does not have, and cells of the table."""
    reasons: dict[str, list[str]] = {}
    for key, reason in absent_monitors(t).items():
        reasons.setdefault(reason, []).append(key.lower())
    lines = [f"without {' '.join(keys)}: {reason}" for reason, keys in reasons.items()]
    cells = [(f"{one.key.lower()} in {one.state.lower()}", one.reason) for one in out_of_reach(t)]
    return lines + [f"without {cell}: {reason}" for cell, reason in cells]


def _moved(t: Target) -> dict[str, Any]:
    """A motion near the end of an output's way: where, how fast, and the end."""
    limits, b = reference_limits(t), bounds_of(t)
    k = t.believed.stroke_output if t.believed.has_stroke else 0
    end = b.touch[k] if np.isfinite(b.touch[k]) else b.range[k]
    place = 0.8 * limits.position[k]
    return {
        "output": k,
        "place": _numbers([place], t),
        "speed": _numbers([np.sqrt(0.5 * limits.acceleration[k] * (end - place))], t),
        "end": _numbers([end], t),
    }


def _strokes(t: Target) -> dict[str, Any]:
    """Where strokes of the test end; a logistic one is within 2e-6 of its way."""
    if not (t.believed.has_stroke and t.believed.travel > 0):
        return {}
    most = float(reference_limits(t).position[t.believed.stroke_output])
    shares = {"stroke_end": 0.5, "stroke_near": 0.499, "stroke_over": 0.501, "stroke_beyond": 1.01}
    found = {key: _numbers([share * most], t) for key, share in shares.items()}
    return found | {"stroke_samples": _numbers([STROKE_SAMPLES], t)}


def _pieces(t: Target, name: str) -> dict[str, Any]:
    """Calls of the pieces with drawn numbers, and checksums of what their expressions give."""
    programs = {key: p for key, p in programs_of(t).items() if key not in FUSED}
    given = max(_size(p.arguments) for p in programs.values())
    found = max(_size(p.results) for p in programs.values())
    draws, pieces, sums = _Draws(t), [], []
    for key, p in programs.items():
        values = draws.take(given)
        starts = _starts(p.arguments)
        times = [starts[of] for of in ("rise", "pole") if of in starts]
        values[times] = TYPES[t.precision](PIECE_TIME)
        arguments = {of: values[starts[of] : starts[of] + size] for of, size in p.arguments}
        results = evaluate(p, arguments, t.precision)
        sums.append(checksum(np.concatenate([results[of] for of, _ in p.results])))
        pieces.append(
            {
                "name": key,
                "call": _call(p, name),
                "times": times,
                "results": _size(p.results),
                "records": bool(piece_records(p)),
            }
        )
    lines = [f"    0x{value:08x}u" for value in sums]
    return {
        "pieces": pieces,
        "piece_sums": ",\n".join(lines),
        "piece_scale": c_number(PIECE_SCALE, t.precision),
        "piece_time": c_number(PIECE_TIME, t.precision),
        "most_given": given,
        "most_found": found,
    }


class _Draws:
    """The numbers that calls.c draws."""

    def __init__(self, t: Target) -> None:
        self.real, self.seed = TYPES[t.precision], 1

    def take(self, count: int) -> Any:
        found = np.zeros(count, dtype=self.real)
        for k in range(count):
            self.seed = (self.seed * 1664525 + 1013904223) % 2**32
            found[k] = self.real((self.seed >> 16) - 32768) * self.real(PIECE_SCALE)
        return found


def _call(p: Program, name: str) -> str:
    """The call of a piece with places in the arrays of drawn and found numbers, or with its records."""
    if piece_records(p):
        return f"{name}_{p.name}(&{p.name}_given, &{p.name}_found)"
    places = {of: f"&given[{at}]" for of, at in _starts(p.arguments).items()}
    places |= {of: f"&found[{at}]" for of, at in _starts(p.results).items()}
    return call_text(p, name, places)


def _starts(sizes: Sequence[tuple[str, int]]) -> dict[str, int]:
    """Where each vector begins, one after the other."""
    ends = np.cumsum([0, *(size for _, size in sizes)])
    return {name: int(at) for (name, _), at in zip(sizes, ends, strict=False)}


def _size(sizes: Sequence[tuple[str, int]]) -> int:
    return sum(size for _, size in sizes)

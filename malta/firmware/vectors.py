"""Recorded vectors: readings of flights, and what the controller makes of them, for a test on any processor.

stroke       a short stroke with noise
saturation   readings far off, so that forces are limited and sums of errors wait, and back
invalid      NaN, infinity, readings out of reach, readings that their sensors call invalid
lift-off     a controller that knows nothing meets a machine that is far away
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.firmware.calibration import FNV_FACTOR, FNV_START
from malta.firmware.ctext import c_number, c_numbers
from malta.firmware.program import Program, evaluate
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.sources import FUSION, call_text, moves_by_model, piece_records, readings_at_rest
from malta.firmware.step import first_state, programs_of, started_state, step_function, zero_reference
from malta.firmware.supervisor import (
    AGREEMENT,
    ENDLESS_SAMPLES,
    IN_USE,
    JUMP,
    MONITORS,
    MOST_LAPSES,
    REACTIONS,
    STATES,
    TRANSITIONS,
    Monitor,
    State,
    absent_monitors,
    bounds_of,
    expected_readings,
    monitors_of,
    reference_limits,
    states_of,
    transitions_of,
)
from malta.simulation import references
from malta.simulation.inputs import motion_of
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory

SAMPLES = 60  # of each vector
STROKE = 0.02  # of the travel, at most


class Vector(NamedTuple):
    """Readings of some samples, and what a controller must make of them."""

    name: str
    warm: bool  # whether the state is one of a machine that follows the first reference; else that of `init`
    readings: FloatArray  # samples x (p, dp, ddp, then what is read), in the order of signals.py
    expected: FloatArray  # samples x (v, then commands or currents)
    checksums: list[int]  # of all outputs and the whole state after each sample


def record_vectors(t: Target) -> list[Vector]:
    """The vectors of a target; the readings are those of simulations, the answers are computed by step.py."""
    rest, moving = _flight(t, stroke=False), _flight(t, stroke=True)
    reach = np.minimum(reading_ranges(t.believed), 1.0)
    far = {name: value.copy() for name, value in rest.items()}
    far["y"][10:35] += 0.2 * reach * (-1.0) ** np.arange(len(reach))
    lifted = {name: value.copy() for name, value in rest.items()}
    lifted["y"] += 0.4 * reach * np.exp(-np.arange(SAMPLES) / 12.0)[:, None]
    return [
        _answer(t, "stroke", moving, warm=True),
        _answer(t, "saturation", far, warm=True),
        _answer(t, "invalid", _damage(t, rest), warm=True),
        _answer(t, "lift_off", lifted, warm=False),
    ]


def _flight(t: Target, *, stroke: bool) -> dict[str, FloatArray]:
    """References and readings of a flight with noise: of a short stroke, or at rest."""
    c, plant = t.controller, t.believed
    lasts = SAMPLES * c.sample_time
    options: Any = {"noise": 1.0, "fidelity": "force" if not t.driven else t.fidelity}
    options["substeps"] = t.steps
    if stroke and plant.has_stroke and plant.stroke.travel:
        scenario = Scenario.stroke(_distance(t, lasts / 6), rise=lasts / 6, duration=lasts, **options)
    else:
        scenario = Scenario("hold", lasts, references.hold, **options)
    run = simulate(plant, c, scenario)
    motion = motion_of(scenario, plant, c, run.t)
    found = {"p": motion.p, "dp": motion.dp, "ddp": motion.ddp} | readings_of(t, run)
    if len(run.t) < SAMPLES:  # it touched down: go on with the last reading
        found = {k: np.vstack([v, np.repeat(v[-1:], SAMPLES - len(v), axis=0)]) for k, v in found.items()}
    return found


def _distance(t: Target, rise: float) -> float:
    """The way of a stroke, m, with half of the largest acceleration of references: a = D k^2 / (6 sqrt(3))."""
    k = 2 * math.log(9) / rise
    most = float(reference_limits(t).acceleration[t.believed.stroke_output])
    return float(min(STROKE * t.believed.stroke.travel, 0.5 * most * 6 * math.sqrt(3) / k**2))


def readings_of(t: Target, run: Trajectory) -> dict[str, FloatArray]:
    """What the controller read in a flight."""
    found = {"y": run.y.copy(), "y_valid": np.ones_like(run.y)}
    if t.driven:
        i = run.i_phase if t.fidelity == "phase" else run.i
        found |= {"i": i.copy(), "i_valid": np.ones_like(i), "link": run.link.copy()}
    if t.excited:  # a hundredth of the limits, in turn of either sign
        signs = np.where(np.add.outer(np.arange(len(run.y)), np.arange(run.v.shape[1])) % 3, 0.01, -0.01)
        found["excitation"] = signs * np.array(t.controller.limits.force)
    return found


def _damage(t: Target, flight: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The same flight with readings that cannot be true."""
    found = {name: value.copy() for name, value in flight.items()}
    outputs = found["y"].shape[1]
    for k, value in enumerate((math.nan, math.inf, -math.inf, 1e30, -1e30)):
        found["y"][4 + 5 * k, k % outputs] = value
    found["y"][32:36] = math.nan
    found["y_valid"][40:44, 0] = 0
    if t.driven:
        found["i"][6, 0], found["i"][11, -1], found["i_valid"][16:20, 1] = math.nan, math.inf, 0
        found["link"][21], found["link"][26], found["link"][31] = math.nan, 0.0, math.inf
    if t.excited:
        found["excitation"][7, 0], found["excitation"][8, -1] = math.nan, math.inf
    return found


def _answer(t: Target, name: str, flight: dict[str, FloatArray], *, warm: bool) -> Vector:
    """A vector with the controller's answers."""
    real, step = t.real, step_function(t)
    order = [*(f.name for f in t.reference_fields), *(f.name for f in t.input_fields)]
    rows = {key: np.asarray(flight[key], dtype=real) for key in order}
    first = {key: rows[key][0] for key in zero_reference(t)}
    state = started_state(t, first) if warm else first_state(t)
    expected, checksums = [], []
    for k in range(SAMPLES):
        sample = {key: value[k] for key, value in rows.items()}
        state, out = step(state, sample, sample)
        last = out["command"] if "command" in out else out["current"]
        expected.append(np.concatenate([out["v"], last]))
        outputs = [out[f.name] for f in t.output_fields if f.size]
        remembered = [state[f.name] for f in t.state_fields if f.size]
        checksums.append(checksum(np.concatenate([*outputs, *remembered])))
    return Vector(name, warm, np.hstack([rows[key] for key in order]), np.array(expected), checksums)


def checksum(values: Any, begin: int = FNV_START) -> int:
    """FNV-1a over the words of 32 bits of numbers, the upper word of a double first; -0 counts as 0."""
    values = np.ascontiguousarray(values + values.dtype.type(0))
    words = values.view(np.uint32 if values.dtype == np.float32 else np.uint64)
    found = begin
    for word in words.tolist():
        for part in (word,) if values.dtype == np.float32 else (word >> 32, word & 0xFFFFFFFF):
            found = ((found ^ part) * FNV_FACTOR) & 0xFFFFFFFF
    return found


# What the exported test tries beside its vectors: each monitor in each state, all transitions, pieces, and tables.
#
# templates/trials.c flies the supervisor with the stand-in of the machine, and makes each row of the table of monitors
# act by a fault, in each state in which it counts; templates/calls.c calls the other functions of the header.


LONGEST_WISH, SLOW_WISH = (
    2000,
    20_000,
)  # samples until a state is reached, at most; of a machine that has to settle
MAX_TRIAL_SAMPLES = 600  # samples until a row acts, the middle of long times left out
SLOWLY = 50  # samples, in which the filter's expectation leaves the readings
SAME_SHARE = 1e-9  # share by which readings differ that tell the same of the states
SHARES = np.geomspace(1e-3, 1e3, 121)  # of a sensor's range, by which a filter that is lost is off
PIECE_SCALE = 2.0**-25  # of drawn whole numbers up to 2^15: 1e-3
PIECE_TIME = 0.02  # s, of a rise, and m, of a pole
STROKE_SAMPLES = 20.0  # of a rise


class OutOfReach(NamedTuple):
    """A row of the table of monitors that no fault makes act in a state, and why."""

    key: str
    state: State
    reason: str


def out_of_reach(t: Target) -> list[OutOfReach]:
    """Where a row counts but no fault of the test makes it act.

    A landing of a stroke alone ends at the first sample without its sensor; a law that sums nothing up has no memory
    that holds a force at its limit; a filter may expect nothing that is beyond all ranges.
    """
    found = []
    if _only_stroke(t):
        reason = "a stroke may end anywhere: it is off at the first sample without its sensor"
        found = [OutOfReach(key, "LANDING", reason) for key in ("STUCK", "UNBELIEVED", "BLIND", "HELPLESS")]
    if t.controller.tracks == "states" and not t.controller.Ki.any() and not t.controller.observed:
        reason = "the law sums nothing up that holds a force at its limit"
        rows = [row for row in monitors_of(t) if row.key in ("HELPLESS", "SATURATION")]
        cells = dict.fromkeys((row.key, state) for row in rows for state in row.states)
        found += [OutOfReach(*cell, reason) for cell in cells if cell not in {one[:2] for one in found}]
    if not np.isfinite(_lost_expectations(t)).any():
        reason = "whatever the filter expects can be read"
        states = [state for row in monitors_of(t) if row.key == "ASTRAY" for state in row.states]
        found += [OutOfReach("ASTRAY", state, reason) for state in states]
    return found


def _only_stroke(t: Target) -> bool:
    return t.believed.has_stroke and len(t.controller.measurements) == 1


def trial_context(t: Target, name: str) -> dict[str, Any]:
    """What trials.c and calls.c are filled with. name : the controller's"""
    b, c = bounds_of(t), t.controller
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
        "over": _faults(t),
        "moved": _motion_near_end(t),
        "stuck": ", ".join(map(str, b.stuck)),
        "stale": b.stale,
        "longest": ENDLESS_SAMPLES,
        "longest_trial": MAX_TRIAL_SAMPLES,
        "longest_disbelief": 2 * AGREEMENT * 4 ** (MOST_LAPSES - 1),
        "longest_wish": SLOW_WISH if moves_by_model(t) else LONGEST_WISH,
        "sensors": ", ".join(f"{_sensors(row, t)}u" for row in monitors_of(t)),
        "out_of_reach": ", ".join(f"{_unreached_states(row, t)}u" for row in monitors_of(t)),
        "moves_otherwise": not t.believed.second_order,
        "unreached": _unreached_lines(t),
        "never_act": [k for k, row in enumerate(monitors_of(t)) if not _tried_states(row, t)],
        **_expectation(t),
        **_strokes(t),
        **_pieces(t, name),
    }


def _place_of_rest(t: Target, sizes: FloatArray) -> FloatArray:
    """Readings of these sizes, of either sign by turns; with more sensors than forces, of a place that has them all."""
    reached = readings_at_rest(t)
    return np.asarray(sizes * (-1.0) ** np.arange(len(sizes)) if reached is None else reached @ sizes)


def _faults(t: Target) -> dict[str, str]:
    """How large faults are, so that their monitors act and no stronger one before them."""
    b, c = bounds_of(t), t.controller
    limits = np.asarray(c.limits.force, dtype=float)
    currents = np.broadcast_to(c.limits.current, len(t.believed.actuator.coils))
    sigma = np.where(np.isfinite(b.sigma), b.sigma, 0.0)
    numbers: dict[str, Any] = {
        "touch": 1.5 * b.touch,
        "range": 2 * b.range,
        "jump": 3 * b.jump,
        "settled": 1.25 * b.settled,
        "drift_step": np.where(np.isfinite(b.jump), 0.6 * b.jump, b.settled),
        "step": _refused_steps(t),
        "rest": _place_of_rest(t, 3 * b.settled),
        "shift": 1.5 * JUMP * sigma,
        "astray": 3 * b.range,
        "lost": np.nan_to_num(_lost_expectations(t)),
        "coil": currents,
        "sum": [1e6],
        "factor": [3.0],
        "observed": [2 * float(np.max(np.where(np.isfinite(limits), limits, 100.0)))],
    }
    if c.tracks == "errors" and not c.Ki.any():  # the sums are among its states
        numbers["saturating"] = np.linalg.pinv(c.K) @ (2 * np.where(np.isfinite(limits), limits, 100.0))
    if t.driven:
        largest = float(np.max(c.limits.current))
        numbers |= {
            "current": [1.5 * b.current],
            "offset": [3 * b.offset],
            "link": [1.5 * t.believed.drive.link_voltage],
            "astray_current": [0.3 * largest],
            "lost_control": [0.9 * largest],
        }
    found = {key: _numbers(values, t) for key, values in numbers.items()}
    return found | {"missed": str(b.unbelieved + 1)}


def _refused_steps(t: Target) -> FloatArray:
    """Steps of references within the limits of places, too far for a sample; beyond those where none is too far."""
    limits = reference_limits(t)
    steps = 0.5 * limits.position
    return np.where(steps > 1.1 * limits.speed * t.controller.sample_time, steps, 2 * bounds_of(t).range)


def _numbers(values: Iterable[float], t: Target) -> str:
    """Numbers in C, those that are infinite as one that nothing reaches."""
    return c_numbers(np.clip([*values], -1e18, 1e18), t.precision)


def _expectation(t: Target) -> dict[str, str]:
    """How readings depend on the filter's states near zero, states by the readings, and samples of a slow shift."""
    if t.controller.tracks == "errors":
        return {}
    C = _slope_of_readings(t)
    matrices = {
        "shows": C,
        "told": np.linalg.pinv(C, SAME_SHARE),
        "alone": _states_by_one_reading(C, bounds_of(t).range),
    }
    numbers = {"slowly": str(SLOWLY), "slowly_real": c_number(float(SLOWLY), t.precision)}
    return numbers | {
        key: ", ".join(f"{{ {_numbers(row, t)} }}" for row in rows) for key, rows in matrices.items()
    }


def _slope_of_readings(t: Target) -> FloatArray:
    """p x n: what the filter expects of the readings, by its states, near zero."""
    xi = ca.SX.sym("xi", len(t.controller.states))
    slope = ca.Function("slope", [xi], [ca.densify(ca.jacobian(expected_readings(t)(xi), xi))])
    return np.array(slope(0))


def _states_by_one_reading(C: FloatArray, ranges: FloatArray) -> FloatArray:
    """n x p: the change of states by which a reading is one more and the others, by their ranges, the least."""
    scaled = C / ranges[:, None]
    columns = []
    for k, row in enumerate(C):
        particular = np.linalg.pinv(row[None])[:, 0]  # 0 of a reading that shows no state
        free = np.eye(C.shape[1]) - np.outer(particular, row)
        others = np.delete(scaled, k, axis=0)
        columns.append(particular - free @ np.linalg.pinv(others @ free, SAME_SHARE) @ (others @ particular))
    return np.column_stack(columns)


@lru_cache(maxsize=16)
def _lost_expectations(t: Target) -> FloatArray:
    """p: by how much states of one reading alone are off, to first order, where a filter expects what no sensor reads.

    Three times its range, or else the least of SHARES of it whose expectation, which need not be linear, is beyond
    twice the range; NaN where none is.
    """
    reach = bounds_of(t).range
    if t.controller.tracks == "errors":
        return 3 * reach
    expect, columns = expected_readings(t), _states_by_one_reading(_slope_of_readings(t), reach)
    found = np.full(len(reach), math.nan)
    for k, column in enumerate(columns.T):
        for share in (3.0, *SHARES, *-SHARES):
            if abs(float(expect(share * reach[k] * column)[k])) > 2 * reach[k]:
                found[k] = share * reach[k]
                break
    return found


def _sensors(row: Monitor, t: Target) -> int:
    """The position sensors that can make a row act, a bit for each."""
    b = bounds_of(t)
    able = {
        "TOUCH": np.isfinite(b.touch),
        "RATE": np.isfinite(b.jump),
        "FOLLOWING": np.isfinite(b.touch),
        "INNOVATION": np.isfinite(b.sigma),
        "STROKE": np.arange(len(b.sigma)) == (t.believed.stroke_output if t.believed.has_stroke else -1),
        "STUCK": np.array(b.stuck) < ENDLESS_SAMPLES,
        "ASTRAY": np.isfinite(_lost_expectations(t)),
    }
    mask = able.get(row.key, np.ones(len(b.range), dtype=bool))
    return sum(1 << k for k, yes in enumerate(mask) if yes)


def _unreached_states(row: Monitor, t: Target) -> int:
    """The states in which no fault makes a row act, a bit for each."""
    numbers = {state: k for k, state in enumerate(STATES)}
    found = [one for one in out_of_reach(t) if one.key == row.key and one.state in row.states]
    return sum(1 << numbers[one.state] for one in found)


def _tried_states(row: Monitor, t: Target) -> set[State]:
    """The states in which a fault makes a row act."""
    return set(row.states) - {"WIRING"} - {one.state for one in out_of_reach(t) if one.key == row.key}


def _unreached_lines(t: Target) -> list[str]:
    """What the test does not reach, for its reader: monitors that the machine does not have, and cells of the table."""
    reasons: dict[str, list[str]] = {}
    for key, reason in absent_monitors(t).items():
        reasons.setdefault(reason, []).append(key.lower())
    lines = [f"without {' '.join(keys)}: {reason}" for reason, keys in reasons.items()]
    cells: dict[tuple[str, str], list[str]] = {}
    for one in out_of_reach(t):
        cells.setdefault((one.key, one.reason), []).append(one.state.lower())
    more = [
        f"without {key.lower()} in {' '.join(states)}: {reason}" for (key, reason), states in cells.items()
    ]
    return lines + more


def _motion_near_end(t: Target) -> dict[str, Any]:
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
    if not (t.believed.has_stroke and t.believed.stroke.travel > 0):
        return {}
    most = float(reference_limits(t).position[t.believed.stroke_output])
    shares = {"stroke_end": 0.5, "stroke_near": 0.499, "stroke_over": 0.501, "stroke_beyond": 1.01}
    found = {key: _numbers([share * most], t) for key, share in shares.items()}
    return found | {"stroke_samples": _numbers([STROKE_SAMPLES], t)}


def _pieces(t: Target, name: str) -> dict[str, Any]:
    """Calls of the pieces with drawn numbers, and checksums of what their expressions give."""
    programs = {key: p for key, p in programs_of(t).items() if key not in FUSION}
    given = max(_size(p.arguments) for p in programs.values())
    found = max(_size(p.results) for p in programs.values())
    draws, pieces, sums = _Draws(t), [], []
    for key, p in programs.items():
        values = draws.take(given)
        starts = _starts(p.arguments)
        times = [starts[of] for of in ("rise", "pole") if of in starts]
        values[times] = t.real(PIECE_TIME)
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
        self.real, self.seed = t.real, 1

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


# Which monitor watches in which state of the supervisor, and why others do not: no cell of the table is empty.


GROUND: tuple[State, ...] = ("OFFSETS", "SENSORS")
OTHER_STATES = {key: tuple(state for state in IN_USE if state != key) for key in IN_USE}

# (monitors, states, why they cannot hurt or do not count there); OFF and FAULT have their gates off
UNWATCHED_STATES: tuple[tuple[tuple[str, ...], tuple[State, ...], str], ...] = (
    (("TOUCH",), GROUND, "the machine rests on its bearing"),
    (("FOLLOWING",), GROUND, "nothing is followed"),
    (("RANGE", "STUCK", "STALE", "NAN"), ("OFFSETS",), "positions are not used yet"),
    (("RATE",), GROUND, "the first readings come from anywhere, and nothing moves"),
    (("INNOVATION", "STROKE", "UNBELIEVED", "BLIND", "ASTRAY"), GROUND, "the filter does not run"),
    (
        ("INNOVATION",),
        ("LIFT", "SETTLE", "LANDING"),
        "a bearing pushes; FOLLOWING, ASTRAY and UNSETTLED watch",
    ),
    (("HELPLESS", "SATURATION"), GROUND, "no force acts"),
    (("SATURATION",), ("LIFT",), "lift-off ends after its time, and SETTLE watches"),
    (("SATURATION", "LINK"), ("LANDING",), "it lands already; HELPLESS watches"),
    (("MISSED", "OVERRUN"), GROUND, "nothing moves"),
    (("OFFSET",), OTHER_STATES["OFFSETS"], "offsets are known, and subtracted"),
    (("CURRENT_SUM", "CURRENT_EXCESS"), ("OFFSETS",), "offsets are not known; OFFSET and CURRENT watch"),
    (("CURRENT_ERROR",), GROUND, "nothing is commanded; OFFSET, CURRENT and CURRENT_EXCESS watch"),
    (("CURRENT_FROZEN",), GROUND, "nothing is commanded"),
    (("REFERENCE",), (*GROUND, "LIFT", "LANDING"), "requests are not followed"),
    (("REFERENCE",), ("SETTLE",), "it waits until the request is within its limits"),
    (("UNSETTLED",), OTHER_STATES["SETTLE"], "nothing is waited for"),
    (("UNREADY",), OTHER_STATES["SENSORS"], "nothing is waited for"),
)


def transition_lines(t: Target) -> list[str]:
    """The table of transitions as lines of Markdown: states, event, next state; those of one event and end in one line.

    transition_lines(Target(malta.gains.read("design/gains/robust.json")))[2]
    """
    found: dict[tuple[str, str], list[str]] = {}
    for begin, on, end in transitions_of(wiring=t.wiring):
        found.setdefault((on, end), []).append(begin)
    rows = [f"| {', '.join(begins)} | {on.lower()} | {end} |" for (on, end), begins in found.items()]
    return ["| from | by | to |", "|---|---|---|", *rows]


def watch_table(t: Target) -> dict[str, dict[State, str]]:
    """The reactions of each monitor in each state, as "hold, land", or in brackets why it does not count there.

    watch_table(Target(malta.gains.read("design/gains/robust.json")))["LINK"]["LIFT"]
    """
    table: dict[str, dict[State, str]] = {}
    for row in monitors_of(t):
        cells = table.setdefault(row.key, dict.fromkeys(states_of(t), ""))
        for state in row.states:
            cells[state] = ", ".join(filter(None, [cells[state], row.reaction.lower()]))
    for key, cells in table.items():
        for state in STATES:
            if state not in IN_USE:
                cells[state] = "(gates are off)"
        if key == "WIRING":
            cells |= dict.fromkeys(IN_USE, "(the wiring is tried once, before the first lift-off)")
        elif t.wiring:
            cells["WIRING"] = (
                cells["WIRING"] or "(small voltages on a machine that rests; WIRING looks at the answers)"
            )
        for keys, states, reason in UNWATCHED_STATES:
            for state in states if key in keys else ():
                cells[state] = cells[state] or f"({reason})"
    return table


def watch_lines(t: Target) -> list[str]:
    """The table in Markdown: monitors down, the states that are not off across; reasons are numbered below it."""
    reasons: list[str] = []
    used: tuple[State, ...] = (*IN_USE, "WIRING") if t.wiring else IN_USE
    lines = [
        "| monitor | " + " | ".join(state.lower() for state in used) + " |",
        "|---" * (1 + len(used)) + "|",
    ]
    for key, cells in watch_table(t).items():
        shown = []
        for state in used:
            text = cells[state]
            if text.startswith("("):
                if text not in reasons:
                    reasons.append(text)
                text = f"({reasons.index(text) + 1})"
            shown.append(text)
        lines.append(f"| `{key.lower()}` | " + " | ".join(shown) + " |")
    return [*lines, "", *(f"{k}. {reason.strip('()')}" for k, reason in enumerate(reasons, 1))]

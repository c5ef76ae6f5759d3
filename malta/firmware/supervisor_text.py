"""The supervisor of supervisor.py as C, and that C compiled: <name>_supervisor.h and .c.

What is compiled on this computer is tested and flies in the simulation, beside the exported controller.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.firmware.ctext import c_number, function_text
from malta.firmware.program import Program, build_program, lower
from malta.firmware.signals import Target
from malta.firmware.sources import arithmetic_context, head_context, render, root_context
from malta.firmware.supervisor import (
    AGREEMENT,
    ENDLESS_SAMPLES,
    EXCITATION_SHARE,
    FREER,
    FROZEN_SAMPLES,
    HELD_SAMPLES,
    JUMP,
    LAPSE_SAMPLES,
    MEAN,
    MOST_LAPSES,
    MOST_RATE,
    REACTIONS,
    REPEATS,
    SAG_SHARE,
    STATES,
    TIMES,
    Monitor,
    State,
    bounds_of,
    current_deviations,
    expected_readings,
    gains_without,
    monitor_names,
    monitors_of,
    prediction_correction,
    reference_limits,
    stars_of,
    states_of,
    transitions_of,
)
from malta.firmware.wiring import wiring_context, wiring_members
from malta.simulation.layout import electronics_of
from malta.synthesis.controller import Controller

MIN_STOP_SAMPLES = 20.0  # samples in which a reference stops at least
FADE_SAMPLES = 40.0  # samples in which an acceleration fades that the next state does not have
MEMORY = 64.0  # samples over which the noise of readings is averaged
MAX_OVERSHOOT = 0.2  # largest (1 - u)^3 (u + 3 u^2): how far a reference of rate 1 goes on in the time 1
MOST_MISSED = 1_000_000  # steps that count as missed


class Member(NamedTuple):
    """A member of a record: a number, an array of them, or another record."""

    kind: Literal["int32_t", "real", "times", "reference", "parameters", "calibration"]
    name: str
    size: int  # 0: no array
    meaning: str


def time_members() -> list[Member]:
    """The durations of a supervisor."""
    words = {
        "offsets": "readings of currents that are averaged",
        "check": "good readings of positions in a row",
        "lift": "",
        "settle": "in a row with small errors",
        "fade": "from one reference to that of the request",
        "landing": "",
        "calm": "in a row without a cause to hold",
    }
    return [Member("int32_t", name, 0, words[name]) for name in TIMES._fields]


def request_members() -> list[Member]:
    """What a supervisor is asked for at a sample."""
    return [
        Member("int32_t", "start", 0, "becomes 1: leave OFF"),
        Member("int32_t", "operate", 0, "1: leave SETTLE for OPERATE"),
        Member("int32_t", "land", 0, "1: land"),
        Member("int32_t", "acknowledge", 0, "becomes 1: leave FAULT"),
        Member("int32_t", "stop", 0, "1: emergency stop, gates off at once; to land first, ask for land"),
        Member("int32_t", "sto", 0, "1: safe torque off is active in the drive"),
        Member("int32_t", "missed", 0, "steps that were missed since the last one"),
        Member("reference", "reference", 0, "in OPERATE"),
    ]


def supervisor_members(t: Target) -> list[Member]:
    """What a supervisor remembers; state, monitor, reaction and acted are for its caller to read."""
    p, rows = len(t.controller.measurements), len(monitors_of(t))
    members = [
        Member("times", "times", 0, ""),
        Member("int32_t", "state", 0, ""),
        Member(
            "int32_t", "enable", 0, "1: gates of the bridges on; 0: all switches open, where the drive can"
        ),
        Member("int32_t", "monitor", 0, "the last one that acted, or -1"),
        Member("int32_t", "reaction", 0, "its reaction"),
        Member("int32_t", "acted", rows, "how often each row of the table acted"),
        Member("int32_t", "unbelieved", p, "samples for which a sensor has been ignored"),
        Member(
            "int32_t", "fit", 0, "1: the compiled arithmetic is that of the text; 0: the machine stays off"
        ),
        Member("int32_t", "started", 0, "the request to start of the sample before"),
        Member("int32_t", "acknowledged", 0, "the same of the one to acknowledge"),
        Member("int32_t", "overruns", 0, "samples with missed steps before them, since the beginning"),
        Member("real", "late", 0, "their share, averaged"),
        Member("int32_t", "samples", 0, "since the state began"),
        Member("int32_t", "steady", 0, "samples in a row of what the state waits for"),
        Member("int32_t", "count", rows * p, "samples in a row over the threshold, of each row and output"),
        Member("int32_t", "agreed", p, "samples in a row in which a sensor reads what is expected"),
        Member("int32_t", "lapses", p, "how often a sensor was wrong lately"),
        Member("int32_t", "leapt", 0, "the sensor that left what was expected, until it is believed; or -1"),
        Member("real", "leap", 0, "by how much it did"),
        Member("int32_t", "repeated", p, "samples for which a reading has been the same"),
        Member("real", "since", p, "references when readings changed last"),
        Member("int32_t", "seeing", 0, "sensors that were believed at the last sample"),
        Member("int32_t", "unchanged", 0, "the same of all readings"),
        Member("real", "rest", p, "readings of the machine at rest"),
        Member("real", "last", p, "last readings"),
        Member("real", "noise", p, "mean of the last readings' jumps"),
        Member("real", "error", p, "mean of the last readings off their references"),
        Member("real", "usual", p, "mean of those believed off what the filter expected, each up to a jump"),
        Member("real", "away", p, "what the last believed ones were off it"),
        Member("real", "shift", p, "mean of what they were off it lately, either way"),
        Member("real", "unrest", 0, "mean of by how much the second of them left it from sample to sample"),
        Member("real", "limited", p, "1 where a force was at its limit"),
        Member("int32_t", "followed", 0, "1 from the first request that was within its limits"),
        Member("real", "asked", p, "last reference that was requested within its limits"),
        Member("real", "asked_rate", p, "its rate"),
        Member("int32_t", "paced", p, "1 where its rate is that of its places"),
        Member("int32_t", "steered", 0, "outputs whose references are on their way to what is requested"),
        Member("real", "place", p, "where the references go"),
        Member("real", "lasts", p, "s, how long they take"),
        Member("real", "stops", p, "s, in which the rate fades that they had"),
        Member("real", "d0", p, "by how much they differed at first, with two derivatives"),
        Member("real", "d1", p, ""),
        Member("real", "d2", p, ""),
    ]
    if t.tunable:
        members += [
            Member("parameters", "parameters", 0, "those of the controller's last step"),
            Member("calibration", "calibration", 0, "what samples take their parameters from; NULL: nothing"),
            Member("int32_t", "refused", 0, "why the last start was refused; 0: it was not"),
            Member("int32_t", "refused_entry", 0, "number of the record that was out of its range, or -1"),
        ]
    if t.driven:
        members.append(Member("real", "offset", len(t.current_readings), "A, of the current sensors"))
        members.append(Member("real", "current", len(t.believed.actuator.coils), "A, commanded"))
        members.append(Member("int32_t", "commanded", 0, "1 where the last command was another one"))
        members.append(Member("real", "i_before", len(t.current_readings), "A, last readings"))
        members.append(
            Member("real", "off_mean", len(t.believed.drive.axes), "A, of axes off their commands")
        )
        members.append(Member("real", "beyond_mean", len(t.believed.drive.axes), "A, of axes beyond them"))
        if stars_of(t):
            members.append(Member("int32_t", "still", len(stars_of(t)), "samples without change of a star"))
            members.append(
                Member("real", "raw_current", len(t.current_readings), "A, last readings as they came")
            )
            members.append(
                Member("int32_t", "same_current", len(t.current_readings), "samples in which each repeats")
            )
            members.append(Member("int32_t", "inferred", 0, "currents that the others of their stars tell"))
    if t.wiring:
        members.append(Member("int32_t", "wired", 0, "1: as it should be, -1: not, 0: not tried"))
        members += [Member(*row) for row in wiring_members(t)]
    return members


def supervisor_sources(t: Target, name: str) -> dict[str, str]:
    """The C files of a controller's supervisor by name: <name>_supervisor.h and <name>_supervisor.c.

    name : the controller's, see export.sources

        supervisor_sources(Target(malta.gains.read("design/gains/robust.json")), "robust")
    """
    context = _context(t, name)
    return {f"{name}_supervisor.{end}": render(f"supervisor.{end}", context) for end in ("h", "c")}


def monitor_lines(t: Target) -> list[str]:
    """The table of monitors for readers: monitor, level and threshold, samples until it acts, reaction."""
    lines = [f"{'monitor':<15}{'level':<46}{'over':>9}{'samples':>9}  reaction"]
    lines += [
        f"{row.key.lower():<15}{row.level:<46}{row.threshold:>9.4g}{row.samples:>9}  {row.reaction.lower()}"
        for row in monitors_of(t)
    ]
    return lines


def _context(t: Target, name: str) -> dict[str, Any]:
    """What the templates of a supervisor are filled with."""
    c, plant = t.controller, t.believed
    times = TIMES if t.driven else TIMES._replace(offsets=0)
    off = off_command(t)
    return head_context(t, name) | {
        "tunable": t.tunable,
        "logged": t.logged > 0,
        "states": list(states_of(t)),
        "monitors": monitor_names(t),
        "reactions": REACTIONS,
        "transitions": transitions_of(wiring=t.wiring),
        "rows": [_row(row, t) for row in monitors_of(t)],
        "state_lines": [f"{key.lower():<10}{words}" for key, words in states_of(t).items()],
        "monitor_lines": monitor_lines(t),
        "records": _records(t, name),
        "times": list(times._asdict().items()),
        "outputs": len(c.measurements),
        "forces": len(c.forces),
        "estimated": len(c.states),
        "rates": _rates(c),
        "input_fields": t.input_fields,
        "output_fields": [f for f in t.output_fields if f.size],
        "currents": len(t.current_readings) if t.driven else 0,
        "link": _number(plant.drive.link_voltage, t) if t.driven else "",
        "coils": len(plant.actuator.coils),
        "axes": len(plant.drive.axes) if t.driven else 0,
        "stars": stars_of(t),
        "moves": _number(1e-4 * float(np.max(c.limits.current)), t),
        "limits": {key: _vector(values, t) for key, values in reference_limits(t)._asdict().items()},
        "excited": t.excited,
        "excitation": _vector(EXCITATION_SHARE * np.asarray(c.limits.force), t),
        "command": len(off),
        "off": _vector(off, t),
        "stroke_output": plant.stroke_output if plant.has_stroke else -1,
        "except_stroke": f" && (k != {plant.stroke_output})" if plant.has_stroke else "",
        "only_stroke": plant.has_stroke and len(c.measurements) == 1,
        "longest": ENDLESS_SAMPLES,
        "arithmetic": arithmetic_context(t.precision),
        "most_missed": MOST_MISSED,
        **root_context(t.precision),
        "uneven": _number(bounds_of(t).uneven, t),
        "frozen_samples": FROZEN_SAMPLES,
        **_bounds(t),
        **_filters(t, name),
        **{key: c_number(value, t.precision) for key, value in _NUMBERS.items()},
        **wiring_context(t),
        "wiring_members": [Member(*row) for row in wiring_members(t)] if t.wiring else [],
    }


def _rates(c: Controller) -> int:
    """How many positions of the filter are followed by their rates, in this order; 0 where its states are others."""
    half = len(c.A) // 2
    top = np.hstack([np.zeros((half, half)), np.eye(half)])
    return half if c.tracks == "states" and len(c.A) == 2 * half and np.array_equal(c.A[:half], top) else 0


def _place_rows(t: Target) -> str:
    """C of the filter's positions that readings add to; "" where positions do not give every reading by itself."""
    c, half = t.controller, _rates(t.controller)
    C = c.C[:, :half]
    return _matrix(np.linalg.pinv(C), t) if half and np.linalg.matrix_rank(C) == len(C) else ""


def _bounds(t: Target) -> dict[str, Any]:
    """The limits of the outputs."""
    b = bounds_of(t)
    names = (
        "touch",
        "range",
        "jump",
        "leap",
        "sigma",
        "unmoved",
        "settled",
        "drift",
        "nearest",
        "astray",
        "stopping",
    )
    stuck = {"stuck": ", ".join(map(str, b.stuck)), "repeats": str(REPEATS)}
    counts = {
        "agreement": AGREEMENT,
        "bridged": b.bridged,
        "held": HELD_SAMPLES,
        "most_lapses": MOST_LAPSES,
        "lapse_samples": LAPSE_SAMPLES,
        "unbelieved": b.unbelieved,
        "uncommanded": _number(b.deviation, t),
        "leaps": bool(gains_without(t).L),
        "landed_by": _landed_by(t),
    }
    return {name: _vector(getattr(b, name), t) for name in names} | stuck | counts


def _landed_by(t: Target) -> str:
    """Which of the outputs, by k, tell where they rest that a machine has landed, as a condition; "": all do.

    Where nothing is met a reading is everywhere near. Where no output meets anything those tell that rest elsewhere
    than they hover. A stroke rests anywhere.
    """
    stroke = t.believed.stroke_output if t.believed.has_stroke else -1
    met = np.isfinite(np.delete(bounds_of(t).touch, stroke) if stroke >= 0 else bounds_of(t).touch)
    conditions = [f"k != {stroke}"] if stroke >= 0 else []
    if stroke < 0 and met.any() and not met.all():
        conditions.append(f"near_touch[k] < {_number(1e17, t)}")
    if not met.any():
        conditions.append(f"is_near(sup->rest[k], {_number(0.0, t)}, k) == 0")
    return " && ".join(conditions if len(conditions) < 2 else [f"({one})" for one in conditions])


def _filters(t: Target, name: str) -> dict[str, Any]:
    """What the filter expects, and the filters that do without a sensor."""
    c, gains = t.controller, gains_without(t)
    p, places = len(c.measurements), gains.places
    programs: dict[str, Program] = {}
    if t.driven:
        programs["deviation"] = build_program(lower(current_deviations(t), t.precision))
    if c.tracks == "states":
        programs["expectation"] = build_program(lower(expected_readings(t), t.precision))
    if gains.L:
        programs["correction"] = build_program(lower(prediction_correction(t), t.precision))
    missing, blocks = np.zeros((len(places), len(c.states), p)), []
    for k in range(p):
        of = [f"    {{\n{_matrix(L, t)}\n    }}" for L in gains.L.get(k, missing)]
        blocks.append("  {\n" + ",\n".join(of) + "\n  }")
    return {
        "tracks_errors": c.tracks == "errors",
        "fallback": bool(gains.L),
        "rejoined": _place_rows(t) if gains.L else "",
        "places": len(places),
        "first_place": _number(float(places[0]), t),
        "apart": _number(float(np.ptp(places)) / max(len(places) - 1, 1), t),
        "has_gain": ", ".join(str(int(k in gains.L)) for k in range(p)),
        "gain_rows": ",\n".join(blocks),
        **{key: function_text(program, name, t.precision, static=True) for key, program in programs.items()},
    }


def _number(value: float, t: Target) -> str:
    """A limit in C; in place of none a number that nothing reaches, and whose square is a number in any precision."""
    return c_number(min(value, 1e18), t.precision)


def _vector(values: Iterable[float], t: Target) -> str:
    """Limits or gains in C."""
    return ", ".join(_number(float(v), t) for v in values)


def _matrix(rows: FloatArray, t: Target) -> str:
    """A matrix of gains in C."""
    indent = " " * 8
    lines = [
        textwrap.fill(_vector(row, t), 110, initial_indent=indent, subsequent_indent=indent) for row in rows
    ]
    return ",\n".join(f"{indent[2:]}{{\n{line}\n{indent[2:]}}}" for line in lines)


_NUMBERS = {
    "zero": 0.0,
    "one": 1.0,
    "two": 2.0,
    "three": 3.0,
    "six": 6.0,
    "twelve": 12.0,
    "half": 0.5,
    "three_halves": 1.5,
    "most": 1e30,  # of a reading that is a number
    "believed": JUMP,
    "beside": 0.1,  # share of a clearance, by which a machine is read beyond the place where it rests
    "recent_miss": 0.004,  # share of missed steps, below which the last one is some milliseconds ago
    "error_share": 1 / 8,  # of a following error in its mean
    "quarter": 0.25,  # of a leap, that noise is on average
    "apart_from_others": 4.0,  # times what others leave the filter by from sample to sample
    "lost_with_all": 1.5,  # leaps, that readings may be off the filter more than they were
    "lost_alone": 3.0,  # leaps, that they may be off a filter that does without a sensor
    "ahead": 4.0,  # in times of this mean
    "freer": FREER,
    "jump_deviations": math.sqrt(2) * JUMP,
    "mean_jump": 2 / math.sqrt(math.pi),
    "memory": 1 / MEMORY,
    "mean_share": 1 / MEAN,
    "shortest": MIN_STOP_SAMPLES,
    "quick": FADE_SAMPLES,
    "passing": MAX_OVERSHOOT,
    "most_rate": MOST_RATE,
    "sagging": SAG_SHARE,
    "gentle": 0.75,  # of the acceleration limit, with which a reference goes to its request
    "least_share": 0.25,  # the same beside the acceleration of the request
    "exceeding": 1.00001,  # times a limit, by which sums of single precision may be over it
    "rounding": 1e-5,  # of a limit, by which references of two samples may differ beyond it
    "fade_rate": 3.95,  # at least the largest second derivative of (1 - u)^3 (u + 3 u^2)
    "fade_speed": 15 / 8 / 0.75,
    "fade_acceleration": 10 / math.sqrt(3) / 0.75,
}


def _row(row: Monitor, t: Target) -> dict[str, Any]:
    """A row of the table of monitors for the template."""
    bits = sum(1 << k for k, state in enumerate(states_of(t)) if state in row.states)
    threshold = c_number(row.threshold, t.precision)
    return row._asdict() | {"threshold": threshold, "states": bits}


def off_command(t: Target) -> list[float]:
    """What is commanded for no voltage, or for no current of electronics that take set points; else nothing."""
    if t.has_set_points:
        electronics = electronics_of(t.believed, t.setup)
        if electronics is None:
            return []
        y = t.believed.h(ca.SX.zeros(len(t.believed.states)), 0)
        held = electronics.held(ca.SX.zeros(len(t.believed.actuator.coils)), y)
        return [float(v) for v in np.array(ca.evalf(ca.densify(held))).ravel()]
    if not t.driven:
        return []
    return [0.5] * len(t.current_readings) if t.fidelity == "phase" else [0.0] * len(t.current_readings)


def _records(t: Target, name: str) -> list[dict[str, Any]]:
    """The structs of the header."""
    listed = (
        ("times", "Durations in samples.", time_members()),
        ("request", "What is asked for at a sample.", request_members()),
        ("supervisor", "What the supervisor remembers.", supervisor_members(t)),
    )
    return [
        {"name": key, "meaning": meaning, "lines": [_line(member, name) for member in members]}
        for key, meaning, members in listed
    ]


def _line(member: Member, name: str) -> str:
    """A member of a struct, with its meaning."""
    kind = member.kind if member.kind == "int32_t" else f"{name}_{member.kind}"
    if member.kind in ("parameters", "calibration"):
        kind = f"const {kind} *" if member.kind == "parameters" else f"{kind} *"
    size = f"[{member.size}]" if member.size else ""
    text = f"{kind} {member.name}{size};"
    return f"{text} /* {member.meaning} */" if member.meaning else text


OFF_COMMAND = 0.5  # duty cycles of half-bridges that make no voltage
NUMBERS: dict[State, int] = {state: k for k, state in enumerate(STATES)}

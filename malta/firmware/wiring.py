"""The wiring of a machine that rests: what its sensors and currents answer to small voltages, by its own model.

The supervisor of an export with `--wiring` turns the gates on before the first lift-off, at MAX_SHARE of the force
limits at most. Each half-bridge (or coil, where the drive has the current loops) is commanded w(t) = +1 -1 -1 +1 -1
+1 +1 -1 ... by sections of a test, the signs of Thue and Morse. No polynomial of low order in t shows in it: a free
mover ends where it was, and its slow motions do not count. The answer of a signal s is the mean of w s, with w as
late as the currents. Answers are those of the machine linearized at rest on its contacts, at places of the stroke:

    x' = A x + B F i,    L i' = T(x)+ V - R i,    answers E[place][output][command]

templates/wiring.c measures them, and looks for the swaps, inversions and the place for which they are as expected.
"""

from __future__ import annotations

import math
import textwrap
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.firmware.ctext import c_number, c_numbers
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.supervisor import stars_of, touch_bounds
from malta.linear.sampling import sample
from malta.linear.system import System

MAX_SHARE = 0.04  # of the limit of a force: windings of less resistance stay below 5 %
MAX_WAY = 0.02  # share of a clearance by which a test moves the mover
MIN_RATIO = 8.0  # of an output's answers over their noise
SECTIONS, MOST_SECTIONS = 8, 64  # of a test
SHORTEST_SECTION, LONGEST_SECTION = 5, 40  # samples
MIN_PLACES, MAX_PLACES = 33, 257  # along the stroke
PLACE_ERROR = 0.03  # of answers between two places
FALL_STEP, FALL_STEPS, FALL_DAMPING = (
    5e-5,
    5000,
    300.0,
)  # s, steps and 1/s of the fall to where a machine rests
NEWTON_STEPS = 6  # from there on, and from place to place
MAX_MISTAKES = 3  # of commands and of the commutation that are looked for together
JUDGED = {
    "mistake": 0.05,  # of a fit, that a mistake has to be better by
    "tie": 0.05,  # of two fits that are as good
    "of_currents": 0.1,  # share of what the currents do not fit
    "own_first": 0.02,  # of a fit, before another output is preferred
    "least_fit": 0.3,  # below, a reading shows nothing
    "least_gain": 0.15,
    "low_gain": 0.65,
    "high_gain": 1.5,
    "least_seen": 1e-6,
    "rest_share": 0.1,  # of a clearance, by which a place of rest may differ
    "near_place": 1.6,  # places, by which the commutation may differ
    "leaks": 0.06,  # of a slow motion, that shows in an answer
    "eight": 8.0,
}
REST_ERROR = 1e-2  # m/s^2 (rad/s^2), of a machine at rest


class WiringTable(NamedTuple):
    """What is commanded, and what answers it: G places, p outputs, m commands, J tests, q currents."""

    places: FloatArray  # G, of the stroke; one of 0 for a machine without
    rest: FloatArray  # G x p, readings at rest; 0 for the stroke
    answers: FloatArray  # G x p x m, to each command alone, of size 1
    stretch: FloatArray  # J x p, times those answers in each test
    patterns: FloatArray  # J x m, of the commands
    sections: tuple[int, ...]  # J, samples of a section
    counts: tuple[int, ...]  # J, sections: a power of 2
    currents: FloatArray  # q x m, answers of the currents to each command alone; 0 x m without sensors
    swaps: tuple[
        tuple[int, int, int], ...
    ]  # blocks of commands that may be swapped: two first ones, and their length


@lru_cache(maxsize=4)
def wiring_table(t: Target) -> WiringTable:
    """The table of a target. Raises InputError for a machine that does not show its wiring at rest.

    wiring_table(Target(controller, wiring=True)).patterns
    """
    if t.has_set_points or t.fidelity == "dq":
        raise _refusal(t, "electronics that take set points", "an export down to currents")
    plant = t.believed
    plant.require_second_order("wiring")
    places, models = _places_of(t)
    middle = models[len(models) // 2]
    size = MAX_SHARE / max(float((np.abs(m.force) / _force_limits(t)[:, None]).max()) for m in models)
    singles = size * np.eye(middle.voltages)
    section = _longest_section(t, middle, singles, MAX_WAY)
    number = SECTIONS
    base, currents = _answers(t, middle, singles, section, number)
    patterns: list[FloatArray] = [singles]
    sections, counts = [section] * len(singles), [number] * len(singles)
    stretch = [np.ones((len(singles), len(base)))]
    for k in _weak_outputs(t, base, section * number):
        more = _patterns_for(t, models, k)
        long = _longest_section(t, middle, more, 2 * MAX_WAY)
        noise = _noise(t)[k] / max(
            float(np.linalg.norm(_answers(t, middle, more, long, SECTIONS)[0][k])), 1e-300
        )
        count = 2 ** math.ceil(math.log2(max((MIN_RATIO * noise) ** 2 / long, SECTIONS)))
        if count > MOST_SECTIONS:
            found = f"no answer of {plant.outputs[k].name} above its noise"
            raise _refusal(t, found, "a sensor that shows a push")
        single = _answers(t, middle, singles, long, count)[0]
        ratio = (single * base).sum(axis=1) / (base * base).sum(axis=1)
        patterns.append(more)
        sections += [long] * len(more)
        counts += [count] * len(more)
        stretch.append(np.tile(ratio, (len(more), 1)))
    answers = np.array([_answers(t, m, singles, section, number)[0] for m in models]) / size
    rest = np.array([m.rest for m in models])
    return WiringTable(
        places, rest, answers, np.vstack(stretch), np.vstack(patterns), tuple(sections), tuple(counts),
        currents / size, _swaps(t),
    )  # fmt: skip


def _refusal(t: Target, found: str, expected: str) -> InputError:
    return InputError("export", f"wiring of {t.believed.name}", found, expected)


class _Rest(NamedTuple):
    """The machine linearized where it rests at a place: states (x, i) and commands V."""

    x: FloatArray  # of the machine
    rest: FloatArray  # p, readings; 0 for the stroke
    linear: System  # to readings of outputs and currents
    force: FloatArray  # m_forces x commands, steady

    @property
    def voltages(self) -> int:
        return int(self.linear.B.shape[1])


@lru_cache(maxsize=4)
def _places_of(t: Target) -> tuple[FloatArray, list[_Rest]]:
    """So many places that answers between them are known, and the machine at each."""
    plant = t.believed
    if not (plant.has_stroke and plant.stroke.travel):
        return np.zeros(1), [_machine_at(t, 0.0, np.zeros(len(plant.states)))]
    count = MIN_PLACES
    x: FloatArray = np.zeros(len(plant.states))
    while True:
        places = np.linspace(-plant.stroke.travel, plant.stroke.travel, count)
        models = []
        for place in places:
            models.append(_machine_at(t, float(place), x))
            x = models[-1].x
        forces = np.array([m.force for m in models])
        error = np.abs(forces[1:-1] - (forces[:-2] + forces[2:]) / 2).max() / np.abs(forces).max() / 4
        if error < PLACE_ERROR:
            return places, models
        count = 2 * count - 1
        if count > MAX_PLACES:
            raise _refusal(
                t, f"forces that turn within {np.diff(places)[0]:.2g} m of the stroke", "longer poles"
            )


@lru_cache(maxsize=4)
def _functions(t: Target) -> tuple[ca.Function, ca.Function, ca.Function]:
    """x -> damped fall by FALL_STEP, the stroke clamped;  x -> rates;  x -> A, B F, C and T+."""
    plant = t.believed
    n = len(plant.states)
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", len(plant.inputs))
    rate = ca.SX(ca.vertcat(plant.f(x, u, plant.load(x) + plant.contacts.bearing(x))))
    A, B, C = ca.jacobian(rate, x), ca.jacobian(rate, u), ca.jacobian(plant.h(x, u), x)
    rest = ca.substitute(rate, u, ca.SX.zeros(u.shape))
    half = n // 2
    v = x[half:] + FALL_STEP * (rest[half:] - FALL_DAMPING * x[half:])
    if plant.has_stroke:
        v[plant.stroke_state] = 0
    fall = ca.Function("fall", [x], [ca.vertcat(x[:half] + FALL_STEP * v, v)])
    if t.driven:
        axes = ca.SX.sym("i", len(plant.drive.axes))
        force, turned = ca.jacobian(plant.drive.force(axes), axes), plant.drive.to_axes(x)
        back = plant.drive.to_phases(x)
    else:
        coils = ca.SX.sym("i", len(plant.actuator.coils))
        force = ca.substitute(
            ca.jacobian(plant.actuator.forces(x, coils), coils), coils, ca.SX.zeros(coils.shape)
        )
        turned, back = ca.SX.eye(coils.numel()), ca.SX(0, coils.numel())
    linear = ca.Function("linear", [x, u], [ca.densify(e) for e in (A, B, C, force, turned, back)])
    return fall, ca.Function("rest", [x], [rest]), linear


def _machine_at(t: Target, place: float, x: FloatArray) -> _Rest:
    """The machine that has fallen to where it rests at a place. Raises InputError where nothing carries it."""
    plant = t.believed
    fall, rate, linear = _functions(t)
    x = x.copy()
    if plant.has_stroke:
        x[plant.stroke_state] = place
    if not x.any() or len(x[x != 0]) == 1:
        x = np.array(fall.fold(FALL_STEPS)(x)).ravel()
    half, q = (
        len(x) // 2,
        [k for k in range(len(x) // 2) if k != (plant.stroke_state if plant.has_stroke else -1)],
    )
    for _ in range(NEWTON_STEPS):
        stiffness = np.array(linear(x, np.zeros(len(plant.inputs)))[0])[half:, q]
        if not np.isfinite(stiffness).all():
            break
        x[q] -= np.linalg.lstsq(stiffness, np.array(rate(x)).ravel()[half:], rcond=1e-9)[0]
        x[half:] = 0
    left = np.array(rate(x)).ravel()
    if plant.has_stroke:
        left[plant.stroke_state + len(left) // 2] = 0
    y = np.array(ca.DM(plant.h(ca.DM(x), 0))).ravel()
    if not (np.abs(left).max() < REST_ERROR and (np.abs(y) <= reading_ranges(plant)).all()):
        found = "a mover that nothing carries at rest: its contacts have no bearing"
        raise _refusal(t, found, "a machine whose model rests with its gates off")
    A, B, C, force, turned, back = (np.array(v) for v in linear(x, np.zeros(len(plant.inputs))))
    a = plant.actuator
    if t.driven:
        per = plant.drive.link_voltage * turned
        whole = np.block([[A, B @ force], [np.zeros((len(per), len(A))), -a.R / a.L * np.eye(len(per))]])
        inputs = np.vstack([np.zeros((len(A), per.shape[1])), per / a.L])
        readings = np.block([[C, np.zeros((len(C), len(per)))], [np.zeros((len(back), len(A))), back]])
        force = force @ per / a.R
    else:
        whole, inputs, readings = A, B @ force, C
    rest = y.copy()
    if plant.has_stroke:
        rest[plant.stroke_output] = 0.0
    nothing = np.zeros((len(readings), inputs.shape[1]))
    return _Rest(x, rest, System(whole, inputs, readings, nothing), force)


def _force_limits(t: Target) -> FloatArray:
    own = np.asarray(t.controller.limits.force, dtype=float)
    return np.asarray(
        np.where(np.isfinite(own), own, np.asarray(t.believed.actuator.force_limit, dtype=float))
    )


def _noise(t: Target) -> FloatArray:
    """Of a sample of each output."""
    return np.asarray(t.believed.sensors.deviations)


@lru_cache(maxsize=4)
def _ways(t: Target) -> FloatArray:
    """The way of each output to its contact, or its travel."""
    own = touch_bounds(t.believed)
    return np.where(np.isfinite(own), own, reading_ranges(t.believed))


def waves(section: int, count: int) -> FloatArray:
    """w(t) of a test of so many sections of so many samples."""
    return np.repeat([1.0 - 2.0 * (k.bit_count() % 2) for k in range(count)], section)


def lateness(t: Target) -> int:
    """Samples by which currents follow voltages: L / R. The answer is the mean of w, so much later, and s."""
    a = t.believed.actuator
    return round(float(a.L / a.R) / t.controller.sample_time) if t.driven else 0


def _flights(t: Target, m: _Rest, patterns: FloatArray, section: int, count: int) -> FloatArray:
    """Readings of a test of each pattern: samples x readings x J."""
    A, B = sample(m.linear.A, m.linear.B, t.controller.sample_time)
    X: FloatArray = np.zeros((len(A), len(patterns)))
    rows, drive = [], B @ patterns.T
    for w in (*waves(section, count).tolist(), *[0.0] * lateness(t)):
        rows.append(m.linear.C @ X)
        X = A @ X + w * drive
    return np.array(rows)


def _answers(
    t: Target, m: _Rest, patterns: FloatArray, section: int, count: int
) -> tuple[FloatArray, FloatArray]:
    """Answers of outputs and of currents to each pattern: p x J, q x J."""
    flown = _flights(t, m, patterns, section, count)[lateness(t) :]
    found = np.asarray(np.tensordot(waves(section, count), flown, 1)) / (section * count)
    return found[: len(m.rest)], found[len(m.rest) :]


def _longest_section(t: Target, m: _Rest, patterns: FloatArray, share: float) -> int:
    """The longest section, by doubling, of a test that moves no output by more than a share of its way."""
    section = SHORTEST_SECTION
    while section < LONGEST_SECTION:
        moved = np.abs(_flights(t, m, patterns, 2 * section, SECTIONS)[:, : len(m.rest)]).max(axis=(0, 2))
        if (moved > share * _ways(t)).any():
            break
        section *= 2
    return section


def _weak_outputs(t: Target, base: FloatArray, samples: int) -> list[int]:
    """Outputs whose answers to single commands are no more than noise."""
    noise = _noise(t) / np.sqrt(samples)
    return [
        k for k, row in enumerate(base) if np.linalg.norm(row) < MIN_RATIO * noise[k] * np.sqrt(base.shape[1])
    ]


def _patterns_for(t: Target, models: list[_Rest], k: int) -> FloatArray:
    """Commands at which the forces of output k act and no others do, at any place."""
    forces = np.array([m.force for m in models]) / _force_limits(t)[None, :, None]
    own = _forces_of(t, k)
    others = np.vstack([f[~own] for f in forces])
    size, modes = np.linalg.eigh(others.T @ others)
    free = modes[:, size <= 1e-9 * size[-1]].T
    wanted = np.vstack([f[own] for f in forces]) @ free.T
    power, modes = np.linalg.eigh(wanted.T @ wanted)
    found = modes[:, power > 1e-6 * max(power[-1], 1e-300)].T @ free
    sizes = [MAX_SHARE / max(float(np.abs(f @ row).max()) for f in forces) for row in found]
    return np.array([size * row for size, row in zip(sizes, found, strict=True)])


def _forces_of(t: Target, k: int) -> Any:
    """Whether each force moves output k: by the law's model, more than it moves others."""
    c = t.controller
    gain = np.abs(c.C @ c.A @ c.B)
    return np.asarray(gain[k] > 0.1 * gain[k].max())


def _swaps(t: Target) -> tuple[tuple[int, int, int], ...]:
    """Pairs of blocks of commands: modules, stars, and single ones."""
    count = len(t.current_readings) if t.driven else len(t.believed.actuator.coils)
    blocks: list[list[tuple[int, ...]]] = []
    if t.driven:
        drive = t.believed.drive
        T = np.abs(np.array(ca.DM(drive.to_phases(ca.DM(t.believed.at().x)))))
        blocks.append(
            [tuple(np.flatnonzero(T[:, list(g)].sum(axis=1) > 1e-9).tolist()) for g in drive.groups]
        )
        blocks.append([tuple(star) for star in stars_of(t)])
    blocks.append([(k,) for k in range(count)])
    return tuple(
        (a[0], b[0], len(a))
        for level in blocks
        for a, b in combinations(level, 2)
        if len(a) == len(b) and all(np.all(np.diff(one) == 1) for one in (a, b))
    )


def wiring_members(t: Target) -> list[tuple[Any, str, int, str]]:
    """What a supervisor remembers of its wiring, as Member: kind, name, size, meaning."""
    w = wiring_table(t)
    (J, m), p, q = w.patterns.shape, len(t.controller.measurements), len(w.currents)
    listed: list[tuple[Any, str, int, str]] = [
        ("int32_t", "test", 0, "of the wiring, under way"),
        ("int32_t", "moment", 0, "samples since it began"),
        ("int32_t", "tried", 0, "hypotheses on the wiring"),
        ("int32_t", "level", 0, "mistakes that were accepted"),
        ("int32_t", "best", 0, "hypothesis"),
        ("int32_t", "rival", 0, "another one as good, or -1"),
        ("int32_t", "doubt", 0, "the same of the first mistake"),
        ("int32_t", "coil", m, "that each command drives, from 0 on"),
        ("int32_t", "turned", m, "-1 where it is inverted"),
        ("int32_t", "shows", p, "output of each reading, from 1 on; < 0: inverted; 0: none"),
        ("int32_t", "shows_else", p, "the same without the first mistake of commands"),
        ("int32_t", "cables", 0, "1: sensors of currents are swapped with what they read"),
        ("int32_t", "reads", max(q, 1), "current of each sensor, as shows"),
        ("real", "gain", p, "of each reading"),
        ("real", "read", 0, "place that is read"),
        ("real", "at", 0, "place for which currents are commutated"),
        ("real", "misfit", 0, "of what is accepted"),
        ("real", "least", 0, "of the best hypothesis"),
        ("real", "scale", 2, "currents over those expected, in short and in long tests"),
        ("real", "answer", J * p, "of each reading to each test"),
        ("real", "wander", J * p, "its mean way"),
    ]
    if q:
        listed.append(("real", "carried", J * q, "A, answers of the currents"))
    return listed


def wiring_context(t: Target) -> dict[str, Any]:
    """What wiring.c is filled with; `wiring` alone where it is left out."""
    if not t.wiring:
        return {"wiring": False}
    w, n = wiring_table(t), t.precision
    lengths = [section * count for section, count in zip(w.sections, w.counts, strict=True)]
    singles, swaps = w.patterns.shape[1], w.swaps or ((0, 0, 0),)  # C has no arrays without entries
    usual = _usual_currents(t, w)

    def rows(values: FloatArray) -> str:
        return ",\n".join(
            textwrap.fill(f"{{ {c_numbers(v, n)} }}", 118, initial_indent="  ", subsequent_indent="    ")
            for v in values
        )

    return {
        "wiring": True,
        "wiring_share": f"{100 * MAX_SHARE:g}",
        "tests": len(w.patterns),
        "commands": singles,
        "commanded": "command" if t.driven else "current",
        "answer_places": len(w.places),
        "last_place": c_number(float(len(w.places) - 1), n),
        "first_answer": c_number(float(w.places[0]), n),
        "answers_apart": c_number(float(np.diff(w.places)[0]) if len(w.places) > 1 else 1.0, n),
        "pattern_rows": rows(w.patterns),
        "sections": ", ".join(map(str, w.sections)),
        "late": lateness(t),
        "lengths": ", ".join(map(str, lengths)),
        "roots": c_numbers(np.sqrt(lengths), n),
        "stretch_rows": rows(w.stretch),
        "answer_rows": ",\n".join(f"  {{\n{rows(a)}\n  }}" for a in w.answers),
        "rest_rows": rows(w.rest),
        "ways": c_numbers(_ways(t), n),
        "noises": c_numbers(np.maximum(_noise(t), 1e-6 * _ways(t)), n),
        "swaps": swaps,
        "swap_rows": ", ".join(f"{{ {a}, {b}, {c} }}" for a, b, c in swaps),
        "current_rows": rows(w.currents),
        "current_squares": c_numbers(usual, n),
        "levels": MAX_MISTAKES,
        **{key: c_number(value, n) for key, value in JUDGED.items()},
    }


def _usual_currents(t: Target, w: WiringTable) -> list[float]:
    """Sums of squares of the answers of the currents, of short tests and of long ones."""
    if not len(w.currents):
        return [0.0, 0.0]
    m, sums = w.patterns.shape[1], [0.0, 0.0]
    middle = _places_of(t)[1][len(w.places) // 2]
    for j, test in enumerate(zip(w.patterns, w.sections, w.counts, strict=True)):
        found = _answers(t, middle, test[0][None], *test[1:])[1]
        sums[j >= m] += float((found**2).sum())
    return sums

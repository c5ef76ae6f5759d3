"""What a law shall reach, each as a number that shall be at most 1, with its exact derivative.

    sensitivity    max |S| of each channel / limit          gain_limit   max sigma(W G) / limit
    disk_margin    least * max |S - 1/2| of each channel    noise_limit  rms of outputs under white noise / limit
    tracking       max |S| / (peak s + w steady) / (s + w)  poles        decay, damping and speed of all poles

A hard goal bounds the search; the largest of the others is made as small as these allow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.display import display
from malta.errors import InputError
from malta.linear.conversion import from_control
from malta.linear.interconnection import append, series
from malta.linear.peaks import response_at
from malta.linear.system import System
from malta.structured.loops import ClosedLoop, LawPorts, Pole, gain_slope, noise, peaks_of
from malta.synthesis.elements import CALLER

At = Literal["sensors", "forces"]
WATCHED_POLES = 6  # poles of a group that a search looks at
FIELD = {"sensors": ("reference", "error"), "forces": ("load", "acting")}


class GoalFigure(NamedTuple):
    """One number of a loop: what it is of, its value over its bound, and the derivative by [D C; B A] of the law."""

    goal: str
    channel: str
    w: float  # rad/s, of a peak or a pole; NaN of others
    value: float
    slope: FloatArray


@display
@dataclass(frozen=True, eq=False)
class Goal:
    """A goal of a search.

    name : of the goal
    figures : a stable closed loop -> its figures, which shall be at most 1
    hard : whether it bounds the search; else it is made small
    unit : what the figure 1 stands for, in words
    peak : of a sensitivity: its bound, and where it is measured

    >>> from malta import structured
    >>> goal = structured.sensitivity(2.0)
    >>> goal.name, goal.hard, goal.peak
    ('sensitivity 2', True, (2.0, 'sensors'))
    """

    name: str
    figures: Callable[[ClosedLoop], list[GoalFigure]]
    hard: bool = True
    unit: str = ""
    peak: tuple[float, At] | None = None


def soft(goal: Goal) -> Goal:
    """The same goal, which is made as small as hard ones allow.

    goal : a hard one

    >>> from malta import structured
    >>> structured.soft(structured.sensitivity(2.0)).hard
    False
    """
    return replace(goal, hard=False)


def sensitivity(peak: float, *, at: At = "sensors", channels: Sequence[str] | None = None) -> Goal:
    """Bound |S| of each channel by itself, the others closed, at all frequencies.

    peak : above 1, since the mean of log |S| is not negative
    at : "sensors" or "forces"
    channels : names; None: all

    Raises InputError for a peak that no loop has.

    >>> from malta import structured
    >>> structured.sensitivity(2.0).name
    'sensitivity 2'
    """
    if not peak > 1:
        raise InputError(CALLER, "sensitivity", f"{peak}", "a peak above 1: Bode's integral allows no other")
    made = partial(_each_channel, name := f"sensitivity {peak:g}", at, channels, 1 / peak, 0.0)
    return Goal(name, made, unit=f"|S| = {peak:g}", peak=(peak, at))


def disk_margin(least: float, *, at: At = "sensors", channels: Sequence[str] | None = None) -> Goal:
    """The disk margin of each channel, without skew, at least this: alpha = 1 / max |S - 1/2|.

    least : between 0 and 2; the gain may change by (2 + alpha) / (2 - alpha) either way
    at, channels : as in `sensitivity`

    Raises InputError for a margin that no loop has.

    >>> from malta import structured
    >>> structured.disk_margin(0.8).unit
    'alpha = 0.8'
    """
    if not 0 < least < 2:
        raise InputError(CALLER, "disk_margin", f"{least}", "a margin between 0 and 2")
    made = partial(_each_channel, name := f"disk margin {least:g}", at, channels, least, 0.5)
    return Goal(name, made, unit=f"alpha = {least:g}")


def gain_limit(
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    limit: float,
    *,
    weight: Any = None,
    name: str = "",
) -> Goal:
    """The largest singular value between signals at most a limit, at all frequencies.

    inputs : "reference x1", "load fx_B1" (on a force), "disturbance F_x"; "load" alone for all of them
    outputs : "error x1", "output x1", "force fx_B1" (of the law), "acting fx_B1" (with the load)
    limit : in units of the outputs over those of the inputs
    weight : W of W G: a stable proper control system with one input; None: 1. Of a sampled loop it is sampled by
        Tustin's rule
    name : of the goal; "": of its signals

    Raises InputError for a limit that is not above 0, and for other weights.

    >>> from malta import structured
    >>> structured.gain_limit("load", "output", 1e-4, name="stiffness").name
    'stiffness'
    """
    _require_positive("gain_limit", limit)
    W = None if weight is None else _weight_of(weight)
    title = name or f"gain {inputs} -> {outputs}"
    return Goal(title, partial(_gain, title, inputs, outputs, 1 / limit, W), unit=f"gain {limit:g}")


def tracking(
    time: float, *, peak: float = 1.5, steady: float = 1e-3, channels: Sequence[str] | None = None
) -> Goal:
    """Bound |S| of each channel by (peak s + w steady) / (s + w) at s = jw, so that slow references are followed.

    time : s, of the answer, 2 / w
    peak : of |S| far above w
    steady : |S| at rest, above 0
    channels : names of outputs; None: all

    Raises InputError for numbers that are not above 0.

    >>> from malta import structured
    >>> structured.tracking(0.05).unit
    '2 / w = 0.05 s'
    """
    for one in (time, peak, steady):
        _require_positive("tracking", one)
    w = 2 / time
    W = _first_order(-w * steady / peak, 1.0, w / peak - w * steady / peak**2, 1 / peak)
    made = partial(_each_channel, name := f"tracking {time:g} s", "sensors", channels, 1.0, 0.0, W=W)
    return Goal(name, made, unit=f"2 / w = {time:g} s")


def noise_limit(
    levels: Mapping[str, float], outputs: str | Sequence[str], limit: float, *, name: str = ""
) -> Goal:
    """The rms of outputs under white noise at most a limit; of several outputs the root of the sum of squares.

    levels : of inputs, as {"reference x1": 1e-7, "load": 0.5}: standard deviations of a sample of a sampled loop, the
        roots of spectral densities of a continuous one. Noise of a sensor enters as a reference does
    outputs : as in `gain_limit`
    limit : in their unit
    name : of the goal; "": of its signals

    Raises InputError for levels and limits that are not above 0.

    >>> from malta import structured
    >>> structured.noise_limit({"reference": 1e-7}, "force", 0.5).unit
    'rms 0.5'
    """
    for value in (limit, *levels.values()):
        _require_positive("noise_limit", value)
    title = name or f"noise {' '.join(levels)} -> {outputs}"
    return Goal(title, partial(_noise, title, dict(levels), outputs, limit), unit=f"rms {limit:g}")


def poles(decay: float = 0.0, damping: float = 0.0, fastest: float = math.inf) -> Goal:
    """All poles of the closed loop: Re at most -decay, damping ratio at least this, size at most `fastest`.

    decay : 1/s
    damping : 0 to 1
    fastest : rad/s

    Raises InputError for numbers out of these, and for none.

    >>> from malta import structured
    >>> structured.poles(decay=10.0).name
    'poles'
    """
    expected = "a decay above 0, a damping below 1, or poles faster than the decay"
    bounds = _PoleBounds(decay, damping, fastest)
    bounds.require("poles", expected, some=True)
    return Goal("poles", partial(_poles, bounds), unit=bounds.words)


def stable_law(decay: float = 0.0, damping: float = 0.0, fastest: float = math.inf) -> Goal:
    """The law itself is stable, integrals aside: its own poles, with the loop open, as `poles` has those of the loop.

    A law with a pole in the right half plane holds the loop, and runs away where an input saturates or a sensor fails.
    Integrals, poles at 0 that no parameter moves, are left out.

    decay, damping, fastest : of all other poles, as in `poles`

    Raises InputError as `poles`.

    >>> from malta import structured
    >>> structured.stable_law(fastest=1e4).unit
    'stable, up to 10000 rad/s'
    """
    bounds = _PoleBounds(decay, damping, fastest)
    bounds.require("stable_law", "0 or more, 0 to 1, and poles faster than the decay")
    made = partial(_law_poles, bounds)
    return Goal("stable law", made, unit=", ".join(filter(None, ["stable", bounds.words])))


class _PoleBounds(NamedTuple):
    """What is asked of all poles: 1/s, a ratio, rad/s."""

    decay: float
    damping: float
    fastest: float

    def require(self, goal: str, expected: str, *, some: bool = False) -> None:
        """Raise InputError for numbers that no poles have, and, where `some` is asked for, for no bound at all."""
        decay, damping, fastest = self
        possible = decay >= 0 and 0 <= damping < 1 and fastest > decay
        if not possible or (some and self == (0, 0, math.inf)):
            raise InputError(CALLER, goal, f"decay {decay}, damping {damping}, fastest {fastest}", expected)

    @property
    def words(self) -> str:
        parts = [f"decay {self.decay:g} 1/s"] * (self.decay > 0)
        parts += [f"damping {self.damping:g}"] * (self.damping > 0)
        return ", ".join(parts + [f"up to {self.fastest:g} rad/s"] * math.isfinite(self.fastest))


def _require_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(CALLER, name, f"{value}", "a number above 0")


def _weight_of(weight: Any) -> System:
    """A stable proper weight with one input and one output."""
    wanted = "a proper control system with one input and one output"
    found = from_control(weight, CALLER, "weight", expected=wanted)
    if found.D.shape != (1, 1) or not found.stable:
        raise InputError(
            CALLER, "weight", "an unstable one or one of several signals", "a stable one of one signal"
        )
    return found


def _first_order(a: float, b: float, c: float, d: float) -> System:
    return System(np.array([[a]]), np.array([[b]]), np.array([[c]]), np.array([[d]]))


def _weight(system: System, W: System) -> System:
    """W behind each output."""
    return series(system, append(*[W] * len(system.D)))


def _figures_of(
    loop: ClosedLoop,
    found: tuple[System, LawPorts],
    factor: float,
    shift: float,
    W: System | None,
    of: tuple[str, str],
) -> list[GoalFigure]:
    """The peaks of factor W (G - shift)."""
    system, by = found
    shifted = replace(system, D=system.D - shift * np.eye(*system.D.shape))
    figures = []
    for peak in peaks_of(shifted if W is None else _weight(shifted, W)):
        at = 1.0 if W is None else complex(response_at(W, np.array([peak.w]))[0, 0, 0])
        slope = factor * gain_slope(shifted, by, peak, at)
        figures.append(GoalFigure(*of, peak.w, factor * peak.value, loop.slope(slope)))
    return figures


def _each_channel(
    goal: str, at: At, channels: Sequence[str] | None, factor: float, shift: float, loop: ClosedLoop,
    W: System | None = None,
) -> list[GoalFigure]:  # fmt: skip
    into, out = FIELD[at]
    names = (loop.model.outputs if at == "sensors" else loop.model.inputs) if channels is None else channels
    return [
        figure
        for name in names
        for figure in _figures_of(
            loop,
            loop.part(loop.rows(f"{out} {name}"), loop.columns(f"{into} {name}")),
            factor,
            shift,
            W,
            (goal, name),
        )
    ]


def _gain(
    goal: str, inputs: Any, outputs: Any, factor: float, W: System | None, loop: ClosedLoop
) -> list[GoalFigure]:
    part = loop.part(loop.rows(outputs), loop.columns(inputs))
    return _figures_of(loop, part, factor, 0.0, W, (goal, ""))


def _noise(
    goal: str, levels: Mapping[str, float], outputs: Any, limit: float, loop: ClosedLoop
) -> list[GoalFigure]:
    """Of a sampled loop the sum over samples is the integral over w of |G|^2 T / (1 + (w T/2)^2)."""
    columns = [(k, level) for signal, level in levels.items() for k in loop.columns(signal)]
    size = np.array([level for _, level in columns])
    system, by = loop.part(loop.rows(outputs), [k for k, _ in columns])
    system, by = replace(system, B=system.B * size, D=system.D * size), by._replace(D21=by.D21 * size)
    T = loop.model.sample_time
    if T is not None:
        k = len(system.D)
        system = _weight(system, _first_order(-2 / T, 1.0, 2 / math.sqrt(T), 0.0))
        wide = np.zeros((k, by.B2.shape[1]))
        by = LawPorts(np.vstack([by.B2, by.D12]), np.hstack([by.C2, np.zeros((len(by.C2), k))]), wide, by.D21)
    value, slope = noise(system, by)
    assert slope is not None
    return [GoalFigure(goal, "", math.nan, value / limit, loop.slope(slope / limit))]


def _poles(asked: _PoleBounds, loop: ClosedLoop) -> list[GoalFigure]:
    found = _pole_figures(asked, loop.poles(), loop.model.sample_time, damped=asked.damping > 0)
    return [GoalFigure("poles", kind, size, value, loop.slope(slope)) for kind, size, value, slope in found]


def _law_poles(asked: _PoleBounds, loop: ClosedLoop) -> list[GoalFigure]:
    found = _pole_figures(asked, loop.law_poles(), loop.model.sample_time, damped=True)
    return [GoalFigure("stable law", *figure) for figure in found]


def _pole_figures(
    asked: _PoleBounds, poles_: Sequence[Pole], T: float | None, *, damped: bool
) -> list[tuple[str, float, float, FloatArray]]:
    """Figures that are 1 at the bound: decay / -Re would jump at 0, so a difference over the decay counts."""
    found = []
    decay, damping, fastest = asked
    for pole in poles_:
        s, slope = pole.value, pole.slope
        if T is not None:  # the pole ln(z) / T that the sampled loop has
            half = s * T / 2
            if abs(1 - half) < 1e-9 or abs(1 + half) < 1e-6:  # pure delay
                continue
            s, slope = np.log((1 + half) / (1 - half)) / T, slope / (1 - half**2)
        size = abs(s)
        if size == 0:
            continue
        grown = (np.conj(s) * slope).real / size  # of |s|
        if decay:
            found.append(("decay", size, 2 + s.real / decay, slope.real / decay))
        if damped:
            ratio, by = -s.real / size, -slope.real / size + s.real * grown / size**2
            found.append(("damping", size, 1 + damping - ratio, -by))
        if math.isfinite(fastest):
            found.append(("fastest", size, size / fastest, grown / fastest))
    top = max((f[2] for f in found), default=0.0)
    return [f for f in found if f[2] >= min(top, 0.5)]


def stability(loop: ClosedLoop, rate: float) -> list[GoalFigure]:
    """1 + Re(pole) / rate of the slowest poles: below 1 where the loop is stable."""
    return [
        GoalFigure(
            "stability", "", abs(pole.value), 1 + pole.value.real / rate, loop.slope(pole.slope.real / rate)
        )
        for pole in loop.poles(WATCHED_POLES)
    ]

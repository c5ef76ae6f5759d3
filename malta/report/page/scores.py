"""Figures of merit of a loop: identifiers with units, words, and which way is better. One table of meanings.

Headlines of reports, columns of comparisons and their JSON documents take their figures from here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from malta.identifiers import distinct, identifier
from malta.loops.recovery import furthest
from malta.margins.verify import BANDWIDTHS
from malta.model.signals import FINE
from malta.report.figures.parts import UNITS, micro, number
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.report.page.analysis import Analysis

Better = Literal["high", "low", ""]  # "": neither
Scope = Literal[
    "loop", "box", "machine"
]  # what two designs share for a comparison of the figure to make sense
PLAIN = (1e-2, 1e6)  # sizes of numbers that are written without a power of ten
ROOTS = ("m s^0.5", "rad s^0.5")  # units of load errors, which are no products of whole powers


class Meaning(NamedTuple):
    """What a kind of figures is."""

    group: str
    better: Better
    scope: Scope
    unit: str = "1"  # for display


MEANINGS: dict[str, Meaning] = {
    "stable": Meaning("stability and margins", "high", "loop"),
    "margin_proven": Meaning("stability and margins", "high", "box", "percent"),
    "margin_lost_at": Meaning("stability and margins", "high", "box", "percent"),
    "disk": Meaning("stability and margins", "high", "loop"),
    "disk_of": Meaning("stability and margins", "high", "machine"),
    "delay_margin": Meaning("stability and margins", "high", "loop", "us"),
    "mass_margin": Meaning("stability and margins", "high", "machine", "kg"),
    "payload": Meaning("stability and margins", "high", "machine", "kg"),
    "peak_s": Meaning("sensitivity", "low", "loop"),
    "peak_s_of": Meaning("sensitivity", "low", "machine"),
    "peak_t": Meaning("sensitivity", "low", "loop"),
    "bandwidth": Meaning("bandwidth and poles", "high", "loop", "rad/s"),
    "natural": Meaning("bandwidth and poles", "", "loop", "rad/s"),
    "slowest_pole": Meaning("bandwidth and poles", "high", "loop", "rad/s"),
    "damping": Meaning("bandwidth and poles", "high", "loop"),
    "motion": Meaning("noise at rest", "low", "machine"),
    "command": Meaning("noise at rest", "low", "machine"),
    "load_moves": Meaning("a constant load from outside", "low", "machine"),
    "load_settles": Meaning("a constant load from outside", "low", "machine", "s"),
    "compliance": Meaning("a constant load from outside", "low", "machine"),
    "job_lower": Meaning("main job", "low", "machine"),
    "job_higher": Meaning("main job", "high", "machine"),
    "job": Meaning("main job", "", "machine"),
    "requirements": Meaning("requirements", "high", "machine"),
    "undecided": Meaning("requirements", "", "machine"),
    "at_most": Meaning("requirements", "low", "machine"),
    "at_least": Meaning("requirements", "high", "machine"),
}
# Words in the names of the experiments' figures of merit.
HIGHER = re.compile(
    r"payload|carried|efficiency|stiffness|inside the clearance|lowest|smallest stair|slow landings"
)
NEITHER = re.compile(
    r"reference|over fastest|^moved$|its speed|thrust per|drive constant|fitted|largest stair"
)


class Score(NamedTuple):
    """A figure of merit of a design."""

    kind: str  # of MEANINGS
    key: str  # identifier with its unit
    label: str
    value: float  # SI
    unit: str  # for display
    factor: float  # from SI to it
    signal: str = ""  # in the label, of a figure that each signal has

    @property
    def meaning(self) -> Meaning:
        """What figures of this kind are."""
        return MEANINGS[self.kind]

    @property
    def text(self) -> str:
        """The value in its unit, with four digits."""
        if self.kind == "stable":
            return "yes" if self.value else "NO"
        if math.isnan(self.value):
            return "none"
        if math.isinf(self.value):
            return "any"
        return four_digits(self.factor * self.value)

    @property
    def heading(self) -> str:
        """The label with the unit in brackets."""
        shown = {"percent": "%", "1": ""}.get(self.unit, micro(self.unit))
        return f"{self.label} [{shown}]" if shown else self.label


def four_digits(value: float) -> str:
    """A number with four digits; far from one with its power of ten.

    >>> four_digits(0.5), four_digits(4.7e-7)
    ('0.5000', '4.7e-07')
    """
    rounded = float(f"{value:.4g}")
    return number(rounded) if PLAIN[0] <= abs(value) < PLAIN[1] or not value else f"{rounded:g}"


def scores_of(found: Analysis) -> list[Score]:
    """List the figures of merit of a loop, in the order of their groups."""
    parts = (_margins, _sensitivities, _bandwidths, _noise, _loads, _job, _requirements)
    scores = [score for part in parts for score in part(found)]
    return [s._replace(key=key) for s, key in zip(scores, distinct(s.key for s in scores), strict=True)]


def _score(kind: str, name: str, label: str, value: float, unit: str = "", signal: str = "") -> Score:
    """The figure of a kind: `name` is its key without a unit; `unit` for display, if not that of its kind."""
    unit = unit or MEANINGS[kind].unit
    factor, shown = UNITS[unit] if unit in ROOTS else (in_unit(1.0, unit), unit)
    return Score(kind, identifier(name, unit), label, float(value), shown, factor, signal)


def _margins(a: Analysis) -> Iterator[Score]:
    yield _score("stable", "stable", "stable on the machine", float(a.margins.stable))
    if a.margin is not None:
        where = f", {a.margins.extent}" if str(a.margins.extent) else ""
        yield _score(
            "margin_proven", "margin_proven", f"margin of parameters, proven{where}", a.margin.lower or 0.0
        )
        yield _score("margin_lost_at", "margin_lost_at", "lost at", a.margin.upper)
    classical = a.classical
    if classical is None:
        return
    for disk in classical.disks:
        signal = disk.channels.removesuffix(" alone") if disk.channels.endswith(" alone") else ""
        words = f"disk margin, {disk.channels}"
        kind = "disk_of" if signal else "disk"
        yield _score(kind, f"disk_margin {disk.channels}", words, disk.size, signal=signal)
    smallest = min(classical.delay.values())
    yield _score("delay_margin", "delay_margin", "delay margin, smallest", smallest)
    if a.robust is not None and a.robust.mass is not None and a.margin is not None:
        yield _score("mass_margin", "mass_margin", "mass margin, linear loop", a.robust.mass.lower or 0.0)
    if a.payload is not None:
        yield _score("payload", "payload_held", "payload held at rest", a.payload.held)
        if not math.isnan(a.payload.carried):
            yield _score("payload", "payload_carried", "payload in flight", a.payload.carried)


def _sensitivities(a: Analysis) -> Iterator[Score]:
    peaks = a.margins.peak_sensitivity
    sensors = {name: peak for name, peak in peaks.items() if name != "sigma_max"}
    worst = max(sensors.values()) if a.margins.stable else math.nan
    yield _score("peak_s", "peak_sensitivity", "peak |S| of the worst sensor", worst)
    yield _score("peak_s", "peak_sensitivity_sigma_max", "peak sigma_max(S)", peaks["sigma_max"])
    for name, peak in sensors.items():
        yield _score("peak_s_of", f"peak_sensitivity {name}", f"peak |S| at {name}", peak, signal=name)
    if a.classical is not None:
        largest = max(gang[1] for gang in a.classical.gang.values())
        yield _score("peak_t", "peak_complementary", "peak |T| of the worst sensor", largest)


def _bandwidths(a: Analysis) -> Iterator[Score]:
    for key, value in a.margins.bandwidth.items():
        kind = "natural" if key.startswith("w_n") else "bandwidth"
        yield _score(kind, f"bandwidth_{key}", BANDWIDTHS[key], value)
    poles = a.margins.poles.closed_loop
    if len(poles) and a.margins.stable:
        yield _score("slowest_pole", "slowest_pole", "decay of the slowest pole", -poles.real.max())
        damping = -poles.real / np.maximum(np.abs(poles), 1e-300)
        yield _score("damping", "smallest_damping", "smallest damping ratio", damping.min())


def _noise(a: Analysis) -> Iterator[Score]:
    if a.noise is None:
        return
    for signal, value in zip(a.plant.outputs, a.noise.motion, strict=True):
        fine, words = FINE.get(signal.unit, signal.unit), f"motion {signal.name}, rms"
        yield _score("motion", f"motion {signal.name} rms", words, value, fine, signal.name)
    for signal, value in zip(a.plant.inputs, a.noise.force, strict=True):
        words = f"command {signal.name}, rms"
        yield _score("command", f"command {signal.name} rms", words, value, signal.unit, signal.name)


def _loads(a: Analysis) -> Iterator[Score]:
    units = {s.name: s.unit for s in a.plant.disturbances}
    for load, output in furthest(a.recovered):
        fine, name = FINE.get(output.unit, output.unit), f"load {load.name}"
        size = f"1 {units[load.name]} {load.name}".replace("1 1 ", "1 ")
        settled = f"{size}: within 1 % after"
        peak = f"{size}: largest over frequency"
        moved = f"{size}: largest deviation"
        yield _score("load_moves", f"{name} largest", moved, output.largest, fine, load.name)
        yield _score("load_settles", f"{name} settles", settled, output.settled, signal=load.name)
        yield _score("compliance", f"{name} compliance", peak, output.compliance, fine, load.name)


def _job(a: Analysis) -> Iterator[Score]:
    if a.job is None:
        return
    several = len(a.job.cases) > 1
    rows = [("", merit) for merit in a.job.merits]
    if several and [m.label for m in a.job.merits] == [m.label for m in a.job.cases[0].merits]:
        rows = [(case.label, merit) for case in a.job.cases for merit in case.merits]
    completed = float(np.mean([case.run.verdict.completed for case in a.job.cases]))
    yield _score(
        "job_higher", f"{a.job.name} completed", f"{a.job.name}: runs completed", completed, "percent"
    )
    for case, merit in rows:
        kind = "job_lower"
        if NEITHER.search(merit.label):
            kind = "job"
        elif HIGHER.search(merit.label):
            kind = "job_higher"
        label = f"{case}: {merit.label}" if case else merit.label
        name = f"{a.job.name} {case} {merit.key or merit.label}"
        yield _score(kind, name, label, merit.value, merit.unit)


def _requirements(a: Analysis) -> Iterator[Score]:
    asked = [one for one in a.outcomes if one.asked is not None]
    if asked:
        kept = sum(one.holds for one in asked) / len(asked)
        yield _score("requirements", "requirements_held", "requirements held", kept, "percent")
        undecided = sum(one.verdict == "undecided" for one in asked) / len(asked)
        if undecided:
            yield _score(
                "undecided", "requirements_undecided", "requirements undecided", undecided, "percent"
            )
    for one in a.outcomes:
        more = f" {one.how}" if sum(other.name == one.name for other in a.outcomes) > 1 else ""
        words = requirement_words(one.name) + (f", {one.how}" if more else "")
        unit = FINE.get(one.unit, one.unit)
        kind = "at_least" if one.at_least else "at_most"
        yield _score(kind, f"requirement {one.name}{more}", words, one.found, unit)


def requirement_words(name: str) -> str:
    """A requirement in words, with the name of its signal or load as it is: "peak sensitivity", "recovery F_x left"."""
    base, space, rest = name.partition(" ")
    return base.replace("_", " ") + space + rest


def best_of(scores: Sequence[Score | None]) -> tuple[bool, ...]:
    """Which designs are better than some other: those that share the best value, none where all are as good.

    Values that are written with the same digits are as good as each other.
    """
    known = [score for score in scores if score is not None and not math.isnan(score.value)]
    if len(known) < 2 or not known[0].meaning.better:
        return tuple(False for _ in scores)
    pick = max if known[0].meaning.better == "high" else min
    best = pick(known, key=lambda score: score.value).text
    if all(score.text == best for score in known):
        return tuple(False for _ in scores)
    return tuple(score is not None and score.text == best for score in scores)

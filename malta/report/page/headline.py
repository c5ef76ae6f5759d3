"""The top of a report: its key figures, and what the design is in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.margins.figures import BANDWIDTHS, zone
from malta.model.signals import FINE
from malta.report.figures.parts import merit_phrase, micro, number
from malta.report.page.design import kind_of
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.report.page.analysis import Analysis

MERITS = 3  # of the main job, on the first screen


class KeyFigure(NamedTuple):
    """A figure that a reader looks for first."""

    label: str
    value: str
    note: str = ""
    state: str = ""  # "good", "near", "bad" or ""


def key_figures(a: Analysis) -> list[KeyFigure]:
    """List the figures that a reader looks for first: stability, margin, peak |S|, bandwidth, noise, main job."""
    parts = (_stability, _margin, _peak, _bandwidth, _noise, _job, _requirements)
    return [figure for part in parts for figure in part(a)]


def _stability(a: Analysis) -> Iterator[KeyFigure]:
    stable = a.report.stable
    largest = a.report.stages[-1].spectral_radius
    note = "with hold, delay and current loops" if stable else f"a pole at |λ| = {largest:.6f}"
    yield KeyFigure("Loop", "stable" if stable else "UNSTABLE", note, "good" if stable else "bad")


def _margin(a: Analysis) -> Iterator[KeyFigure]:
    label, margin = "Margin of the parameters", a.report.robust
    if not a.subject.box:
        yield KeyFigure(label, "not asked", "the gain file names no uncertain parameters")
    elif not a.report.stable:
        yield KeyFigure(label, "none", "the loop is unstable already", "bad")
    elif margin is None:
        yield KeyFigure(label, "not proven", "left out by --no-proof")
    elif margin.lower is None:
        yield KeyFigure(label, "nothing proven", margin.reason, "bad")
    else:
        box = ", ".join(f"{name} ±{100 * share:g} %" for name, share in a.subject.box.items())
        state = "good" if margin.lower >= 1 else "bad"
        where = f" {a.report.extent}" if str(a.report.extent) else ""
        more = "at least " if margin.exhausted else ""
        yield KeyFigure("Proven margin", f"{more}{100 * margin.lower:.1f} %", f"of {box}{where}", state)


def _peak(a: Analysis) -> Iterator[KeyFigure]:
    if not a.report.stable:
        return
    peaks = {name: peak for name, peak in a.report.peak_sensitivity.items() if name != "sigma_max"}
    name = max(peaks, key=lambda sensor: peaks[sensor])
    found = zone(peaks[name])
    state = {"A": "good", "B": "near"}.get(found, "bad")
    note = f"zone {found} of ISO 14839-3, worst at {name}"
    yield KeyFigure("Peak |S|", f"{peaks[name]:.2f}", note, state)


def _bandwidth(a: Analysis) -> Iterator[KeyFigure]:
    key = "sigma_max_T"
    value = a.report.bandwidth.get(key, math.nan)
    if math.isfinite(value):
        note = f"{number(value)} rad/s, {BANDWIDTHS[key]}"
        yield KeyFigure("Bandwidth", f"{number(value / (2 * math.pi), 3)} Hz", note)


def _noise(a: Analysis) -> Iterator[KeyFigure]:
    noise = a.report.noise
    if noise is None or not (np.any(noise.motion) or np.any(noise.force)):
        return
    for values, signals, label in (
        (noise.motion, a.plant.outputs, "Motion at rest"),
        (noise.force, a.plant.inputs, "Commands at rest"),
    ):
        largest: dict[str, tuple[float, str]] = {}  # by unit
        for signal, value in zip(signals, values.tolist(), strict=True):
            largest[signal.unit] = max(largest.get(signal.unit, (0.0, "")), (value, signal.name))
        texts = []
        for unit, (value, _) in largest.items():
            fine = FINE.get(unit, unit)
            shown = "" if fine == "1" else f" {micro(fine)}"
            texts.append(f"{number(in_unit(value, fine), 3)}{shown}")
        names = ", ".join(name for _, name in largest.values())
        yield KeyFigure(label, " · ".join(texts), f"rms of the worst: {names}")


def _job(a: Analysis) -> Iterator[KeyFigure]:
    if a.job is None:
        return
    outcome, label = a.job.outcome, a.job.name.replace("-", " ").replace("_", " ").capitalize()
    state = "bad" if a.job.failed else "good"
    short = "completed" if not a.job.failed else outcome
    fidelity = f"simulated, fidelity {a.job.run.scenario.fidelity}"
    yield KeyFigure(label, short, outcome if short != outcome and a.job.failed else fidelity, state)
    for merit in a.job.merits[:MERITS]:
        if math.isfinite(merit.value) and not a.job.failed:
            yield KeyFigure(merit.label.capitalize(), merit_phrase(merit), label.lower())


def _requirements(a: Analysis) -> Iterator[KeyFigure]:
    asked = [one for one in a.report.requirements if one.asked is not None]
    if asked:
        held = sum(one.holds for one in asked)
        open_ = sum(one.verdict == "undecided" for one in asked)
        state = "good" if held == len(asked) else "bad"
        words = f"{held} of {len(asked)} hold" + (f", {open_} undecided" if open_ else "")
        yield KeyFigure("Requirements", words, "[specification] of the design file", state)


def summary_sentences(a: Analysis) -> list[str]:
    """Say in words what the design is."""
    c, plant = a.subject.controller, a.plant
    rate = (
        f"at {1e-3 / c.sample_time:g} kHz" if c.sample_time <= 1e-3 else f"every {c.sample_time * 1e3:g} ms"
    )
    law = kind_of(c)
    article = "An" if law == "LQG" else "A"
    what = f"{law} controller" if law.isupper() else law
    text = f"{article} {what} of the machine {plant.name}, preset {a.subject.parameters.preset}: "
    text += f"{_count(len(c.measurements), 'measurement')} and {_count(len(c.forces), 'command')} {rate}, "
    text += f"{_count(len(c.states), 'state')}."
    sentences = [text]
    parts = []
    if c.integrating:
        parts.append("sums the errors")
    if c.observed:
        parts.append("observes constant forces of disturbance")
    if c.lagging:
        parts.append("has the lag of the current loops in its model")
    if c.delay:
        parts.append(f"has a delay of {_count(c.delay, 'sample')} in its model")
    if c.commutation is not None:
        parts.append("commutates for the predicted place")
    if parts:
        sentences.append(f"It {_list_in_words(parts)}.")
    if plant.has_stroke:
        sentences.append(f"The stroke moves {plant.stroke} by ±{in_unit(plant.travel, 'mm'):g} mm.")
    spec = a.subject.written_from
    if spec is not None and spec.summary:
        sentences.insert(0, f"{spec.summary.rstrip('.')}.")
    if a.subject.changes:
        sentences.append(
            f"The machine is changed: {', '.join(a.subject.changes)}; the controller is not told."
        )
    if not a.report.stable:
        sentences.append("The loop is UNSTABLE on this machine: it has no sensitivities, margins or noise.")
    return sentences


def _count(number_of: int, what: str) -> str:
    return f"{number_of} {what}{'' if number_of == 1 else 's'}"


def _list_in_words(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"

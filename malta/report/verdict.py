"""The verdict on a loop in five lines, the same in the terminal and on every page.

loop          whether the machine's loop is stable
margin        proven margin of the parameters, as a staircase from full state feedback to the machine over its travel
peak |S|      of the worst sensor, with its zone
requirements  those that fail first, then how many hold
yield         of the campaigns of these gains
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from rich.text import Text

from malta.bound import at_least, at_most
from malta.display import micro, number
from malta.margins.loop_report import LoopReport, zone
from malta.margins.outcome import Outcome, near_limits
from malta.model.parameters import box_words
from malta.report.tables import fold

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

    from malta.campaigns.summary import Summary

LABEL = 14  # columns of a terminal, of the labels
BLOCKS = "▁▂▃▄▅▆▇█"
STYLES = {"good": "bold green", "near": "bold yellow", "bad": "bold red", "": "bold"}
SIGNS = {"good": "✓", "near": "?", "bad": "✗", "": "–"}  # for readers without colours
SHOWN_NEAR_LIMITS = 2  # requirements that are named though they hold
SHOWN_FAILURES = 3  # failing requirements that are named


class Stair(NamedTuple):
    """The proven margin of one stage, in multiples of the uncertainty."""

    name: str
    proven: float


class VerdictLine(NamedTuple):
    """A line of the verdict: what it is about, what was found, and what belongs to it."""

    label: str
    value: str
    note: str = ""
    state: str = ""  # "good", "near", "bad" or ""
    stairs: tuple[Stair, ...] = ()


def verdict_lines(found: LoopReport, campaigns: Sequence[Summary] = ()) -> tuple[VerdictLine, ...]:
    """Judge a loop in five lines: stability, proven margin, peak `|S|`, requirements, yield.

    found : from `malta.verify`
    campaigns : summaries of campaigns of these gains

    Returns the lines, of which `verdict_text` and `verdict_html` make what is shown.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2})
    >>> for line in malta.report.verdict_lines(found):
    ...     print(f"{line.label}: {line.value}")
    loop: stable
    margin: 390.69 % proven
    peak |S|: 1.57, zone A
    requirements: not judged
    yield: not sampled
    """
    return (_loop(found), _margin(found), _peak(found), _requirements(found.requirements), _yield(campaigns))


def _loop(found: LoopReport) -> VerdictLine:
    if found.stable:
        return VerdictLine("loop", "stable", found.loop.contents, "good")
    note = f"a pole at |lambda| = {found.stages[-1].spectral_radius:.6f}, {found.loop.contents}"
    return VerdictLine("loop", "UNSTABLE", note, "bad")


def _margin(found: LoopReport) -> VerdictLine:
    margin = found.robust
    if not found.uncertainty:
        return VerdictLine("margin", "not proven", "no uncertain parameters, or the proof was left out")
    if not found.stable:
        return VerdictLine("margin", "none", "the loop is unstable already", "bad")
    of = " ".join(
        filter(None, (f"of {box_words(found.uncertainty, found.plant.parameters)}", str(found.extent)))
    )
    if not found.covers_travel:
        own = "in its middle and at its end" if found.controller.schedule is None else found.places_covered
        of += f" (only {own})"
    stairs = _stairs(found)
    if margin is None or margin.reason == "not asked":
        return VerdictLine("margin", "not proven", "the proof was left out (--no-proof)")
    if margin.lower is None:
        return VerdictLine("margin", "nothing proven", f"{margin.reason}; {of}", "bad", stairs)
    lost = "no unstable machine found" if margin.exhausted else f"lost at {margin.lost.percent()}"
    state = "good" if margin.lower >= 1 else "bad"
    return VerdictLine("margin", f"{margin.proven.percent()} proven", f"{lost} {of}", state, stairs)


def _stairs(found: LoopReport) -> tuple[Stair, ...]:
    """The proven margins of the stages, and of the machine over its travel; none where it is the only one."""
    stages = [(link.name, link.margin) for link in found.chain]
    if found.extent.intervals and stages and found.robust is not None:
        stages.append(("travel" if found.extent.stroke else found.extent.course, found.robust))
    return tuple(Stair(name, margin.lower or 0.0) for name, margin in stages)


def _peak(found: LoopReport) -> VerdictLine:
    if not found.stable:
        return VerdictLine("peak |S|", "none", "the loop is unstable", "bad")
    peaks = {name: peak for name, peak in found.peak_sensitivity.items() if name != "sigma_max"}
    name = max(peaks, key=lambda sensor: peaks[sensor])
    found_zone = zone(peaks[name])
    state = {"A": "good", "B": "near"}.get(found_zone, "bad")
    note = f"of ISO 14839-3, worst at {name}"
    bounds = [gain.upper for gain in found.worst.values()]
    if bounds and None not in bounds:
        highest = max(bound for bound in bounds if bound is not None)
        note += f"; over the uncertainty at most {at_most(highest).text()}, zone {zone(highest)}"
    return VerdictLine("peak |S|", f"{peaks[name]:.2f}, zone {found_zone}", note, state)


def _requirements(outcomes: Sequence[Outcome]) -> VerdictLine:
    """The requirements that fail, then those that nothing decides, then how many hold."""
    asked = [one for one in outcomes if one.asked is not None]
    if not asked:
        return VerdictLine("requirements", "not judged", "no [specification] to judge by")
    failed = sorted((one for one in asked if one.verdict == "fails"), key=lambda one: -one.ratio)
    undecided = [one for one in asked if one.verdict == "undecided"]
    notes = [f"{one.words} {one.found_text}, asked {one.asked_text}" for one in (*failed, *undecided)][
        :SHOWN_FAILURES
    ]
    more = len(failed) + len(undecided) - len(notes)
    notes += [f"{more} more"] if more else []
    if not failed and not undecided:
        near = near_limits(asked, SHOWN_NEAR_LIMITS)
        note = near and f"nearest their limits: {near}"
        return VerdictLine("requirements", f"all {len(asked)} hold", note, "good")
    parts = [f"{len(failed)} of {len(asked)} {'FAILS' if len(failed) == 1 else 'FAIL'}"] if failed else []
    parts += [f"{len(undecided)} undecided"] if undecided else []
    return VerdictLine("requirements", ", ".join(parts), "; ".join(notes), "bad" if failed else "near")


def _yield(campaigns: Sequence[Summary]) -> VerdictLine:
    """The yield of each campaign by its strictest bounds, the lowest first."""
    shares = []
    for one in campaigns:
        if not one.runs:
            continue
        yields = one.yields
        within = yields.specified or yields.published
        rate = within or yields.completed
        what = "within bounds" if within is not None else "completed, without bounds"
        interval = f"95 % interval {number(100 * rate.low)} to {number(100 * rate.high)} %"
        shares.append((rate.share, what, f"of {rate.runs} machines, {one.plan.scenario} ({interval})"))
    if not shares:
        return VerdictLine("yield", "not sampled", "see malta campaign")
    shares.sort(key=lambda one: one[0])
    share, what, note = shares[0]
    note += f"; lowest of {len(shares)} campaigns" if len(shares) > 1 else ""
    return VerdictLine("yield", f"{number(100 * share)} % {what}", note, "good" if share == 1 else "near")


def staircase(stairs: Sequence[Stair]) -> str:
    """Proven margins as blocks of their heights, the largest a whole one; "" for a single one.

    >>> staircase([Stair("LQR", 4.0), Stair("sampled", 2.0), Stair("travel", 1.0)])
    '█▄▂'
    """
    largest = max((stair.proven for stair in stairs), default=0.0)
    if len(stairs) < 2 or not largest > 0:
        return ""
    return "".join(BLOCKS[max(math.ceil(len(BLOCKS) * _height(s, largest)), 1) - 1] for s in stairs)


def _height(stair: Stair, largest: float) -> float:
    """A margin as a share of the largest, which may be without end."""
    return 1.0 if stair.proven == largest else stair.proven / largest


@dataclass(frozen=True)
class VerdictText:
    """The lines of a verdict for a terminal, folded behind their labels."""

    lines: tuple[VerdictLine, ...]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw the lines: label, value in the colour of its state, note."""
        width = max(options.max_width - LABEL, LABEL)
        for line in self.lines:
            bar = staircase(line.stairs)
            value = f"{bar} {line.value}".lstrip()
            text = micro(f"{value}, {line.note}" if line.note else value)
            folded = fold(text, width)
            shown = Text(f"{line.label:{LABEL}}")
            shown.append(("\n" + " " * LABEL).join(folded))
            if folded[0].startswith(micro(value)):
                shown.stylize(STYLES[line.state], LABEL, LABEL + len(value))
            yield shown


def verdict_text(found: LoopReport, campaigns: Sequence[Summary] = ()) -> VerdictText:
    """Write the verdict on a loop for a terminal, as `malta verify` prints it first and last.

    found : from `malta.verify`
    campaigns : summaries of campaigns of these gains

    Returns what `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True, spec=spec)
    >>> rich.print(malta.report.verdict_text(found))
    loop          stable, with hold
    margin        ██▇▇▇ 390.69 % proven, lost at 390.70 % of m ±20 %
    peak |S|      1.57, zone A, of ISO 14839-3, worst at y; over the uncertainty at
                  most 1.749, zone A
    requirements  all 4 hold, nearest their limits: peak sensitivity 98.38 %, margin
                  93.58 %
    yield         not sampled, see malta campaign
    """
    return VerdictText(verdict_lines(found, campaigns))


def verdict_html(lines: Sequence[VerdictLine]) -> str:
    """Write a verdict as HTML: a list of label, value and note, with the staircase as bars beside their names.

    lines : from `verdict_lines`

    Returns the element as text.

    >>> from malta.report.verdict import VerdictLine, verdict_html
    >>> verdict_html([VerdictLine("loop", "stable", "with hold", "good")])
    '<dl class="verdict"><div class="good"><dt>loop</dt><dd><b>✓ stable</b> with hold</dd></div></dl>'
    """
    rows = []
    for line in lines:
        note = f" {html.escape(micro(line.note))}" if line.note else ""
        value = html.escape(micro(f"{SIGNS[line.state]} {line.value}"))
        state = f' class="{line.state}"' if line.state else ""
        bars = stairs_html(line.stairs)
        rows.append(f"<div{state}><dt>{line.label}</dt><dd><b>{value}</b>{note}{bars}</dd></div>")
    return f'<dl class="verdict">{"".join(rows)}</dl>'


def stairs_html(stairs: Sequence[Stair]) -> str:
    """Proven margins as bars of their heights, each with its name and its share; "" for a single one."""
    largest = max((stair.proven for stair in stairs), default=0.0)
    if len(stairs) < 2 or not largest > 0:
        return ""
    bars = (
        f'<span class="{"" if s.proven >= 1 else "bad"}"><i style="height:{2.4 * _height(s, largest):.2f}rem"></i>'
        f"<em>{html.escape(s.name)}</em><em>{at_least(s.proven).percent()}</em></span>"
        for s in stairs
    )
    return f'<span class="stairs">{"".join(bars)}</span>'

"""A log as a page to look into: panels by unit that zoom together, with a cursor that tells values. Drawn by uPlot."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.display import micro, prefixed_unit, quantity
from malta.files import read_packaged
from malta.identification.log_view import VIEWED, SignalPanel, view_log, view_panels
from malta.identification.survey import SOUND_LOG
from malta.report.page.document import Page, json_in_page, page_style, render_template, script_of
from malta.report.page.sections import plain_sheet
from malta.report.tables.experiments import log_rows

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.identification.log import Log

MAX_PAGE_NUMBERS = 700_000  # of all signals: 3.7 MB of a page
UPLOT = "report/page/uplot"


def log_page(log: Log, findings: Sequence[str] = ()) -> Page:
    """Write a log as one page in HTML that needs no network and no other file.

    log : what to draw; a long one with the least and the largest value of each of some thousand intervals
    findings : what else is wrong with it, in words

    Returns a Page. Signals of one unit share a panel, unless one is much larger than others.
    """
    from markupsafe import Markup

    signals = sum(len(log.signals.get(group, ())) for group in VIEWED)
    most = MAX_PAGE_NUMBERS // max(signals, 1)
    views = view_log(log, log.samples if log.samples <= most else most // 2)
    panels = view_panels(views)
    shape: dict[str, Any] = {"t": "", "f": "", "lines": [], "whole": True}
    if views:
        shape = {
            "t": _pack(views[0].ends[0], np.float64),
            "f": _pack(views[0].f),
            "lines": views[0].lines.tolist(),
            "whole": views[0].whole,
        }
    library = (
        read_packaged(f"{UPLOT}/uPlot.iife.min.js").decode().replace("https://", "", 1)
    )  # of its first line
    uplot = f"/*! {read_packaged(f'{UPLOT}/LICENSE').decode()} */\n{library}"
    policy, script = script_of(f"{uplot}\n{read_packaged('report/page/log.js').decode()}")
    each = 1 if not views or views[0].whole else -(-log.samples // (most // 2))
    page = render_template(
        "log.html.jinja", title=Path(log.source).name, policy=policy, script=Markup(script), about=_about(log, each),
        style=Markup(page_style() + read_packaged(f"{UPLOT}/uPlot.min.css").decode()),
        findings=[*log.notes, *([*log.survey.findings, *findings] or [SOUND_LOG])],
        sheet=plain_sheet("", ("signal", "least", "mean", "largest", "deviation"), log_rows(log)),
        data=Markup(json_in_page(shape | {"panels": [_panel(panel) for panel in panels]})),
    )  # fmt: skip
    return Page(f"{log.source}: log", page)


def _about(log: Log, each: int) -> str:
    """What the log is of, in a sentence."""
    drawn = "each sample" if each == 1 else f"the least and the largest of each {each} samples"
    excited = f", an excitation with a period of {log.period:g} s" if log.period else ""
    return (
        f"{log.machine or 'an unnamed machine'} under {log.controller or 'an unnamed law'}: {log.samples} samples of "
        f"{micro(quantity(log.sample_time, 's'))}, {log.samples * log.sample_time:g} s{excited}. Drawn is {drawn}."
    )


def _panel(panel: SignalPanel) -> dict[str, Any]:
    """A panel for the page's script: values and amplitudes in a unit in which they are short."""
    unit, power = prefixed_unit(max(view.size for view in panel.views), panel.unit)
    return {
        "unit": "" if unit == "1" else micro(unit),
        "signals": [
            {
                "name": view.label,
                "group": view.group,
                "values": _pack(view.ends[1] / 1000.0**power),
                "amplitude": _pack(view.amplitude / 1000.0**power),
            }
            for view in panel.views
        ],
    }


def _pack(values: FloatArray, kind: Any = np.float32) -> str:
    """Numbers as little-endian bytes in base64; NaN where one is missing."""
    return base64.b64encode(np.asarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()).decode()

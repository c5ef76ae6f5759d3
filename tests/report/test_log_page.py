"""The page of a log: its values are those of the log, panels follow each other, it needs no network and it prints."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import browser as browser, open_page, printed_overlaps
from conftest import Run
from page_checks import read_page

from malta.identification import Log, write_log
from malta.identification.log_view import view_log, view_panels
from malta.model.plant import Signal
from malta.report.page import log as log_pages
from malta.report.page.log import log_page

SAMPLES = 2000


@pytest.fixture(scope="module")
def log() -> Log:
    """Two readings of 2 mm and of 20 um with a gap, a reference, a current and an excitation of 40 Hz."""
    t = 1e-4 * np.arange(SAMPLES)
    wave = np.sin(2 * np.pi * 40 * t)
    y = np.column_stack([2e-3 * wave, 20e-6 * wave])
    y[500:510, 1] = np.nan
    columns = {
        "y": y,
        "i": 0.5 * wave[:, None],
        "excitation": 3 * wave[:, None],
        "reference": 1e-3 + 0 * y + 1e-4 * y,
    }
    signals = {
        "y": (Signal("z", "m"), Signal("x<b>", "m")),
        "i": (Signal("i", "A"),),
        "excitation": (Signal("f", "N"),),
        "reference": (Signal("z", "m"), Signal("x<b>", "m")),
    }
    return Log("folder/made.npz", "cart", "law", 1e-4, 0.025, t, columns, signals)


def data_of(html: str) -> Any:
    """What the script of a page reads."""
    return json.loads(re.findall(r"id=\"log-data\">(.*?)</script>", html, re.DOTALL)[0])


def numbers(text: str, kind: str = "<f4") -> Any:
    return np.frombuffer(base64.b64decode(text), kind)


def test_signals_stand_by_unit_and_size(log: Log) -> None:
    panels = view_panels(view_log(log))
    assert [[view.label for view in panel.views] for panel in panels] == [
        ["z", "ref. z", "ref. x<b>"],
        ["x<b>"],
        ["i"],
        ["exc. f"],
    ]


def test_a_slow_log_says_its_sample_in_milliseconds(log: Log) -> None:
    slow = replace(log, sample_time=0.055, t=0.055 * np.arange(SAMPLES))
    assert f"{SAMPLES} samples of 55 ms, 110 s" in log_pages._about(slow, 1)
    assert "samples of 100 µs" in log_pages._about(log, 1)


def test_a_page_has_the_samples_of_its_log(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    page = log_page(log, ["said <i>so</i>"]).html
    read_page(page)
    assert "said &lt;i&gt;so&lt;/i&gt;" in page
    assert "Permission is hereby granted, free of charge" in page  # the licence of uPlot
    assert len(page) < 250_000
    data = data_of(page)
    assert [panel["unit"] for panel in data["panels"]] == ["mm", "µm", "mA", "N"]
    assert numbers(data["t"], "<f8") == pytest.approx(log.t)
    fine = numbers(data["panels"][1]["signals"][0]["values"])
    assert fine == pytest.approx(1e6 * log.columns["y"][:, 1], rel=1e-6, abs=1e-6, nan_ok=True)
    assert data["lines"] == pytest.approx([40.0])
    # Of a long log each interval has its least and its largest value.
    monkeypatch.setattr(log_pages, "MAX_PAGE_NUMBERS", 6 * 200)
    data = data_of(log_page(log).html)
    coarse = numbers(data["panels"][0]["signals"][0]["values"]).reshape(-1, 2)
    assert (data["whole"], coarse.shape) == (False, (100, 2))
    assert coarse == pytest.approx(
        1e3 * np.column_stack([f(log.columns["y"][:, 0].reshape(100, 20), axis=1) for f in (np.min, np.max)]),
        rel=1e-5,
    )


def test_panels_zoom_together_and_tell_values_by_keys(log: Log, tmp_path: Path, browser: Any) -> None:
    page = log_page(log).save(tmp_path / "log.html")
    for width, scheme in ((390, "dark"), (1280, "light")):
        open_page(browser, page, width=width, scheme=scheme)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    spans = "return charts.filter(c => !c.spectrum).map(c => [c.chart.scales.x.min, c.chart.scales.x.max])"
    whole = [0.0, pytest.approx(1e-4 * (SAMPLES - 1))]
    assert browser.execute_script(spans) == [whole] * 4
    panel = browser.find_elements("css selector", "#panels .panel")[1]
    browser.execute_script("arguments[0].focus()", panel)
    panel.send_keys("+")
    low, high = browser.execute_script(spans)[3]
    assert high - low == pytest.approx(1e-4 * (SAMPLES - 1) / 2)
    height = "return document.documentElement.scrollHeight"
    before = browser.execute_script(height)
    panel.send_keys("\ue014")  # arrow to the right
    said = browser.find_element("id", "told").get_attribute("textContent")
    t, value = re.findall(r"^([\d.]+) s, x<b> (\S+) µm$", said)[0]
    at = round(float(t) / 1e-4)
    assert float(value.replace("−", "-")) == pytest.approx(1e6 * log.columns["y"][at, 1], abs=1e-3)
    told = [row.text for row in browser.find_elements("css selector", ".panel:focus .u-value")]
    assert told[-1] == f"{value} µm"
    assert browser.execute_script(height) == before  # what is told moves nothing
    panel.send_keys("0")
    assert browser.execute_script(spans) == [whole] * 4
    browser.find_element("css selector", "#panels .u-series:nth-child(2) th").click()
    assert browser.execute_script("return [...hidden]") == ["z"]
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert printed_overlaps(browser, "h1, h2, .about, p, canvas, .u-legend tr, table") == []


def test_the_command_writes_the_page(log: Log, tmp_path: Path, run: Run) -> None:
    path = write_log(log, tmp_path / "made.npz")
    assert f"wrote {tmp_path / 'page.html'}" in run("log", path, "--out", tmp_path / "page.html").out.replace(
        "\n", ""
    )
    assert (tmp_path / "page.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    said = run("log", path, "--out", tmp_path / "page.txt")
    assert said.code == 2
    assert ".html" in said.err

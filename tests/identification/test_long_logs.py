"""Logs that stay in their file tell the same as logs in memory."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.identification import Log, log_files, log_of, prediction, read_log, spectra, write_log
from malta.identification.folding import fold
from malta.identification.log_files import without_idle
from malta.identification.readers import instruments, raster, stored, text
from malta.identification.readers.stored import EvenTimes, StoredTable

CONTROLLER = malta.gains.read("design/gains/robust.json")
PLANT = malta.plant_of(CONTROLLER.parameters)
ASKED = ["K_A", "K_B", "K_D"]


@pytest.fixture(scope="module")
def log() -> Log:
    plan = malta.excite(malta.loop(PLANT, CONTROLLER), period=0.25, periods=18, band=(8.0, 400.0), lines=8)
    return without_idle(
        log_of(malta.simulate(PLANT, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration)))
    )


def open_long(path: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> Log:
    """A log that is read as one of many gigabytes is."""
    for module in (log_files, text, instruments):
        monkeypatch.setattr(module, "MOST_IN_MEMORY", 1000)
    monkeypatch.setattr(log_files, "SMALL_ARRAY", 100)
    monkeypatch.setattr(raster, "SAMPLED_TIMES", 1000)
    return read_log(path, **options)


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".parquet"])
def test_tables_in_a_file_are_those_in_memory(
    log: Log, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    y = np.array(log.columns["y"][:6000])
    y[7, 1] = np.nan
    short = replace(log, t=log.t[:6000], columns={g: t[:6000] for g, t in log.columns.items()} | {"y": y})
    path = write_log(short, tmp_path / f"log{suffix}")
    known, found = read_log(path), open_long(path, monkeypatch)
    assert isinstance(found.t, EvenTimes)
    assert np.asarray(found.t) == pytest.approx(known.t)
    for group, table in found.columns.items():
        assert isinstance(table, StoredTable)
        assert np.array_equal(np.asarray(table), known.columns[group], equal_nan=True)
        assert np.array_equal(table[100:200], known.columns[group][100:200], equal_nan=True)
    assert found.survey.findings == known.survey.findings == ("1 readings of y1 missing, 0.0167 %",)
    for heading, numbers in known.survey.statistics.items():
        assert found.survey.statistics[heading] == pytest.approx(numbers, rel=1e-9, abs=1e-15)
    milli = open_long(path, monkeypatch, columns="z=z:mm") if suffix != ".npz" else known
    if suffix != ".npz":
        assert milli.table("y", ["z"])[:50] == pytest.approx(1e-3 * known.table("y", ["z"])[:50])


def test_long_logs_tell_the_same_at_the_lines(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(log, tmp_path / "log.npz")
    known = malta.identify(CONTROLLER, read_log(path), parameters=["K_B"], in_time=False)
    found = malta.identify(CONTROLLER, open_long(path, monkeypatch), parameters=["K_B"], in_time=False)
    assert found.values == pytest.approx(known.values, rel=1e-8)
    assert (found.chi2, found.distortion) == pytest.approx((known.chi2, known.distortion), rel=1e-4)


@pytest.mark.slow
def test_long_logs_tell_the_same_parameters(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(log, tmp_path / "log.npz")
    known = malta.identify(CONTROLLER, read_log(path), parameters=ASKED)
    found = malta.identify(CONTROLLER, open_long(path, monkeypatch), parameters=ASKED)
    assert found.values == pytest.approx(known.values, rel=1e-7)
    assert found.half_widths == pytest.approx(known.half_widths, rel=1e-4)
    assert (found.chi2, found.distortion) == pytest.approx((known.chi2, known.distortion), rel=1e-4)
    assert known.in_time is not None
    assert found.in_time is not None
    assert found.in_time.values == pytest.approx(known.in_time.values, rel=1e-7)
    # Passes over a part of the record end where passes over all of it end.
    monkeypatch.setattr(prediction, "PREFIX", 20_000)
    monkeypatch.setattr(prediction, "RUN_SAMPLES", 10_000)
    part = malta.identify(CONTROLLER, open_long(path, monkeypatch), parameters=ASKED)
    assert part.in_time is not None
    off = (part.in_time.values - known.in_time.values) / np.sqrt(np.diag(known.in_time.covariance))
    assert np.abs(off).max() < 0.05
    assert part.in_time.rms == pytest.approx(known.in_time.rms, rel=1e-3)


@pytest.mark.slow
def test_missing_readings_of_a_long_log_are_filled_in(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    y = np.array(log.columns["y"])
    y[np.random.default_rng(3).random(y.shape) < 0.05] = np.nan
    y[30_000:30_100] = np.nan
    path = write_log(replace(log, columns={**log.columns, "y": y}), tmp_path / "log.npz")
    monkeypatch.setattr("malta.identification.survey.BLOCK_ROWS", 15_050)
    known = malta.identify(CONTROLLER, read_log(path), parameters=ASKED)
    found = malta.identify(CONTROLLER, open_long(path, monkeypatch), parameters=ASKED)
    assert found.values == pytest.approx(known.values, rel=1e-6)
    assert known.in_time is not None
    assert found.in_time is not None
    assert found.in_time.missing == known.in_time.missing > 20_000


@pytest.mark.slow
def test_loops_are_measured_from_long_logs(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_log(log, tmp_path / "log.npz")
    short = malta.measure(CONTROLLER, read_log(path))
    long = malta.measure(CONTROLLER, open_long(path, monkeypatch))
    assert long.S.size == pytest.approx(short.S.size, rel=1e-6)
    assert long.S.deviation == pytest.approx(short.S.deviation, rel=1e-4)


def test_a_wrong_period_of_a_long_log_is_refused(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(replace(log, period=0.24), tmp_path / "log.npz")
    with pytest.raises(malta.CheckError, match=r"has not the period of 0\.24 s"):
        malta.identify(CONTROLLER, open_long(path, monkeypatch), parameters=ASKED)
    huge = np.array(log.columns["y"])
    huge[5, 0] = 1e40
    path = tmp_path / "huge.npz"
    arrays: dict[str, Any] = {"t": log.t, "y": huge, "y_columns": [f"{s.name} [m]" for s in PLANT.outputs]}
    np.savez(path, **arrays)
    with pytest.raises(malta.InputError, match=r"x1: found .*1e\+40, expected readings"):
        _ = open_long(path, monkeypatch).survey


@pytest.mark.parametrize(("periods", "samples"), [(20, 100), (16, 100), (5, 64), (3, 50), (7, 33)])
def test_folded_periods_have_the_coefficients_of_the_whole(periods: int, samples: int) -> None:
    N = periods * samples
    x = np.random.default_rng(periods).normal(size=(N + 13, 3))
    found, X = fold([x[:, :2], x[:, 2:]], N, periods), np.fft.rfft(x[13:], axis=0) / N
    beside = min(8, periods // 2)
    multiple = (np.arange(len(X)) + periods // 2) // periods
    near = np.abs(np.arange(len(X)) - multiple * periods) <= beside
    bins = np.flatnonzero(near & (multiple < len(found.table)))
    assert np.abs(found[bins] - X[bins]).max() < 1e-14
    assert found[0] == pytest.approx(X[0])
    assert found.minus([periods], X[[periods]])[periods] == pytest.approx(np.zeros(3), abs=1e-14)
    if periods > 16:
        with pytest.raises(IndexError, match="not near a multiple"):
            _ = found[9]


def test_bins_of_noise_are_the_nearest_ones() -> None:
    for periods, lines in ((20, [40, 80]), (3, [30, 60]), (17, [17])):
        found = spectra.noise_bins(np.array(lines), periods, 400)
        free = np.setdiff1d(np.arange(1, min(400, lines[-1] + 4 * periods)), np.arange(0, 400, periods))
        for line, bins in zip(lines, found, strict=True):
            assert sorted(np.abs(bins - line)) == sorted(np.abs(free - line))[:16]
            assert len(set(bins.tolist()) & set(free.tolist())) == 16


def test_a_long_log_takes_the_memory_of_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count, path = 600_000, tmp_path / "log.npz"
    random = np.random.default_rng(4)
    arrays: dict[str, Any] = {"t": 5e-5 * np.arange(count), "y": random.normal(size=(count, 20))}
    np.savez(path, **arrays, y_columns=np.array([f"x{k} [m]" for k in range(20)]))
    assert path.stat().st_size > 96e6
    tracemalloc.start()
    found = open_long(path, monkeypatch).survey.statistics
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 44e6  # of 96 MB; most is the block of 50 000 rows and what is counted of it
    assert found["x3 [m]"][3] == pytest.approx(float(arrays["y"][:, 3].std()), rel=1e-12)
    with pytest.raises(malta.InputError, match="has become shorter"):
        stored.stored_table(path, (0, np.dtype(float), False), (10**9, 20)).rows(10**9 - 5, 10**9)


def test_a_table_in_its_file_behaves_as_an_array(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods, attributes and arithmetic of arrays: of the numbers that were written."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    run = malta.simulate(malta.plant_of(controller.parameters), controller, malta.Scenario.stroke(noise=1.0))
    written = log_of(run)
    read = open_long(write_log(written, tmp_path / "log.npz"), monkeypatch)
    own, table = written.columns["y"], read.columns["y"]
    assert isinstance(table, StoredTable)
    assert np.asarray(read.t)[-1] - read.t[0] == pytest.approx(np.ptp(written.t))
    assert read.t.mean() == pytest.approx(written.t.mean())
    assert table.shape == own.shape
    assert table.any()
    assert np.array_equal(table.std(axis=0), own.std(axis=0))
    assert np.array_equal(2 * table - table[:1], 2 * own - own[:1])
    assert np.array_equal(table[:, 1], own[:, 1])

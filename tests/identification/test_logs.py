"""Logs: what a bench would write, read back from every encoding, and what is wrong with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run, one_sentence

import malta
from malta.identification import log_files
from malta.identification.log_view import view_log
from malta.identification.readers import numbers
from malta.identification.readers.numbers import Dialect
from malta.identification.spectra import in_axes
from malta.model.plant import Signal
from malta.report.figures import log_figure

ROBUST = "design/gains/robust.json"
CONTROLLER = malta.gains.read(ROBUST)


@pytest.fixture(scope="module")
def log() -> malta.identification.Log:
    stroke = malta.Scenario.stroke(10e-3, duration=0.02, noise=1.0, quantize=True)
    return malta.identification.log_of(
        malta.simulate(malta.plant_of(CONTROLLER.parameters), CONTROLLER, stroke)
    )


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat", ".parquet"])
def test_a_log_is_read_as_it_was_written(log: malta.identification.Log, suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow", reason="pyarrow writes and reads Parquet files")
    found = malta.identification.read_log(malta.identification.write_log(log, tmp_path / f"log{suffix}"))
    assert (found.machine, found.controller, found.sample_time) == ("tubular", "robust", 50e-6)
    assert len(found.sha256) == 64
    for group in ("y", "v", "i", "u", "reference", "excitation", "flags"):
        table = log.table(group, found.names(group))
        assert found.columns[group] == pytest.approx(table, rel=1e-8, abs=1e-12)
    assert found.signals["y"] == log.signals["y"]


def test_a_log_says_nothing_of_the_truth(log: malta.identification.Log, tmp_path: Path) -> None:
    heading = malta.identification.write_log(log, tmp_path / "log.csv").read_text().split("\n")[5].split(",")
    assert heading[:6] == ["t [s]", "x1 [m]", "y1 [m]", "x2 [m]", "y2 [m]", "z [m]"]
    assert not any("hat" in name or "alpha" in name for name in heading)


def test_currents_are_those_that_the_sensors_read() -> None:
    par = replace(CONTROLLER.parameters, s_i=5e-3, q_i=1e-3)
    scenario = malta.Scenario("hold", 0.05, malta.references.hold, noise=1.0)
    run = malta.simulate(malta.plant_of(par), CONTROLLER, scenario)
    off = malta.identification.log_of(run).columns["i"] - run.i
    # Three phases of 5 mA each, in amplitude-invariant axes: sqrt(2/3), and over three rows again sqrt(1/3) or more.
    assert 1e-3 < off[:, 2].std() < 5e-3
    assert abs(off[:, 2].mean()) < 3e-4


def test_csv_of_other_programs(tmp_path: Path) -> None:
    text = "t [ms],x1 [um],fx [N],i_a [mA],ref.x1 [mm]\n0,1,2,3,0\n0.05,,2,3,0\n0.10,3,2,3,1\n"
    (tmp_path / "other.csv").write_text(text)
    found = malta.identification.read_log(tmp_path / "other.csv")
    assert found.t.tolist() == pytest.approx([0, 50e-6, 100e-6])
    assert found.columns["y"][[0, 2], 0].tolist() == pytest.approx([1e-6, 3e-6])
    assert found.columns["i"][0, 0] == pytest.approx(3e-3)
    assert found.columns["reference"][2, 0] == pytest.approx(1e-3)
    assert found.survey.missing == {"x1": 1}


def test_columns_that_are_not_asked_for_are_not_read(log: malta.identification.Log, tmp_path: Path) -> None:
    for suffix in (".csv", ".npz"):
        path = malta.identification.write_log(log, tmp_path / f"log{suffix}")
        every, few = malta.identification.read_log(path), malta.identification.read_log(path, ("y", "i"))
        assert list(few.columns) == ["y", "i"]
        assert all(np.array_equal(few.columns[group], every.columns[group]) for group in ("y", "i"))
        assert (few.period, few.sha256, few.signals["i"]) == (every.period, every.sha256, every.signals["i"])
    text = "t [s],x1 [m],fx [N]\n0,1,2\n1,2\n2,1,4\n"
    (tmp_path / "short.csv").write_text(text)
    with pytest.raises(malta.InputError, match="a line that cannot be read"):
        malta.identification.read_log(tmp_path / "short.csv", ("y",))


def test_compiled_c_reads_the_doubles_of_numpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers of all sizes and digits; and those half between two doubles, where rounding twice goes wrong."""
    random = np.random.default_rng(1)
    cells = random.normal(size=(500, 4)) * 10.0 ** random.integers(-24, 24, (500, 4))
    half = 2 * random.integers(2**52, 2**53, 500) + 1  # of 54 binary digits
    rows = [
        f"{k},{a:.17g},{b:.9g},{c!r},{int(h) * 125}e-3, {d:.2f}\r"
        for k, ((a, b, c, d), h) in enumerate(zip(cells.tolist(), half, strict=True))
    ]
    path = tmp_path / "log.csv"
    last = ["", "500,,-0.0,nan,4.9e-324,1e-400", "501,12345678901234567890123,.5,5.,+1E2,0"]
    path.write_text("\n".join(["t [s],x [m],y [um],f [N],i [A],u [mV]", *rows, *last]))
    found = []
    for module in (log_files, None):
        if module is None:
            monkeypatch.setattr(numbers, "fast_rows", lambda *_: None)
        monkeypatch.setattr(log_files, "MAX_READING", np.inf)
        found.append(malta.identification.read_log(path))
    for group, table in found[0].columns.items():
        assert np.array_equal(table.view(np.uint64), found[1].columns[group].view(np.uint64)), group


@pytest.mark.parametrize(
    "row", ["1,2", "1,2,3,4", "1,a,3", "1,1.2.3,4", "1,0x2,3", "1,+,3", "1,2e,3", "1,2 3,4"]
)
def test_compiled_c_leaves_to_numpy_what_is_no_table_of_numbers(row: str) -> None:
    rows = f"0,1,2\n{row}\n".encode()
    assert numbers.fast_rows(rows, Dialect("utf-8", ",", ".", 0, "nnn"), [0, 1, 2]) is None


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "no line of headings"),
        ("t [s],x1\n0,1\n1,2\n", "a heading without unit"),
        ("t [s],x1 [kg]\n0,1\n1,2\n", r"not used: x1 \[kg\]"),
        ("t [s],x1 [m]\n0,1\n0,2\n", "times that do not rise"),
        ("t [s],x1 [m]\n0,1\n1,a\n", "cannot be read"),
        ("t [s],fx [N]\n0,1\n1,2\n", "no measured outputs"),
        ("x1 [m],a [A]\n0,1\n1,2\n", "no column of times"),
        ("t [s],x1 [m]\n", "headings alone"),
        ("t [s],x1 [m]\n0,1\n1,1e308\n", r"1e\+308 in sample 2"),
        ("t [s],x1 [m]\n0,1\n1e40,2\n", "times that do not rise"),
        ("# sample_time fast\nt [s],x1 [m]\n0,1\n1,2\n", "sample_time: found 'fast'"),
        ("# period nan s\nt [s],x1 [m]\n0,1\n1,2\n", "period: found 'nan'"),
    ],
)
def test_what_is_no_log_is_refused(text: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(malta.InputError, match=found):
        malta.identification.read_log(tmp_path / "bad.csv")
    for suffix in (".npz", ".mat", ".parquet", ".txt"):
        (tmp_path / f"bad{suffix}").write_bytes(b"no archive")
        with pytest.raises(malta.InputError):
            malta.identification.read_log(tmp_path / f"bad{suffix}")


def test_arrays_that_are_no_log_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    good: dict[str, Any] = {"y": np.zeros((2, 1)), "y_columns": np.array(["x1 [m]"])}
    for t in (np.arange(2) * 1j, np.zeros((2, 1)), np.array(["0", "1"])):
        np.savez(path, t=t, **good)
        with pytest.raises(malta.InputError, match="t: found an array of"):
            malta.identification.read_log(path)
    np.savez(path, t=np.arange(2.0), period=np.zeros(0), **good)
    assert malta.identification.read_log(path).period == 0


def test_a_log_of_few_samples_or_of_zeros_is_answered(log: malta.identification.Log) -> None:
    controller = malta.gains.read(ROBUST)
    few = {group: table[:5] for group, table in log.columns.items()}
    for ask in (malta.learn, malta.identification.replay_law):
        with pytest.raises(malta.CheckError, match="5 samples of a reference"):
            ask(controller, replace(log, t=log.t[:5], columns=few))
    zeros = {group: 0 * table for group, table in log.columns.items()}
    assert len(log_figure(replace(log, columns=zeros)).axes) == 2 * len(log.names("y"))


def test_a_picture_has_envelope_spectrum_and_excited_lines_of_each_signal() -> None:
    t = 1e-4 * np.arange(25_000)
    force, y = 3 * np.sin(2 * np.pi * 40 * t), 5e-6 * np.sin(2 * np.pi * 40 * t + 1)
    y[7_003] = -2e-3
    y[12_000:12_100] = np.nan
    signals = {"y": (Signal("x", "m"),), "excitation": (Signal("f", "N"), Signal("g", "N"))}
    columns = {"y": y[:, None], "excitation": np.column_stack([force, 0 * force])}
    log = malta.identification.Log("made", "", "", 1e-4, 0.025, t, columns, signals)
    x, f = view_log(log)
    assert (x.name, f.name, len(x.t)) == ("x", "f", 1000)
    assert np.nanmin(x.low) == -2e-3  # one sample of a line that is one pixel of 25 samples wide
    assert np.isnan(x.low[480:484]).all()
    assert np.nanmax(x.high) == pytest.approx(5e-6, rel=1e-3)
    assert f.lines == pytest.approx([40.0])
    assert f.at_lines == pytest.approx([3.0], rel=1e-9)
    assert x.at_lines == pytest.approx([5e-6], rel=0.05)
    assert f.f[f.amplitude.argmax()] == pytest.approx(40, rel=0.03)
    figure = log_figure(log)
    assert [axes.get_ylabel() for axes in figure.axes] == ["x [µm]", "", "exc. f [N]", ""]


def test_a_spectrogram_says_when_which_tone_is_there() -> None:
    """A force of 3 N that goes from 200 to 1000 Hz in the middle, and a reading that is zero, or not there."""
    t = 1e-4 * np.arange(20_000)
    force = 3 * np.sin(2 * np.pi * np.where(t < 1, 200, 1000) * t)
    signals = {"y": (Signal("x", "m"), Signal("n", "m")), "v": (Signal("f", "N"),)}
    columns = {"y": np.column_stack([0 * t, np.nan * t]), "v": force[:, None]}
    figure = log_figure(
        malta.identification.Log("made", "", "", 1e-4, 0.0, 5 + t, columns, signals), spectrogram=True
    )
    (axes,) = (one for one in figure.axes if one.get_ylabel() == "f [N]")
    drawn = figure.axes[figure.axes.index(axes) + 1]
    assert (drawn.get_xlabel(), drawn.get_ylabel(), drawn.get_yscale()) == ("time [s]", "f [Hz]", "log")
    assert "dB of 1 N" in [one.get_ylabel() for one in figure.axes]
    mesh: Any = drawn.collections[0]
    level, corners = np.asarray(mesh.get_array()), mesh.get_coordinates()
    begins, f = corners[0, :-1, 0], corners[:-1, 0, 1]
    for when, tone in ((5.4, 200.0), (6.6, 1000.0)):
        column = level[:, np.searchsorted(begins, when)]
        assert column.max() == pytest.approx(20 * np.log10(3), abs=1.5)  # a tone between two bins
        assert f[column.argmax()] == pytest.approx(tone, abs=40)
    assert level.min() < -20


def test_a_spectrogram_wants_a_picture(run: Run, tmp_path: Path) -> None:
    for options in ((), ("--out", tmp_path / "log.html")):
        refused = run("log", "log.csv", "--spectrogram", *options)
        assert refused.code == 2
        assert "expected" in one_sentence(refused.err)


def test_gaps_stuck_and_clipped_sensors_are_seen(log: malta.identification.Log) -> None:
    y, t = np.array(log.columns["y"]), np.array(log.t)
    y[:, 4] += 1e-3 * np.sin(300 * t)
    y[100:, 0] = y[100, 0]
    y[:, 4] = np.clip(y[:, 4], -np.inf, np.quantile(y[:, 4], 0.9))
    y[7, 1] = np.nan
    t[200:] += 1e-3
    found = replace(log, t=t, columns={**log.columns, "y": y}).survey
    assert (found.gaps, found.missing) == (1, {"y1": 1})
    assert found.stuck == {"x1": 300}
    assert found.clipped == {"z": pytest.approx(40, abs=2)}
    whole = log.survey
    assert (whole.gaps, whole.stuck, whole.clipped) == (0, {}, {})


@pytest.mark.slow
def test_commands_write_and_show_a_log(run: Run, tmp_path: Path) -> None:
    file, picture = tmp_path / "stroke.csv", tmp_path / "log.png"
    said = run("simulate", ROBUST, "--set", "K_D=4.68", "--noise", "1", "--log", file)
    assert f"wrote {file}" in said.out
    shown = run("log", file, "--out", picture)
    assert shown.code == 0
    assert "2000 samples of 50 µs" in shown.out
    assert picture.stat().st_size > 10_000
    found = json.loads(run("log", file, "--json").out)
    assert found["signals"]["z"]["unit"] == "m"
    learned = run("learn", ROBUST, file, "--next", tmp_path / "next.csv", "--json")
    assert (tmp_path / "next.csv").read_text().startswith("t [s],exc.f_D [N]\n0,")
    assert run("learn", ROBUST).code == 2
    assert json.loads(learned.out)["after"] == pytest.approx(4.68, rel=0.01)
    said = run("replay", ROBUST, file)
    assert (said.code, "as logged" in said.out, "K_D -11 %" in said.err) == (1, True, True)
    other = run("replay", "design/gains/calibrated.json", file, "--json")
    assert (other.code, json.loads(other.out)["same"]) == (1, False)


def test_currents_of_phases_become_those_of_axes() -> None:
    """A dump of C down to duty cycles has phase currents; the run knows both."""
    scenario = malta.Scenario(
        "hold", 0.01, malta.references.hold, fidelity="phase", quantize=False, noise=0.0
    )
    plant = malta.plant_of(CONTROLLER.parameters)
    run = malta.simulate(plant, CONTROLLER, scenario)
    log = malta.identification.log_of(run)
    phases = replace(
        log, columns={**log.columns, "i": run.i_phase}, signals={**log.signals, "i": plant.drive.phases}
    )
    found = in_axes(phases, plant)
    assert found.names("i") == [s.name for s in plant.drive.axes]
    assert found.columns["i"] == pytest.approx(run.i, abs=1e-5)
    assert np.abs(run.i).max() > 0.1
    assert in_axes(log, plant) is log

"""Logs of instruments and other programs: what is read has the numbers, units and sample times that were written."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import malta
from malta.identification import read_log
from malta.identification.readers.choice import ColumnChoice
from malta.identification.readers.raster import period_of, raster_of

TS, N = 50e-6, 400
T = TS * np.arange(N)
NAMES, UNITS = ["x1", "z", "i_dd1", "exc.f_D"], ["m", "m", "A", "N"]
TABLE = np.column_stack(
    [
        4e-5 * np.sin(300 * T),
        1e-4 * np.cos(50 * T),
        0.5 * np.sin(700 * T + 1),
        19 * np.sin(2 * np.pi * T / 5e-3),
    ]
)
HEADINGS = [f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True)]


def rows(separator: str = ",", decimal: str = ".", t: Any = T, *, fmt: str = "%.9g") -> str:
    lines = [
        separator.join(fmt % value for value in (moment, *row)) for moment, row in zip(t, TABLE, strict=True)
    ]
    return "\n".join(line.replace(".", decimal) for line in lines) + "\n"


def head(separator: str = ",", *, bracket: str = "[]", time: str = "t") -> str:
    names = [f"{time} [s]", *HEADINGS]
    return separator.join(n.replace("[", bracket[0]).replace("]", bracket[1]) for n in names) + "\n"


def scope(header: str, number: str = "%.6e,%.6e,%.6e\n", scale: float = 1e5) -> str:
    return header + "".join(
        number % (t, scale * x, i) for t, x, i in zip(T, TABLE[:, 0], TABLE[:, 2], strict=True)
    )


TEK = """Model,MSO58
Firmware Version,1.40.9

Point Format,Y,
Horizontal Units,s,
Sample Interval,5e-05,
Probe Attenuation,1,1
Vertical Units,V,V
Vertical Offset,0,0
Yzero,0,0

Label,x1,i_dd1
TIME,CH1,CH2
"""
TWINCAT = """Name|Scope Project
File|C:\\log.svdx
Starttime of export|132774

Name|x1|Name|i_dd1
SymbolComment||SymbolComment|
Data-Type|REAL64|Data-Type|REAL64
SampleTime[ms]|0,05|SampleTime[ms]|0,05
Unit|m|Unit|A
""".replace("|", "\t")
LVM = """LabVIEW Measurement|
Writer_Version|2
Separator|Tab
X_Columns|One
***End_of_Header***||
Channels|2||
Samples|400|400|
Y_Unit_Label|m|A
X_Dimension|Time|Time|
X0|0|0|
Delta_X|5E-5|5E-5|
***End_of_Header***|||
X_Value|x1|i_dd1|Comment
""".replace("|", "\t")
STAMPS = [str(np.datetime64("2026-11-27T23:59:59.99", "us") + round(1e6 * t)) for t in T]

TEXTS: dict[str, tuple[str | bytes, dict[str, Any]]] = {
    "semicolon.csv": (head(";") + rows(";", ","), {}),
    "semicolon_dot.csv": (head(";") + rows(";"), {}),
    "tabs.txt": (head("\t") + rows("\t"), {}),
    "spaces.dat": (
        "".join(f"{n}_[{u}] " for n, u in zip(["t", *NAMES], ["s", *UNITS], strict=True))
        + "\n"
        + rows("   "),
        {},
    ),
    "savetxt.txt": ("# " + head(" ").replace(" [", "[") + rows(" "), {}),
    "paren.csv": (head(bracket="()") + rows(), {}),
    "slash.csv": (
        ",".join(f"{n} / {u}" for n, u in zip(["t", *NAMES], ["s", *UNITS], strict=True)) + "\n" + rows(),
        {},
    ),
    "quoted.csv": (",".join(f'"{n}"' for n in head().strip().split(",")) + "\n" + rows(), {}),
    "two_rows.csv": ("t," + ",".join(NAMES) + "\ns," + ",".join(UNITS) + "\n" + rows(), {}),
    "bom_crlf.csv": (("\ufeff" + head(time="Time") + rows()).replace("\n", "\r\n").encode(), {}),
    "utf16.csv": ((head() + rows()).encode("utf-16"), {}),
    "latin1.csv": (
        (head() + rows()).replace("x1 [m]", "x1 [\u00b5m]").encode("latin-1"),
        {"columns": '"x1":m'},
    ),
    "packed.csv.gz": (gzip.compress((head() + rows()).encode()), {}),
    "index.csv": (",".join(["", *HEADINGS]) + "\n" + rows(t=np.arange(N)), {"sample_time": TS}),
    "instants.csv": (
        head()
        + "".join(
            f"{s},{line.split(',', 1)[1]}\n" for s, line in zip(STAMPS, rows().splitlines(), strict=True)
        ),
        {},
    ),
    "unix.csv": (head() + rows(t=1.7642e9 + T, fmt="%.17g"), {}),
    "cut.csv": (head() + rows() + "0.02,1e-5,2e-", {}),
    "tek.csv": (scope(TEK), {"columns": "x1=x1:10um/V,i_dd1=i_dd1:A/V"}),
    "keysight.csv": (scope("x-axis,1,2\nsecond,Volt,Volt\n"), {"columns": "x1=1:10um/V,i_dd1=2:A/V"}),
    "saleae.csv": (
        scope("Time [s],Channel 0,Channel 1\n", "%.9f,%.6f,%.6f\n"),
        {"columns": 'x1="Channel 0":10um/V,i_dd1="Channel 1":A'},
    ),
    "lecroy.csv": (
        "LECROYHDO6104,17161,Waveform\nSegments,1,SegmentSize,400\nSegment,TrigTime,TimeSinceSegment1\n"
        "#1,27-Nov-2026 22:10:11,0\nTime,Ampl\n"
        + "".join(f"{t:.6e},{1e5 * x:.6e}\n" for t, x in zip(T, TABLE[:, 0], strict=True)),
        {"columns": "x1=Ampl:10um"},
    ),
    "rigol.csv": (
        "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-5.000000e-01,5.000000e-05\n"
        + "".join(f"{k},{1e5 * x:.6e},{i:.6e},\n" for k, (x, i) in enumerate(TABLE[:, [0, 2]])),
        {"columns": "x1=CH1:10um/V,i_dd1=CH2:A/V"},
    ),
    "twincat.csv": (
        TWINCAT
        + "".join(
            f"{1e3 * t:.4f}\t{x:.9g}\t{1e3 * t:.4f}\t{i:.9g}\n".replace(".", ",")
            for t, x, i in zip(T, TABLE[:, 0], TABLE[:, 2], strict=True)
        ),
        {},
    ),
    "labview.lvm": (scope(LVM, "%.6f\t%.9g\t%.9g\n", 1.0), {}),
}


def require_same(path: Path, options: dict[str, Any], least: int = 1) -> malta.identification.Log:
    """Read a file, and compare each of its signals with what was written."""
    found = read_log(path, **options)
    assert found.samples == N
    assert found.sample_time == pytest.approx(TS, rel=1e-9)
    signals = [(group, name) for group in found.columns for name in found.names(group)]
    assert len(signals) >= least
    for group, name in signals:
        k = NAMES.index("exc." + name if group == "excitation" else name)
        values = found.table(group, [name])[:, 0]
        assert values == pytest.approx(TABLE[:, k], abs=2e-6 * np.abs(TABLE[:, k]).max())
    return found


@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_instruments_are_read(name: str, tmp_path: Path) -> None:
    content, options = TEXTS[name]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = require_same(path, options, 1 if name == "lecroy.csv" else 2)
    if "excitation" in found.columns:
        assert found.period == pytest.approx(5e-3, rel=1e-9)
        assert any("repeats itself" in note for note in found.notes)


def test_words_for_missing_readings_and_columns_of_no_signal(tmp_path: Path) -> None:
    lines = ["t [s],x1 [m],T [degC],v [m/s],flag.ok [1],comment", "0,1e-5,25,0.1,1,start"]
    lines += [
        f"{k}e-3,{word},25,0.1,1,x"
        for k, word in enumerate(["NaN", "NA", "-", "#N/A", "n/a", "null", "", "2e-5"], 1)
    ]
    path = tmp_path / "words.csv"
    path.write_text("\n".join(lines) + "\n")
    found = read_log(path)
    assert (found.samples, found.survey.missing["x1"], found.names("flags")) == (9, 7, ["ok"])
    assert found.notes == ("not used: T [degC], v [m/s]",)


def test_a_damaged_row_is_no_header(tmp_path: Path) -> None:
    lines = (head() + rows()).splitlines()
    for at, line in ((200, "0.01,1,2,3"), (300, "0.015,a,1,2,3")):
        path = tmp_path / "bad.csv"
        path.write_text("\n".join([*lines[:at], line, *lines[at + 1 :]]))
        with pytest.raises(malta.InputError, match=f"a line that cannot be read.*row {at}"):
            read_log(path)


Maker = Callable[[Path], None]


def _mdf(path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        signals = [
            asammdf.Signal(v, T, name=n, unit=u) for v, n, u in zip(TABLE.T, NAMES, UNITS, strict=True)
        ]
        file.append(signals)
        file.append([asammdf.Signal(np.arange(3.0), 0.3 * np.arange(3), name="temperature", unit="degC")])
        file.save(path)


def _tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(path)) as file:
        file.write_segment(
            [
                nptdms.ChannelObject("log", n, v, {"unit_string": u, "wf_increment": TS, "wf_samples": N})
                for v, n, u in zip(TABLE.T.copy(), NAMES, UNITS, strict=True)
            ]
        )


def _hdf5(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        group = file.create_group("bench")
        group["t"] = T
        for v, n, u in zip(TABLE.T, NAMES, UNITS, strict=True):
            group[n] = v
            group[n].attrs["unit"] = u


def _parquet(path: Path) -> None:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    stamps = np.datetime64("2026-11-27", "ns") + np.round(1e9 * T).astype("m8[ns]")
    parquet.write_table(arrow.table([*TABLE.T.copy(), stamps], names=[*NAMES, "time"]), path)


def _mcap(path: Path) -> None:
    writer = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        file = writer.Writer(stream)
        file.start()
        schema = file.register_schema("row", "jsonschema", b'{"type":"object"}')
        channel = file.register_channel("log", "json", schema)
        for t, row in zip(T, TABLE.tolist(), strict=True):
            stamp = round(1e9 * t)
            file.add_message(channel, stamp, json.dumps(dict(zip(NAMES, row, strict=True))).encode(), stamp)
        file.finish()


def _bag(path: Path) -> None:
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    message, layout = (store.types[f"std_msgs/msg/{n}"] for n in ("Float64MultiArray", "MultiArrayLayout"))
    with rosbag2.Writer(path, version=9) as file:
        topic = file.add_connection("/log", message.__msgtype__, typestore=store)
        for t, row in zip(T, TABLE, strict=True):
            raw = store.serialize_cdr(message(layout([], 0), row), message.__msgtype__)
            file.write(topic, round(1e9 * t) + 1, raw)


UNIT_CHOICE = {"columns": "x1:m,z:m,i_*:A,exc.*:N"}
NUMBERED = {"columns": "x1={0}1:m,z={0}2:m,i_dd1={0}3:A,exc.f_D={0}4:N"}
BINARY: dict[str, tuple[Maker, dict[str, Any]]] = {
    "dspace.mf4": (_mdf, {}),
    "ni.tdms": (_tdms, {}),
    "log.h5": (_hdf5, {}),
    "log.parquet": (_parquet, UNIT_CHOICE),
    "log.mcap": (_mcap, UNIT_CHOICE),
    "bag": (_bag, {"columns": NUMBERED["columns"].format("data_")}),
}


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::PendingDeprecationWarning")
def test_binary_files_of_instruments_are_read(name: str, tmp_path: Path) -> None:
    make, options = BINARY[name]
    make(tmp_path / name)
    require_same(tmp_path / name, options, 4)


def test_rasters_of_a_file_have_to_be_one(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "two.mf4"
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(TABLE[:, 0], T, name="x1", unit="m")])
        file.append([asammdf.Signal(TABLE[::2, 2], T[::2], name="i_dd1", unit="A")])
        file.save(path)
    with pytest.raises(malta.InputError, match=r"different rasters: .*x1 400.*i_dd1 200"):
        read_log(path)


def matlab_files(folder: Path) -> dict[str, dict[str, Any]]:
    from scipy.io import savemat

    recording = np.zeros(4, dtype=[("Name", object), ("Unit", object), ("Data", object), ("XIndex", object)])
    for k in range(4):
        recording[k] = ("Model Root/" + NAMES[k], UNITS[k], TABLE[:, k], 1)
    axis = {"Name": "time", "Data": T, "Unit": "s"}
    savemat(folder / "dspace.mat", {"rec1": {"X": axis, "Y": recording, "Description": {}}})
    signals = {"values": TABLE, "dimensions": 4, "label": "y"}
    savemat(folder / "simulink.mat", {"logsout": {"time": T[:, None], "signals": signals}})
    savemat(folder / "tofile.mat", {"ans": np.vstack([T, TABLE.T])})
    savemat(
        folder / "vectors.mat",
        {"time": T, **{n.replace(".", "_"): v for n, v in zip(NAMES, TABLE.T, strict=True)}},
    )
    groups = {"t": T, "y": TABLE[:, :2], "y_columns": np.array(["x1 [m]", "z [m]"]), "u": np.zeros((0, 0))}
    savemat(
        folder / "char.mat",
        {**groups, "u_columns": np.zeros((0, 0)), "i": TABLE[:, 2], "i_columns": "i_dd1 [A]"},
    )
    columns = "exc.f_D=exc_f_D:N,x1:m,z:m,i_*:A"
    return {
        "dspace.mat": {},
        "simulink.mat": {"columns": NUMBERED["columns"].format("y_")},
        "tofile.mat": {"columns": "x1=ans_2:m,z=ans_3:m,i_dd1=ans_4:A,exc.f_D=ans_5:N"},
        "vectors.mat": {"columns": columns},
        "char.mat": {},
    }


def test_matlab_simulink_dspace_and_empty_arrays_are_read(tmp_path: Path) -> None:
    for name, options in matlab_files(tmp_path).items():
        require_same(tmp_path / name, options, 3)


def test_text_of_octave_is_read(tmp_path: Path) -> None:
    def matrix(name: str, table: Any) -> str:
        lines = "\n".join(" " + " ".join(f"{x:.17g}" for x in row) for row in np.atleast_2d(table))
        return f"# name: {name}\n# type: matrix\n# rows: {len(table)}\n# columns: {np.shape(table)[1]}\n{lines}\n\n\n"

    def text(words: str) -> str:
        return f"# type: sq_string\n# elements: 1\n# length: {len(words)}\n{words}\n\n\n"

    cell = "# name: y_columns\n# type: cell\n# rows: 2\n# columns: 1\n"
    cell += "".join(f"# name: <cell-element>\n{text(words)}" for words in ("x1 [m]", "z [m]")) + "\n\n"
    path = tmp_path / "octave.mat"
    parts = ["# Created by Octave 8.4.0\n", matrix("t", T[:, None]), matrix("y", TABLE[:, :2]), cell]
    path.write_text("".join([*parts, "# name: machine\n", text("tubular")]))
    assert require_same(path, {}, 2).machine == "tubular"


def test_mat_files_of_version_7_3_are_read(tmp_path: Path) -> None:
    """As MATLAB lays them out: arrays turned, characters as numbers, cells as references."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "new.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, table in (("t", T[None]), ("y", TABLE[:, :2].T)):
            file[name] = table
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        refs = []
        for k, words in enumerate(("x1 [m]", "z [m]")):
            file[f"#refs#/{k}"] = np.array([[ord(c)] for c in words], dtype=np.uint16)
            file[f"#refs#/{k}"].attrs["MATLAB_class"] = np.bytes_("char")
            refs.append([file[f"#refs#/{k}"].ref])
        file.create_dataset("y_columns", data=np.array(refs, dtype=h5py.ref_dtype))
        file["y_columns"].attrs["MATLAB_class"] = np.bytes_("cell")
    require_same(path, {}, 2)


def test_compressed_archives_are_read_and_bombs_are_not(tmp_path: Path) -> None:
    groups: dict[str, Any] = {"t": T, "y": TABLE[:, :2], "y_columns": np.array(["x1 [m]", "z [m]"])}
    np.savez_compressed(tmp_path / "small.npz", **groups)
    require_same(tmp_path / "small.npz", {}, 2)
    np.savez_compressed(tmp_path / "bomb.npz", t=np.zeros(9_000_000))
    with pytest.raises(malta.InputError, match="compressed or overlap"):
        read_log(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    ("package", "suffix"),
    [("asammdf", ".mf4"), ("nptdms", ".tdms"), ("h5py", ".h5"), ("mcap.reader", ".mcap")],
)
def test_a_package_that_is_not_there_is_named(
    package: str, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> None:
        raise ImportError(f"{name}, {package}")

    (tmp_path / f"log{suffix}").write_bytes(b"\x89HDF\r\n\x1a\n")
    monkeypatch.setattr("malta.identification.readers.raw.import_module", fail)
    with pytest.raises(
        malta.InputError, match=rf"a {suffix} file without \w+, expected .*pip install 'malta\[formats\]'"
    ):
        read_log(tmp_path / f"log{suffix}")


@pytest.mark.parametrize(
    ("columns", "found"),
    [
        ("x1", "NAME=COLUMN:UNIT"),
        ("x1=CH9:m", "no such column in scope.csv, expected one of"),
        ("x1=CH1:furlong", "furlong"),
        ("x1=CH1:0m", "what 1 in the column is"),
        ("x1=CH1:m,x1=CH2:m", "two columns"),
        ("x1=CH1:m/s", "a prefix that tells the group"),
        ("x1=CH1", "unit 'count'"),
        ("q*:m", "a pattern as x"),
    ],
)
def test_choices_that_fit_nothing_are_refused(columns: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "scope.csv").write_text("t [s],CH1 [count],CH2\n0,1,2\n1,2,3\n2,3,4\n")
    with pytest.raises(malta.InputError, match=found):
        read_log(tmp_path / "scope.csv", columns=columns)


def test_a_factor_is_what_one_in_the_file_is(tmp_path: Path) -> None:
    (tmp_path / "scope.csv").write_text("stamp,CH1 [mV],CH2 [count]\n0,1000,2\n1,2000,3\n2,3000,4\n")
    choice = "x1=CH1:10um/V,y.a=CH2:-0.5mm/s^2"
    found = read_log(tmp_path / "scope.csv", columns=choice, time="stamp:ms")
    assert found.columns["y"] == pytest.approx(np.array([[1e-5, -1e-3], [2e-5, -1.5e-3], [3e-5, -2e-3]]))
    assert (found.sample_time, found.t.tolist()) == (1e-3, pytest.approx([0, 1e-3, 2e-3]))
    items = ColumnChoice.of('i1="Coil, a: left":A').columns
    assert [(one.signal, one.column, one.unit) for one in items] == [("i1", "Coil, a: left", "A")]


def test_an_excitation_comes_from_a_file_of_its_own(tmp_path: Path) -> None:
    one, log = tmp_path / "one.csv", tmp_path / "log.csv"
    force = TABLE[:100, 3].tolist()
    one.write_text(
        "t [s],exc.f_D [N]\n"
        + "".join(f"{t!r},{f!r}\n" for t, f in zip(T[:100].tolist(), force, strict=True))
    )
    log.write_text(
        "t [s],x1 [m]\n"
        + "".join(f"{t!r},{x!r}\n" for t, x in zip(T.tolist(), TABLE[:, 0].tolist(), strict=True))
    )
    found = read_log(log, excitation=one)
    assert found.period == pytest.approx(5e-3, rel=1e-12)
    assert found.columns["excitation"][:, 0] == pytest.approx(np.tile(force, 4))
    one.write_text("t [s],exc.f_D [N]\n0,1\n1e-4,2\n2e-4,1\n")
    with pytest.raises(malta.InputError, match=r"samples of 0\.0001 s, expected those of the log"):
        read_log(log, excitation=one)


# Rasters: the period of times, however coarsely they are written.

LONG = TS * np.arange(60_000)


@pytest.mark.parametrize(
    ("t", "error"),
    [
        (
            1.7642e9 + LONG,
            1e-6,
        ),  # seconds since 1970, of which a double keeps 0.24 us; the median was 50.068 us
        ((10 + LONG).astype(np.float32).astype(float), 1e-5),
        ((100 + LONG).astype(np.float32).astype(float), 1e-5),
        ((1000 + LONG).astype(np.float32).astype(float), 1e-4),
        (np.round(LONG, 4), 1e-4),
        (np.delete(LONG, slice(300, 9000)), 1e-12),
        (np.delete(1.7642e9 + LONG, slice(300, 9000)), 1e-6),
    ],
)
def test_the_sample_time_is_that_of_the_whole_record(t: Any, error: float) -> None:
    found = raster_of(t, 0.0, "log")
    assert found.sample_time == pytest.approx(TS, rel=error)
    assert found.jitter == 0
    k = (found.t - found.t[0]) / found.sample_time
    assert np.abs(k - np.round(k)).max() < 1e-3


def test_jitter_is_not_rounding() -> None:
    late = LONG + np.abs(np.random.default_rng(1).normal(size=len(LONG))) * 1e-6
    assert raster_of(late, 0.0, "log").jitter == pytest.approx(0.6e-6 * 2**0.5, rel=0.02)


@pytest.mark.parametrize(
    ("t", "named", "found"),
    [
        ([0, 1, 0.5], 0.0, "times that do not rise: 0.5 s in row 3 after 1 s"),
        (np.insert(LONG, 7, LONG[7]), 0.0, r"0\.00035 s in rows 8 and 9"),
        (
            [0, 1, 2],
            1e-3,
            r"0\.001 s, while the times rise by 1 s \(1000 times as short: another unit of time\?\)",
        ),
        ([0, np.nan, 2], 0.0, "times that do not rise"),
    ],
)
def test_times_that_are_no_raster_are_refused(t: Any, named: float, found: str) -> None:
    with pytest.raises(malta.InputError, match=found):
        raster_of(np.array(t, dtype=float), named, "log")


def test_stamps_tell_their_unit(tmp_path: Path) -> None:
    first = int(1e9 * datetime(2026, 11, 27).timestamp())
    path = tmp_path / "stamps.csv"
    path.write_text("timestamp,x1 [m]\n" + "".join(f"{first + 50_000 * k},{k}e-6\n" for k in range(1000)))
    found = read_log(path)
    assert found.sample_time == pytest.approx(TS, rel=1e-4)
    assert "times are stamps in 1e-09 s since 1970" in found.notes


def test_a_period_is_found_where_columns_repeat_themselves() -> None:
    random = np.random.default_rng(2)
    one = random.normal(size=(137, 2))
    assert period_of(np.tile(one, (5, 1))[30:]) == 137
    assert period_of(np.concatenate([np.zeros((500, 2)), np.tile(one, (4, 1))])) == 137
    assert period_of(random.normal(size=(400, 2))) == 0
    assert period_of(np.ones((400, 2))) == 0


@pytest.mark.parametrize("command", [["log"], ["identify", "design/gains/robust.json"]])
def test_a_time_that_is_no_number_names_the_column_of_times(
    tmp_path: Path, command: list[str], run: Callable[..., Any]
) -> None:
    """--time is how long a command takes; of a log it may name the column, as --stamps does."""
    path = tmp_path / "log.csv"
    heading = "stamp," + ",".join(f"{n} [{u}]" for n, u in zip(NAMES, UNITS, strict=True))
    np.savetxt(path, np.column_stack([1e3 * T, TABLE]), delimiter=",", header=heading, comments="")
    options = (
        ("--time", "stamp:ms"),
        ("--stamps", "stamp:ms"),
        ("--time", "gone:ms"),
        ("--time", "stamp", "--stamps", "t"),
    )
    one, other, gone, both = (run(*command, path, *given) for given in options)
    assert one == other
    assert "gone" in gone.err
    assert "--stamps: found --time COLUMN too" in both.err

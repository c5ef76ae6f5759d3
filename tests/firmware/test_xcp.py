"""The exported XCP slave: pyxcp calibrates and measures over loopback and over a pseudo-terminal."""

from __future__ import annotations

import importlib
import os
import pty
import re
import socket
import struct
import subprocess
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from conftest import ROOT
from exported import HERE, build, require, target

from malta.errors import InputError
from malta.firmware import export, xcp_master
from malta.firmware.calibration import parameters_of
from malta.firmware.export import a2l_text, folder_files
from malta.firmware.signals import Target
from malta.firmware.supervisor import STATES, TIMES
from malta.firmware.xcp import (
    FOUND,
    PARAMETERS,
    SUPERVISOR,
    WIRED,
    XcpPort,
    read_port,
    time_stamps,
    wiring_results,
)
from malta.firmware.xcp_master import XcpMaster

if TYPE_CHECKING:
    from conftest import Run

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def slave(port: int = 5555) -> Target:
    return replace(target("halbach", "double"), tunable=True, xcp=XcpPort(port=port))


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The slave for this computer."""
    require("gcc")
    folder = tmp_path_factory.mktemp("xcp")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "costs", lambda _: [])
        for file, text in folder_files(slave(), "0" * 64, proof=False).items():
            (folder / file).write_text(text, encoding="utf-8")
    warnings = (
        "-Werror",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        "-Wshadow",
        "-Wconversion",
        "-Wdouble-promotion",
        "-Wundef",
    )
    return build(HERE, folder, *warnings, main="_xcp_pc")


@contextmanager
def running(program: Path, *arguments: str) -> Iterator[Any]:
    started = subprocess.Popen(
        [program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert started.stdout is not None
    assert started.stderr is not None
    try:
        assert started.stdout.readline() == "ready\n", started.stderr.read()
        yield started
    finally:
        started.kill()
        started.wait()
        started.stdout.close()
        started.stderr.close()


class Kept:
    """What comes of data: a policy of pyxcp's frames."""

    def __init__(self) -> None:
        self.data: list[bytes] = []

    def feed(self, category: Any, _counter: int, _time: int, payload: bytes) -> None:
        if category.name == "DAQ":
            self.data.append(bytes(payload))

    def finalize(self) -> None:
        pass


@contextmanager
def master(kept: Any = None, **transport: Any) -> Iterator[Any]:
    """A master of pyxcp, connected."""
    pytest.importorskip("pyxcp", exc_type=ImportError)
    config: Any = importlib.import_module("pyxcp.config")
    Master = importlib.import_module("pyxcp.master").Master
    app = config.PyXCP()
    app.general, app.transport = config.General(parent=app), config.Transport(parent=app)
    app.general.disable_error_handling = True
    kind, options = next(iter(transport.items()))
    app.transport.layer = kind.upper()
    app.transport.timeout = 1.0
    for key, value in options.items():
        setattr(getattr(app.transport, kind), key, value)
    with Master(kind, app, policy=kept) as one:
        one.connect()
        yield one


def udp(port: int) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": port, "protocol": "UDP"}


def reals(m: Any, area: int, offset: int, count: int) -> tuple[float, ...]:
    return struct.unpack(f"<{count}d", bytes(m.shortUpload(8 * count, (area << 16) + offset)))


def error_of(call: Any) -> bytes:
    """The bytes of a refusal."""
    XcpResponseError = importlib.import_module("pyxcp.types").XcpResponseError
    with pytest.raises(XcpResponseError) as caught:
        call()
    return bytes([int(caught.value.get_error_code())])


def calibrate(m: Any) -> None:
    """Half of a limit is taken, twice of it refused, and half a number or one of another type not written."""
    offset = sum(
        8 * p.field.size
        for p in parameters_of(slave())[: [p.field.name for p in parameters_of(slave())].index("force_limit")]
    )
    (own,) = reals(m, PARAMETERS, offset, 1)
    m.setMta((PARAMETERS << 16) + offset)
    m.download(struct.pack("<d", own / 2))
    m.setCalPage(0x01, 0, 1)
    time.sleep(0.3)
    assert commits(m) == (0, -1, 1)
    m.setMta((PARAMETERS << 16) + offset)
    m.download(struct.pack("<d", 2 * own))
    assert error_of(lambda: m.setCalPage(0x01, 0, 1)) == b"\x22"
    assert commits(m) == (3, offset // 8, 1)
    for data, at in ((struct.pack("<f", 1.0), offset), (struct.pack("<d", own), offset + 4)):
        m.setMta((PARAMETERS << 16) + at)
        assert error_of(lambda data=data: m.download(data)) == b"\x22"
    m.setMta(SUPERVISOR << 16)
    assert error_of(lambda: m.download(bytes(8))) == b"\x23"
    m.copyCalPage(0, 0, 0, 1)
    assert reals(m, PARAMETERS, offset, 1) == (own,)


def commits(m: Any) -> tuple[int, ...]:
    """Reason, entry and count of the commits."""
    return struct.unpack("<4i", bytes(m.shortUpload(16, 6 << 16)))[1:]


def test_pyxcp_calibrates_over_loopback(program: Path) -> None:
    port = free_port()
    with running(program, "udp", "127.0.0.1", str(port)), master(eth=udp(port)) as m:
        assert m.slaveProperties.maxCto == 128
        assert bytes(m.identifier(1), "ascii") if isinstance(m.identifier(1), str) else m.identifier(1)
        calibrate(m)


def test_pyxcp_calibrates_over_a_serial_line(program: Path) -> None:
    here, there = pty.openpty()
    tty.setraw(here)
    tty.setraw(there)
    far, near = pty.openpty()
    tty.setraw(far)
    tty.setraw(near)
    bridge = subprocess.Popen(["python3", "-c", BRIDGE, str(here), str(far)], pass_fds=(here, far))
    try:
        options = {"port": os.ttyname(near), "bitrate": 115200, "tail_format": "CHECKSUM_BYTE"}
        with running(program, "serial", os.ttyname(there)), master(sxi=options) as m:
            calibrate(m)
    finally:
        bridge.kill()
        bridge.wait()
        for number in (here, there, far, near):
            os.close(number)


BRIDGE = """import os, select, sys
a, b = int(sys.argv[1]), int(sys.argv[2])
while True:
    for one in select.select([a, b], [], [])[0]:
        os.write(b if one == a else a, os.read(one, 4096))
"""


def test_every_sample_of_the_law_is_measured(program: Path) -> None:
    """A list of the supervisor's state and of a reading, with time stamps: each sample has the next number."""
    port, kept = free_port(), Kept()
    state = (SUPERVISOR << 16) + 4 * len(TIMES)
    with running(program, "udp", "127.0.0.1", str(port)), master(kept, eth=udp(port)) as m:
        m.freeDaq()
        m.allocDaq(1)
        m.allocOdt(0, 1)
        m.allocOdtEntry(0, 0, 2)
        m.setDaqPtr(0, 0, 0)
        m.writeDaq(0xFF, 4, 0, state)
        m.writeDaq(0xFF, 8, 0, 3 << 16)
        assert error_of(lambda: m.writeDaq(0xFF, 8, 0, 3 << 16)) == b"\x29"
        m.setDaqListMode(0x10, 0, 0, 1, 0)
        m.startStopDaqList(0x02, 0)
        m.startStopSynch(0x01)
        time.sleep(0.8)
        m.startStopSynch(0x00)
        assert m.getDaqEventInfo(0).daqEventProperties
    rows = [struct.unpack("<BIid", data) for data in kept.data]
    numbers = [row[1] for row in rows]
    assert len(rows) > 5
    assert [b - a for a, b in pairwise(numbers)] == [1] * (len(rows) - 1)
    assert {list(STATES)[row[2]] for row in rows} <= {"OFF", "OFFSETS", "SENSORS"}


def ask(s: socket.socket, packet: bytes, length: int | None = None) -> bytes:
    """The answer to a packet; b"" where none comes."""
    s.send(struct.pack("<HH", len(packet) if length is None else length, 0) + packet)
    try:
        return s.recv(512)[4:]
    except TimeoutError:
        return b""


@contextmanager
def raw(port: int) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.settimeout(0.5)
        s.connect(("127.0.0.1", port))
        yield s


def test_a_second_master_and_a_frame_cut_short_are_refused(program: Path) -> None:
    """Each with one reason, and nothing of it is done."""
    port = free_port()
    with running(program, "udp", "127.0.0.1", str(port)), raw(port) as one, raw(port) as two:
        assert ask(one, b"\xfd") == b""  # who is not connected is not answered
        assert ask(one, b"\xff\x00")[:1] == b"\xff"
        assert ask(two, b"\xff\x00") == b"\xfe\x33"
        assert ask(two, b"\xfd") == b"\xfe\x33"
        assert ask(one, b"\xfd\x00", length=9) == b"\xfe\x21"
        assert ask(one, b"\xf6\x00\x00") == b"\xfe\x21"  # SET_MTA without its address
        assert ask(one, b"\x11") == b"\xfe\x20"
        assert ask(one, b"\xf4\x08\x00\x00" + struct.pack("<I", 9 << 16)) == b"\xfe\x22"
        assert ask(one, b"\xfe") == b"\xff"
        assert ask(two, b"\xff\x00")[:1] == b"\xff"


@pytest.mark.slow
def test_a_connection_that_is_lost_leaves_what_was_committed(program: Path) -> None:
    """The law goes on; the next master, after some silence, finds what was committed."""
    port = free_port()
    with running(program, "udp", "127.0.0.1", str(port)):
        with raw(port) as one:
            ask(one, b"\xff\x00")
            ask(one, b"\xf6\x00\x00\x00" + struct.pack("<I", PARAMETERS << 16))
            own = struct.unpack("<d", ask(one, b"\xf5\x08")[1:])[0]
            ask(one, b"\xf6\x00\x00\x00" + struct.pack("<I", PARAMETERS << 16))
            assert ask(one, b"\xf0\x08" + struct.pack("<d", 1.01 * own)) == b"\xff"
            assert ask(one, b"\xeb\x01\x00\x01") == b"\xff"
        with raw(port) as two:
            assert ask(two, b"\xff\x00") == b"\xfe\x33"
            time.sleep(5.2)
            assert ask(two, b"\xff\x00")[:1] == b"\xff"
            answer = ask(two, b"\xf4\x10\x00\x00" + struct.pack("<I", 6 << 16))
            assert struct.unpack("<4i", answer[1:])[1:] == (0, -1, 1)


def test_a_busy_port_is_one_sentence(program: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        port = str(s.getsockname()[1])
        done = subprocess.run(
            [program, "udp", "127.0.0.1", port], capture_output=True, text=True, check=False, timeout=10
        )
    assert done.returncode == 2
    assert re.fullmatch(
        rf"UDP port {port} at 127.0.0.1: another program uses it; give another one, as: .*\n", done.stderr
    )
    gone = subprocess.run(
        [program, "serial", "/dev/no"], capture_output=True, text=True, check=False, timeout=10
    )
    assert (gone.returncode, gone.stderr.count("\n")) == (2, 1)


@pytest.mark.parametrize("port", ["70000", "0", "-1", "5555x", ""])
def test_a_port_that_is_none_is_one_sentence(program: Path, port: str) -> None:
    done = subprocess.run(
        [program, "udp", "127.0.0.1", port], capture_output=True, text=True, check=False, timeout=10
    )
    assert (done.returncode, done.stderr) == (2, f"UDP port: found {port}, expected 1 to 65535\n")


def test_the_a2l_has_the_slave_and_its_addresses() -> None:
    text = a2l_text(slave(6000), "halbach")
    assert '0x0100 6000 ADDRESS "127.0.0.1"' in text
    assert 'EVENT "a sample of the law"' in text
    assert "SYMBOL_LINK" not in text
    assert re.search(r"CHARACTERISTIC K\.\S+ .*\n\s+VALUE 0x10000 ", text)
    assert text.count("/begin") == text.count("/end")
    plain = a2l_text(replace(slave(), xcp=None), "halbach")
    assert "XCP" not in plain
    assert "SYMBOL_LINK" in plain


def test_ports_that_are_none_are_refused() -> None:
    assert read_port("5600", 57600) == XcpPort("127.0.0.1", 5600, 57600)
    for text, baud, words in (
        ("there:1", None, "ADDRESS:PORT"),
        ("70000", None, "1 to 65535"),
        ("5555", 1, "one of 9600"),
    ):
        with pytest.raises(InputError, match=words):
            read_port(text, baud)
    with pytest.raises(InputError, match="one that is tunable"):
        replace(slave(), tunable=False)


def test_time_stamps_count_samples() -> None:
    assert time_stamps(50e-6) == (4, 5)
    assert time_stamps(55e-3) == (6, 55)
    assert SimpleNamespace(**XcpPort()._asdict()).baud == 115200


@pytest.mark.slow
def test_signals_are_logged_live(program: Path, tmp_path: Path, run: Run) -> None:
    """`malta log --live`: every sample of the law, and a name that is none is refused with those that there are."""
    port, a2l = free_port(), tmp_path / "halbach.a2l"
    a2l.write_text(a2l_text(slave(), "halbach"), encoding="utf-8")
    command = ["log", str(a2l), "--live", f"127.0.0.1:{port}"]
    code, out, err = run(*command, "--signal", "in.y.x", "--for", "0.1")
    assert (code, out) == (2, "")
    assert "found no answer" in err
    with running(program, "udp", "127.0.0.1", str(port)):
        code, out, err = run(
            *command,
            "--signal",
            "in.y.x",
            "--signal",
            "supervisor.state",
            "--for",
            "1",
            "--out",
            str(tmp_path / "l.csv"),
        )
        assert code == 0, err
        assert "0 lost" in out
        rows = (tmp_path / "l.csv").read_text(encoding="utf-8").splitlines()
        assert rows[0] == "t [s],in.y.x [m],supervisor.state [1]"
        times = [float(row.split(",")[0]) for row in rows[1:]]
        assert len(times) > 5
        assert all(abs(b - a - 0.055) < 1e-9 for a, b in pairwise(times))
        code, _, err = run(*command, "--signal", "y_used.xx")
        assert code == 2
        assert "did you mean 'y_used.x'" in err


@pytest.mark.slow
def test_the_wiring_is_read_over_the_line(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """`malta commission --wiring` reads what a supervisor has found; the stand-in's was left out."""
    require("gcc")
    gains, port = ROOT / "design" / "gains" / "robust.json", free_port()
    monkeypatch.setattr(export, "costs", lambda _: [])
    code, _, err = run(
        "export",
        str(gains),
        "--xcp",
        f"127.0.0.1:{port}",
        "--wiring",
        "--no-proof",
        "--out",
        str(tmp_path / "c"),
    )
    assert code == 0, err
    with running(build(HERE, tmp_path / "c", main="_xcp_pc")):
        code, out, err = run("commission", str(gains), "--wiring", f"127.0.0.1:{port}")
    assert (code, out) == (1, "")
    assert "the wiring was not tried" in err


class Memory:
    """A slave that answers from what it has: the areas of its wiring, its name, and the size of its numbers."""

    def __init__(self, law: str, t: Target, members: dict[str, float]) -> None:
        self.data, self.sent, self.law, self.size = list[bytes](), b"", law.encode(), t.real_bytes
        self.areas = dict[int, bytes]()
        for area, letter, names in zip(
            (WIRED, FOUND), ("i", "d" if self.size == 8 else "f"), wiring_results(t), strict=True
        ):
            values = [members.get(name, 1) for name, size in names for _ in range(max(size, 1))]
            self.areas[area] = struct.pack(
                f"<{len(values)}{letter}", *(values if letter != "i" else map(int, values))
            )

    def send(self, packet: bytes) -> None:
        self.sent = packet

    def receive(self, _seconds: float) -> bytes:
        if self.sent[0] == 0xFA:
            return struct.pack("<BBHI", 0xFF, 0, 0, len(self.law))
        if self.sent[0] == 0xF5:
            return b"\xff" + self.law
        if self.sent[0] == 0xD9:
            return bytes([0xFF, 1, self.size, 1, 0, 0x44, 5, 0])
        if self.sent[0] != 0xF4:
            return b"\xff"
        area, at = divmod(struct.unpack("<I", self.sent[4:8])[0], 1 << 16)
        found = self.areas[area][at : at + self.sent[1]]
        return b"\xff" + found if len(found) == self.sent[1] else b"\xfe\x22"


@pytest.mark.slow
def test_the_wiring_of_any_export_is_read(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of numbers of four bytes, and of an export down to currents; another law is refused by its name."""
    gains, law, wired = str(ROOT / "design" / "gains" / "halbach.json"), "halbach", 1
    t = replace(target("halbach", "float"), fidelity="force", tunable=True, wiring=True)

    @contextmanager
    def connected(where: str) -> Iterator[XcpMaster]:
        yield XcpMaster(Memory(law, t, {"doubt": -1, "cables": 0, "wired": wired}), where)

    monkeypatch.setattr(xcp_master, "xcp_master", connected)
    code, _, err = run("commission", gains, "--wiring", "there:1")
    assert code == 1
    assert "there:1: " in err
    wired = 0
    code, out, err = run("commission", gains, "--wiring", "there:1")
    assert (code, out) == (1, "")  # nobody takes this for wiring that is right
    assert "the wiring was not tried" in err
    law = "other"
    code, _, err = run("commission", gains, "--wiring", "there:1")
    assert (code, err) == (2, "malta: there:1: law: found other, expected halbach, that of the gain file\n")


@pytest.mark.parametrize(
    "where",
    [
        "",
        "127.0.0.1",
        ":5556",
        "127.0.0.1:",
        "127.0.0.1:abc",
        "127.0.0.1:0",
        "127.0.0.1:65536",
        "host:5555.5",
    ],
)
def test_what_is_no_address_of_a_slave_is_not_taken_for_a_serial_port(where: str, run: Run) -> None:
    code, out, err = run("commission", str(ROOT / "design/gains/robust.json"), "--wiring", where)
    assert (code, out) == (2, "")
    expected = "ADDRESS:PORT with a port of 1 to 65535, as 127.0.0.1:5555, or a serial port, as /dev/ttyUSB0"
    assert err == f"malta: address of an XCP slave: found {where!r}, expected {expected}\n"


@pytest.mark.parametrize("where", ["/dev/none", "./none", "COMX"])
def test_a_serial_port_that_is_none_is_named(where: str, run: Run) -> None:
    code, _, err = run("commission", str(ROOT / "design/gains/robust.json"), "--wiring", where)
    assert code == 2
    assert err.startswith(f"malta: {where}: found ")


@pytest.mark.parametrize(
    "option",
    [("--plan",), ("--json",), ("--logs", "l"), ("--out", "o"), ("--step", "loop"), ("--skip", "loop")],
)
def test_the_wiring_is_asked_for_alone(option: tuple[str, ...], run: Run) -> None:
    """Options that it would ignore are refused: --json promises a document."""
    gains = str(ROOT / "design" / "gains" / "robust.json")
    code, out, err = run("commission", gains, "--wiring", "127.0.0.1:5555", *option)
    assert (code, out) == (2, "")
    assert "other options beside it" in err


class Falls:
    """A slave that sends so many samples and then falls silent."""

    def __init__(self, samples: int) -> None:
        self.left, self.stamp, self.asked = samples, 0, b""

    def send(self, packet: bytes) -> None:
        self.asked = packet

    def receive(self, seconds: float) -> bytes:
        if self.asked and not (self.asked == b"\xdd\x00" or (self.asked == b"\xdd\x01" and self.stamp)):
            self.asked, self.stamp = b"", self.stamp + (self.asked == b"\xdd\x01")
            return b"\xff"
        if self.left == 0:
            time.sleep(min(seconds, 0.01))
            return b""
        self.left, self.stamp = self.left - 1, self.stamp + 1
        return struct.pack("<BId", 0, self.stamp, 0.5)


def test_what_a_line_gave_before_it_broke_is_kept(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The samples before a connection is lost are those that somebody looks for; it is not waited for until the end."""
    a2l, out = tmp_path / "halbach.a2l", tmp_path / "l.csv"
    a2l.write_text(a2l_text(slave(), "halbach"), encoding="utf-8")
    slaves = iter((Falls(7), Falls(0)))

    @contextmanager
    def connected(where: str, _baud: int) -> Iterator[XcpMaster]:
        yield XcpMaster(next(slaves), where)

    monkeypatch.setattr(xcp_master, "xcp_master", connected)
    monkeypatch.setattr(xcp_master, "ANSWER_TIME", 0.05)
    command = ("log", str(a2l), "--live", "there:1", "--signal", "in.y.x", "--for", "600", "--out", str(out))
    code, shown, err = run(*command)
    assert code == 1
    assert "7 samples, 0 lost" in shown
    assert "there:1: the line broke at 0.44 s; what came until then is above" in err
    assert len(out.read_text(encoding="utf-8").splitlines()) == 8
    out.unlink()
    code, _, err = run(*command)
    assert code == 2
    assert "found no answer" in err
    assert not out.exists()


def test_a_live_log_has_no_document(tmp_path: Path, run: Run) -> None:
    code, out, err = run("log", str(tmp_path / "a.a2l"), "--live", "127.0.0.1:5555", "--json")
    assert (code, out) == (2, "")
    assert "--json or --gains beside it" in err

"""`malta pil`: the exported program at the other end of a serial line, here a pseudo-terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from conftest import ROOT, one_sentence
from exported import HERE, PROCESSORS, Processor, build, texts
from hypothesis import given, strategies as st
from test_documents import document

import malta
from malta.errors import InputError
from malta.firmware import pil as serial_line
from malta.firmware.pil import START, Frame, frame_bytes
from malta.firmware.program import Precision

if TYPE_CHECKING:
    from conftest import Run

GAINS = ROOT / "design" / "gains" / "halbach.json"
SHA256 = json.loads(GAINS.read_text(encoding="utf-8"))["sha256"]
UART = """/* The serial port of QEMU's mps2-an386: a CMSDK UART. */
#include <stdint.h>
#define REGISTER(at) (*(volatile uint32_t *)(0x40004000u + (at)))
int32_t halbach_pil_get(void) {
  REGISTER(8) = 3u; /* on */
  while ((REGISTER(4) & 2u) == 0u) { }
  return (int32_t)(REGISTER(0) & 0xFFu);
}
void halbach_pil_put(uint32_t byte) { while ((REGISTER(4) & 1u) != 0u) { } REGISTER(0) = byte; }
uint32_t halbach_pil_count(void) { static uint32_t k; k += 21u; return k; }
"""


def write_target(folder: Path, precision: Precision = "double") -> Path:
    """The exported folder of the gain file, with its own sha256."""
    for file, text in texts("halbach", precision).items():
        (folder / file).write_text(text.replace("0" * 64, SHA256), encoding="utf-8")
    return folder


@pytest.fixture
def wire() -> Iterator[Callable[[list[str]], str]]:
    """Starts a program at the other end of a serial line; the port's name."""
    started: list[Any] = []

    def start(command: list[str]) -> str:
        here, there = pty.openpty()
        tty.setraw(there)
        program = subprocess.Popen(command, stdin=here, stdout=here, stderr=subprocess.DEVNULL)
        started.append((program, here, there))
        return os.ttyname(there)

    yield start
    for program, here, there in started:
        program.kill()
        program.wait()
        os.close(here)
        os.close(there)


class Between:
    """A line between two that changes what the target answers, by how many bytes it has carried."""

    def __init__(self, port: str, change: Callable[[bytes, int], bytes]) -> None:
        self.far = os.open(port, os.O_RDWR | os.O_NOCTTY)
        self.here, self.there = pty.openpty()
        tty.setraw(self.there)
        self.change, self.carried, self.ended = change, 0, threading.Event()
        self.thread = threading.Thread(target=self.carry, daemon=True)
        self.thread.start()

    @property
    def port(self) -> str:
        return os.ttyname(self.there)

    def carry(self) -> None:
        while not self.ended.is_set():
            for one in select.select([self.here, self.far], [], [], 0.05)[0]:
                data = os.read(one, 65536)
                if one == self.here:
                    os.write(self.far, data)
                else:
                    os.write(self.here, self.change(data, self.carried))
                    self.carried += len(data)

    def close(self) -> None:
        self.ended.set()
        self.thread.join()
        for number in (self.far, self.here, self.there):
            os.close(number)


@pytest.fixture
def target(tmp_path: Path, wire: Callable[[list[str]], str]) -> str:
    return wire([str(build(HERE, write_target(tmp_path), "-O1", main="_pil"))])


@pytest.mark.slow_for("double")
@pytest.mark.parametrize("precision", ["double", pytest.param("float", marks=pytest.mark.slow)])
def test_a_target_with_the_same_bits_passes(
    precision: Precision, tmp_path: Path, wire: Callable[[list[str]], str], run: Run
) -> None:
    program = build(HERE, write_target(tmp_path, precision), "-O2", main="_pil")
    port = wire([str(program)])
    code, out, err = run("pil", GAINS, "--port", port)
    assert (code, err) == (0, "")
    assert f"({precision}) against the recorded vectors" in " ".join(out.split())
    assert re.search(r"^ stroke +60 +0 *$", out, re.MULTILINE), out
    assert re.search(r"^\d+ samples / s with the line\npass: all bits agree\n\Z", out, re.MULTILINE), out
    said = run("pil", GAINS, "--port", port, "--json")
    code, found = said[0], document(said, "pil-output")
    assert (code, found["agrees"], found["precision"]) == (0, True, precision)
    assert [v["name"] for v in found["vectors"]] == ["stroke", "saturation", "invalid", "lift_off"]
    assert {v["first_that_differs"] for v in found["vectors"]} == {None}
    assert (found["requests_sent_again"], found["slowest_step_counts"]) == (0, None)


@pytest.mark.slow
def test_another_bit_is_found(tmp_path: Path, wire: Callable[[list[str]], str], run: Run) -> None:
    """A force that is larger by its last bit, from the third step of all on."""
    line = "  run->counts = halbach_pil_count() - run->counts;\n"
    more = "  { static int n; if (++n > 2) { run->out.v[0] = run->out.v[0] * (1.0 + 0x1p-52); } }\n"
    path = write_target(tmp_path) / "halbach_pil.c"
    text = path.read_text(encoding="utf-8")
    assert line in text
    path.write_text(text.replace(line, line + more), encoding="utf-8")
    port = wire([str(build(HERE, tmp_path, "-O1", main="_pil"))])
    code, out, _ = run("pil", GAINS, "--port", port)
    assert code == 1
    found = re.search(r"^ stroke +60 +2 +(\S+)", out, re.MULTILINE)
    assert found, out
    assert 0 < float(found[1]) < 1e-12
    assert out.endswith("fail: the target computes other bits\n")


@pytest.mark.slow
def test_another_gain_file_is_a_sentence(tmp_path: Path, wire: Callable[[list[str]], str], run: Run) -> None:
    for file, text in texts("halbach", "double").items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    port = wire([str(build(HERE, tmp_path, "-O1", main="_pil"))])
    code, out, err = run("pil", GAINS, "--port", port)
    assert (code, out) == (2, "")
    said = one_sentence(err)
    assert (
        "found the controller of a gain file with sha256 000000000000..., expected that of halbach.json"
        in said
    )


def test_silence_is_a_sentence(wire: Callable[[list[str]], str], run: Run) -> None:
    port = wire(["sleep", "60"])
    code, out, err = run("pil", GAINS, "--port", port, "--timeout", "0.05")
    assert (code, out) == (2, "")
    silence = f"{port}: found no answer in 0.05 s, 4 times, "
    assert silence + "expected a target that runs NAME_pil.c of its export, at this speed" in one_sentence(
        err
    )


def test_a_line_that_garbles_all_is_a_sentence(target: str, run: Run) -> None:
    between = Between(target, lambda data, _: bytes(b ^ 1 for b in data))
    code, out, err = run("pil", GAINS, "--port", between.port, "--timeout", "0.1")
    between.close()
    assert (code, out) == (2, "")
    assert "found garbled frames, 4 times, expected a line without errors, at this speed" in one_sentence(err)


@pytest.mark.slow
def test_a_line_that_garbles_some_costs_time_only(target: str) -> None:
    """Bytes that change and bytes that are lost, of answers: they are asked for again, and no step is made twice."""

    def damage(data: bytes, at: int) -> bytes:
        found = [(at + k, byte) for k, byte in enumerate(data)]
        kept = [(place, byte) for place, byte in found if place % 1999 != 900]
        return bytes(byte ^ 64 if place % 1499 == 700 else byte for place, byte in kept)

    between = Between(target, damage)
    replay = malta.firmware.replay_on_target(GAINS, between.port, seconds=0.3)
    between.close()
    assert replay.agrees
    assert replay.repeated > 5
    assert [v.largest for v in replay.vectors] == [0.0] * 4


@given(st.lists(st.sampled_from([START, b"\0\0", b"\1", frame_bytes(Frame(1, 2, b"abc"))]), max_size=12))
def test_whatever_comes_is_read_in_frames(pieces: list[bytes]) -> None:
    """A whole frame behind bytes that look like one is found, or they are told as garbled; reading goes on."""
    data = b"".join(pieces) + bytes(70_000) + frame_bytes(Frame(3, 4, b"end"))
    at, found = 0, []
    while True:
        frame, behind = serial_line.next_frame(data, at)
        if frame is None:
            break
        assert behind > at
        at = behind
        found.append(frame)
    assert found[-1] == Frame(3, 4, b"end")


def hear(port: serial_line.Port) -> Frame:
    """The next frame that comes, of those without a payload."""
    data = b""
    while len(data) < 10:
        more = port.read(2.0)
        assert more
        data += more
    frame, _ = serial_line.next_frame(data, 0)
    assert frame is not None
    return frame


def test_a_garbled_request_is_asked_for_again(target: str) -> None:
    """The target says so at once; what is no request as well; and after half a frame it finds the next one."""
    with serial_line.serial_port(target, 115200) as port:
        line = serial_line.SerialLine(port, target, 2.0)
        assert line.ask(1, b"")[0] == 1
        damaged = bytearray(frame_bytes(Frame(2, 9, b"\1")))
        damaged[-1] ^= 1
        port.write(bytes(damaged))
        assert hear(port).kind == serial_line.GARBLED
        port.write(frame_bytes(Frame(77, 9, b"")))
        assert hear(port)[:2] == (serial_line.GARBLED, 9)
        port.write(frame_bytes(Frame(3, 9, bytes(40)))[:20])
        line.seconds = 0.3
        assert line.ask(1, b"")[0] == 1
        assert line.repeated >= 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("--port", "/dev/nothing"),
            "/dev/nothing: found No such file or directory, expected a serial port, as",
        ),
        (("--port", "/dev/null"), "/dev/null: found Inappropriate ioctl for device, expected a serial port"),
        (("--port", "/dev/null", "--baud", "12345"), "--baud: found 12345, expected one of 9600 19200 38400"),
        (("--port", "/dev/null", "--timeout", "0"), "seconds"),
    ],
)
def test_a_port_that_is_none_is_a_sentence(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    code, out, err = run("pil", GAINS, *arguments)
    assert (code, out) == (2, "")
    assert sentence in one_sentence(err)


def test_without_termios_pyserial_has_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here one that echoes: pyserial's names and times."""

    class Serial:
        in_waiting = 0
        timeout = 0.0

        def __init__(self, name: str, baud: int, write_timeout: float) -> None:
            if name != "COM3" or baud < 9600 or write_timeout < 1:
                raise OSError(2, "could not open port")
            self.data = b""

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None:
            self.data = b""

        def write(self, data: bytes) -> None:
            self.data += data

        def read(self, count: int) -> bytes:
            found, self.data = self.data[:count], self.data[count:]
            self.in_waiting = len(self.data)
            return found

        def reset_input_buffer(self) -> None:
            self.data = b""

    monkeypatch.setattr(serial_line, "termios", None)
    monkeypatch.setitem(__import__("sys").modules, "serial", SimpleNamespace(Serial=Serial))
    with serial_line.serial_port("COM3", 115200) as port:
        port.write(b"abc")
        assert port.read(1.0) == b"abc"
        port.write(b"de")
        port.clear()
        assert port.read(0.0) == b""
    with (
        pytest.raises(InputError, match="COM4: found could not open port"),
        serial_line.serial_port("COM4", 9600),
    ):
        pass
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with (
        pytest.raises(InputError, match="without termios, expected pyserial"),
        serial_line.serial_port("COM3", 9600),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_an_emulated_cortex_a9_passes(
    precision: Precision, tmp_path: Path, wire: Callable[[list[str]], str]
) -> None:
    p = PROCESSORS["Cortex-A9"]
    program = build(p, write_target(tmp_path, precision), "-O2", main="_pil")
    assert malta.firmware.replay_on_target(GAINS, wire([*p.runner, str(program)]), seconds=30).agrees


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_board_with_a_serial_port_passes(precision: Precision, tmp_path: Path) -> None:
    """A Cortex-M4F without an operating system, whose UART is a pseudo-terminal of QEMU's; its timer is read."""
    m4: Processor = PROCESSORS["Cortex-M4F"]
    write_target(tmp_path, precision)
    (tmp_path / "uart.c").write_text(UART, encoding="utf-8")
    program = build(m4, tmp_path, "-O2", "-DHALBACH_PIL_PORT", main="_pil")
    quiet = ["-display", "none", "-monitor", "none", "-serial", "pty", "-semihosting"]
    command = [*m4.runner[:3], *quiet, "-kernel", str(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as board:
        assert board.stdout is not None
        said = board.stdout.readline()
        found = re.search(r"(/dev/\S+)", said)
        try:
            assert found, said
            replay = malta.firmware.replay_on_target(GAINS, found[1], seconds=30)
        finally:
            board.kill()
    assert replay.agrees
    assert (replay.precision, replay.counts) == (precision, 21)

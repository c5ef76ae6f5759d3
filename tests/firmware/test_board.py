"""The port of examples/zynq7000, compiled for its board, and run by QEMU with a stand-in and the slave on its UART."""

from __future__ import annotations

import os
import pty
import subprocess
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import ROOT
from exported import require, run, target

from malta.firmware import export
from malta.firmware.export import a2l_text, folder_files
from malta.firmware.signals import Target, XcpPort
from malta.firmware.supervisor import STATES
from malta.firmware.xcp_master import read_a2l, record_live, xcp_master

PORT = ROOT / "examples" / "zynq7000"
A9 = ("-mcpu=cortex-a9", "-mfpu=vfpv3", "-mfloat-abi=hard", "-std=c99", "-O2", "-ffp-contract=off")
OWN = (
    "-fno-math-errno",
    "-fno-tree-loop-distribute-patterns",
    "-nostartfiles",
    "-nostdlib",
    "-Wall",
    "-Wextra",
    "-Werror",
)


def compile_port(t: Target, folder: Path, *flags: str) -> Path:
    """A program for the board: no library but the compiler's own."""
    require("arm-none-eabi-gcc")
    name = t.controller.name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "costs", lambda _: [])
        for file, text in folder_files(t, "0" * 64, proof=False).items():
            (folder / file).write_text(text, encoding="utf-8")
    files = [f"{name}{end}.c" for end in ("", "_parts", "_parameters", "_supervisor", "_xcp", "_main")]
    own = [f"-DLAW={name}", f"-DSAMPLE_TIME={name.upper()}_SAMPLE_TIME", *flags, "-I."]
    linked = ["-T", str(PORT / "zynq.ld"), *files, str(PORT / "port.c"), "-lgcc", "-o", "board.elf"]
    done = run(["arm-none-eabi-gcc", *A9, *OWN, *own, *linked], folder)
    assert done.returncode == 0, done.stderr[:3000]
    return folder / "board.elf"


@contextmanager
def emulated(program: Path) -> Iterator[str]:
    """The board in QEMU; the name of the line to its UART."""
    require("qemu-system-arm")
    here, there = pty.openpty()
    tty.setraw(here)
    tty.setraw(there)
    quiet = ["-m", "64", "-display", "none", "-monitor", "none", "-serial", "stdio"]
    command = ["qemu-system-arm", "-M", "xilinx-zynq-a9", *quiet, "-kernel", str(program)]
    started = subprocess.Popen(command, stdin=here, stdout=here, stderr=subprocess.DEVNULL)
    try:
        yield os.ttyname(there)
    finally:
        started.kill()
        started.wait()
        os.close(here)
        os.close(there)


@pytest.mark.slow
def test_law_supervisor_and_slave_run_on_the_board_s_processor(tmp_path: Path) -> None:
    """Samples follow one another without a gap, and the supervisor goes its way. It proves nothing of timers."""
    t = replace(target("halbach", "double"), tunable=True, xcp=XcpPort())
    program = compile_port(t, tmp_path, "-DSTAND_IN", "-DHALBACH_STAND_IN")
    a2l = tmp_path / "own.a2l"
    a2l.write_text(a2l_text(t, "halbach"), encoding="utf-8")
    with emulated(program) as line, xcp_master(line) as master:
        found = record_live(master, read_a2l(a2l), ["supervisor.state", "supervisor.monitor"], 4.0)
    assert found.lost == 0
    assert len(found.t) > 5
    states = {list(STATES)[int(k)] for k in found.values[:, 0]}
    assert states <= {"OFF", "OFFSETS", "SENSORS"}
    assert set(found.values[:, 1]) == {-1.0}


@pytest.mark.slow
def test_the_port_of_a_drive_compiles_without_a_warning(tmp_path: Path) -> None:
    """With its converters and PWM, and the wiring tried at the first start."""
    t = replace(target("robust", "float"), tunable=True, xcp=XcpPort(), wiring=True)
    assert compile_port(t, tmp_path, "-DDRIVEN").stat().st_size > 50_000
    assert len((PORT / "port.c").read_text(encoding="utf-8").splitlines()) <= 200

"""Exported controllers for tests: folders of a shipped gain file, compiled and run for several processors."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.arrays import FloatArray
from malta.firmware import export
from malta.firmware.export import folder_files
from malta.firmware.flight import Native
from malta.firmware.program import Precision
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.sources import piece_records, render, root_context
from malta.firmware.step import programs_of
from malta.synthesis.controller import Controller

PRECISIONS: tuple[Precision, ...] = ("double", "float")
# A shipped design of each kind of law and machine, in one precision each, by turns. The text of table2 and calibrated
# is that of robust with other numbers, that of halbach_late has all that halbach's has; planar_pid is one of
# test_unusual_exports.
KINDS: tuple[tuple[str, Precision], ...] = (
    *(("halbach_late", "float"), ("halbach_pid", "double"), ("robust", "double")),
    *(("robust_observer", "float"), ("tubular_pid", "double"), ("planar", "double")),
)
EXACT = ("-std=c99", "-ffp-contract=off", "-fno-math-errno")
START = Path(__file__).parent / "targets"  # of a program on a Cortex-M


def of_each_kind(*fast: str) -> list[Any]:
    """Parameters (name, precision) of KINDS: those of the designs that are named are fast, the others slow."""
    return [pytest.param(*kind, marks=[] if kind[0] in fast else [pytest.mark.slow]) for kind in KINDS]


class Processor(NamedTuple):
    """Where an exported test runs: a compiler with its options, and what runs its program."""

    compiler: str
    options: tuple[str, ...] = ()
    runner: tuple[str, ...] = ()
    bare: bool = False  # without an operating system


def cortex_m(cpu: str, fpu: str, board: str) -> Processor:
    options = (f"-mcpu={cpu}", "-mthumb", "-mfloat-abi=hard", f"-mfpu={fpu}")
    runner = ("qemu-system-arm", "-M", board, "-nographic", "-semihosting", "-kernel")
    return Processor("arm-none-eabi-gcc", options, runner, bare=True)


HERE = Processor("gcc")
A9 = ("-mcpu=cortex-a9", "-mfpu=vfpv3", "-mfloat-abi=hard")
PROCESSORS = {
    "here": HERE,
    "Cortex-A9": Processor("arm-linux-gnueabihf-gcc", (*A9, "-static"), ("qemu-arm", "-cpu", "cortex-a9")),
    "Cortex-M4F": cortex_m("cortex-m4", "fpv4-sp-d16", "mps2-an386"),
    "Cortex-M7": cortex_m("cortex-m7", "fpv5-d16", "mps2-an500"),
}


@cache
def controller(name: str) -> Controller:
    """The controller of a shipped gain file."""
    return malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")


@cache
def target(name: str, precision: Precision) -> Target:
    """The export of a shipped gain file, as far down as its machine is modelled."""
    c = controller(name)
    return Target(c, precision, fidelity_of(malta.plant_of(c.parameters)))


@cache
def texts(name: str, precision: Precision) -> dict[str, str]:
    """The files of an export by name, as where no compiler counts what a step costs: that takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "costs", lambda _: [])
        return folder_files(target(name, precision), "0" * 64, proof=False)


def write_folder(name: str, precision: Precision, folder: Path) -> Path:
    """The folder with the files of an export."""
    for file, text in texts(name, precision).items():
        (folder / file).write_text(text, encoding="utf-8")
    return folder


def root_text(precision: Precision) -> str:
    """C of the square root as own_root, bit by bit on every processor."""
    own = {"name": "own", "NAME": "OWN", "arm_fpu": ""}
    text = render("root.c", root_context(precision) | own)
    for processor in ("__SSE2__", "__aarch64__", "__riscv_flen"):
        text = text.replace(f"defined({processor})", "0")
    return f"#include <stdbool.h>\n#include <stdint.h>\n\ntypedef {precision} own_real;\n\n{text}"


def require(*tools: str) -> None:
    """Skip the test where a tool is missing."""
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed")


def c_files(folder: Path, main: str) -> list[Path]:
    """The C files of a program: all without a main(), and the one of the shortest name that ends with `main`."""
    paths = sorted(folder.glob("*.c"))
    programs = [path for path in paths if "int main(" in path.read_text(encoding="utf-8")]
    chosen = sorted((path for path in programs if path.stem.endswith(main)), key=lambda path: len(path.stem))[
        :1
    ]
    return [path for path in paths if path not in programs] + chosen


def build(p: Processor, folder: Path, *flags: str, main: str = "_test") -> Path:
    """A program of the folder for a processor. Fails with the compiler's words."""
    require(p.compiler, *p.runner[:1])
    program = folder / "program.elf"
    start = []
    if p.bare:
        start = [
            *("--specs=rdimon.specs", "-nostartfiles"),
            *("-T", str(START / "cortex_m.ld"), str(START / "cortex_m.c")),
        ]
    files = [str(path) for path in c_files(folder, main)]
    done = run([p.compiler, *p.options, *EXACT, *flags, *start, *files, "-o", str(program)], folder)
    assert done.returncode == 0, done.stderr[:2000]
    return program


def run(command: list[str], folder: Path, seconds: float = 300) -> subprocess.CompletedProcess[str]:
    """What a command prints."""
    return subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds,
        stdin=subprocess.DEVNULL,
    )


def run_test(
    p: Processor, folder: Path, *flags: str, main: str = "_test"
) -> subprocess.CompletedProcess[str]:
    """What the program of a folder prints on a processor."""
    return run([*p.runner, str(build(p, folder, *flags, main=main))], folder)


def call_piece(
    native: Native, piece: str, given: Mapping[str, FloatArray], sizes: Mapping[str, int]
) -> dict[str, Any]:
    """Call a piece of compiled C with vectors; the results by name. sizes : of the results"""
    results = {name: np.zeros(size, dtype=native.target.real) for name, size in sizes.items()}
    vectors = [np.ascontiguousarray(value, dtype=native.target.real) for value in given.values()]
    function = getattr(native.lib, f"{native.name}_{piece}")
    if piece_records(programs_of(native.target)[piece]):  # of nothing but these arrays, in this order
        both = [np.concatenate(vectors), np.concatenate(list(results.values()))]
        function(*(v.ctypes.data_as(ctypes.c_void_p) for v in both))
        ends = np.cumsum([v.size for v in results.values()])[:-1]
        return dict(zip(results, np.split(both[1], ends), strict=True))
    # The C has no arguments without entries.
    function(*(v.ctypes.data_as(ctypes.c_void_p) for v in (*vectors, *results.values()) if v.size))
    return results

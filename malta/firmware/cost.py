"""What a step costs: operations by kind, and bytes, stack and instructions on the targets whose compilers are here."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from malta.firmware.ctext import c_name
from malta.firmware.export import sources
from malta.firmware.longest_path import FLAGS as APART
from malta.firmware.longest_path import LISTING, longest_path
from malta.firmware.program import TRUTHS
from malta.firmware.signals import Target
from malta.firmware.step import programs_of
from malta.firmware.supervisor_text import supervisor_sources

CLOCK = 667e6  # Hz, of the Cortex-A9 of the paper's Zynq 7000
SECONDS = 120.0  # a compiler may take at most
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fno-tree-loop-distribute-patterns")
STEP = ("step", "sense", "decide", "look_up")  # functions of every sample, with those of their blocks
KINDS = {
    "additions": ("ADD", "SUB", "NEG"),
    "multiplications": ("MUL",),
    "divisions": ("DIV",),
    "roots": ("SQRT",),
    "comparisons and choices": (*TRUTHS, "FMIN", "FMAX", "FABS", "IF_ELSE_ZERO", "PICK"),
}


class Processor(NamedTuple):
    """A target: its name, the prefix of its tools, and options of its compiler."""

    name: str
    prefix: str
    options: tuple[str, ...]


PROCESSORS = (
    Processor("this computer", "", ()),
    Processor(
        "Cortex-A9",
        "arm-linux-gnueabihf-",
        ("-mcpu=cortex-a9", "-mfpu=vfpv3", "-mfloat-abi=hard", "-marm"),
    ),
    Processor(
        "Cortex-M4F",
        "arm-none-eabi-",
        ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    ),
)


class Cost(NamedTuple):
    """Of a controller on one processor."""

    processor: str
    text: int  # bytes of code and constants
    data: int  # bytes of variables that the program owns
    state: int  # bytes of the state, which the caller owns
    stack: int  # bytes, the deepest of a step
    instructions: int  # of a step, in a straight line
    calls: int  # of these, calls of arithmetic that the processor does not have
    supervised: int  # instructions of the supervisor's step with the controller's, at most (longest_path.py)


def operations(t: Target) -> dict[str, int]:
    """How many operations of each kind a step has."""
    count: Counter[str] = Counter()
    for name in ("sense", "decide"):
        count.update(o.op for o in programs_of(t)[name].operations)
    return {kind: sum(count[op] for op in ops) for kind, ops in KINDS.items()}


def costs(t: Target) -> list[Cost]:
    """The costs on every processor whose compiler is installed."""
    name = c_name(t.controller.name)
    own = supervisor_sources(t, name)
    files, straight = (sources(t, "", loops=loops) | own for loops in (True, False))
    found = [cost_on(p, files, straight, name) for p in PROCESSORS]
    return [cost for cost in found if cost is not None]


def cost_on(p: Processor, files: Mapping[str, str], straight: Mapping[str, str], name: str) -> Cost | None:
    """The cost on one processor; None without its compiler. straight : the same controller, its loops written out"""
    tools = [shutil.which(p.prefix + tool) for tool in ("gcc", "size", "objdump")]
    if any(tool is None for tool in tools):
        return None
    gcc, size, objdump = map(str, tools)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        # A loop's instructions are executed several times: they are counted where it is written out.
        counted = "straight" if straight != files else name
        (folder / f"{counted}.c").write_text(straight[f"{name}.c"], encoding="utf-8")
        (folder / "state.c").write_text(
            f'#include "{name}.h"\nconst char state_bytes[sizeof({name}_state)] = {{0}};\n', encoding="utf-8"
        )
        for file in dict.fromkeys((f"{name}.c", f"{counted}.c", "state.c")):
            command = [gcc, *FLAGS, *p.options, "-fstack-usage", "-c", file]
            if _run(command, folder) is None:
                return None
        sizes = (_run([size, f"{name}.o"], folder) or "").splitlines()[-1].split()
        state = (_run([size, "state.o"], folder) or "").splitlines()[-1].split()
        listing = _run([objdump, "-d", "--no-show-raw-insn", f"{counted}.o"], folder) or ""
        supervised = _supervised(p, files, name, folder)
        stacks = _stacks((folder / f"{name}.su").read_text(encoding="utf-8"))
    own = {f"{name}_{function}" for function in STEP} | {"look_up"}
    lines = _instructions(listing, lambda function: function in own or function.startswith(_blocks(name)))
    return Cost(
        p.name,
        int(sizes[0]),
        int(sizes[1]) + int(sizes[2]),
        int(state[0]),
        _deepest(stacks, name),
        len(lines),
        sum("__aeabi_" in line for line in lines),
        supervised,
    )


def _supervised(p: Processor, files: Mapping[str, str], name: str, folder: Path) -> int:
    """The instructions on the longest path of the supervisor's step; 0 where a tool fails."""
    listings = {}
    for file in (f"{name}.c", f"{name}_supervisor.c"):
        listed = Path(file).with_suffix(".apart").name
        if _run([f"{p.prefix}gcc", *FLAGS, *APART, *p.options, "-c", file, "-o", listed], folder) is None:
            return 0
        listings[file] = _run([f"{p.prefix}objdump", *LISTING, listed], folder) or ""
    return longest_path(listings, files, f"{name}_supervisor_step")


def _blocks(name: str) -> tuple[str, ...]:
    """How the names of the functions of a step's blocks begin."""
    return tuple(f"{name}_{function}_" for function in STEP if function != "step")


def _deepest(stacks: Mapping[str, int], name: str) -> int:
    """Bytes of stack of a step: its own, and those of the function and of the block that take most."""
    deepest = stacks.get("look_up", 0)
    for function in ("sense", "decide"):
        blocks = [size for f, size in stacks.items() if f.startswith(f"{name}_{function}_")]
        deepest = max(deepest, stacks.get(f"{name}_{function}", 0) + max(blocks, default=0))
    return stacks.get(f"{name}_step", 0) + deepest


def _run(command: list[str], folder: Path) -> str | None:
    """What a tool prints; None where it fails."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False, timeout=SECONDS
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _stacks(usage: str) -> dict[str, int]:
    """Bytes of stack by function, from gcc's -fstack-usage."""
    found = {}
    for line in usage.splitlines():
        where, count, *_ = line.split("\t")
        found[where.rpartition(":")[2]] = int(count)
    return found


def _instructions(listing: str, is_own: Callable[[str], bool]) -> list[str]:
    """The instructions of a step's functions in objdump's listing."""
    found, inside = [], False
    for line in listing.splitlines():
        head = re.match(r"^[0-9a-f]+ <([^>]+)>:$", line)
        if head:
            inside = is_own(head[1].split(".")[0])
        elif inside and re.match(r"^\s+[0-9a-f]+:\s+[a-z]", line) and ".word" not in line:
            found.append(line)
    return found

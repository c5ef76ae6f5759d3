"""What a step costs: operations by kind, and bytes, stack and instructions on the targets whose compilers are here."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from malta.arrays import FloatArray
from malta.files import scratch_folder
from malta.firmware.ctext import c_name
from malta.firmware.program import FUSED, TRUTHS
from malta.firmware.signals import Target
from malta.firmware.sources import ring_sources, sources
from malta.firmware.step import programs_of, started_state, step_function, zero_reference
from malta.firmware.supervisor_text import supervisor_sources
from malta.firmware.vectors import readings_of
from malta.model.places import position_in
from malta.simulation import references
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller
from malta.synthesis.schedule import SCHEDULED_MATRICES

if TYPE_CHECKING:
    from malta.proof.margin import Margin


# Instructions on the longest path of a compiled function, at most: a bound for the time of the supervised step.
#
# Instructions of a listing are nodes of a graph, and a loop is one node: its longest way round, times the passes that
# the C text says (`for` up to a number). Of each branch the longer side counts, also where the sides of two branches
# exclude each other, so that the bound may be above what ever happens. A loop that ends by its data (the search in a
# table) counts once.


# Functions stay functions, and a switch stays branches, so that lines and branches are those of the text.
CC_FLAGS = ("-g", "-fno-inline", "-fno-partial-inlining", "-fno-ipa-cp", "-fno-ipa-sra", "-fno-jump-tables")
LISTING = ("-d", "-l", "-r", "--no-show-raw-insn")  # of objdump
_RETURN_LINE = re.compile(r"^(?:ret|retq|bx\s+lr|(?:pop|ldmia(?:\.w)?)\b.*\bpc\b.*)")
_JUMP_LINE = re.compile(r"^(?:b|b\.n|b\.w|jmp|jmpq)\s")
_CALL_LINE = re.compile(r"^(?:bl|blx|call|callq)\s")
_BRANCH_LINE = re.compile(r"^(?:b[a-z]{2}(?:\.[nw])?|b|b\.n|b\.w|cbn?z|j[a-z]+)\s")


class Instruction(NamedTuple):
    """A line of a listing: what it costs, and where it may go."""

    address: int
    text: str
    weight: int  # passes of the loops that it is in
    symbol: str  # of another function that it calls or jumps to


def longest_path(listings: Mapping[str, str], texts: Mapping[str, str], function: str) -> int:
    """The instructions of a function with all that it calls, at most.

    listings : what objdump shows of each C file, compiled with FLAGS; texts : all files, headers too, by name
    """
    macros = dict(re.findall(r"#define (\w+) (\d+)u?\b", "\n".join(texts.values())))
    functions: dict[str, list[Instruction]] = {}
    for file, listing in listings.items():
        functions |= _functions_of(listing, passes_of(texts[file], macros))

    @cache
    def cost(name: str) -> int:
        code = functions.get(name, [])
        return _longest(code, [i.weight * (1 + (cost(i.symbol) if i.symbol else 0)) for i in code])

    return cost(function)


def passes_of(text: str, macros: Mapping[str, str]) -> list[int]:
    """How often each line of a C text runs at most, by the loops around it.

    >>> passes_of("for (k = 0; k < N; k++) {\\n  x++;\\n}\\ny++;", {"N": "4"})
    [4, 4, 4, 1]
    """
    lines = text.split("\n")
    passes = [1] * len(lines)
    for at, line in enumerate(lines):
        head = re.search(r"\bfor \(.*?[<>]=? \(?(\w+)", line)
        count = macros.get(head[1], head[1]).rstrip("u") if head else ""
        if not count.isdigit():
            continue
        depth = 0
        for k in range(at, len(lines)):
            passes[k] *= int(count)
            depth += lines[k].count("{") - lines[k].count("}")
            if depth <= 0:
                break
    return passes


def _functions_of(listing: str, passes: list[int]) -> dict[str, list[Instruction]]:
    """The instructions of each function."""
    found: dict[str, list[Instruction]] = {}
    code: list[Instruction] = []
    name, weight = "", 1
    for line in listing.splitlines():
        if head := re.match(r"^[0-9a-f]+ <([^>]+)>:$", line):
            name = head[1]
            code = found.setdefault(name, [])
        elif place := re.match(r"^\S*\.c:(\d+)", line):
            weight = passes[int(place[1]) - 1]
        elif relocation := re.match(r"^\s+[0-9a-f]+: R_\S*(?:CALL|JUMP|PLT|PC32)\S*\s+(\w+)", line):
            if code and (_CALL_LINE.match(code[-1].text) or _JUMP_LINE.match(code[-1].text)):
                code[-1] = code[-1]._replace(symbol=relocation[1])
        elif one := re.match(r"^\s+([0-9a-f]+):\s+([a-z].*)", line):
            text = one[2].strip()
            target = re.search(r"<(\w+)>", text)  # a function's beginning
            calls = target and target[1] != name and (_CALL_LINE.match(text) or _JUMP_LINE.match(text))
            code.append(Instruction(int(one[1], 16), text, weight, target[1] if target and calls else ""))
    return found


def _longest(code: list[Instruction], costs: list[int]) -> int:
    """The dearest way through instructions."""
    places = {i.address: k for k, i in enumerate(code)}
    after: dict[int, list[int]] = {}
    for k, i in enumerate(code):
        onward = [] if _RETURN_LINE.match(i.text) or _JUMP_LINE.match(i.text) else [k + 1]
        goal = re.search(r"\b([0-9a-f]+) <", i.text)
        if goal and _BRANCH_LINE.match(i.text) and not i.symbol and int(goal[1], 16) in places:
            onward.append(places[int(goal[1], 16)])
        after[k] = [j for j in onward if j < len(code)]
    return _way(after, costs, set(after), 0) if code else 0


def _way(after: Mapping[int, list[int]], costs: list[int], nodes: set[int], start: int) -> int:
    """The dearest way from a node within others; a loop is one node, whose cost is its dearest way round."""
    edges = [(k, j) for k in nodes for j in after[k] if j in nodes]
    ends = np.array(edges, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(edges)), ends), shape=(max(nodes) + 1,) * 2).tocsr()
    reached = set(breadth_first_order(graph, start, return_predecessors=False).tolist())
    group_of = connected_components(graph, connection="strong")[1].tolist()
    groups: dict[int, set[int]] = {}
    for k in reached:
        groups.setdefault(group_of[k], set()).add(k)
    onward = {
        n: {group_of[j] for k in group for j in after[k] if j in reached} - {n} for n, group in groups.items()
    }
    ways: dict[int, int] = {}  # from each loop on
    for n in TopologicalSorter(onward).static_order():  # the last ones first
        group = groups[n]
        if len(group) == 1:
            own = costs[min(group)]
        else:
            first = start if start in group else min(j for k in nodes - group for j in after[k] if j in group)
            inside = {k: [j for j in after[k] if j in group and j != first] for k in group}
            own = _way(inside, costs, group, first)
        ways[n] = own + max((ways[m] for m in onward[n]), default=0)
    return ways[group_of[start]]


# What single precision does to a controller: its coefficients, its margin, and the noise of its rounding.


ROUNDING_SAMPLES = 200  # samples over which the noise of rounding is measured


class RoundingNoise(NamedTuple):
    """Of each commanded force, rms: what rounding adds, and what the sensors' noise makes."""

    rounding: FloatArray
    sensors: FloatArray


def round_gains(c: Controller) -> Controller:
    """The controller with the coefficients that single precision holds."""

    def in_single(record: Any) -> dict[str, Any]:
        return {name: getattr(record, name).astype(np.float32).astype(float) for name in SCHEDULED_MATRICES}

    if c.schedule is None:
        return replace(c, **in_single(c))
    return replace(c, **in_single(c), schedule=replace(c.schedule, **in_single(c.schedule)))


def rounded_margin(c: Controller, uncertainty: dict[str, float]) -> Margin | None:
    """The margin of the sampled loop with rounded coefficients, proven over the travel; None without uncertainty."""
    from malta.margins.travel import travel_margin
    from malta.model.plants import plant_of

    if not uncertainty:
        return None
    return travel_margin(plant_of(c.parameters), round_gains(c), uncertainty)


def rounding_noise(t: Target) -> RoundingNoise:
    """The noise of rounding beside that of the sensors, from the same readings of a machine at rest.

    Both precisions take the readings of one flight; what their forces differ by is the rounding.
    """
    c, plant = t.controller, t.believed
    lasts = ROUNDING_SAMPLES * c.sample_time
    fidelity: Any = t.fidelity if t.driven else "force"
    hold = Scenario("hold", lasts, references.hold, noise=1.0, fidelity=fidelity, substeps=t.steps)
    run = simulate(plant, c, hold)
    read = readings_of(t, run)
    if t.excited:
        read["excitation"] = np.zeros_like(read["excitation"])
    forces = {}
    for precision in ("double", "float"):
        own = replace(t, precision=precision)
        step, reference = step_function(own), zero_reference(own)
        state, rows = started_state(own, reference), []
        for k in range(len(run.t)):
            state, out = step(state, reference, {name: column[k] for name, column in read.items()})
            rows.append(out["v"].astype(float))
        forces[precision] = np.array(rows)
    apart = forces["float"] - forces["double"]
    steady = forces["double"] - c.feedforward.at(position_in(plant, run.x[0]))
    return RoundingNoise(np.sqrt((apart**2).mean(axis=0)), np.sqrt((steady**2).mean(axis=0)))


def smallest_error(c: Controller, e: float) -> float:
    """The error (m) below which a plain sum of single precision at `e` (m s) stands still: half its step over Ts."""
    return float(np.spacing(np.float32(e))) / 2 / c.sample_time


CLOCK = 667e6  # Hz, of the Cortex-A9 of the paper's Zynq 7000
SECONDS = 120.0  # a compiler may take at most
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fno-tree-loop-distribute-patterns")
STEP = ("step", "sense", "decide", "look_up")  # functions of every sample, with those of their blocks
FUSED_KIND = "fused multiply-adds"  # that an export has only on demand
KINDS = {
    "additions": ("ADD", "SUB", "NEG"),
    "multiplications": ("MUL",),
    FUSED_KIND: FUSED,
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
        "Cortex-A9", "arm-linux-gnueabihf-", ("-mcpu=cortex-a9", "-mfpu=vfpv3", "-mfloat-abi=hard", "-marm")
    ),
    Processor(
        "Cortex-M4F",
        "arm-none-eabi-",
        ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    ),
)


class ProcessorCost(NamedTuple):
    """Of a controller on one processor."""

    processor: str
    text: int  # bytes of code and constants
    data: int  # bytes of variables that the program owns
    state: int  # bytes of the state, which the caller owns
    stack: int  # bytes, the deepest of a step
    instructions: int  # of a step, in a straight line
    calls: int  # of these, calls of arithmetic that the processor does not have
    supervised: int  # instructions of the supervisor's step with the controller's, at most (cost.py)


def operations(t: Target) -> dict[str, int]:
    """How many operations of each kind a step has."""
    count: Counter[str] = Counter()
    for name in ("sense", "decide"):
        count.update(o.op for o in programs_of(t)[name].operations)
    kinds = [kind for kind in KINDS if t.fused or kind != FUSED_KIND]
    return {kind: sum(count[op] for op in KINDS[kind]) for kind in kinds}


def costs(t: Target) -> list[ProcessorCost]:
    """The costs on every processor whose compiler is installed."""
    name = c_name(t.controller.name)
    own = supervisor_sources(t, name)
    files, straight = (sources(t, "", loops=loops) | own for loops in (True, False))
    found = [cost_on(p, files, straight, name) for p in PROCESSORS]
    return [cost for cost in found if cost is not None]


def cost_on(
    p: Processor, files: Mapping[str, str], straight: Mapping[str, str], name: str
) -> ProcessorCost | None:
    """The cost on one processor; None without its compiler. straight : the same controller, its loops written out"""
    if any(shutil.which(p.prefix + tool) is None for tool in ("gcc", "size", "objdump")):
        return None
    # A loop's instructions are executed several times: they are counted where it is written out.
    counted = "straight" if straight != files else name
    state = f'#include "{name}.h"\nconst char state_bytes[sizeof({name}_state)] = {{0}};\n'
    more = {f"{counted}.c": straight[f"{name}.c"], "state.c": state}
    with _write_folder({**files, **more}) as folder:
        for file in dict.fromkeys((name, counted, "state")):
            if _compile(p, folder, file, "-fstack-usage") is None:
                return None
        sizes, (bytes_of_state, *_) = (
            (_run([f"{p.prefix}size", f"{of}.o"], folder) or "").splitlines()[-1].split()
            for of in (name, "state")
        )
        listing = _run([f"{p.prefix}objdump", "-d", "--no-show-raw-insn", f"{counted}.o"], folder) or ""
        apart = {f"{of}.c": _disassemble(p, folder, of) for of in (name, f"{name}_supervisor")}
        stacks = _stacks((folder / f"{name}.su").read_text(encoding="utf-8"))
    supervised = 0
    if None not in apart.values():
        listings = {file: str(text) for file, text in apart.items()}
        supervised = longest_path(listings, files, f"{name}_supervisor_step")
    own = {*(f"{name}_{function}" for function in STEP), "look_up"}
    blocks = tuple(f"{name}_{function}_" for function in STEP if function != "step")
    code = [
        instruction.text
        for function, instructions in _functions_of(listing, []).items()
        if function.split(".")[0] in own or function.startswith(blocks)
        for instruction in instructions
    ]
    return ProcessorCost(
        p.name,
        int(sizes[0]),
        int(sizes[1]) + int(sizes[2]),
        int(bytes_of_state),
        _deepest(stacks, name),
        len(code),
        sum("__aeabi_" in text for text in code),
        supervised,
    )


@contextmanager
def _write_folder(files: Mapping[str, str]) -> Iterator[Path]:
    """A folder with these files."""
    with scratch_folder() as folder:
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        yield folder


def _compile(p: Processor, folder: Path, name: str, *options: str) -> str | None:
    """Compile NAME.c to NAME.o; None where that fails."""
    return _run([f"{p.prefix}gcc", *FLAGS, *options, *p.options, "-c", f"{name}.c"], folder)


def _disassemble(p: Processor, folder: Path, name: str) -> str | None:
    """The instructions of NAME.c with its lines, each function apart; None where a tool fails."""
    done = _compile(p, folder, name, *CC_FLAGS, "-o", f"{name}.apart")
    return None if done is None else _run([f"{p.prefix}objdump", *LISTING, f"{name}.apart"], folder)


RARE_STEPS = ("begin_block", "stop_after", "count_down")  # of a ring: at a block's begin, at a trigger, after


class LogCost(NamedTuple):
    """Instructions that a ring buffer adds to a step, at most: to most of them, and to the dearest."""

    processor: str
    each: int
    most: int


def log_costs(t: Target) -> list[LogCost]:
    """What the ring buffer of an export costs on every processor whose compiler is installed."""
    name = c_name(t.controller.name)
    files = sources(t, "", name) | ring_sources(t, "", name)
    file, found = f"{name}_log.c", []
    for p in PROCESSORS:
        with _write_folder(files) as folder:
            listing = _disassemble(p, folder, f"{name}_log")
        if listing is not None:
            own = [f"{name}_log_sample", f"{name}_log_keep"]
            most = sum(1 + longest_path({file: listing}, files, part) for part in own)  # 1: the call
            seldom = sum(longest_path({file: listing}, files, part) for part in RARE_STEPS)
            found.append(LogCost(p.name, most - seldom, most))
    return found


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

"""What a step costs: operations by kind, and bytes, stack and instructions on the targets whose compilers are here."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.files import scratch_folder
from malta.firmware.ctext import c_name
from malta.firmware.export import sources
from malta.firmware.program import TRUTHS, TYPES
from malta.firmware.ring import ring_sources
from malta.firmware.signals import Target
from malta.firmware.step import programs_of, started_state, step_function, zero_reference
from malta.firmware.supervisor_text import supervisor_sources
from malta.model.plant import FloatArray, position_in
from malta.simulation import references
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller
from malta.synthesis.schedule import SCHEDULED

if TYPE_CHECKING:
    from malta.proof.margin import Margin


# Instructions on the longest path of a compiled function, at most: a bound for the time of the supervised step.
#
# Instructions of a listing are nodes of a graph, and a loop is one node: its longest way round, times the passes that
# the C text says (`for` up to a number). Of each branch the longer side counts, also where the sides of two branches
# exclude each other, so that the bound may be above what ever happens. A loop that ends by its data (the search in a
# table) counts once.


# Functions stay functions, and a switch stays branches, so that lines and branches are those of the text.
APART = ("-g", "-fno-inline", "-fno-partial-inlining", "-fno-ipa-cp", "-fno-ipa-sra", "-fno-jump-tables")
LISTING = ("-d", "-l", "-r", "--no-show-raw-insn")  # of objdump
_ENDS = re.compile(r"^(?:ret|retq|bx\s+lr|(?:pop|ldmia(?:\.w)?)\b.*\bpc\b.*)")
_LEAVES = re.compile(r"^(?:b|b\.n|b\.w|jmp|jmpq)\s")
_CALLS = re.compile(r"^(?:bl|blx|call|callq)\s")
_BRANCHES = re.compile(r"^(?:b[a-z]{2}(?:\.[nw])?|b|b\.n|b\.w|cbn?z|j[a-z]+)\s")


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
            if code and (_CALLS.match(code[-1].text) or _LEAVES.match(code[-1].text)):
                code[-1] = code[-1]._replace(symbol=relocation[1])
        elif one := re.match(r"^\s+([0-9a-f]+):\s+([a-z].*)", line):
            text = one[2].strip()
            target = re.search(r"<(\w+)>", text)  # a function's beginning
            calls = target and target[1] != name and (_CALLS.match(text) or _LEAVES.match(text))
            code.append(Instruction(int(one[1], 16), text, weight, target[1] if target and calls else ""))
    return found


def _longest(code: list[Instruction], costs: list[int]) -> int:
    """The dearest way through instructions."""
    places = {i.address: k for k, i in enumerate(code)}
    after: dict[int, list[int]] = {}
    for k, i in enumerate(code):
        onward = [] if _ENDS.match(i.text) or _LEAVES.match(i.text) else [k + 1]
        goal = re.search(r"\b([0-9a-f]+) <", i.text)
        if goal and _BRANCHES.match(i.text) and not i.symbol and int(goal[1], 16) in places:
            onward.append(places[int(goal[1], 16)])
        after[k] = [j for j in onward if j < len(code)]
    return _way(after, costs, set(after), 0) if code else 0


def _way(after: Mapping[int, list[int]], costs: list[int], nodes: set[int], start: int) -> int:
    """The dearest way from a node within others; a loop is one node, whose cost is its dearest way round."""
    ways: dict[int, int] = {}  # from each loop on, by its first node in the order of its group
    groups = _loops(after, nodes, start)  # the last ones first
    group_of = {k: n for n, group in enumerate(groups) for k in group}
    for n, group in enumerate(groups):
        if len(group) == 1:
            own = costs[min(group)]
        else:
            first = start if start in group else min(j for k in nodes - group for j in after[k] if j in group)
            inside = {k: [j for j in after[k] if j in group and j != first] for k in group}
            own = _way(inside, costs, group, first)
        onward = {group_of[j] for k in group for j in after[k] if j in group_of and group_of[j] != n}
        ways[n] = own + max((ways[m] for m in onward), default=0)
    return ways[group_of[start]]


def _loops(after: Mapping[int, list[int]], nodes: Iterable[int], start: int) -> list[set[int]]:
    """The strongly connected groups that a node reaches, each behind those that it leads to (Tarjan 1972)."""
    allowed = set(nodes)
    number: dict[int, int] = {start: 0}
    low, path, found = {start: 0}, [start], []
    work = [(start, iter([j for j in after[start] if j in allowed]))]
    on_path = {start}
    while work:
        k, onward = work[-1]
        j = next(onward, None)
        if j is None:
            work.pop()
            if work:
                low[work[-1][0]] = min(low[work[-1][0]], low[k])
            if low[k] == number[k]:
                group = set()
                while k not in group:
                    group.add(path.pop())
                found.append(group)
                on_path -= group
        elif j not in number:
            number[j] = low[j] = len(number)
            path.append(j)
            on_path.add(j)
            work.append((j, iter([i for i in after[j] if i in allowed])))
        elif j in on_path:
            low[k] = min(low[k], number[j])
    return found


# What single precision does to a controller: its coefficients, its margin, and the noise of its rounding.


SAMPLES = 200  # over which the noise of rounding is measured


class RoundingNoise(NamedTuple):
    """Of each commanded force, rms: what rounding adds, and what the sensors' noise makes."""

    rounding: FloatArray
    sensors: FloatArray


def rounded(c: Controller) -> Controller:
    """The controller with the coefficients that single precision holds."""

    def in_single(record: Any) -> dict[str, Any]:
        return {name: getattr(record, name).astype(np.float32).astype(float) for name in SCHEDULED}

    if c.schedule is None:
        return replace(c, **in_single(c))
    return replace(c, **in_single(c), schedule=replace(c.schedule, **in_single(c.schedule)))


def rounded_margin(c: Controller, uncertainty: dict[str, float]) -> Margin | None:
    """The margin of the sampled loop with rounded coefficients, proven over the travel; None without uncertainty."""
    from malta.margins.travel import travel_margin
    from malta.model.data import plant_of

    if not uncertainty:
        return None
    return travel_margin(plant_of(c.parameters), rounded(c), uncertainty)


def rounding_noise(t: Target) -> RoundingNoise:
    """The noise of rounding beside that of the sensors, from the same readings of a machine at rest.

    Both precisions take the readings of one flight; what their forces differ by is the rounding.
    """
    c, plant = t.controller, t.believed
    lasts = SAMPLES * c.sample_time
    fidelity: Any = t.fidelity if t.driven else "force"
    run = simulate(plant, c, Scenario("hold", lasts, references.hold, noise=1.0, fidelity=fidelity))
    forces = {}
    for precision in ("double", "float"):
        own = replace(t, precision=precision)
        step, reference = step_function(own), zero_reference(own)
        real = TYPES[own.precision]
        state = started_state(own, reference)
        rows = []
        for k in range(len(run.t)):
            readings: dict[str, Any] = {"y": run.y[k].astype(real), "y_valid": np.ones(len(plant.outputs))}
            if t.driven:
                i = run.i_phase if t.fidelity == "phase" else run.i
                readings |= {"i": i[k], "i_valid": np.ones(i.shape[1]), "link": run.link[k]}
            if t.excited:
                readings["excitation"] = np.zeros(len(plant.inputs))
            state, out = step(state, reference, readings)
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
    supervised: int  # instructions of the supervisor's step with the controller's, at most (cost.py)


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
    with scratch_folder() as folder:
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


SELDOM = (
    "begin_block",
    "stop_after",
    "count_down",
)  # functions of a ring: at a block's begin, at and after a trigger


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
        with scratch_folder() as folder:
            for one, text in files.items():
                (folder / one).write_text(text, encoding="utf-8")
            command = [f"{p.prefix}gcc", *FLAGS, *APART, *p.options, "-c", file, "-o", "log.o"]
            done = _run(command, folder)
            listing = None if done is None else _run([f"{p.prefix}objdump", *LISTING, "log.o"], folder)
        if listing is not None:
            own = [f"{name}_log_sample", f"{name}_log_keep"]
            most = sum(1 + longest_path({file: listing}, files, part) for part in own)  # 1: the call
            seldom = sum(longest_path({file: listing}, files, part) for part in SELDOM)
            found.append(LogCost(p.name, most - seldom, most))
    return found


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

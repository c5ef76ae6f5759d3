"""Control periods by the thousand: CasADi's functions as C, compiled once, or on CasADi's virtual machine.

The functions of machine.py are straight lines of scalar operations. Here they become C inside the loop of engine.c,
with every number of machine and controller an argument: one compilation serves all machines and gain files of a shape.
What depends on those numbers alone is computed once a run (`prepare`), nothing is computed twice, and factors that sums
share are taken out of them. Long functions come in parts, which hand over numbers in an array: twice the text in one
piece takes a compiler far more than twice the time. For many machines the same text is compiled with one machine in
each lane of a SIMD register, and once more for tilts as small as an air gap leaves room for: without a branch, and done
over where a tilt turns out to have been larger.

Compiled engines stay in the user's cache folder under the SHA-256 of their text, the compiler, its options and the
processor; two processes that compile at once write the same file, each under a name of its own first. Without a C
compiler CasADi's virtual machine runs the same functions.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
import platformdirs

from malta.errors import CheckError
from malta.simulation.period import Parts

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

LANES = 8
WHOLE = 4000  # statements of the longest function that is not cut in parts
PART = 300  # statements of a part, at most
FLAGS = (
    *("-std=gnu11", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fschedule-insns", "-fsched-pressure", "-fPIC", "-shared"),
)

_BINARY = {"ADD": "+", "SUB": "-", "MUL": "*"}
_TRUTH = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
_EACH = [
    "sqrt",
    "floor",
    "ceil",
    "exp",
    "log",
    "tan",
    "tanh",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "sign",
]
_FORMS = (
    {f"OP_{name}": f"{{0}} {sign} {{1}}" for name, sign in _BINARY.items()}
    | {f"OP_{name.upper()}": f"each_{name}({{0}})" for name in _EACH}
    | {f"OP_{name.upper()}": f"each_{name}({{0}}, {{1}})" for name in ("pow", "atan2", "hypot", "fmod")}
    | {
        "OP_ASSIGN": "{0}",
        "OP_NEG": "-{0}",
        "OP_SQ": "{0} * {0}",
        "OP_TWICE": "{0} + {0}",
        "OP_DIV": "{0} * inverse({1})",
        "OP_INV": "inverse({0})",
        "OP_FABS": "size({0})",
        "OP_SIN": "sine({0})",
        "OP_COS": "cosine({0})",
        "OP_FMIN": "smaller({0}, {1})",
        "OP_FMAX": "larger({0}, {1})",
        "OP_CONSTPOW": "each_pow({0}, {1})",
        "OP_IF_ELSE_ZERO": "where({0}, {1})",  # the first as a mask
        "PICK": "pick({0}, {1}, {2})",  # likewise
        "TILT": "tilt({0})",  # the square of an angle that is likely to be small, and its functions
        "TILT_SINE": "tilt_sine({0}, {1})",
        "TILT_COSINE": "tilt_cosine({0}, {1})",
        "TILT_SECANT": "tilt_secant({0}, {1})",
    }
)
# Truths are masks; they become 1 and 0 where they are calculated with.
_MASKS = {f"OP_{name}": f"MASK({{0}} {sign} {{1}})" for name, sign in _TRUTH.items()} | {
    "OP_NOT": "~{0}",
    "OP_AND": "{0} & {1}",
    "OP_OR": "{0} | {1}",
}
_NAMES = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


class _Node(NamedTuple):
    """A scalar of the straight line: what it does with earlier nodes, or what it reads."""

    op: str  # "" where `form` is read or written out in place
    form: str
    arguments: tuple[int, ...]
    fixed: bool  # depends on theta and constants alone


def translate(f: ca.Function, shared: Sequence[int], first_constant: int) -> tuple[str, str, int]:
    """C of an SX function whose last argument is theta: lines of `prepare`, the function, and how many constants.

    shared : arguments that are the same in every lane.

    Raises CheckError for an operation that has no C form here.
    """
    nodes, outputs = _read(f, shared)
    used = _reached(nodes, [k for *_, k in outputs])
    fixed = [k for k in used if nodes[k].fixed]
    # What the moving part reads of the fixed part goes through the array c.
    read = {a for k in used if not nodes[k].fixed for a in nodes[k].arguments} | {k for *_, k in outputs}
    kept = [k for k in fixed if k in read and nodes[k].op]
    place = {k: first_constant + index for index, k in enumerate(kept)}
    moving = [k for k in used if nodes[k].op and not nodes[k].fixed]
    parts = _cut(moving)
    part = {k: index for index, members in enumerate(parts) for k in members}
    slot = _slots(nodes, parts, {k for *_, k in outputs})

    def text(k: int, *, at: int | None, mask: bool = False) -> str:
        """What a node is called in a part of the function, or in `prepare`; as a mask if that is asked for."""
        node = nodes[k]
        is_mask = node.op in _MASKS
        if at is not None and k in place:
            plain, is_mask = f"c[{place[k]}]", False
        elif k in slot and part[k] != at:
            plain = f"bits(s[{slot[k]}])" if is_mask else f"s[{slot[k]}]"
        else:
            plain = f"t{k}" if node.op else node.form
        if mask:
            return plain if is_mask else f"MASK({plain} != 0.0)"
        return f"truth({plain})" if is_mask else plain

    def line(k: int) -> str:
        node, at = nodes[k], part.get(k)
        masks = _mask_arguments(node)
        values = [text(a, at=at, mask=i in masks) for i, a in enumerate(node.arguments)]
        kind = "whole" if node.op in _MASKS else "real"
        return f"  const {kind} t{k} = {node.form.format(*values)};"

    def handed_over(k: int) -> str:
        return f"  s[{slot[k]}] = {f'value(t{k})' if nodes[k].op in _MASKS else f't{k}'};"

    prepare = [line(k) for k in fixed if nodes[k].op]
    prepare += [f"  c[{place[k]}] = {text(k, at=None)};" for k in kept]
    bodies = [
        [x for k in members for x in (line(k), *([handed_over(k)] if k in slot else []))] for members in parts
    ]
    results = [(f"r{i}[{j}]", text(k, at=len(parts) - 1)) for i, j, k in outputs]
    bodies[-1] += [f"  const real o{n} = {found};" for n, (_, found) in enumerate(results)]
    bodies[-1] += [f"  {place} = o{n};" for n, (place, _) in enumerate(results)]
    kinds = ["double" if i in shared else "real" for i in range(f.n_in() - 1)]
    # The first argument may be the first result: what is read is read before anything is written.
    arguments = [
        ("const real *restrict ", "c"),
        *((f"const {kind} *{'restrict ' * (i > 0)}", f"a{i}") for i, kind in enumerate(kinds)),
        *((f"real *{'restrict ' * (i > 0)}", f"r{i}") for i in range(f.n_out())),
    ]
    function = _assembled(f.name(), arguments, bodies, len(set(slot.values())))
    return "\n".join(["  {", *prepare, "  }"]), function, len(kept)


def _cut(statements: list[int]) -> list[list[int]]:
    """The statements of one function, or of parts of about the same length."""
    count = math.ceil(len(statements) / PART) if len(statements) > WHOLE else 1
    edges = [len(statements) * k // count for k in range(count + 1)]
    return [statements[begin:end] for begin, end in pairwise(edges)]


def _slots(nodes: list[_Node], parts: list[list[int]], results: set[int]) -> dict[int, int]:
    """Where the nodes that later parts read stand meanwhile; a place is taken again after the last part that reads."""
    last = {
        k: index for index, members in enumerate(parts) for reader in members for k in nodes[reader].arguments
    }
    last |= dict.fromkeys(results, len(parts) - 1)  # the last part writes them
    slot: dict[int, int] = {}
    leaving: list[list[int]] = [[] for _ in parts]  # places by the last part that reads them
    free: list[int] = []
    size = 0
    for index, members in enumerate(parts):
        free += leaving[index - 1] if index else []
        for k in members:
            if last[k] > index:
                if not free:
                    free, size = [size], size + 1
                slot[k] = free.pop()
                leaving[last[k]].append(slot[k])
    return slot


def _assembled(name: str, arguments: list[tuple[str, str]], bodies: list[list[str]], slots: int) -> str:
    """The function; or its parts, which share the array s, and a function that calls one after the other."""
    taken, given = ", ".join(map("".join, arguments)), ", ".join(called for _, called in arguments)
    inline, apart = (
        f"static {x}void" for x in ("inline __attribute__((always_inline)) ", "__attribute__((noinline)) ")
    )
    (*_, body), lines = bodies, []
    if len(bodies) > 1:
        for k, members in enumerate(bodies):
            lines += [f"{apart} {name}_{k}({taken}, real *restrict s) {{", *members, "}"]
        body = [f"  real s[{slots}];", *(f"  {name}_{k}({given}, s);" for k in range(len(bodies)))]
    return "\n".join([*lines, f"{inline} {name}({taken}) {{", *body, "}", ""])


def _read(f: ca.Function, shared: Sequence[int]) -> tuple[list[_Node], list[tuple[int, int, int]]]:
    """The instructions of an SX function, and which node is which entry of which result."""
    theta = f.n_in() - 1
    nodes = _Line()
    slot: dict[int, int] = {}  # of CasADi's work vector: the node it holds
    outputs: list[tuple[int, int, int]] = []
    for k in range(f.n_instructions()):
        op, reads, writes = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs.append((writes[0], writes[1], slot[reads[0]]))
            continue
        if op == ca.OP_INPUT:
            i, j = reads
            text = f"theta[{j}]" if i == theta else f"a{i}[{j}]"
            node = _Node("" if i != theta else "INPUT", f"K({text})" if i in shared else text, (), i == theta)
            slot[writes[0]] = nodes.place(node)
        elif op == ca.OP_CONST:
            text = f"K({_number(f.instruction_constant(k))})"
            slot[writes[0]] = nodes.place(_Node("", text, (), True))
        else:
            name = _NAMES[op]
            if name not in _FORMS and name not in _MASKS:
                raise CheckError(f"the compiled engine has no {name}")
            slot[writes[0]] = nodes.add(name, *(slot[r] for r in reads))
    return nodes.nodes, outputs


def _number(value: float) -> str:
    """A constant as C writes it."""
    return repr(value).replace("inf", "INFINITY").replace("nan", "NAN")


class _Line:
    """Nodes, each of them once."""

    def __init__(self) -> None:
        self.nodes: list[_Node] = []
        self._known: dict[_Node, int] = {}

    def place(self, node: _Node) -> int:
        """Where this very node stands, now or already."""
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

    def add(self, name: str, *arguments: int) -> int:
        """Where the result of an operation stands, in the form that costs least."""
        made = getattr(self, f"_{name.removeprefix('OP_').lower()}", None)
        found: int | None = made(*arguments) if made is not None else None
        return self._plain(name, *arguments) if found is None else found

    def _plain(self, name: str, *arguments: int) -> int:
        if name in ("OP_ADD", "OP_MUL"):
            arguments = tuple(sorted(arguments))
        fixed = all(self.nodes[a].fixed for a in arguments)
        return self.place(_Node(name, _MASKS.get(name) or _FORMS[name], arguments, fixed))

    def _scaled(self, k: int) -> tuple[int, int] | None:
        """The fixed factor and the moving one of a product."""
        node = self.nodes[k]
        if node.op != "OP_MUL" or node.fixed:
            return None
        one, other = node.arguments
        if self.nodes[one].fixed:
            return one, other
        return (other, one) if self.nodes[other].fixed else None

    def _mul(self, one: int, other: int) -> int | None:
        """Fixed factors are multiplied with each other, once a run."""
        for factor, product in ((one, other), (other, one)):
            parts = self._scaled(product)
            if self.nodes[factor].fixed and parts is not None:
                return self._plain("OP_MUL", self._plain("OP_MUL", factor, parts[0]), parts[1])
        return None

    def _div(self, one: int, other: int) -> int | None:
        """A reciprocal, which is computed once a run where it is fixed, and a product."""
        return self.add("OP_MUL", one, self.add("OP_INV", other))

    def _inv(self, k: int) -> int | None:
        node = self.nodes[k]
        if node.fixed:
            return self.place(_Node("OP_INV", "1.0 / {0}", (k,), True))
        return self._plain("TILT_SECANT", *node.arguments) if node.op == "TILT_COSINE" else None

    def _add(self, one: int, other: int) -> int | None:
        """if_else(c, x, y) comes as (c ? x : 0) + (not c ? y : 0)."""
        first, second = self.nodes[one], self.nodes[other]
        if first.op == second.op == "OP_IF_ELSE_ZERO":
            condition = self.nodes[second.arguments[0]]
            if condition.op == "OP_NOT" and condition.arguments == first.arguments[:1]:
                return self._plain("PICK", *first.arguments, second.arguments[1])
        return self._together("OP_ADD", one, other)

    def _sub(self, one: int, other: int) -> int | None:
        return self._together("OP_SUB", one, other)

    def _together(self, name: str, one: int, other: int) -> int | None:
        """The sum of two products that share their fixed factor."""
        first, second = self._scaled(one), self._scaled(other)
        if first is None or second is None or first[0] != second[0]:
            return None
        return self.add("OP_MUL", first[0], self.add(name, first[1], second[1]))

    def _sin(self, k: int) -> int | None:
        return self._tilt("TILT_SINE", k)

    def _cos(self, k: int) -> int | None:
        return self._tilt("TILT_COSINE", k)

    def _tilt(self, name: str, k: int) -> int | None:
        """The angle is taken for a tilt, radians of a mover in its air gap, where it is a state and what is added."""
        return self._plain(name, k, self._plain("TILT", k)) if self._state(k) else None

    def _state(self, k: int) -> bool:
        node = self.nodes[k]
        if node.op in ("OP_ADD", "OP_SUB"):
            return any(self._state(a) for a in node.arguments)
        return node.form.startswith("a0[")


def _mask_arguments(node: _Node) -> range:
    """Which arguments a node takes as masks."""
    if node.op in ("OP_IF_ELSE_ZERO", "PICK"):
        return range(1)
    return range(2) if node.op in ("OP_NOT", "OP_AND", "OP_OR") else range(0)


def _reached(nodes: list[_Node], roots: list[int]) -> list[int]:
    """The nodes that the roots need, in order."""
    needed, waiting = set(), list(roots)
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += nodes[k].arguments
    return sorted(needed)


def source(p: Parts, digest: ca.Function | None) -> str:
    """The whole C text, but for the number of lanes."""
    prepares, functions, count = [], [], 0
    given = {"sense": [1], "decide": [1], "substep": [2], "digest": [2]}
    for f in (p.sense, p.decide, p.substep, *([digest] if digest else [])):
        prepare, function, more = translate(f, given[f.name()], count)
        prepares.append(prepare)
        functions.append(function)
        if f is not digest:
            functions.append("#if LANES > 1\n" + _near(function) + "#endif\n")
        count += more
    sizes = {
        "THETA": len(p.theta),
        "CONSTANTS": count,
        "STATES": p.sense.size1_in(0),
        "MACHINE": p.substep.size1_in(0),
        "GIVEN": p.sense.size1_in(1),
        "OUTPUTS": p.sense.size1_in(2),
        "FORCES": p.decide.size1_in(3),
        "HELD": p.substep.size1_in(1),
        "JITTER": p.substep.size1_in(3),
        "ROW": p.decide.size1_out(2),
        "DIGEST": digest.size1_in(0) if digest else 0,
    }
    defines = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    prepare = "static void prepare(const real *theta, real *c) {\n" + "\n".join(prepares) + "\n}\n"
    frame = files("malta.simulation").joinpath("engine.c").read_text(encoding="utf-8")
    return defines + frame.replace("/*MODEL*/", prepare + "".join(functions))


def _near(function: str) -> str:
    """The function for small tilts alone, which tells by `range` whether they were: its code has no branches.

    Parts without a tilt serve both.
    """
    end = "}\n"
    *parts, whole = function.removesuffix(end).split(end)
    tilted = [part for part in parts if "tilt" in part]
    for part in tilted:
        name = part.partition("(const real *")[0].split()[-1]
        whole = whole.replace(f" {name}(c, ", f" {name}_near(range, c, ")
    texts = [text.replace("(const real *", "_near(real *range, const real *", 1) for text in (*tilted, whole)]
    return "".join(text.replace("tilt", "near") + end for text in texts)


@cache
def compiler() -> tuple[str, ...] | None:
    """The system's C compiler, as a command: $CC (which may have options), or the first of cc, gcc and clang."""
    chosen = shlex.split(os.environ.get("CC", ""))
    for name, *options in [chosen] if chosen else [["cc"], ["gcc"], ["clang"]]:
        path = shutil.which(name)
        if path:
            return path, *options
    return None


@cache
def _processor() -> str:
    """What `-march=native` depends on."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "".join(sorted({x for x in lines if x.startswith(("flags", "model name", "Features"))}))
    return platform.processor() + platform.machine()


@cache
def _version(cc: tuple[str, ...]) -> str:
    return subprocess.run([*cc, "--version"], capture_output=True, text=True, check=False).stdout


def library(text: str, lanes: int, folder: Path | None = None) -> ctypes.CDLL | None:
    """The compiled text, from the cache folder or compiled now; None where no compiler can do it."""
    cc = compiler()
    if cc is None:
        return None
    key = "\n".join([text, str(lanes), *FLAGS, *cc, _version(cc), _processor(), platform.platform()])
    name = f"{hashlib.sha256(key.encode()).hexdigest()}.so"
    for place in (folder or cache_folder(), Path(tempfile.gettempdir()) / f"malta-{os.getuid()}"):
        path = place / name
        try:
            place.mkdir(parents=True, exist_ok=True, mode=0o700)
            if place.stat().st_uid != os.getuid():
                continue  # code is loaded from here: nobody else's
            if not _whole(path) and not _compiled(cc, text, lanes, path):
                return None
            return ctypes.CDLL(str(path))
        except OSError:
            continue
    return None


def _whole(path: Path) -> bool:
    """Whether a library ends with the hash of what stands before: loading half of one would end the process."""
    if not path.exists():
        return False
    content = path.read_bytes()
    return len(content) > 32 and hashlib.sha256(content[:-32]).digest() == content[-32:]


def cache_folder() -> Path:
    """Where compiled engines stay; deleting it costs seconds of compilation."""
    return platformdirs.user_cache_path("malta")


def _compiled(cc: tuple[str, ...], text: str, lanes: int, path: Path) -> bool:
    """Compile to `path`, whole or not at all."""
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        c, so = Path(scratch) / "engine.c", Path(scratch) / "engine.so"
        c.write_text(text, encoding="utf-8")
        for native in (["-march=native"], []):
            command = [*cc, *FLAGS, *native, f"-DLANES={lanes}", str(c), "-o", str(so), "-lm"]
            if subprocess.run(command, capture_output=True, check=False).returncode == 0:
                content = so.read_bytes()
                so.write_bytes(content + hashlib.sha256(content).digest())  # see _whole
                so.replace(path)
                return True
    return False


@dataclass(frozen=True, eq=False)
class Engine:
    """Runs control periods of one machine: (first, state, given, noise, fast noise) -> (state, rows)."""

    kind: str  # "compiled" or "virtual machine"
    run: Callable[[int, FloatArray, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def _address(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def substeps_until(sample: int, substeps: float) -> int:
    """Substeps before a sample, where it takes so many: each sample begins with the first substep after it."""
    return math.ceil(sample * substeps - 1e-6)


def compiled_engine(run: Any, p: Parts, theta: FloatArray, substeps: float, table: FloatArray) -> Engine:
    """`run` of a library with one lane. Rows per call are limited by memory alone."""
    width = p.decide.size1_out(2)
    theta, table = (np.ascontiguousarray(a, dtype=float) for a in (theta, table))

    def call(
        first: int, state: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        after = np.array(state, dtype=float)
        given, noise, fast = (np.ascontiguousarray(a) for a in (given, noise, fast))
        rows = np.empty((len(given), width))
        run(
            ctypes.c_long(first),
            ctypes.c_long(len(given)),
            ctypes.c_double(substeps),
            _address(theta),
            ctypes.c_long(len(table)),
            _address(table),
            _address(after),
            _address(given),
            _address(noise),
            _address(fast),
            _address(rows),
        )
        return after, rows

    return Engine("compiled", call)


def feedforward_table(z_grid: FloatArray, v0: FloatArray) -> FloatArray:
    """Rows of z, v0(z) and its slope up to the next row."""
    slope = np.diff(v0, axis=0) / np.diff(z_grid)[:, None]
    return np.ascontiguousarray(np.hstack([z_grid[:, None], v0, np.vstack([slope, slope[-1:]])]))


def virtual_engine(chain_of: Callable[[int], ca.Function], substeps: float) -> Engine:
    """The chained functions of machine.py on CasADi's virtual machine; a short last block is padded.

    chain_of : the chain for samples of so many substeps
    """

    def call(
        first: int, state: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        edges = np.array([substeps_until(first + k, substeps) for k in range(len(given) + 1)])
        edges, parts, k = edges - edges[0], [], 0
        while k < len(given):
            chain = chain_of(int(edges[k + 1] - edges[k]))
            block = chain.size2_in(1)
            alike = np.diff(edges[k : k + block + 1]) == edges[k + 1] - edges[k]
            end = k + (len(alike) if alike.all() else int(alike.argmin()))
            part = fast[edges[k] : edges[end]].reshape(end - k, -1)
            inputs = np.hstack([given[k:end], noise[k:end], part])
            padded = np.vstack([inputs, np.repeat(inputs[-1:], block - len(inputs), axis=0)])
            states, rows = evaluate(chain, state, padded)
            state = states[len(inputs) - 1]
            parts.append(rows[: len(inputs)])
            k = end
        return state, np.concatenate(parts)

    return Engine("virtual machine", call)


def evaluate(function: ca.Function, *arguments: FloatArray) -> list[FloatArray]:
    """Call a dense CasADi function on numpy's own memory, a row for each of its columns: no conversion to DM."""
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    buffer, run = function.buffer()
    inputs = [np.ascontiguousarray(array, dtype=float) for array in arguments]
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    run()
    return results


def in_lanes(rows: FloatArray, groups: int) -> FloatArray:
    """Rows of machines as groups x numbers x LANES; the last machine fills what is left of the last group."""
    filled = np.concatenate([rows, np.repeat(rows[-1:], groups * LANES - len(rows), axis=0)])
    return np.ascontiguousarray(filled.reshape(groups, LANES, -1).swapaxes(1, 2))


def run_many(
    lib: Any,
    chosen: slice,
    *,
    substeps: int,
    theta: FloatArray,
    table: FloatArray,
    states: FloatArray,
    given: FloatArray,
    uniform: bool,
    sigma: FloatArray,
    keys: Any,
    digests: FloatArray,
) -> None:
    """Some groups of LANES machines (the first axis) through all samples of `given`; states and digests are changed."""
    lib.run_many(
        ctypes.c_long(len(range(*chosen.indices(len(theta))))),
        ctypes.c_long(len(given)),
        ctypes.c_long(substeps),
        _address(theta[chosen]),
        ctypes.c_long(len(table)),
        _address(table),
        _address(states[chosen]),
        _address(given),
        ctypes.c_long(uniform),
        _address(sigma[chosen]),
        _address(keys[chosen]),
        _address(digests[chosen]),
    )

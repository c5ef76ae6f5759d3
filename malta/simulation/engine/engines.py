"""Engines of control periods and of recursions over a log: compiled C, or CasADi's virtual machine without one."""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from importlib import import_module
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import read_packaged
from malta.model.parameters import acting_names, shape_parameters, twins_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.engine.compiled import address_of, feedforward_table, library
from malta.simulation.engine.instructions import (
    MASKS,
    NO_COUNTS,
    Counts,
    Node,
    counts_of,
    find_common,
    foresee,
    mask_arguments,
    needed_nodes,
    places,
    read_instructions,
)
from malta.simulation.engine.integration_state import with_working_state
from malta.simulation.layout import (
    SHARED_NUMBERS,
    Setup,
    electronics_of,
    ending_columns,
    flatten,
    layout_of,
    numbers_of,
)
from malta.simulation.period import Period, chain, columns_of, period_of, without_zeros
from malta.synthesis.controller import Controller
from malta.synthesis.law import gains_of

# C text of CasADi functions: the control period inside the loop of engine.c, on the numbers of numbers.c.
#
# Every number of machine and controller is an entry of theta, so that one compilation serves all machines and gain
# files of a shape. What is the same for a run or for all lanes is computed once, see instructions.py. A long function
# is cut into parts that hand numbers over in an array: compilers need far more than twice the time for twice the text
# in one piece. Each function has a second version for small tilts, which has no branches.


MAX_WHOLE_STATEMENTS = 4000  # statements: a longer function is cut into parts
MAX_PART_STATEMENTS = 300  # statements of a part at most
UNCHANGED_ENTRIES = ("digest", "cruise", "substep")  # an entry that stays as it is is not written


class Text(NamedTuple):
    """A CasADi function in C."""

    prepare: str  # lines that compute its entries of c and d
    function: str
    counts: Counts  # of its own entries
    foresee: str  # lines that compute its entries of g


def source(p: Period, digest: ca.Function | None, cruise: Sequence[ca.Function] = ()) -> str:
    """The whole C text of an engine; the number of lanes is a macro of the compilation.

    digest : the function that updates a run's digest, see digest.py; None for an engine of one lane
    cruise : when a shorter update does the same, and that update
    """
    texts, functions, counts = [], [], NO_COUNTS
    given = {"sense": 1, "decide": 1, "substep": 2, "digest": 2, "cruises": 2, "cruise": 2}
    common = [k for k, name in enumerate(p.theta) if name in SHARED_NUMBERS]
    motion = (p.substep,) if p.enter is None or p.leave is None else (p.enter, p.substep, p.leave)
    for f in (p.sense, p.decide, *motion, *([digest] if digest else []), *cruise):
        text = translate(f, [given[f.name()]] if f.name() in given else [], counts, common)
        functions.append(text.function)
        if f in (p.sense, p.decide, *motion):
            functions.append(_small_tilt_version(text.function))
        texts.append(text)
        counts = Counts(*(have + more for have, more in zip(counts, text.counts, strict=True)))
    columns = range(p.decide.size1_in(3)) if p.columns is None else p.columns
    sizes = {
        "THETA": len(p.theta),
        "CONSTANTS": counts.c,
        "SHARED": counts.d,
        "FORESEEN": counts.g,
        "STATES": p.sense.size1_in(0),
        "MACHINE": (p.enter or p.substep).size1_in(0),
        "WORKING": p.substep.size1_in(0),
        "COORDINATES": int(p.enter is not None),
        "GIVEN": p.sense.size1_in(1),
        "OUTPUTS": p.sense.size1_in(2),
        "FORCES": p.decide.size1_in(3),
        "COLUMNS": len(columns),
        "COLUMN": ", ".join(map(str, columns)),
        "TILTED": int(any("tilt" in function for function in functions)),
        "HELD": p.substep.size1_in(1),
        "JITTER": p.substep.size1_in(3),
        "ROW": p.decide.size1_out(2),
        "DIGEST": digest.size1_in(0) if digest else 0,
        "CRUISE": int(bool(cruise)),
    }
    defines = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    prepare = _once("prepare(const real *theta, real *c, double *d)", [text.prepare for text in texts])
    ahead = _once("foresee(const double *d, const double *given, double *g)", [x.foresee for x in texts])
    numbers, noise, loop = (
        read_packaged(f"simulation/engine/{name}.c").decode() for name in ("numbers", "noise", "engine")
    )
    noise = f"#if LANES > 1\n{noise}#endif\n"
    return "".join([defines, numbers, prepare, ahead, *functions, noise, loop])


def _once(name: str, blocks: list[str]) -> str:
    """The text of a function of several blocks."""
    return f"static void {name} {{\n" + "\n".join(f"  {{\n{lines}\n  }}" for lines in blocks) + "\n}\n"


class Names(NamedTuple):
    """The C names of nodes."""

    nodes: list[Node]
    place: dict[int, str]  # of nodes that are computed once
    slot: dict[int, int]  # of nodes that one part of a function leaves to another
    part: dict[int, int]  # of the function, that computes a node

    def text(self, k: int, *, at: int | None, mask: bool = False) -> str:
        """The name of a node in part `at` of the function, or in `prepare` (None); as a mask on request."""
        node, place = self.nodes[k], self.place.get(k, "")
        is_mask = node.op in MASKS
        if at is not None and place:
            plain, is_mask = place if place.startswith("c") else f"K({place})", False
        elif k in self.slot and self.part[k] != at:
            plain = f"bits(s[{self.slot[k]}])" if is_mask else f"s[{self.slot[k]}]"
        else:
            plain = f"t{k}" if node.op else node.form
        if mask:
            return plain if is_mask else f"MASK({plain} != 0.0)"
        return f"truth({plain})" if is_mask else plain

    def lines(self, k: int) -> list[str]:
        """The statement that computes a node, and the one that leaves it to other parts."""
        node, at, masks = self.nodes[k], self.part.get(k), mask_arguments(self.nodes[k])
        values = [self.text(a, at=at, mask=i in masks) for i, a in enumerate(node.arguments)]
        kind = "whole" if node.op in MASKS else "real"
        line = f"  const {kind} t{k} = {node.form.format(*values)};"
        if k not in self.slot:
            return [line]
        return [line, f"  s[{self.slot[k]}] = {f'value(t{k})' if kind == 'whole' else f't{k}'};"]

    def keep(self, k: int) -> str:
        """The statement that stores a number that is computed once a run."""
        place, value = self.place[k], self.text(k, at=None)
        return f"  {place} = {value if place.startswith('c') else f'LANE({value}, 0)'};"


def translate(
    f: ca.Function, shared: Sequence[int], first: Counts = NO_COUNTS, common: Collection[int] = ()
) -> Text:
    """C text of an SX function whose last argument is theta.

    shared : arguments that have the same value in every lane
    first : entries of c, d and g before those of this function
    common : entries of theta that have the same value in every lane

    Raises CheckError for an operation that has no C form here.
    """
    nodes, outputs = read_instructions(f, shared, common)
    used = needed_nodes(nodes, [k for *_, k in outputs])
    early = find_common(nodes, used)
    moving = [k for k in used if nodes[k].op and not nodes[k].fixed and k not in early]
    place = places(nodes, used, early, {k for *_, k in outputs}, first)
    parts = _cut_in_parts(moving)
    part = {k: index for index, members in enumerate(parts) for k in members}
    names = Names(nodes, place, _slots(nodes, parts, {k for *_, k in outputs}), part)
    fixed = [k for k in used if nodes[k].fixed and nodes[k].op]
    prepare = [line for k in fixed for line in names.lines(k)] + [names.keep(k) for k in fixed if k in place]
    bodies = [[line for k in members for line in names.lines(k)] for members in parts]
    results = [(f"r{i}[{j}]", names.text(k, at=len(parts) - 1)) for i, j, k in outputs]
    if f.name() in UNCHANGED_ENTRIES:
        results = [(to, value) for to, value in results if value != to.replace("r0", "a0")]
    bodies[-1] += [f"  const real o{n} = {found};" for n, (_, found) in enumerate(results)]
    bodies[-1] += [f"  {to} = o{n};" for n, (to, _) in enumerate(results)]
    function = _assemble(f.name(), _arguments(f, shared), bodies, len(set(names.slot.values())))
    return Text("\n".join(prepare), function, counts_of(place), "\n".join(foresee(nodes, used, early, place)))


def _arguments(f: ca.Function, shared: Sequence[int]) -> list[tuple[str, str]]:
    """(type, name) of the arguments of a function in C: constants c, arguments a0, a1, ..., results r0, r1, ..."""
    kinds = ["double" if i in shared else "real" for i in range(f.n_in() - 1)]
    # The first argument and the first result may be the same array: all entries are read before one is written.
    return [
        ("const real *restrict ", "c"),
        *(("const double *restrict ", array) for array in "dg"),
        *((f"const {kind} *{'restrict ' * (i > 0)}", f"a{i}") for i, kind in enumerate(kinds)),
        *((f"real *{'restrict ' * (i > 0)}", f"r{i}") for i in range(f.n_out())),
    ]


def _cut_in_parts(statements: list[int]) -> list[list[int]]:
    """The statements of one function in parts of about the same length; one part for a short function."""
    count = math.ceil(len(statements) / MAX_PART_STATEMENTS) if len(statements) > MAX_WHOLE_STATEMENTS else 1
    edges = [len(statements) * k // count for k in range(count + 1)]
    return [statements[begin:end] for begin, end in pairwise(edges)]


def _slots(nodes: list[Node], parts: list[list[int]], results: set[int]) -> dict[int, int]:
    """Places in the array s of nodes that later parts read. A place is free again after its last reader."""
    last = {
        k: index for index, members in enumerate(parts) for reader in members for k in nodes[reader].arguments
    }
    last |= dict.fromkeys(results, len(parts) - 1)  # the last part writes the results
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


def _assemble(name: str, arguments: list[tuple[str, str]], bodies: list[list[str]], slots: int) -> str:
    """The text of a function; of several parts, also a function that calls them in turn with the array s."""
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


def _small_tilt_version(function: str) -> str:
    """The version of a function for small tilts, without branches. `range` returns the largest squared tilt.

    A sample whose range is too large is computed again by the general version. Parts without a tilt serve both.
    """
    if "tilt" not in function:
        name = function.rpartition("void ")[2].partition("(")[0]
        return f"#define {name}_near(range, ...) {name}(__VA_ARGS__)\n"
    end = "}\n"
    *parts, whole = function.removesuffix(end).split(end)
    tilted = [part for part in parts if "tilt" in part]
    for part in tilted:
        name = part.partition("(const real *")[0].split()[-1]
        whole = whole.replace(f" {name}(c, ", f" {name}_near(range, c, ")
    texts = [text.replace("(const real *", "_near(real *range, const real *", 1) for text in (*tilted, whole)]
    return "".join(text.replace("tilt", "near") + end for text in texts)


EngineChoice = Literal["auto", "compiled", "virtual machine"]
BLOCK = 250  # samples in one call of the virtual machine's chain


@dataclass(frozen=True, eq=False)
class Engine:
    """A function that simulates samples of one machine: (first, state, given, noise, fast noise) -> (state, rows).

    first : index of the first sample
    given, noise, rows : samples x size; fast noise : substeps x size
    The compiled engine's rows end with the first in which a contact ends the run.
    """

    kind: str  # "compiled" or "virtual machine"
    run: Callable[[int, FloatArray, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


@lru_cache(maxsize=32)  # building takes as long as a run; records compare by identity, so no hit is stale
def engine_of(
    plant: Plant,
    c: Controller,
    setup: Setup,
    substeps: float,
    errors: tuple[tuple[str, float], ...] = (),
    choice: EngineChoice = "auto",
) -> Engine:
    """The engine of a machine under a controller: compiled where possible, else CasADi's virtual machine.

    errors : of the sensors, (name, SI)

    Raises InputError for the choice "compiled" without a C compiler, or for a controller that looks up a table.
    """
    values = numbers_of(plant, c, substeps, dict(errors))
    if choice != "virtual machine":
        lib = library_of(shape_of(plant, c, setup))
        if lib is not None:
            ff, width = c.feedforward, sum(layout_of(plant, c, setup).row.values())
            table = feedforward_table(ff.z_grid, ff.v0)
            return compiled_engine(
                lib.run, width, flatten(values), substeps, table, ending_columns(plant, c, setup)
            )
        if choice == "compiled":
            if plant_of(c.parameters).actuator.tabulated:
                raise InputError(
                    "simulate", "engine", "a controller that looks up a table", "virtual machine"
                )
            raise InputError("simulate", "engine", "no C compiler that works", "cc, gcc or clang, or $CC")
    p = period_of(plant, c, setup, values, constant=True)
    block = 1 if setup.outside or electronics_of(plant, setup) is not None else BLOCK
    return virtual_engine(cache(lambda count: chain(p, c, count, block)), substeps)


@dataclass(frozen=True)
class LoopShape:
    """The shape of a plant and a controller. Two shapes are equal where the same compiled text serves both."""

    key: tuple[Any, ...]
    plant: Plant = field(compare=False)
    controller: Controller = field(compare=False)
    setup: Setup


def shape_of(plant: Plant, c: Controller, setup: Setup) -> LoopShape:
    """The shape of a plant and a controller: all that their functions depend on, except numbers."""
    variant, par = plant.variant, plant.parameters
    kin = (variant.func, *sorted(variant.keywords.items())) if isinstance(variant, partial) else (variant,)
    twins = tuple(twins_of(par).items())
    patterns = tuple(
        (m.shape, *m.sparsity().get_triplet()[0], *m.sparsity().get_triplet()[1])
        for m in gains_of(c).values()
    )
    fixed = (*shape_parameters(par).items(), *acting_names(par))
    columns = columns_of(c)
    law = (c.tracks, None if c.schedule is None else c.schedule.output)
    return LoopShape((type(par), kin, twins, fixed, patterns, columns, *law, c.parameters), plant, c, setup)


@lru_cache(maxsize=32)
def library_of(
    shape: LoopShape, lanes: int = 1, digest: ca.Function | None = None, cruise: tuple[ca.Function, ...] = ()
) -> Any:
    """The library of a shape; None where it cannot be compiled.

    digest : the function that updates a run's digest; for several lanes
    cruise : see digest.cruise_functions
    """
    if plant_of(shape.controller.parameters).actuator.tabulated:
        return None
    text = partial(engine_text, shape, digest, cruise)
    return library(text, lanes, key=engine_key(shape, digest, cruise))


def engine_text(
    shape: LoopShape, digest: ca.Function | None = None, cruise: tuple[ca.Function, ...] = ()
) -> str:
    """The C text of a shape's engine; digest and cruise as in `library_of`."""
    return source(compiled_period(shape), digest, cruise)


@lru_cache(maxsize=32)
def engine_key(
    shape: LoopShape, digest: ca.Function | None = None, cruise: tuple[ca.Function, ...] = ()
) -> str:
    """What decides an engine's C text, which takes ten times as long to make: its functions as they are first written,
    with all that a machine's module may have read from elsewhere, and malta's modules that make text of them."""
    plant, c, s = shape.plant, shape.controller, shape.setup
    numbers = numbers_of(plant, c, 1)
    p = period_of(plant, c, s, numbers, constant=False, shorten=lambda expressions: expressions)
    functions = (p.sense, p.decide, p.substep, *([digest] if digest else []), *cruise)
    rest = (p.theta, columns_of(c), s.fidelity, s.fraction, plant.second_order)
    parts = [_translators(), repr(rest).encode(), *(f.serialize().encode() for f in functions)]
    return hashlib.sha256(b"\n".join(parts)).hexdigest()


@cache
def _translators() -> bytes:
    """The modules that make an engine's text, as they are: sources or compiled, in a folder or a zip."""
    names = ("engines", "instructions", "integration_state")
    modules: list[Any] = [import_module(f"malta.simulation.engine.{name}") for name in names]
    texts = ("engine.c", "noise.c", "numbers.c")
    return b"".join(
        [
            *(module.__loader__.get_data(module.__file__) for module in modules),
            *(read_packaged(f"simulation/engine/{name}") for name in texts),
        ]
    )


@lru_cache(maxsize=32)
def compiled_period(shape: LoopShape) -> Period:
    """The functions of a control period as they are compiled: with numbers as arguments, without what drops out."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    p = period_of(plant, c, setup, numbers_of(plant, c, 1), constant=False)
    return with_working_state(without_zeros(p, columns_of(c)), plant, c, setup)


def substeps_until(sample: int, substeps: float) -> int:
    """Number of substeps before a sample. `substeps` a sample may be no integer: a sample then begins with the first
    substep after it."""
    return math.ceil(sample * substeps - 1e-6)


def compiled_engine(
    run: Any, width: int, theta: FloatArray, substeps: float, table: FloatArray, ending: Sequence[int] = ()
) -> Engine:
    """The engine of a library with one lane; `run` is the library's function.

    width : of a row
    ending : columns of a row that end a run, see ending_columns; rows after such a row are not computed
    """
    ends, columns = ctypes.c_long(len(ending)), (ctypes.c_long * len(ending))(*ending)
    theta, table = (np.ascontiguousarray(a, dtype=float) for a in (theta, table))
    numbers, points, rows_of_table = (  # these addresses keep their arrays alive
        theta.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_long(len(table)),
        table.ctypes.data_as(ctypes.c_void_p),
    )

    def call(
        first: int, state: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        after = np.array(state, dtype=float)
        given, noise, fast = (np.ascontiguousarray(a) for a in (given, noise, fast))
        rows = np.empty((len(given), width))
        done = run(
            ctypes.c_long(first),
            ctypes.c_long(len(given)),
            ctypes.c_double(substeps),
            numbers,
            points,
            rows_of_table,
            address_of(after),
            address_of(given),
            address_of(noise),
            address_of(fast),
            address_of(rows),
            ends,
            columns,
        )
        return after, rows[:done]

    return Engine("compiled", call)


def virtual_engine(chain_of: Callable[[int], ca.Function], substeps: float) -> Engine:
    """The engine of CasADi's virtual machine; the last samples of a run are padded to a whole block.

    chain_of : number of substeps -> the function `chain` of period.py for samples of so many substeps
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
    """Call a dense CasADi function on numpy arrays: a row of an array is a column of the function's argument or result.

    The function reads and writes the arrays' memory, which is faster than a conversion to DM.
    """
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    buffer, run = function.buffer()
    inputs = [np.ascontiguousarray(array, dtype=float) for array in arguments]
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    run()
    return results

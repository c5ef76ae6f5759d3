"""Ways to write a controller's step in C: instructions that processors execute, and time here.

Instructions are counted by QEMU, one by one, loops and library functions included: those of eleven steps without those
of one. malta's export is beside matrices in loops, and beside C that CasADi generates from the same expressions.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from timing import Result, medians

import malta
from malta.firmware.cost import CLOCK, FLAGS, PROCESSORS, Processor, cost_on
from malta.firmware.ctext import c_name, c_number, function_text, signature
from malta.firmware.period_functions import decide, named_function, sense
from malta.firmware.program import Precision, build_program, evaluate, lower
from malta.firmware.signals import Target
from malta.firmware.sources import sources
from malta.firmware.step import look_up, programs_of, started_state, step_function
from malta.firmware.vectors import record_vectors
from malta.synthesis.law import command_forces, gains_of
from malta.synthesis.linear_law import estimate_states

ROOT = Path(__file__).parents[1]
HERE, A9, M4F = PROCESSORS
CASADI = "CasADi's generated C"
STEPS = 200_000  # of a timed program
PRECISIONS: tuple[Precision, ...] = ("double", "float")
START = ROOT / "tests" / "targets"  # of a program on a Cortex-M
MACHINE = (
    "--specs=rdimon.specs",
    "-nostartfiles",
    "-T",
    str(START / "cortex_m.ld"),
    str(START / "cortex_m.c"),
)
LINKED: dict[str, tuple[str, ...]] = {A9.name: ("-static",), M4F.name: MACHINE}
RUNNERS = {
    A9.name: ("qemu-arm", "-cpu", "cortex-a9"),
    M4F.name: ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel"),
}


class Way(NamedTuple):
    """A program that computes a function again and again."""

    text: str  # of the function, in a file of its own
    declared: str  # what its caller knows of it
    call: str
    options: tuple[str, ...] = ()


def law_function(t: Target, kind: Any, gains: Mapping[str, Any]) -> ca.Function:
    """Positions, filter and law, as functions of matrices of a kind of CasADi's symbols, SX or MX."""
    c, plant = t.controller, t.believed
    sizes = {"xi_pred": len(c.states), "e": len(c.measurements), "y": len(c.measurements)}
    sizes |= {"xi_ref": len(c.states), "v_ff": len(c.forces), "v0": len(c.forces)}
    a = {name: kind.sym(name, size) for name, size in sizes.items()}
    y = ca.SX.sym("y", sizes["y"])
    positions = ca.Function("positions", [y], [ca.densify(plant.position_of(y))])
    xi_hat = estimate_states(gains, a["xi_pred"], a["y"])
    following, saturated, v = command_forces(gains, xi_hat, a["e"], a["xi_ref"], a["v_ff"], a["v0"])
    results = {
        "q": positions(a["y"]),
        "xi_hat": xi_hat,
        "v": v,
        "saturated": saturated,
        "xi_pred_next": following,
    }
    dense = [ca.densify(value) for value in results.values()]
    return ca.Function("law", list(a.values()), dense, list(a), list(results))


def law_ways(t: Target) -> dict[str, Way]:
    """Positions, filter and law of a controller, written in different ways."""
    gains = gains_of(t.controller)
    scalars = law_function(t, ca.SX, {name: ca.SX(value) for name, value in gains.items()})
    sparse = {name: ca.sparsify(value) for name, value in gains.items()}
    dense = {name: ca.densify(value) for name, value in gains.items()}
    return {
        "malta": own(scalars, t.precision),
        "matrices in loops": loops(t, gains),
        f"{CASADI}, scalars": generated([scalars], t.precision),
        f"{CASADI}, sparse matrices": generated([law_function(t, ca.MX, sparse)], t.precision),
        f"{CASADI}, dense matrices": generated([law_function(t, ca.MX, dense)], t.precision),
    }


def period_ways(t: Target) -> dict[str, Way]:
    """What is read, and all that follows from it to the duty cycles; without the search in the table of v0(z)."""
    functions = [sense(t).plain, decide(t).plain]
    read, decided = (own(f, t.precision) for f in functions)
    return {
        "malta": Way(
            f"{read.text}\n{decided.text}",
            f"{read.declared}\n{decided.declared}",
            f"{read.call}\n{decided.call}",
        ),
        f"{CASADI}, scalars": generated(functions, t.precision),
    }


def own(f: ca.Function, precision: Precision) -> Way:
    """As malta exports it."""
    p = build_program(lower(f, precision))
    head = f"#include <stdbool.h>\ntypedef {precision} own_real;\n"
    given = [f"{f.name()}_{name}" for name, size in (*p.arguments, *p.results) if size]
    body = function_text(p, "own", precision)
    return Way(
        ("" if f.name() == "decide" else head) + body,
        f"typedef {precision} own_real;\n{signature(p, 'own')};",
        f"own_{p.name}({', '.join(given)});",
    )


def generated(functions: list[ca.Function], precision: Precision) -> Way:
    """As CasADi writes it; constants in single precision, where numbers are."""
    code = ca.CodeGenerator("generated.c", {"casadi_real": precision})
    calls, declared = [], []
    for f in functions:
        code.add(f)
        n = f.name()
        arguments = ", ".join(f"{n}_{f.name_in(k)}" for k in range(f.n_in()))
        results = ", ".join(f"{n}_{f.name_out(k)}" for k in range(f.n_out()))
        declared.append(f"int {n}(const {precision} **, {precision} **, long long *, {precision} *, int);")
        calls.append(
            f"{{ static const {precision} *a[{f.sz_arg() + 1}]; static {precision} *r[{f.sz_res() + 1}];\n"
            f"static long long iw[{f.sz_iw() + 1}]; static {precision} w[{f.sz_w() + 1}];\n"
            f"if (!a[0]) {{ const {precision} *a1[] = {{ {arguments} }}; {precision} *r1[] = {{ {results} }};\n"
            f"for (int i = 0; i < {f.n_in()}; i++) a[i] = a1[i];\n"
            f"for (int i = 0; i < {f.n_out()}; i++) r[i] = r1[i]; }}\n"
            f"{n}(a, r, iw, w, 0); }}"
        )
    options = ("-fsingle-precision-constant",) if precision == "float" else ()
    return Way(code.dump(), "\n".join(declared), "\n".join(calls), options)


def loops(t: Target, gains: Mapping[str, Any]) -> Way:
    """Plain C with a loop for each product of a matrix and a vector; positions, which are none, as exported."""
    y = ca.SX.sym("y", len(t.controller.measurements))
    positions = named_function("positions", {"y": y}, {"q": t.believed.position_of(y)})
    matrices = {name: np.array(gains[name]) for name in ("Ad", "Bd", "Cd", "L", "K", "Ki")}
    limit = np.array(gains["force_limit"]).reshape(-1, 1)
    matrices["limit"] = np.broadcast_to(limit, (len(t.controller.forces), 1))
    text = [
        own(positions, t.precision).text,
        "typedef own_real real;",
        "static void add(int m, int n, const real *A, const real *x, real *r) {",
        "  for (int i = 0; i < m; i++) { real s = r[i];",
        "    for (int j = 0; j < n; j++) s += A[i * n + j] * x[j];",
        "    r[i] = s; } }",
    ]
    for name, value in matrices.items():
        numbers = ", ".join(c_number(x, t.precision) for x in value.ravel())
        text.append(f"static const real {name}[{value.size}] = {{ {numbers} }};")
    n, m, k = len(t.controller.states), len(t.controller.forces), len(t.controller.measurements)
    text += [
        "void law(const real *xi_pred, const real *e, const real *y, const real *xi_ref, const real *v_ff,",
        "         const real *v0, real *q, real *xi_hat, real *v, real *saturated, real *next) {",
        f"  real r[{k}], c[{k}], d[{n}], u[{m}];",
        "  own_positions(y, q);",
        f"  for (int i = 0; i < {k}; i++) c[i] = 0;",
        f"  add({k}, {n}, Cd, xi_pred, c);",
        f"  for (int i = 0; i < {k}; i++) r[i] = y[i] - c[i];",
        f"  for (int i = 0; i < {n}; i++) xi_hat[i] = xi_pred[i];",
        f"  add({n}, {k}, L, r, xi_hat);",
        f"  for (int i = 0; i < {n}; i++) {{ d[i] = xi_ref[i] - xi_hat[i]; next[i] = 0; }}",
        f"  for (int i = 0; i < {m}; i++) v[i] = v_ff[i] + v0[i];",
        f"  add({m}, {n}, K, d, v);",
        f"  add({m}, {k}, Ki, e, v);",
        f"  for (int i = 0; i < {m}; i++) {{ const real w = v[i];",
        "    v[i] = w > limit[i] ? limit[i] : w < -limit[i] ? -limit[i] : w;",
        "    saturated[i] = v[i] != w; u[i] = v[i] - v0[i]; }",
        f"  add({n}, {n}, Ad, xi_hat, next);",
        f"  add({n}, {m}, Bd, u, next);",
        "}",
    ]
    head = f"void law({', '.join([f'const {t.precision} *'] * 6 + [f'{t.precision} *'] * 5)});"
    names = ("xi_pred", "e", "y", "xi_ref", "v_ff", "v0", "q", "xi_hat", "v", "saturated", "xi_pred_next")
    return Way("\n".join(text), head, f"law({', '.join(f'law_{name}' for name in names)});")


def program_text(w: Way, precision: Precision, given: Mapping[str, Any], sizes: Mapping[str, int]) -> str:
    """A main program: COUNT steps from the same numbers."""
    arrays = [
        f"static {precision} {name}[] = {{ {', '.join(c_number(float(x), precision) for x in value)} }};"
        for name, value in given.items()
    ]
    arrays += [f"static {precision} {name}[{size}];" for name, size in sizes.items()]
    show = (
        f'for (unsigned i = 0; i < sizeof {name} / sizeof {name}[0]; i++) printf("%.17g\\n", (double){name}[i]);'
        for name in sizes
    )
    shown = f"#ifdef SHOWN\n{' '.join(show)}\n#endif\n"
    body = f"int main(void) {{ for (int k = 0; k < COUNT; k++) {{\n{w.call}\n}}\n{shown}return 0; }}\n"
    return "\n".join(["#ifdef SHOWN\n#include <stdio.h>\n#endif", w.declared, *arrays, body])


def build(p: Processor, folder: Path, w: Way, main: str, *options: str) -> Path:
    """The program of a way for a processor."""
    (folder / "way.c").write_text(w.text, encoding="utf-8")
    (folder / "main.c").write_text(main, encoding="utf-8")
    program = folder / "program.elf"
    flags = [*FLAGS, *p.options, *options]
    commands = [
        [f"{p.prefix}gcc", *flags, *w.options, "-c", "way.c"],
        [f"{p.prefix}gcc", *flags, "main.c", "way.o", *LINKED.get(p.name, ()), "-lm", "-o", str(program)],
    ]
    for command in commands:
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return program


def instructions(p: Processor, w: Way, main: str) -> float:
    """Instructions of one step, as they are executed."""
    counts = []
    with tempfile.TemporaryDirectory() as scratch:
        for count in (1, 11):
            program, log = build(p, Path(scratch), w, main, f"-DCOUNT={count}"), Path(scratch) / "log"
            runner, *rest = RUNNERS[p.name]
            watched = [runner, "-singlestep", "-d", "exec,nochain", "-D", str(log), *rest, str(program)]
            subprocess.run(watched, check=True, capture_output=True, stdin=subprocess.DEVNULL)
            with log.open("rb") as lines:
                counts.append(sum(line.startswith(b"Trace") for line in lines))
    return (counts[1] - counts[0]) / 10


def can_count(p: Processor) -> bool:
    """Whether compiler and QEMU are here, and QEMU can go instruction by instruction by this option."""
    runner = RUNNERS[p.name][0]
    if shutil.which(f"{p.prefix}gcc") is None or shutil.which(runner) is None:
        return False
    return "-singlestep" in subprocess.run([runner, "-help"], capture_output=True, text=True).stdout


class Case(NamedTuple):
    """A function, and numbers to compute it with."""

    name: str
    precision: Precision
    ways: dict[str, Way]
    given: dict[str, Any]  # arguments by name
    sizes: dict[str, int]  # of the results

    def main(self, way: str) -> str:
        return program_text(self.ways[way], self.precision, self.given, self.sizes)


def cases(t: Target) -> list[Case]:
    """The law (positions, filter, law), and the whole control period at a stroke's thirtieth sample."""
    law = law_function(t, ca.SX, {name: ca.SX(value) for name, value in gains_of(t.controller).items()})
    rng = np.random.default_rng(6)
    small = {f"law_{law.name_in(k)}": 1e-6 * rng.normal(size=law.size1_in(k)) for k in range(law.n_in())}
    wanted = {f"law_{law.name_out(k)}": law.size1_out(k) for k in range(law.n_out())}
    known = readings(t)
    given: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    for f in (sense(t).plain, decide(t).plain):
        arguments = [f.name_in(k) for k in range(f.n_in())]
        given |= {f"{f.name()}_{name}": known[name] for name in arguments}
        sizes |= {f"{f.name()}_{f.name_out(k)}": f.size1_out(k) for k in range(f.n_out())}
        known |= evaluate(programs_of(t)[f.name()], known, t.precision)
    return [
        Case("law", t.precision, law_ways(t), small, wanted),
        Case("control period", t.precision, period_ways(t), given, sizes),
    ]


def readings(t: Target) -> dict[str, Any]:
    """State, reference, readings and v0 at the thirtieth sample of a stroke."""
    vector = record_vectors(t)[0]
    fields = [*t.reference_fields, *t.input_fields]
    ends = np.cumsum([field.size for field in fields])[:-1]
    rows = [
        dict(zip((field.name for field in fields), np.split(row, ends), strict=True))
        for row in vector.readings
    ]
    state, step = started_state(t, rows[0]), step_function(t)
    for row in rows[:29]:
        state, _ = step(state, row, row)
    none = {field.name: np.zeros(0) for field in t.state_fields if not field.size}
    z = rows[29]["y"][t.believed.stroke_output]
    return {**none, **state, **rows[29], "v0": look_up(t, z)}


def results(w: Way, main: str) -> Any:
    """What a way computes here."""
    with tempfile.TemporaryDirectory() as scratch:
        program = build(HERE, Path(scratch), w, main, "-DCOUNT=1", "-DSHOWN")
        printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    return np.array([float(line) for line in printed.split()])


def agree(case: Case) -> None:
    """All ways compute the same numbers, or the comparison is worth nothing."""
    expected = results(case.ways["malta"], case.main("malta"))
    most = 1e-12 if case.precision == "double" else 1e-3
    for way in case.ways:
        apart = np.abs(results(case.ways[way], case.main(way)) - expected).max() / np.abs(expected).max()
        assert apart < most, f"{case.name}: {way} and malta differ by {apart:.1e}"


def whole_step(t: Target) -> int | None:
    """Instructions of the exported step on the paper's processor, as an export reports them; None without compiler."""
    files = sources(t, "", loops=False)
    cost = cost_on(A9, files, files, c_name(t.controller.name))
    return None if cost is None else cost.instructions


def rows_of(case: Case, runs: int) -> list[Result]:
    """Instructions on both processors, then seconds here."""
    agree(case)
    rows = []
    peers = [way for way in case.ways if way != "malta"]
    title = f"{case.name}, {case.precision}"
    for p in (A9, M4F):
        if not can_count(p):
            print(f"left out: {p.name} (no compiler or no QEMU)", file=sys.stderr)
            continue
        counts = {way: instructions(p, case.ways[way], case.main(way)) for way in case.ways}
        what = f"{title}: {p.name} instructions"
        rows += [Result(what, counts["malta"], way, counts[way], "at least 1", unit="") for way in peers]
    with tempfile.TemporaryDirectory() as scratch:
        calls: dict[str, Callable[[], object]] = {}
        for k, (way, w) in enumerate(case.ways.items()):
            folder = Path(scratch) / str(k)
            folder.mkdir()
            program = build(HERE, folder, w, case.main(way), f"-DCOUNT={STEPS}")
            calls[way] = partial(subprocess.run, [str(program)], check=True)
        seconds = dict(zip(calls, medians(*calls.values(), runs=runs, what=title), strict=True))
    what = f"{title}: here"
    return rows + [Result(what, seconds["malta"] / STEPS, way, seconds[way] / STEPS, "") for way in peers]


def firmware(runs: int) -> list[Result]:
    """The exported law and control period of the tubular machine, beside other ways to write them in C."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    rows = []
    for precision in PRECISIONS:
        t = Target(controller, precision, "phase")
        for case in cases(t):
            rows += rows_of(case, runs)
        count = whole_step(t)
        if count is not None:
            what, clocks = f"whole step, {precision}: {A9.name} instructions", controller.sample_time * CLOCK
            rows.append(Result(what, count, "50 us at 667 MHz, one a clock", clocks, "at least 10", unit=""))
    return rows

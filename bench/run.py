"""Benchmarks: malta beside what a user would pick instead, as ratios of medians from one run.

make bench            python bench/run.py [--runs N]

The peers that are not python-control are written by hand (peers/ and peer_*.py). "C by hand, gcc -O3" has malta's
equations as they stand; the others are reformulated as an expert would for this machine alone: modes apart, small
angles only, no spin. numba and jax take part where they are installed.
"""

from __future__ import annotations

import argparse
import importlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import control
import numpy as np
from peer_control import closed_loop
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

import malta
from malta.machine import state_reference
from malta.plants import tubular
from malta.simulate import compiled_shape, engine_of, feedforward

if TYPE_CHECKING:
    from malta.plant import FloatArray

ROOT = Path(__file__).parents[1]
IMPORTS = "import numpy, scipy, control, casadi"
MACHINES = 10_000


class Result(NamedTuple):
    """A line of the table."""

    workload: str
    ours: float  # s
    peer: str
    theirs: float  # s
    wanted: str


def medians(*calls: Callable[[], object], runs: int, what: str) -> list[float]:
    """Median seconds of each call, taken in turn after one warm-up of each."""
    times: list[list[float]] = [[] for _ in calls]
    for run in track(range(runs + 1), what, console=Console(stderr=True), transient=True):
        for call, seconds in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if run:
                seconds.append(time.perf_counter() - start)
    return [statistics.median(seconds) for seconds in times]


def optional(*names: str) -> dict[str, Any]:
    """Peers whose compiler or library is here."""
    found = {}
    for name in names:
        try:
            found[name] = importlib.import_module(name)
        except ImportError as error:
            print(f"left out: {name} ({error})", file=sys.stderr)
    return found


def whole_process(runs: int) -> list[Result]:
    """`malta design design/table2.toml` against a process that only imports what it needs."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "malta.cli", "design", "design/table2.toml"]
        command += ["--out", scratch, "--figures", scratch]

        def process(arguments: list[str]) -> Callable[[], object]:
            return lambda: subprocess.run(arguments, cwd=ROOT, check=True, capture_output=True)

        ours, bare = medians(
            process(command), process([sys.executable, "-c", IMPORTS]), runs=runs, what="whole process"
        )
    return [Result("design table2, whole process", ours, "its imports alone", bare, "at least 0.67")]


def given(controller: Any, plant: Any, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """p*, xi* and v_ff of the stroke, which the peers are handed."""
    motion = malta.Scenario.stroke().reference(plant)(t)
    rows = zip(motion.p, motion.dp, strict=True)
    xi_ref = np.array([np.array(state_reference(plant)(*row)).ravel() for row in rows])
    return motion.p, xi_ref, feedforward(controller, motion)


def stroke(runs: int) -> list[Result]:
    """0.1 s of the stroke: 2000 control steps of four Runge–Kutta steps, the loops built beforehand on all sides."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "table2.json")
    par = controller.parameters
    assert isinstance(par, tubular.Parameters)
    plant = tubular.plant(par)
    scenario = malta.Scenario.stroke(delay=0, fidelity="force")  # as the peers
    t = np.arange(2000) * controller.sample_time
    p_ref, xi_ref, v_ff = given(controller, plant, t)
    start = malta.simulate(plant, controller, scenario)
    loops = {lean: closed_loop(par, controller, lean=lean) for lean in (False, True)}
    inputs = np.hstack([p_ref, xi_ref, v_ff]).T
    first = np.concatenate([start.x[0], start.force[0], xi_ref[0], np.zeros(10)])

    def documented(lean: bool) -> Any:
        return control.input_output_response(loops[lean], t, inputs, X0=first).outputs.T

    def by_hand(module: Any) -> Any:
        return module.single(par, controller, p_ref, xi_ref, v_ff)[0]

    peers: dict[str, Callable[[], Any]] = {
        "python-control, documented": lambda: documented(False),
        "python-control, plain floats": lambda: documented(True),
    }
    names = {"peer_c": "C by hand, reformulated", "peer_numba": "numba by hand, reformulated"}
    for name, module in optional("peer_c", "peer_numba").items():
        if name == "peer_c":
            peers["C by hand, gcc -O3"] = lambda module=module: module.plain(  # type: ignore[misc]
                par, controller, p_ref, xi_ref, v_ff
            )[0]
        peers[names[name]] = lambda module=module: by_hand(module)  # type: ignore[misc]
    for name, peer in peers.items():  # the same motion, or the comparison is worth nothing
        difference = np.abs(peer() - start.p).max()
        assert difference < 1e-9, f"{name} and malta differ by {difference} m"

    def anew() -> object:
        engine_of.cache_clear()
        compiled_shape.cache_clear()
        return malta.simulate(plant, controller, scenario)

    def fidelity(name: Any) -> Callable[[], object]:
        return lambda: malta.simulate(plant, controller, malta.Scenario.stroke(delay=0, fidelity=name))

    (built,) = medians(anew, runs=runs, what="built anew")
    ours, one, virtual, dq, phase, *theirs = medians(
        lambda: malta.simulate(plant, controller, scenario),
        lambda: malta.simulate(
            plant, controller, malta.Scenario.stroke(delay=0, fidelity="force", substeps=1)
        ),
        lambda: malta.simulate(plant, controller, scenario, engine="virtual machine"),
        fidelity("dq"),
        fidelity("phase"),
        *peers.values(),
        runs=runs,
        what="stroke",
    )
    wanted = ["at least 300", "", "at least 0.5", "", ""]
    rows = [Result("stroke, 0.1 s", ours, *rest) for rest in zip(peers, theirs, wanted, strict=False)]
    slowest = next(iter(peers))
    return [
        *rows,
        Result("the same, one step a sample", one, "four steps a sample", ours, ""),
        Result("the same with building the loop", built, slowest, theirs[0], ""),
        Result("the same without a compiler", virtual, slowest, theirs[0], "at least 30"),
        Result("fidelity dq", dq, "fidelity force", ours, "at least 0.25"),
        Result("fidelity phase", phase, "real time", 0.1, "at least 5"),
    ]


def many(runs: int) -> list[Result]:
    """10 000 different machines, each with its own noise, on all cores."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "calibrated.json")
    par = controller.parameters
    assert isinstance(par, tubular.Parameters)
    plant = tubular.plant(par)
    names = ("m", "K_A", "K_B", "K_D")
    factors = 1 + 0.2 * np.random.default_rng(0).uniform(-1, 1, (MACHINES, len(names)))
    changes = {name: getattr(par, name) * factors[:, k] for k, name in enumerate(names)}
    scenario = malta.Scenario.stroke(delay=0, fidelity="force", noise=1.0)
    inputs = given(controller, plant, np.arange(2000) * controller.sample_time)
    found = malta.simulate_many(plant, controller, scenario, changes)

    def by_hand(module: Any, **options: Any) -> Any:
        return module.many(par, controller, factors, *inputs, noise=1.0, **options)

    asked = {"peer_c": "at least 0.67", "peer_numba": "at least 4"}
    asked |= {"peer_numpy": "at least 10", "peer_jax": "at least 10"}
    told = {"peer_c": "C by hand, SIMD, OpenMP", "peer_numba": "numba prange, lanes by hand"}
    told |= {"peer_numpy": "numpy over machines", "peer_jax": "jax vmap"}
    calls: dict[str, Callable[[], Any]] = {}
    wanted = []
    for name, module in optional(*asked).items():
        calls[told[name]] = lambda module=module: by_hand(module)  # type: ignore[misc]
        wanted.append(asked[name])
        if name in ("peer_c", "peer_numba"):
            calls[told[name] + ", scalar noise"] = lambda module=module: by_hand(module, scalar_noise=True)  # type: ignore[misc]
            wanted.append("")
    for name, call in calls.items():
        median = np.median(
            call()[0] / found.deviation.T if call()[0].shape[0] == 5 else call()[0] / found.deviation
        )
        assert abs(median - 1) < 0.05, f"{name} and malta differ: {median}"
    ours, *theirs = medians(
        lambda: malta.simulate_many(plant, controller, scenario, changes),
        *calls.values(),
        runs=max(2, runs // 3),
        what=f"{MACHINES} machines",
    )
    return [
        Result(f"{MACHINES} machines, own noise", ours, *rest)
        for rest in zip(calls, theirs, wanted, strict=True)
    ]


def main() -> None:
    """Run all and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7, help="counted runs of each")
    runs = parser.parse_args().runs
    table = Table(title=f"medians of {runs} runs in turn, seconds", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("malta", "s", "peer", "s", "peer / malta", "wanted"):
        table.add_column(column, justify="left" if column in ("malta", "peer") else "right")
    for row in whole_process(runs) + stroke(runs) + many(runs):
        ratio = f"{row.theirs / row.ours:.2f}"
        table.add_row(row.workload, f"{row.ours:.4f}", row.peer, f"{row.theirs:.4f}", ratio, row.wanted)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()

"""Benchmarks: malta beside what a user would pick instead, as ratios of medians from one run.

make bench            python bench/run.py [--runs N]
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

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

ROOT = Path(__file__).parents[1]
IMPORTS = "import numpy, scipy, control, casadi"


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


def whole_process(runs: int) -> list[tuple[str, float, str, float, str]]:
    """`malta design design/table2.toml` against a process that only imports what it needs."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "malta.cli", "design", "design/table2.toml"]
        command += ["--out", scratch, "--figures", scratch]

        def process(arguments: list[str]) -> Callable[[], object]:
            return lambda: subprocess.run(arguments, cwd=ROOT, check=True, capture_output=True)

        ours, bare = medians(
            process(command), process([sys.executable, "-c", IMPORTS]), runs=runs, what="whole process"
        )
    return [("design table2, whole process", ours, "its imports alone", bare, "at least 0.67")]


def stroke(runs: int) -> list[tuple[str, float, str, float, str]]:
    """0.1 s of the stroke: 2000 control steps of four Runge–Kutta steps, the loops built beforehand on both sides."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "table2.json")
    par = controller.parameters
    assert isinstance(par, tubular.Parameters)
    plant = tubular.plant(par)
    scenario = malta.Scenario.stroke(delay=0, fidelity="force")  # as the peer
    t = np.arange(2000) * controller.sample_time
    motion = scenario.reference(plant)(t)
    v_ff = feedforward(controller, motion)
    xi_ref = np.array(
        [np.array(state_reference(plant, *row)).ravel() for row in zip(*motion[:2], strict=True)]
    )
    start = malta.simulate(plant, controller, scenario)
    peers = {lean: closed_loop(par, controller, lean=lean) for lean in (False, True)}
    inputs = np.hstack([motion.p, xi_ref, v_ff]).T
    first = np.concatenate([start.x[0], start.force[0], xi_ref[0], np.zeros(10)])

    def peer(lean: bool) -> Callable[[], object]:
        return lambda: control.input_output_response(peers[lean], t, inputs, X0=first)

    for lean in peers:  # the same motion, or the comparison is worth nothing
        response = control.input_output_response(peers[lean], t, inputs, X0=first)
        difference = np.abs(response.outputs.T - start.p).max()
        assert difference < 1e-9, f"peer and malta differ by {difference} m"

    def anew() -> object:
        engine_of.cache_clear()
        compiled_shape.cache_clear()
        return malta.simulate(plant, controller, scenario)

    def virtual() -> object:
        return malta.simulate(plant, controller, scenario, engine="virtual machine")

    ours, machine, built, documented, floats = medians(
        lambda: malta.simulate(plant, controller, scenario),
        virtual,
        anew,
        peer(False),
        peer(True),
        runs=runs,
        what="stroke",
    )
    return [
        ("stroke, 0.1 s", ours, "python-control, documented", documented, "at least 300"),
        ("stroke, without a compiler", machine, "python-control, documented", documented, "at least 30"),
        ("stroke, 0.1 s", ours, "python-control, plain floats", floats, ""),
        ("the same with building the loop", built, "python-control, documented", documented, ""),
    ]


def main() -> None:
    """Run all and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7, help="counted runs of each")
    runs = parser.parse_args().runs
    table = Table(title=f"medians of {runs} runs in turn, seconds", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("malta", "s", "peer", "s", "peer / malta", "wanted"):
        table.add_column(column, justify="left" if column in ("malta", "peer") else "right")
    for name, ours, peer, theirs, wanted in whole_process(runs) + stroke(runs):
        table.add_row(name, f"{ours:.4f}", peer, f"{theirs:.4f}", f"{theirs / ours:.2f}", wanted)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()

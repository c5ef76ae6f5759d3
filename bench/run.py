"""Benchmarks: malta beside what a user would pick instead, as ratios of medians from one run.

make bench            python bench/run.py [--runs N] [--only stroke many ...] [--page docs/benchmarks.md]

The peers that are not python-control are written by hand (peers/ and peer_*.py). Some have malta's equations as they
stand; those called reformulated are what an expert makes of them for this machine alone: modes apart, small angles
only, no spin, sums of forces in place of forces, noise in single precision. numba and jax take part where they are
installed.
"""

from __future__ import annotations

import argparse
import importlib
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import control
import numpy as np
from firmware import firmware
from identification import identification, spectra
from live import live_page
from margins import margin, published
from page import update_page
from peer_control import closed_loop, documented_run
from peer_problem import Workload
from rich import box
from rich.console import Console
from rich.table import Table
from structured import structured
from timing import Result, medians, optional
from waveforms import waveform

import malta
from malta.machines.halbach.experiments import steps_reference
from malta.machines.planar import commutation, field, plant as planar
from malta.machines.planar.motions import CELLS
from malta.machines.tubular import plant as tubular
from malta.model.printed import published_value
from malta.simulation.engine.engines import engine_of, library_of
from malta.simulation.inputs import feedforward
from malta.simulation.period import state_reference
from malta_papers.planar.experiments import compile_function

ROOT = Path(__file__).parents[1]
IMPORTS = "import numpy, scipy, control, casadi, filterpy.kalman"
MACHINES = 10_000
MANY = 100_000  # machines of a campaign in flat memory, which is timed once
SCENARIO = malta.Scenario.stroke(delay=0, fidelity="force", substeps=4)  # as many steps as the peers take
CHOSEN = replace(SCENARIO, substeps=None)  # as malta chooses for an error below 1e-9 m


def whole_process(runs: int) -> list[Result]:
    """`malta design design/table2.toml` against a process that only imports what it needs."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "malta", "design", "design/table2.toml"]
        command += ["--out", scratch, "--figures", scratch]

        def process(arguments: list[str]) -> Callable[[], object]:
            return lambda: subprocess.run(arguments, cwd=ROOT, check=True, capture_output=True)

        ours, bare = medians(
            process(command), process([sys.executable, "-c", IMPORTS]), runs=runs, what="whole process"
        )
    return [Result("design table2, whole process", ours, "its imports alone", bare, "at least 0.67")]


def workload(name: str) -> tuple[malta.model.Plant, Workload]:
    """0.1 s of the stroke with a design's gains: 2000 samples of four Runge–Kutta steps, forces as first-order lags."""
    controller = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    par = controller.parameters
    assert isinstance(par, tubular.Parameters)
    plant = tubular.plant(par)
    motion = SCENARIO.reference(plant)(np.arange(2000) * controller.sample_time)
    rows = zip(motion.p, motion.dp, strict=True)
    xi_ref = np.array([np.array(state_reference(plant)(*row)).ravel() for row in rows])
    return plant, Workload(par, controller, motion.p, xi_ref, feedforward(controller, motion))


def stroke(runs: int) -> list[Result]:
    """0.1 s of the stroke: 2000 control steps of four Runge–Kutta steps, the loops built beforehand on all sides.

    The references too: peers are given theirs, and malta remembers those of a scenario that can only repeat.
    """
    plant, work = workload("table2")
    controller, scenario = work.controller, SCENARIO
    start = malta.simulate(plant, controller, scenario)
    loops = {lean: closed_loop(work.par, controller, lean=lean) for lean in (False, True)}
    inputs = np.hstack([work.p_ref, work.xi_ref, work.v_ff]).T
    first = np.concatenate([start.x[0], start.force[0], work.xi_ref[0], np.zeros(10)])

    def documented(lean: bool) -> Any:
        t = np.arange(2000) * controller.sample_time
        return control.input_output_response(loops[lean], t, inputs, X0=first).outputs.T

    peers: dict[str, Callable[[], Any]] = {
        "python-control, documented": lambda: documented(False),
        "python-control, plain floats": lambda: documented(True),
    }
    found = optional("peer_c", "peer_numba")
    if "peer_c" in found:
        peers["C, the same equations"] = lambda: found["peer_c"].plain(work)[0]
        peers["C, reformulated"] = lambda: found["peer_c"].single(work)[0]
    if "peer_numba" in found:
        peers["numba, reformulated"] = lambda: found["peer_numba"].single(work)[0]
    for name, peer in peers.items():  # the same motion, or the comparison is worth nothing
        difference = np.abs(peer() - start.p).max()
        assert difference < 1e-9, f"{name} and malta differ by {difference} m"

    def anew() -> object:
        engine_of.cache_clear()
        library_of.cache_clear()
        return malta.simulate(plant, controller, scenario)

    def fidelity(name: Any) -> Callable[[], object]:
        flown = replace(CHOSEN, fidelity=name)  # built here: only its flight is timed
        return lambda: malta.simulate(plant, controller, flown)

    (built,) = medians(anew, runs=runs, what="built anew")
    ours, one, virtual, dq, phase, *theirs = medians(
        lambda: malta.simulate(plant, controller, scenario),
        lambda: malta.simulate(plant, controller, CHOSEN),
        lambda: malta.simulate(plant, controller, scenario, engine="virtual machine"),
        fidelity("dq"),
        fidelity("phase"),
        *peers.values(),
        runs=runs,
        what="stroke",
    )
    wanted = ["at least 300", "", "at least 0.5", "at least 0.9", ""]
    rows = [Result("stroke, 0.1 s", ours, *rest) for rest in zip(peers, theirs, wanted, strict=False)]
    slowest = next(iter(peers))
    return [
        *rows,
        Result("the same, steps as malta chooses", one, "four steps a sample", ours, ""),
        Result("the same with building the loop", built, slowest, theirs[0], ""),
        Result("the same without a compiler", virtual, slowest, theirs[0], "at least 30"),
        Result("fidelity dq, chosen steps", dq, "fidelity force, chosen steps", one, "at least 0.25"),
        Result("fidelity phase, chosen steps", phase, "real time", 0.1, "at least 5"),
    ]


class Peer(NamedTuple):
    """How many machines are run elsewhere."""

    name: str
    module: str
    function: str
    wanted: str
    options: dict[str, Any] = {}  # noqa: RUF012
    same_noise: bool = False


PEERS = (
    Peer(
        "C, SIMD, OpenMP, same equations and noise", "peer_c", "plain_many", "at least 0.67", same_noise=True
    ),
    Peer("numba prange, same equations", "peer_numba_plain", "many", "at least 4"),
    Peer("jax vmap, same equations", "peer_jax_plain", "many", "at least 10"),
    Peer("numpy over machines, reformulated", "peer_numpy", "many", "at least 10"),
    Peer("C, SIMD, OpenMP, reformulated", "peer_c", "many", "at least 0.9"),
    Peer("the same, scalar noise", "peer_c", "many", "", {"scalar_noise": True}),
    Peer("numba prange, reformulated, lanes by hand", "peer_numba", "many", ""),
    Peer("the same, np.random", "peer_numba", "many", "", {"scalar_noise": True}),
    Peer("jax vmap, reformulated", "peer_jax", "many", ""),
)


def many(runs: int) -> list[Result]:
    """10 000 different machines, each with its own noise, on all cores."""
    plant, nominal = workload("calibrated")
    names = ("m", "K_A", "K_B", "K_D")
    factors = 1 + 0.2 * np.random.default_rng(0).uniform(-1, 1, (MACHINES, len(names)))
    work = nominal._replace(factors=factors, noise=1.0)
    changes = {name: getattr(work.par, name) * factors[:, k] for k, name in enumerate(names)}
    scenario = replace(SCENARIO, noise=1.0)
    found = malta.simulation.simulate_many(plant, work.controller, scenario, changes)
    modules = optional(*dict.fromkeys(peer.module for peer in PEERS))
    peers = [peer for peer in PEERS if peer.module in modules]

    def calling(peer: Peer) -> Callable[[], Any]:
        return lambda: getattr(modules[peer.module], peer.function)(work, **peer.options)

    calls = [calling(peer) for peer in peers]
    for peer, call in zip(peers, calls, strict=True):
        ratio = call()[0] / found.deviation
        if peer.same_noise:  # the same trajectories
            assert np.abs(ratio - 1).max() < 1e-9, f"{peer.name} and malta differ: {np.abs(ratio - 1).max()}"
        assert abs(np.median(ratio) - 1) < 0.01, f"{peer.name} and malta differ: {np.median(ratio)}"
    chosen = replace(scenario, substeps=None)
    ours, default, *theirs = medians(
        lambda: malta.simulation.simulate_many(plant, work.controller, scenario, changes),
        lambda: malta.simulation.simulate_many(plant, work.controller, chosen, changes),
        *calls,
        runs=runs,
        what=f"{MACHINES} machines",
    )
    return [
        Result("the same, steps as malta chooses", default, "four steps a sample", ours, ""),
        *(
            Result(f"{MACHINES} machines, own noise", ours, peer.name, seconds, peer.wanted)
            for peer, seconds in zip(peers, theirs, strict=True)
        ),
    ]


def campaigns(runs: int) -> list[Result]:
    """Strokes of different machines: campaigns, with their files, beside loops over what a user would pick.

    Times are for one machine, of as many as each takes in about a second. A million takes ten times MANY: blocks are
    alike, and memory does not grow.
    """
    plant, work = workload("calibrated")
    names = ("m", "K_A", "K_B", "K_D")
    plan = malta.campaigns.Plan(
        work.controller, "stroke", dict.fromkeys(names, 0.2), samples=4096, options={"fidelity": "force"}
    )

    def flown() -> object:
        with tempfile.TemporaryDirectory() as folder:
            return malta.campaign(plan, folder)

    def summarized() -> object:
        with tempfile.TemporaryDirectory() as folder:
            return malta.campaigns.summarize(replace(plan, samples=MANY), folder)

    peers: dict[str, tuple[int, Callable[[], object]]] = {}
    loop = joblib_loop(plant, work, names)
    if loop is not None:
        peers[LOOP] = LOOPED, loop
    found = optional("peer_numba_plain")
    if found:
        some = 1 + 0.2 * np.random.default_rng(0).uniform(-1, 1, (512, len(names)))
        many_work = work._replace(factors=some, noise=1.0)
        peers["numba prange, same equations"] = 512, lambda: found["peer_numba_plain"].many(many_work)
    ours, *theirs = medians(flown, *(call for _, call in peers.values()), runs=runs, what="campaign")
    started = time.perf_counter()
    summarized()
    large = time.perf_counter() - started
    measured = {
        f"campaign of {plan.samples}, seconds a machine": ours / plan.samples,
        f"campaign of {MANY}, once, seconds a machine": large / MANY,
    }
    return [
        Result(what, own, name, seconds / count, "")
        for what, own in measured.items()
        for (name, (count, _)), seconds in zip(peers.items(), theirs, strict=True)
    ]


def joblib_loop(
    plant: malta.model.Plant, work: Workload, names: Sequence[str]
) -> Callable[[], object] | None:
    """LOOPED different machines in python-control, on all cores; None without joblib."""
    if not optional("joblib"):
        return None
    joblib = importlib.import_module("joblib")
    factors = 1 + 0.2 * np.random.default_rng(0).uniform(-1, 1, (LOOPED, len(names)))
    start = malta.simulate(plant, work.controller, SCENARIO)
    inputs = np.hstack([work.p_ref, work.xi_ref, work.v_ff]).T
    first = np.concatenate([start.x[0], start.force[0], work.xi_ref[0], np.zeros(10)])
    pars = [
        replace(work.par, **{n: getattr(work.par, n) * f for n, f in zip(names, row.tolist(), strict=True)})
        for row in factors
    ]
    jobs = [joblib.delayed(documented_run)(par, work.controller, inputs, first) for par in pars]
    return lambda: joblib.Parallel(n_jobs=-1)(jobs)


LOOP, LOOPED = "python-control in a joblib loop", 4


def studies(runs: int) -> list[Result]:
    """A rare touchdown beside plain sampling, Sobol indices beside SALib around loops; loops from LOOPED of their runs.

    Plain sampling has as many runs as its coefficient of variation needs to be that of the subset simulation.
    """
    plant, work = workload("table2")
    names, options = ("m", "K_A", "K_B", "K_D"), {"fidelity": "force", "delay": 0}
    loop = joblib_loop(plant, work, names)
    single = [] if loop is None else medians(loop, runs=runs, what="python-control")
    rows: list[Result] = []
    for spread in (0.06, 0.055):
        plan = malta.campaigns.Plan(
            work.controller, "stroke", dict.fromkeys(names, spread), samples=2000, options=options
        )
        limit = malta.campaigns.limit_of(plan, "touchdown")
        found = malta.campaigns.rare_event(plan, limit).found
        ours, plain = medians(
            partial(malta.campaigns.rare_event, plan, limit),
            partial(malta.campaign, replace(plan, samples=4096)),
            runs=runs,
            what="rare event",
        )
        what = f"rare, {found.probability:.0e} ± {100 * found.cov:.0f} %"
        rows.append(Result(what, ours, "plain sampling, malta", plain / 4096 * found.plain, ""))
        rows += [Result(what, ours, LOOP, seconds / LOOPED * found.plain, "") for seconds in single]
    if optional("SALib"):
        plan = malta.campaigns.Plan(
            work.controller, "stroke", dict.fromkeys(names, 0.05), samples=4096, options=options
        )
        count = malta.campaigns.sensitivity(plan, limit).runs
        ours, alone = medians(
            partial(malta.campaigns.sensitivity, plan, limit),
            partial(malta.simulate, plant, work.controller, SCENARIO),
            runs=runs,
            what="Sobol indices",
        )
        what = f"Sobol indices, {count} runs"
        rows.append(Result(what, ours, "SALib, a loop over malta.simulate", alone * count, ""))
        rows += [Result(what, ours, f"SALib, {LOOP}", seconds / LOOPED * count, "") for seconds in single]
    return rows


def decoupling(runs: int) -> list[Result]:
    """K(p) of the planar motor and its pseudo-inverse: CasADi's C code compiled by malta, beside numpy."""
    peer = importlib.import_module("peer_planar")
    par = malta.read(ROOT / "data" / "planar.toml")
    assert isinstance(par, planar.Parameters)
    exact = field.simulation_model(par)
    models: dict[str, field.CoilModel] = {
        "table": field.table(par, exact, CELLS),
        "exact": exact,
        "analytical": field.Analytical(par),
    }
    arms, calls, few = peer.coils(par), 2000, 50
    codes = {name: compile_function(commutation.decoupling(par, model)) for name, model in models.items()}
    p, W = np.array([6e-3, 4e-3, par.h]), np.array([10.0, 200, 400, 1, 2, 3])

    def by_hand() -> Any:
        return [peer.currents(par, models["table"], arms, p, W) for _ in range(few)][-1]

    def by_malta() -> Any:
        return [
            commutation.currents(commutation.wrench_matrix(par, models["table"], p), W) for _ in range(few)
        ][-1]

    def calling(code: Any) -> Callable[[], Any]:
        return lambda: code(calls, p, W)[1]

    ours = {name: calling(code) for name, code in codes.items() if code is not None}
    if not ours:
        print("left out: planar (no C compiler)", file=sys.stderr)
        return []
    difference = np.abs(ours["table"]() - by_hand()).max()
    assert difference < 1e-9, f"numpy and malta differ by {difference} A"
    own, plain, *compiled_times = medians(by_malta, by_hand, *ours.values(), runs=runs, what="planar")
    own, plain = own / few, plain / few
    seconds = dict(zip(ours, (taken / calls for taken in compiled_times), strict=True))
    printed = malta.model.read_published(ROOT / "data" / "planar.toml")
    loop = published_value(printed, "real_time.mean")
    numpy_loop = "numpy, a loop and pinv"
    return [
        Result("K(p), pinv: table, compiled", seconds["table"], numpy_loop, plain, "at least 20"),
        Result("the same", seconds["table"], "5 us", 5e-6, "at least 1"),
        Result("the same", seconds["table"], "the paper's whole loop", loop, ""),
        Result("exact series, compiled", seconds["exact"], numpy_loop, plain, "at least 20"),
        Result("analytical, compiled", seconds["analytical"], numpy_loop, plain, "at least 20"),
        Result("table, malta's numpy", own, numpy_loop, plain, "at least 1"),
    ]


def halbach(runs: int) -> list[Result]:
    """20 s of the Halbach motor going there and back, every source of error on: 290 000 PWM periods, 364 readings."""
    peer = importlib.import_module("peer_halbach")
    controller = malta.gains.read(ROOT / "design" / "gains" / "halbach.json")
    plant = malta.plant_of(controller.parameters)
    reference = partial(steps_reference, distance=100e-6, rise=0.0, count=8, Ts=controller.sample_time)
    scenario = malta.Scenario("steps", 20.0, reference, fidelity="phase", noise=1.0, quantize=True)
    found = malta.simulate(plant, controller, scenario)
    given = peer.given(plant, controller, scenario)
    rows = peer.run(controller, *given)
    difference = np.abs(np.array([row.x for row in rows]) - found.p[:, 0]).max()
    assert difference < 1e-9, f"plain Python and malta differ by {difference} m"
    ours, theirs = medians(
        lambda: malta.simulate(plant, controller, scenario),
        lambda: peer.run(controller, *given),
        runs=runs,
        what="Halbach motor",
    )
    return [
        Result(
            "Halbach motor, 20 s, all errors", ours, "plain Python, same arithmetic", theirs, "at least 100"
        ),
        Result("the same", ours, "real time", 20.0, "at least 100"),
    ]


WORKLOADS: dict[str, Callable[[int], list[Result]]] = {
    "process": whole_process,
    "stroke": stroke,
    "many": many,
    "margin": margin,
    "waveform": waveform,
    "published": published,
    "campaign": campaigns,
    "studies": studies,
    "planar": decoupling,
    "halbach": halbach,
    "firmware": firmware,
    "live": live_page,
    "structured": structured,
    "identification": identification,
    "spectra": spectra,
}


def main() -> None:
    """Run the workloads, a table each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7, help="counted runs of each")
    parser.add_argument(
        "--only", choices=WORKLOADS, nargs="+", default=[*WORKLOADS], help="some of the workloads"
    )
    parser.add_argument("--page", type=Path, help="a page whose sections of these workloads are replaced")
    arguments = parser.parse_args()
    for name in arguments.only:
        found = WORKLOADS[name](arguments.runs)
        table = Table(
            title=f"{name}: medians of {arguments.runs} runs in turn, seconds where nothing else is named",
            title_justify="left",
            box=box.SIMPLE_HEAD,
        )
        for column in ("malta", "s", "peer", "s", "peer / malta", "wanted"):
            table.add_column(column, justify="left" if column in ("malta", "peer") else "right")
        for row in found:
            theirs, ratio = f"{row.theirs:.4g}", f"{row.theirs / row.ours:.2f}"
            if math.isnan(row.theirs):
                theirs = ratio = "–"
            table.add_row(row.workload, f"{row.ours:.4g}", row.peer, theirs, ratio, row.wanted)
        Console(width=100).print(table)
        if arguments.page is not None:
            description = (WORKLOADS[name].__doc__ or "").strip().partition("\n\n")[0]
            update_page(
                arguments.page, {name: (" ".join(description.split()), found)}, WORKLOADS, arguments.runs
            )


if __name__ == "__main__":
    main()

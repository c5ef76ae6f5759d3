"""Whether the 95 % intervals of `malta identify` hold the truth: random machines, excited, logged and identified.

    python bench/coverage.py --machines 200
    python bench/coverage.py --machines 50 --added 0.1
    python bench/coverage.py --machines 50 --gains planar

Each machine has K_A, K_B, K_D and I_xx at random within 10 % of the gain file's and F_c within 20 %, noise and steps of
all sensors, and the default excitation of 10 s. No parameter is named. Of the planar motor field, inertias, coil pitch
and centre of gravity are random, each by itself, and named. With --added its mass is at random within 10 %
too, and found from a second log with so many kg on it. Some 5 s of a processor for each machine, 9 with --in-time or
--added.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

import malta

if TYPE_CHECKING:
    from malta.identification import ExcitationPlan
    from malta.synthesis.controller import Controller

SPREAD = {
    "robust": {"K_A": 0.1, "K_B": 0.1, "K_D": 0.1, "I_xx": 0.1, "F_c": 0.2},
    "planar": {"B_r": 0.1, "I_x": 0.1, "I_y": 0.1, "I_z": 0.1, "coil_pitch": 0.005, "r_z": 0.2},
}
ALIKE = {"robust": {"I_yy": "I_xx"}, "planar": {}}
NAMED = {"robust": (), "planar": tuple(SPREAD["planar"])}


class Bench(NamedTuple):
    """What flies."""

    name: str  # of the gain file
    controller: Controller
    plan: ExcitationPlan


def bench_of(name: str) -> Bench:
    """The default excitation of a gain file's machine."""
    controller = malta.gains.read(f"design/gains/{name}.json")
    return Bench(
        name, controller, malta.excite(malta.loop(malta.plant_of(controller.parameters), controller))
    )


def main() -> None:
    """Fly and identify the machines, and print in how many of them each interval holds the truth."""
    parser = argparse.ArgumentParser(description="Coverage of intervals of malta identify.")
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--in-time", action="store_true", help="prediction errors in time too")
    parser.add_argument("--added", type=float, default=0.0, help="kg on the machine in a second log")
    parser.add_argument("--gains", choices=list(SPREAD), default="robust")
    asked = parser.parse_args()
    bench = bench_of(asked.gains)
    own: Any = bench.controller.parameters
    random = np.random.default_rng(asked.seed)
    held: dict[str, list[bool]] = {}
    late: dict[str, list[bool]] = {}
    half: dict[str, list[float]] = {}
    chi2, refused = [], []
    for k in range(asked.machines):
        spread = SPREAD[asked.gains] | ({"m": 0.1} if asked.added else {})
        true = {n: getattr(own, n) * random.uniform(1 - s, 1 + s) for n, s in spread.items()}
        found = identified(bench, true, asked, k)
        chi2.append(found.chi2)
        if found.refusal:
            refused.append(found.refusal)
        for j, name in enumerate(found.names):
            truth = true.get(name, getattr(own, name))
            held.setdefault(name, []).append(bool(abs(found.values[j] - truth) < found.half_widths[j]))
            half.setdefault(name, []).append(found.half_widths[j] / truth)
            if found.in_time is not None:
                wide = 1.96 * np.sqrt(found.in_time.covariance[j, j])
                late.setdefault(name, []).append(bool(abs(found.in_time.values[j] - truth) < wide))
        misses = " ".join(f"{name} {len(inside) - sum(inside)}" for name, inside in held.items())
        print(f"{k + 1} machines, {len(refused)} refused, not held: {misses}", flush=True)
    for where, counts in (("at the lines", held), ("in time", late)):
        for name, inside in counts.items():
            ends = binomtest(sum(inside), len(inside)).proportion_ci(0.95, "wilson")
            share = f"{sum(inside)} of {len(inside)}, {100 * ends.low:.1f} .. {100 * ends.high:.1f} %"
            print(f"{where}: {name} held in {share}; median half width {100 * np.median(half[name]):.2g} %")
    print(f"chi2 / dof: median {np.median(chi2):.3f}, largest {max(chi2):.3f}; refused {len(refused)}")
    for text in refused:
        print("  ", text)


def identified(
    bench: Bench, true: dict[str, float], asked: argparse.Namespace, k: int
) -> malta.identification.Identified:
    """What the logs of a machine tell: one log, or two with `added` kg on it in the second."""
    added, seed, named = asked.added, asked.seed, NAMED[bench.name]
    log = flown(bench, true, seed, 2 * k if added else k)
    if not added:
        return malta.identify(bench.controller, log, parameters=named, in_time=asked.in_time)
    loaded = flown(bench, {**true, "m": true["m"] + added}, seed, 2 * k + 1)
    return malta.identification.weigh(bench.controller, log, loaded, {"m": added})


def flown(bench: Bench, true: dict[str, float], seed: int, run: int) -> malta.identification.Log:
    """The log of a machine under the default excitation."""
    par: Any = bench.controller.parameters
    alike = {name: true[twin] for name, twin in ALIKE[bench.name].items()}
    plant = malta.plant_of(replace(par, **true, **alike))
    scenario = malta.Scenario.excited(bench.plan.signal, bench.plan.duration, seed=seed, run=run)
    if plant.actuator.windings is None:
        scenario = scenario.replace(fidelity="force")
    return malta.identification.log_of(malta.simulate(plant, bench.controller, scenario))


if __name__ == "__main__":
    main()

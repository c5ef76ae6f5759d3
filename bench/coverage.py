"""Whether the 95 % intervals of `malta identify` hold the truth: random machines, excited, logged and identified.

    python bench/coverage.py --machines 200
    python bench/coverage.py --machines 50 --added 0.1

Each machine has K_A, K_B, K_D and I_xx at random within 10 % of the gain file's and F_c within 20 %, noise and steps of
all sensors, and the default excitation of 10 s. No parameter is named. With --added its mass is at random within 10 %
too, and found from a second log with so many kg on it. Some 5 s of a processor for each machine, 9 with --in-time or
--added.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import binomtest

import malta

SPREAD = {"K_A": 0.1, "K_B": 0.1, "K_D": 0.1, "I_xx": 0.1, "F_c": 0.2}
CONTROLLER = malta.gains.read("design/gains/robust.json")
PLAN = malta.excite(malta.loop(malta.plant_of(CONTROLLER.parameters), CONTROLLER))


def main() -> None:
    """Fly and identify the machines, and print in how many of them each interval holds the truth."""
    parser = argparse.ArgumentParser(description="Coverage of intervals of malta identify.")
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--in-time", action="store_true", help="prediction errors in time too")
    parser.add_argument("--added", type=float, default=0.0, help="kg on the machine in a second log")
    asked = parser.parse_args()
    random = np.random.default_rng(asked.seed)
    held: dict[str, list[bool]] = {}
    late: dict[str, list[bool]] = {}
    half: dict[str, list[float]] = {}
    chi2, refused = [], []
    for k in range(asked.machines):
        spread = SPREAD | ({"m": 0.1} if asked.added else {})
        true = {
            n: getattr(CONTROLLER.parameters, n) * random.uniform(1 - s, 1 + s) for n, s in spread.items()
        }
        found = identified(true, asked, k)
        chi2.append(found.chi2)
        if found.refusal:
            refused.append(found.refusal)
        for j, name in enumerate(found.names):
            truth = true.get(name, getattr(CONTROLLER.parameters, name))
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


def identified(true: dict[str, float], asked: argparse.Namespace, k: int) -> malta.identification.Identified:
    """What the logs of a machine tell: one log, or two with `added` kg on it in the second."""
    added, seed = asked.added, asked.seed
    log = flown(true, seed, 2 * k if added else k)
    if not added:
        return malta.identify(CONTROLLER, log, in_time=asked.in_time)
    loaded = flown({**true, "m": true["m"] + added}, seed, 2 * k + 1)
    return malta.identification.weigh(CONTROLLER, log, loaded, {"m": added})


def flown(true: dict[str, float], seed: int, run: int) -> malta.identification.Log:
    """The log of a machine under the default excitation."""
    par: Any = CONTROLLER.parameters
    plant = malta.plant_of(replace(par, **true, I_yy=true["I_xx"]))
    scenario = malta.Scenario.excited(PLAN.signal, PLAN.duration, seed=seed, run=run)
    return malta.identification.log_of(malta.simulate(plant, CONTROLLER, scenario))


if __name__ == "__main__":
    main()

"""Whether the 95 % intervals of `malta identify` hold the truth: random machines, excited, logged and identified.

    python bench/coverage.py --machines 200

Each machine has K_A, K_B, K_D and I_xx at random within 10 % of the gain file's and F_c within 20 %, noise and steps of
all sensors, and the default excitation of 10 s. No parameter is named. Some 9 s of a processor for each machine.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import binomtest

import malta

SPREAD = {"K_A": 0.1, "K_B": 0.1, "K_D": 0.1, "I_xx": 0.1, "F_c": 0.2}
GAINS = "design/gains/robust.json"


def main() -> None:
    """Fly and identify the machines, and print in how many of them each interval holds the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    asked = parser.parse_args()
    controller = malta.gains.read(GAINS)
    par: Any = controller.parameters
    plan = malta.excite(malta.loop(malta.plant_of(par), controller))
    random = np.random.default_rng(asked.seed)
    held: dict[str, list[bool]] = {}
    late: dict[str, list[bool]] = {}
    chi2, refused = [], []
    for k in range(asked.machines):
        true = {n: getattr(par, n) * random.uniform(1 - s, 1 + s) for n, s in SPREAD.items()}
        plant = malta.plant_of(replace(par, **true, I_yy=true["I_xx"]))
        scenario = malta.Scenario.excited(plan.signal, plan.duration, seed=asked.seed, run=k)
        log = malta.identification.log_of(malta.simulate(plant, controller, scenario))
        found = malta.identify(controller, log)
        chi2.append(found.chi2)
        if found.refusal:
            refused.append(found.refusal)
        for j, name in enumerate(found.names):
            truth = true.get(name, getattr(par, name))
            held.setdefault(name, []).append(bool(abs(found.values[j] - truth) < found.half_widths[j]))
            if found.in_time is not None:
                half = 1.96 * np.sqrt(found.in_time.covariance[j, j])
                late.setdefault(name, []).append(bool(abs(found.in_time.values[j] - truth) < half))
        print(f"{k + 1} machines, {len(refused)} refused", flush=True)
    for where, counts in (("at the lines", held), ("in time", late)):
        for name, inside in counts.items():
            ends = binomtest(sum(inside), len(inside)).proportion_ci(0.95, "wilson")
            share = f"{sum(inside)} of {len(inside)}, {100 * ends.low:.1f} .. {100 * ends.high:.1f} %"
            print(f"{where}: {name} held in {share}")
    print(f"chi2 / dof: median {np.median(chi2):.3f}, largest {max(chi2):.3f}; refused {len(refused)}")
    for text in refused:
        print("  ", text)


if __name__ == "__main__":
    main()

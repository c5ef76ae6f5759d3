"""The worst waveform of a load beside the same impulse response in plain numpy, one sample after the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from timing import Result, medians

import malta
from malta.loops.loop import Loop

ROOT = Path(__file__).parents[1]
SAMPLES = 12_000  # 0.6 s of the flagship


def plain_norm(loop: Loop) -> float:
    """The sum of |C M^k B_w| over samples, as a user writes it: the load held for each of them."""
    s, k = loop.sampled, len(loop.sampled.control.A)
    assert s.pushed is not None
    M, x = s.closed, np.append(s.pushed[:, 0], np.zeros(k))
    c, total = np.append(s.outputs[0], np.zeros(k)), 0.0
    for _ in range(SAMPLES):
        total += abs(float(c @ x))
        x = M @ x
    return total


def waveform(runs: int) -> list[Result]:
    """Any load of 1 N on the flagship: nominal, and proven over the box of `structured`."""
    loops = []
    for name in ("robust", "structured"):
        controller = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
        loops.append(malta.loop(malta.plant_of(controller.parameters), controller))
    box = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)
    found = malta.worst_waveform(loops[1], "F_x", "x1", 1.0, box)
    seconds, plain, proof = medians(
        lambda: malta.worst_waveform(loops[0], "F_x", "x1"),
        lambda: plain_norm(loops[0]),
        lambda: malta.worst_waveform(loops[1], "F_x", "x1", 1.0, box),
        runs=runs,
        what="waveform",
    )
    norm = 1e6 * plain_norm(loops[0])
    reached = 0.0 if found.over is None else 1e6 * found.over.lower
    return [
        Result("any load of 1 N, nominal", seconds, f"plain numpy, held load: {norm:.2f} um", plain, ""),
        Result(
            f"proven over ±20 % of four: {reached:.2f} .. {found.proven.text(factor=1e6)} um",
            proof,
            "nominal",
            seconds,
            "",
        ),
    ]

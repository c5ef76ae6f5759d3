"""Least H-infinity norms of static output feedback on public plants of COMPleib."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from conftest import ROOT

from malta import structured

FILE = Path(__file__).parent / "compleib.toml"
PLANTS: dict[str, Any] = tomllib.loads(FILE.read_text(encoding="utf-8"))
HALVED = ("AC2", "AC7", "HE1")  # C1 and D12 are over the root of 2
QUICK = ("AC7",)


def matrix(plant: dict[str, Any], key: str, name: str) -> np.ndarray:
    given = plant[key]
    if not isinstance(given[0], list):  # the shape of zeros
        return np.zeros(given)
    return np.array(given, dtype=float) / (np.sqrt(2) if key in ("C1", "D12") and name in HALVED else 1.0)


def static_law(name: str, starts: int) -> tuple[float, np.ndarray]:
    """The least gain found, and K of u = K y. A search goes on from where it ended, on the scale that K has there."""
    A, B1, B, C1, C, D11, D12, D21 = (
        matrix(PLANTS[name], key, name) for key in ("A", "B1", "B", "C1", "C", "D11", "D12", "D21")
    )
    (z, w), (y, _), m = D11.shape, C.shape, B.shape[1]
    labels = {k: [f"{k}{i}" for i in range(n)] for k, n in (("w", w), ("u", m), ("z", z), ("y", y))}
    plant = control.ss(
        A, np.hstack([B1, B]), np.vstack([C1, C]), np.block([[D11, D12], [D21, np.zeros((y, m))]]),
        inputs=labels["w"] + labels["u"], outputs=labels["z"] + labels["y"],
    )  # fmt: skip
    left, right = np.eye(w + m)[:, w:], np.eye(z + y)[z:]
    loads, outputs = [f"load {s}" for s in labels["w"]], [f"output {s}" for s in labels["z"]]
    goal = structured.soft(structured.gain_limit(loads, outputs, 1.0, name="norm"))
    K: np.ndarray = -np.ones((m, y))
    for count in (starts, 1):
        law = structured.states("K", (np.zeros((0, 0)), np.zeros((0, y)), np.zeros((m, 0)), -K))
        found = structured.tune(plant, [structured.Place(left, law, right)], [goal], starts=count)
        K = -found.law.D[w:, z:]
    closed = control.ss(A + B @ K @ C, B1 + B @ K @ D21, C1 + D12 @ K @ C, D11 + D12 @ K @ D21)
    assert closed.poles().real.max() < 0
    assert control.linfnorm(closed)[0] == pytest.approx(found.reached["norm"], rel=1e-5)
    return found.reached["norm"], K


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in PLANTS]
)
def test_a_static_law_reaches_the_norm_of_the_page(name: str) -> None:
    norm, _ = static_law(name, 1 if name in QUICK else 3)
    assert norm == pytest.approx(PLANTS[name]["ours"], rel=5e-4)


def test_the_page_has_these_figures() -> None:
    page = (ROOT / "docs" / "howto" / "structured.md").read_text(encoding="utf-8")
    for name, plant in PLANTS.items():
        assert f"| {name}, {plant['title']} | {len(plant['A'])} | {plant['ours']} |" in page

"""Matrices of a rotor from its dimensions: Timoshenko beam elements and rigid discs, in one plane.

    python beam.py       writes matrices.csv anew, and prints natural frequencies beside the published ones

An element has a displacement and a slope at each end. With r = x + j y of all nodes, an isotropic rotor is

    M r'' - j Omega G r' + K r = f

so that one plane's matrices are enough. Elements: M. I. Friswell, J. E. T. Penny, S. D. Garvey, A. W. Lees, Dynamics of
Rotating Machines, Cambridge University Press, 2010, 5.4; shear coefficient of Cowper. dimensions.toml has the rotor.
"""

from __future__ import annotations

import csv
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Matrix = NDArray[np.floating[Any]]

FOLDER = Path(__file__).resolve().parent
FINE = 0.1  # m, length of an element of matrices.csv: the sensors and discs stand at nodes


class Matrices(NamedTuple):
    """Mass, gyroscopic and stiffness matrix of one plane; displacement and slope of each node in turn, SI."""

    M: Matrix
    G: Matrix
    K: Matrix


def element(length: float, d: float, steel: dict[str, float]) -> Matrices:
    """A round shaft element of diameter d."""
    E, G, rho = steel["E"], steel["G"], steel["rho"]
    A, bend, L, nu = math.pi / 4 * d**2, math.pi / 64 * d**4, length, E / (2 * G) - 1
    shear = 6 * (1 + nu) / (7 + 6 * nu)
    P = 12 * E * bend / (shear * G * A * L**2)
    K = _symmetric(12, 6 * L, -12, 6 * L, (4 + P) * L**2, (2 - P) * L**2) * E * bend / ((1 + P) * L**3)
    moved = _symmetric(
        312 + 588 * P + 280 * P**2, (44 + 77 * P + 35 * P**2) * L, 108 + 252 * P + 140 * P**2,
        -(26 + 63 * P + 35 * P**2) * L, (8 + 14 * P + 7 * P**2) * L**2, -(6 + 14 * P + 7 * P**2) * L**2,
    )  # fmt: skip
    turned = _symmetric(
        36, (3 - 15 * P) * L, -36, (3 - 15 * P) * L,
        (4 + 5 * P + 10 * P**2) * L**2, (-1 - 5 * P + 5 * P**2) * L**2,
    )  # fmt: skip
    turned = turned * rho * bend / (30 * L * (1 + P) ** 2)
    return Matrices(moved * rho * A * L / (840 * (1 + P) ** 2) + turned, 2 * turned, K)


def _symmetric(a: float, b: float, c: float, d: float, e: float, f: float) -> Matrix:
    """The pattern of all matrices of an element, whose halves mirror each other."""
    return np.array([[a, b, c, d], [b, e, -d, f], [c, -d, a, -b], [d, f, -b, e]])


def disc(d: float, bore: float, width: float, rho: float) -> tuple[float, float, float]:
    """Mass (kg), and moments of inertia across and about the axis (kg m^2)."""
    m = rho * math.pi / 4 * (d**2 - bore**2) * width
    return m, m * (d**2 + bore**2) / 16 + m * width**2 / 12, m * (d**2 + bore**2) / 8


def assemble(length: float) -> Matrices:
    """The free rotor of dimensions.toml, of elements of this length, m."""
    rotor = tomllib.loads((FOLDER / "source" / "dimensions.toml").read_text(encoding="utf-8"))
    count = round(rotor["shaft"]["length"] / length)
    found = Matrices(*(np.zeros((2 * count + 2, 2 * count + 2)) for _ in range(3)))
    one = element(length, rotor["shaft"]["diameter"], rotor["steel"])
    for k in range(count):
        at = slice(2 * k, 2 * k + 4)
        for whole, part in zip(found, one, strict=True):
            whole[at, at] += part
    for each in rotor["disc"]:
        m, across, about = disc(
            each["diameter"], rotor["shaft"]["diameter"], each["width"], rotor["steel"]["rho"]
        )
        k = 2 * round(each["at"] / length)
        found.M[k, k] += m
        found.M[k + 1, k + 1] += across
        found.G[k + 1, k + 1] += about
    return found


def whirl(free: Matrices, Omega: float, stiffness: float) -> Matrix:
    """Frequencies on springs at both ends (N/m), rad/s, smallest first; forward whirl is positive."""
    M, G, K = free.M, free.G, free.K.copy()
    for end in (0, len(K) - 2):
        K[end, end] += stiffness
    n = len(M)
    A = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), 1j * Omega * np.linalg.solve(M, G)]]
    )
    w = np.linalg.eigvals(A).imag
    return np.asarray(w[np.argsort(np.abs(w))])


def published() -> dict[str, Any]:
    """What the source of dimensions.toml prints."""
    return tomllib.loads((FOLDER / "source" / "dimensions.toml").read_text(encoding="utf-8"))["published"]


def write(path: Path, free: Matrices) -> None:
    """The entries of the upper triangles that are not zero, one place a line."""
    rows = [
        (i, j, *(float(X[i, j]) for X in free))
        for i in range(len(free.M))
        for j in range(i, len(free.M))
        if any(X[i, j] for X in free)
    ]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("row", "column", "M", "G", "K"))
        writer.writerows(rows)


def compare() -> None:
    """Print natural frequencies beside the published ones."""
    known = published()
    for case in known["case"]:
        ours = np.abs(whirl(assemble(known["element"]), case["speed"] * math.pi / 30, known["stiffness"]))
        for name, row in (("ours", ours[:6]), ("published", case["frequencies"])):
            print(f"{case['speed']:4d} rpm, {name:9s} " + " ".join(f"{w:7.2f}" for w in row) + " rad/s")


if __name__ == "__main__":
    write(FOLDER / "matrices.csv", assemble(FINE))
    compare()

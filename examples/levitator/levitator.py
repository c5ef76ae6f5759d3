"""The unstable pole of a levitator from a record of its position and its current, in a .csv of any rig.

    python levitator.py record.csv --position y:mm --current i:mA --sample-time 3.25ms --mass 2.9g

The machine is x'' = p^2 x + b i about the place of the record: p the unstable pole, b the gain of the current, both
free, of which a mass m makes the negative stiffness m p^2 and the force constant m b. The current is held between
samples, so

    y_k - 2 cosh(p T) y_k-1 + y_k-2 = b (cosh(p T) - 1) / p^2 (i_k-1 + i_k-2) + d + e_k + c_1 e_k-1 + c_2 e_k-2

and the most likely p, b, d, c_1 and c_2 make the prediction errors e as small as they can be (prediction error method;
L. Ljung, System Identification, 2nd ed., ch. 7), whatever law held it: feedback biases nothing. Beside the intervals
stands the size of e and whether it is white: if it is not, the machine has more than this model.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from malta.errors import CheckError, InputError
from malta.units import to_si

FEWEST = 200  # samples
STARTS = (20.0, 60.0, 200.0)  # rad/s, of the pole where the search begins
BEGIN = 50  # samples in which the filter forgets its start
TOLD = 0.2  # of their values, that half of the intervals may be
SLOWEST = 0.01  # 1 / sample time: a slower pole is not told from a drift
LAGS = 20  # samples, over which the residual is tested
SIGMA = 1.96  # half of a 95 % interval


class Levitator(NamedTuple):
    """What a record tells: values with half of their 95 % intervals, SI."""

    pole: float  # rad/s
    pole_half: float
    gain: float  # m/s^2 per A
    gain_half: float
    residual: float  # m, rms of the prediction errors
    whiteness: float  # their largest autocorrelation, in standard deviations of white ones


def identify_levitator(y: Any, i: Any, sample_time: float) -> Levitator:
    """Pole and gain from positions y (m) and currents i (A). Raises CheckError for a record that does not tell them."""
    y, i = np.asarray(y, dtype=float), np.asarray(i, dtype=float)
    if len(y) < FEWEST or len(i) != len(y) or not (np.isfinite(y).all() and np.isfinite(i).all()):
        raise CheckError(f"{len(y)} positions and {len(i)} currents: {FEWEST} of each at least, none missing")
    if not (np.ptp(y) > 0 and np.ptp(i) > 0):
        raise CheckError("the record does not move: a position or a current that is constant")
    scale, size = float(y.std()), float(i.std())
    y, i = (y - y.mean()) / scale, (i - i.mean()) / size

    def errors(theta: Any) -> Any:
        p, b, d, *c = theta
        turn = np.cosh(p * sample_time)
        share = b * (turn - 1) / p**2
        moved = lfilter([1, -2 * turn, 1], [1], y) - lfilter([0, share, share], [1], i) - d
        with np.errstate(all="ignore"):
            e = lfilter([1], [1, *c], moved)[BEGIN:]
        return np.clip(np.nan_to_num(e, nan=1e6), -1e6, 1e6)  # of a filter that is not stable

    found = [
        least_squares(errors, [p, sign * p**2, 0, -0.5, 0.2], x_scale=[10, p**2, 0.01, 0.3, 0.3])
        for p in STARTS
        for sign in (-1, 1)
    ]
    # A filter that is not stable could cancel a pole that no current moves.
    stable = [one for one in found if np.abs(np.roots([1, *one.x[3:]])).max() < 1]
    if not stable:
        raise CheckError("no unstable pole is told: the current does not move the position")
    best = min(stable, key=lambda one: one.cost)
    e = best.fun - best.fun.mean()
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * (e @ e) / len(e)
    half = SIGMA * np.sqrt(np.diag(covariance))
    pole = abs(float(best.x[0]))
    told = (half[:2] < TOLD * np.abs(best.x[:2])).all()
    if not (told and pole * sample_time > SLOWEST):
        raise CheckError(
            f"no unstable pole is told: {pole:.3g} +- {half[0]:.2g} rad/s; excite more, or sample faster"
        )
    lags = [abs(e[k:] @ e[:-k]) / (e @ e) * np.sqrt(len(e)) for k in range(1, LAGS + 1)]
    b, wide = scale / size * np.array([best.x[1], half[1]])
    return Levitator(pole, float(half[0]), float(b), float(wide), scale * float(e.std()), float(max(lags)))


def read_columns(path: Path, columns: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Columns of a .csv by what they are, SI: each is named by its heading and its unit. Raises InputError."""
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if row]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", str(error), "a .csv with a line of headings") from error
    headings = [name.strip() for name in rows[0]] if rows else []
    found = {}
    for what, (heading, unit) in columns.items():
        if heading not in headings:
            raise InputError(path, what, f"no column {heading!r}", f"one of {', '.join(headings) or 'none'}")
        k = headings.index(heading)
        try:
            values = np.array([float(row[k]) for row in rows[1:]])
        except (ValueError, IndexError) as error:
            raise InputError(path, heading, str(error), "a number in each line") from error
        si_unit = {"time": "s", "position": "m", "current": "A"}[what]
        found[what] = values * to_si(1.0, unit, si_unit, path, heading)
    return found


def named(text: str) -> tuple[str, str]:
    """A heading and its unit, as y:mm."""
    heading, colon, unit = text.rpartition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r}: a heading and its unit, as y:mm")
    return heading, unit


def quantity(text: str, unit: str, option: str) -> float:
    """A number with a unit, SI."""
    number = re.fullmatch(r"([-+.\deE]+)\s*(\S*)", text)
    if number is None:
        raise InputError(option, "", repr(text), f"a number with a unit, as 1{unit}")
    return to_si(float(number[1]), number[2] or unit, unit, option, option)


def main(arguments: list[str] | None = None) -> int:
    """Read a record and print what it tells; 1 where it tells nothing, 2 for a file that cannot be read."""
    parser = argparse.ArgumentParser(description="The unstable pole of a levitator from a record.")
    parser.add_argument("record", type=Path)
    parser.add_argument("--position", type=named, required=True, metavar="HEADING:UNIT")
    parser.add_argument("--current", type=named, required=True, metavar="HEADING:UNIT")
    parser.add_argument("--time", type=named, metavar="HEADING:UNIT")
    parser.add_argument(
        "--sample-time", metavar="TIME", help="of a record without a column of times, as 3.25ms"
    )
    parser.add_argument("--mass", metavar="MASS", help="makes stiffness and force constant of pole and gain")
    asked = parser.parse_args(arguments)
    columns = {"position": asked.position, "current": asked.current}
    try:
        if (asked.time is None) == (asked.sample_time is None):
            raise InputError("levitator", "time", "both or none", "--time or --sample-time")
        read = read_columns(asked.record, columns | ({"time": asked.time} if asked.time else {}))
        if asked.time:
            steps = np.diff(read["time"])
            Ts = float(np.median(steps))
            if not (Ts > 0 and np.abs(steps - Ts).max() < 0.1 * Ts):
                raise CheckError(f"{asked.record}: samples at uneven times; median step {Ts:g} s")
        else:
            Ts = quantity(asked.sample_time, "s", "--sample-time")
        found = identify_levitator(read["position"], read["current"], Ts)
        m = quantity(asked.mass, "kg", "--mass") if asked.mass else None
    except (CheckError, InputError) as error:
        print(f"levitator: {error}", file=sys.stderr)
        return 1 if isinstance(error, CheckError) else 2
    print(f"unstable pole {found.pole:.2f} +- {found.pole_half:.2f} rad/s")
    print(f"gain {found.gain:.4g} +- {found.gain_half:.2g} m/s^2 per A")
    if m:
        print(f"negative stiffness {m * found.pole**2:.4g} N/m, force constant {m * found.gain:.4g} N/A")
    print(
        f"residual {1e6 * found.residual:.2f} um rms, largest autocorrelation {found.whiteness:.1f} deviations"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())

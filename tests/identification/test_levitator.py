"""The example that reads a levitator's record: a simulated one, a real one where it is there, and what is refused."""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

EXAMPLE = runpy.run_path(str(ROOT / "examples" / "levitator" / "levitator.py"))
RECORD = os.environ.get("MALTA_MAGNETOSHIELD", "")  # a path to MagnetoShield_ID_Data.mat of AutomationShield
POLE, GAIN, TS = 50.0, -280.0, 3.25e-3


def record(samples: int = 3000, noise: float = 7e-6) -> tuple[Any, Any]:
    """A levitator of 50 rad/s under a PD law with probing, currents held between samples, noise of its sensor."""
    random = np.random.default_rng(4)
    turn, rise = np.cosh(POLE * TS), np.sinh(POLE * TS)
    A = np.array([[turn, rise / POLE], [POLE * rise, turn]])
    B = GAIN * np.array([(turn - 1) / POLE**2, rise / POLE])
    x, y, i, last = np.zeros(2), np.zeros(samples), np.zeros(samples), 0.0
    probe = np.repeat(random.choice([-8e-3, 8e-3], samples // 10 + 1), 10)
    for k in range(samples):
        y[k] = x[0] + noise * random.standard_normal()
        i[k] = 22.0 * y[k] + 0.15 * (y[k] - last) / TS + probe[k]
        last = y[k]
        x = A @ x + B * i[k]
    assert 3e-5 < np.abs(y).max() < 2e-3
    return y, i


def test_pole_and_gain_are_within_their_intervals() -> None:
    y, i = record()
    found = EXAMPLE["identify_levitator"](y + 14e-3, i + 0.02, TS)
    assert abs(found.pole - POLE) < 1.5 * found.pole_half < 1.5
    assert abs(found.gain - GAIN) < 1.5 * found.gain_half < 9
    assert found.whiteness < 4
    assert found.residual < 2 * 7e-6


@pytest.mark.slow_for("t,pos,amps")
@pytest.mark.parametrize("heading", ["t,pos,amps", "t , pos , amps"])
def test_a_record_is_read_by_the_names_of_its_columns(
    heading: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y, i = record(600)
    path = tmp_path / "record.csv"
    rows = np.column_stack([TS * np.arange(len(y)), 1e3 * y, 1e3 * i])
    np.savetxt(path, rows, delimiter=",", header=heading, comments="", fmt="%.8g")
    given = [str(path), "--position", "pos:mm", "--current", "amps:mA"]
    assert EXAMPLE["main"]([*given, "--time", "t:s", "--mass", "3g"]) == 0
    said = capsys.readouterr().out
    pole = float(said.split()[2])
    assert abs(pole - POLE) < 2
    stiffness = float(said.split("negative stiffness ")[1].split()[0])
    assert stiffness == pytest.approx(3e-3 * pole**2, rel=1e-3)
    assert EXAMPLE["main"]([*given, "--sample-time", "3.25ms"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        line for line in said.splitlines() if not line.startswith("negative")
    ]


@pytest.mark.slow
def test_what_tells_no_pole_is_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y, i = record(600)
    path = tmp_path / "record.csv"

    def asked(table: Any, *more: str, heading: str = "y,i") -> tuple[int, str]:
        np.savetxt(path, table, delimiter=",", header=heading, comments="", fmt="%s")
        given = [str(path), "--position", "y:m", "--current", "i:A", *(more or ("--sample-time", "3.25ms"))]
        code = EXAMPLE["main"](given)
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return code, said

    apart = 1e-6 * np.random.default_rng(0).standard_normal((600, 2))  # a current that moves nothing
    cases: dict[str, tuple[int, tuple[int, str]]] = {
        "200 of each at least": (1, asked(np.column_stack([y, i])[:50])),
        "does not move": (1, asked(np.column_stack([y, 0 * i]))),
        "no unstable pole is told": (1, asked(apart)),
        "no column 'y'": (2, asked(np.column_stack([y, i]), heading="x,i")),
        "could not convert": (2, asked(np.array([["1", "a"]]))),
        "unit": (2, asked(np.column_stack([y, i]), "--sample-time", "3 kg")),
        "--time or --sample-time": (
            2,
            asked(np.column_stack([y, i]), "--sample-time", "1ms", "--time", "t:s"),
        ),
    }
    for says, (code, found) in cases.items():
        assert (found[0], says in found[1]) == (code, True), found


@pytest.mark.skipif(
    not RECORD, reason="MALTA_MAGNETOSHIELD names no record; its licence does not let malta ship it"
)
def test_the_record_of_a_magnetoshield() -> None:
    """With a free gain 50.1 +- 0.15 rad/s and 7.3 um were published of it; columns are mm, V and mA."""
    from scipy.io import loadmat

    y, _, i = loadmat(RECORD)["result"].T
    found = EXAMPLE["identify_levitator"](1e-3 * y, 1e-3 * i, 3.25e-3)
    assert found.pole == pytest.approx(50.1, abs=found.pole_half + 0.15)
    assert found.residual == pytest.approx(7.3e-6, abs=1e-6)

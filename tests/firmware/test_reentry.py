"""From which states a supervisor brings its machine back: against flights of its FMU with that of the machine."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import controller, require, target
from test_fmu import Unit, content

import malta
from malta.errors import InputError
from malta.firmware.supervisor import bounds_of
from malta.firmware.supervisor_text import NUMBERS


def states(count: int) -> Any:
    """States of MALTA at rest at the centre."""
    return np.zeros((count, 12))


@pytest.fixture(autouse=True)
def _with_compiler() -> None:
    require("gcc")


def flies_back(x: Any, folder: Path, samples: int) -> bool:
    """The same flight by two FMUs, step by step."""
    t = target("robust", "double")
    units = []
    for part in ("supervised", "machine"):
        with zipfile.ZipFile(io.BytesIO(content(t, part, 3))) as archive:
            archive.extractall(folder / part)
        units.append(Unit(folder / part))
    supervised, machine = units
    machine.begin()
    for key, value in (("x_start", x), ("cold", [1.0]), ("noise", [1.0]), ("seed", [1.0])):
        machine.set(key, value)
    machine.start()
    rates = np.array([x[6], x[7], x[6], x[7], x[8]])  # without tilt
    supervised.begin()
    for key, value in (("p_ref", machine.get("y")), ("dp_ref", rates), ("flying", [1.0])):
        supervised.set(key, value)
    supervised.start()
    worst, shares, gates = np.zeros(5), 0.0, 1.0
    for k in range(samples):
        for group in ("y", "i", "link"):
            supervised.set(group, machine.get(group))
        supervised.set("p_ref", np.zeros(5))
        supervised.set("dp_ref", np.zeros(5))
        supervised.advance()
        shares, gates = (
            max(shares, machine.get("contact").max()),
            min(gates, supervised.get("supervisor.enable")[0]),
        )
        worst = np.maximum(worst, np.abs(machine.get("p"))) if k >= samples - 200 else worst
        machine.set("gates", supervised.get("supervisor.enable"))
        machine.set("command", supervised.get("command"))
        machine.advance()
    rests = (worst <= bounds_of(t).settled).all() and supervised.get("supervisor.state")[0] == NUMBERS[
        "OPERATE"
    ]
    for unit in units:
        unit.fmu.freeInstance()
    return bool(shares < 1 and gates == 1 and rests)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("entry", "size"), [(8, 0.5), (8, 1.8), (7, 0.05), (7, 0.12), (1, -1e-4), (1, 3e-4)], ids=str
)
def test_it_is_what_two_fmus_fly(entry: int, size: float, tmp_path: Path) -> None:
    x = states(1)
    x[0, entry] = size
    x[0, 2] = 5e-3 if entry == 8 else 0.0
    assert (
        flies_back(x[0], tmp_path, 4000) == malta.firmware.recoverable(controller("robust"), x, within=0.2)[0]
    )


def test_more_speed_towards_an_end_is_recovered_from_less() -> None:
    """Along the stroke the mover brakes with 144 m/s^2: from 5 mm, 1.4 m/s end within 13.5 mm."""
    x = states(6)
    x[:, 2] = 5e-3
    x[:, 8] = [0.0, 0.2, 1.4, 1.8, -1.8, 2.5]
    found = malta.firmware.recoverable(controller("robust"), x, within=0.15)
    assert found.tolist() == [True, True, True, False, True, False]


def test_answers_have_the_shape_of_the_states_and_other_machines_answer() -> None:
    x = np.zeros((2, 3, 12))
    x[1, :, 7] = 0.5  # onto a bearing
    found = malta.firmware.recoverable(controller("robust"), x, within=0.05)
    assert found.tolist() == [[True] * 3, [False] * 3]
    x[0, 0, 0] = 7e-4  # beyond the clearance
    assert not malta.firmware.recoverable(controller("robust"), x, within=0.05)[0, 0]


def test_bad_states_get_a_sentence() -> None:
    c = controller("robust")
    with pytest.raises(
        InputError, match=r"recoverable: x: found \(2, 5\), expected finite numbers, ... x 12"
    ):
        malta.firmware.recoverable(c, np.zeros((2, 5)))
    with pytest.raises(InputError, match="no finite numbers"):
        malta.firmware.recoverable(c, np.full((1, 12), np.nan))

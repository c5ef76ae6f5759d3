"""FMUs in a second importer, libcosim: the bits that fmpy gets of them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fmpy")
pytest.importorskip("libcosimpy", reason="libcosimpy not installed")

from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave
from test_fmu import Unit, content, target

from malta.firmware.fmu import PARTS, Part

SAMPLES = 60


@pytest.fixture
def unpack(tmp_path: Path) -> Callable[[str, Part], Unit]:
    """Writes an FMU, and makes an instance of it by fmpy."""

    def make(name: str, part: Part) -> Unit:
        data = content(target(name), part, 2)
        (tmp_path / f"{part}.fmu").write_bytes(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            archive.extractall(tmp_path / part)
        return Unit(tmp_path / part)

    return make


class Cosim:
    """An FMU that libcosim steps."""

    def __init__(self, fmu: Path, step: float) -> None:
        self.execution = CosimExecution.from_step_size(step_size=step * 1e9)  # ns
        self.manipulator, self.observer = (
            CosimManipulator.create_override(),
            CosimObserver.create_last_value(),
        )
        self.number = self.execution.add_local_slave(CosimLocalSlave(str(fmu), "unit"))
        assert self.execution.add_manipulator(self.manipulator)
        assert self.execution.add_observer(self.observer)

    def set(self, references: list[int], values: list[float]) -> None:
        assert self.manipulator.slave_real_values(self.number, references, values)

    def get(self, references: list[int]) -> Any:
        return np.array(self.observer.last_real_values(self.number, references))


def wave(unit: Unit, k: int) -> Mapping[str, Any]:
    """Inputs of a sample: a reference, readings, forces and commands that move."""
    sizes = {
        name: len(unit.groups[name]) for name in ("p_ref", "y", "i", "w", "command") if name in unit.groups
    }
    scale = {"p_ref": 1e-5, "y": 2e-5, "i": 0.1, "w": 0.5, "command": 0.1}
    inputs = {"p_ref", "w"} | ({"y", "i"} if "y_valid" in unit.groups else set())
    if "x_start" in unit.groups:
        inputs |= {"command"}
    return {
        name: scale[name] * np.sin(0.1 * k + np.arange(size))
        for name, size in sizes.items()
        if name in inputs
    }


@pytest.mark.slow_for("controller")
@pytest.mark.parametrize("part", [*PARTS[:1], *(pytest.param(p, marks=pytest.mark.slow) for p in PARTS[1:])])
def test_each_part_is_stepped_to_the_same_bits(
    part: Part, unpack: Callable[[str, Part], Unit], tmp_path: Path
) -> None:
    unit = unpack("halbach", part)
    cosim = Cosim(tmp_path / f"{part}.fmu", unit.step)
    everything = sorted(reference for group in unit.groups.values() for reference in group)[
        1:
    ]  # without time
    unit.begin()
    unit.start()
    moved = 0.0
    for k in range(SAMPLES):
        for name, values in wave(unit, k).items():
            unit.set(name, values)
            cosim.set(unit.groups[name], values.tolist())
        unit.advance()
        assert cosim.execution.step()
        found = np.array(unit.fmu.getReal(everything))
        assert np.array_equal(cosim.get(everything), found), k
        moved = max(moved, float(np.abs(found).max()))
    assert moved > 0
    unit.fmu.freeInstance()

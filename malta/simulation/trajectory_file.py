"""The time series of a run as a file of numpy's (.npz)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from malta.model.plant import Signal
from malta.simulation.trajectory import Trajectory
from malta.writing import replace_files


def save(run: Trajectory, path: str | Path) -> Path:
    """Write the time series as .npz.

    The archive has t, verdict, and for every series an array and its columns as "name [unit]" in <series>_columns.
    """
    path, drive = Path(path), run.plant.actuator.windings
    axes, phases = ((), run.plant.actuator.coils) if drive is None else (drive.axes, drive.phases)
    columns = {
        "reference": run.plant.outputs,
        "p": run.plant.outputs,
        "y": run.plant.outputs,
        "x": run.plant.states,
        "xi_hat": run.controller.states,
        "v": run.plant.inputs,
        "force": run.plant.inputs,
        "saturated": run.plant.inputs,
        "current": run.plant.actuator.coils,
        "i": axes,
        "u": tuple(Signal(s.name.replace("i_", "u_"), "V") for s in axes),
        "link": (Signal("V_link", "V"),),
        "i_phase": phases,
        "duty": tuple(Signal(s.name.replace("i_", "d_"), "1") for s in phases),
    }
    arrays: dict[str, Any] = {"t": run.t, "verdict": np.array([run.verdict.name])}
    for name, signals in columns.items():
        if not getattr(run, name).shape[1]:
            continue  # not simulated at this fidelity
        arrays[name] = getattr(run, name)
        arrays[f"{name}_columns"] = np.array([f"{s.name} [{s.unit}]" for s in signals])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    replace_files({path: buffer.getvalue()})
    return path

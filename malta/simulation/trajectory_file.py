"""The time series of a run as a file of numpy's (.npz)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from malta.simulation.trajectory import Trajectory
from malta.writing import replace_files


def save(run: Trajectory, path: str | Path) -> Path:
    """Write the time series as .npz.

    The archive has t, verdict, and for every series an array and its columns as "name [unit]" in <series>_columns.
    """
    arrays: dict[str, Any] = {"t": run.t, "verdict": np.array([run.verdict.name])}
    for name, signals in run.columns.items():
        arrays[name] = getattr(run, name)
        arrays[f"{name}_columns"] = np.array([f"{s.name} [{s.unit}]" for s in signals])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    path = Path(path)
    replace_files({path: buffer.getvalue()})
    return path

"""Reading a gain file whose gains are to hold a machine: a PID and a law of errors are judged on the one they name."""

from __future__ import annotations

from pathlib import Path

from malta.files import locate
from malta.gains.file import read, refuse_unstable
from malta.synthesis.controller import Controller


def read_stable(path: str | Path) -> Controller:
    """Read a gain file as `malta.gains.read`, and make the loop of a law that has no model: see `require_held`."""
    return require_held(read(path), path)


def require_held(controller: Controller, path: str | Path) -> Controller:
    """The controller of a gain file.

    Raises InputError for gains of a PID or of a law of errors that do not stabilize the loop on the file's own machine.
    """
    if controller.cost is None:
        from malta.loops.own_model import unstable_gain  # here: an LQG needs no loop

        refuse_unstable(unstable_gain, controller, locate(path), "the loop on the file's own machine")
    return controller

"""The gain file: everything that a digital implementation needs, as .json, .npz or .mat.

Its tables and entries, with meaning, unit and shape of each, stand in schema.py, and malta.schemas makes a JSON schema
of them. Version 1; 2 with what is below.

n = n0 + m d where the design models a delay of d samples: the mechanical states first, then stored forces; m more of a
fraction of a sample beyond, law.fraction, which version 1 has not; m more where
the filter observes forces of disturbance. The control law is stated in synthesis/controller.py. A PID controller has
the same law, with a diagonal Ki where each output has its own input (synthesis/pid.py); its cost, its noise and its
poles of regulator and filter are null. current_loop is null where currents follow their commands at once,
limits.voltage is null where voltages have no limit. A simulation keeps the smaller limit of the machine and its file:
of forces and currents always, of voltages where it has windings (fidelities dq and phase; the smallest of the file's).
A machine with electronics of its own keeps its own voltages.

A file of version 2 has one more table, law, and may have others: plant.linear of a machine from plain matrices,
commutation, and schedule. What law.tracks, law.coordinates and commutation mean for the control law stands in
synthesis/controller.py and synthesis/filters.py, what schedule means in synthesis/schedule.py.

There plant.parameters and its terms may be null, feedforward.rate without rates among the states, and limits.current
and limits.force without limits. The states of a law of errors are its own, then its last errors. An
LQG's may hold forces behind the lag of the current loops, as fx_B1[i], between the mechanical states and stored forces.
Its noise may have correlation [n0/2] of readings with accelerations, and any feedforward position m x n0/2 [N/m].
Files without these tables keep version 1.

The JSON is the specification: matrices row by row with round-trip precision, no time stamp, so the same inputs give the
same file. The .npz has the same names joined by dots ("gains.K"), the .mat the same names as nested structs; in both a
list of signals is two lists, name and unit, and null is an empty array. A file whose content does not match its sha256
is refused; a .mat also has a sha256 of its bytes in its header.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from malta.errors import CheckError, InputError
from malta.files import locate
from malta.gains.contents import build_controller
from malta.gains.encodings import content_sha256, decode
from malta.gains.schema import GainFile
from malta.synthesis.controller import Controller
from malta.synthesis.separation import unstable_gain
from malta.tables import validate

SCHEMA = "malta-gains"


def read(path: str | Path) -> Controller:
    """Read a gain file and check it.

    path : .json, .npz or .mat

    Returns the Controller in it.

    Raises InputError, naming file and field: not such a file, another schema or version, a missing or extra entry, a
    wrong shape, NaN or infinity, a non-positive sample time. It also refuses content that does not match its sha256,
    and gains that do not stabilize the file's own model. A PID or a law of errors has no model: `malta.verify` and all
    commands refuse gains that do not stabilize the loop on the file's own machine.

    >>> import malta
    >>> malta.gains.read("design/gains/planar.json")
    Controller('planar', preset 'pitch_16_3', 24 states, 6 forces, 5 kHz, delay 1)
    """
    path = locate(path)
    controller = build_controller(content_of(path)[0], path)
    refuse_unstable(unstable_gain, controller, path, "the file's own model")
    return controller


def refuse_unstable(
    judge: Callable[[Controller], tuple[str, float] | None], controller: Controller, path: Path, whose: str
) -> None:
    """Raise InputError for a gain of a file that leaves a pole of `whose` unstable, as `judge` finds it."""
    try:
        with np.errstate(all="ignore"):
            unstable = judge(controller)
    except CheckError as error:
        raise InputError(path, "model", str(error), "a model whose numbers can be multiplied") from error
    if unstable is not None:
        name, radius = unstable
        found = f"a pole of {whose} at |lambda| = {radius:.7g}"
        raise InputError(path, f"gains.{name}", found, "gains that stabilize it")


def content_of(path: Path) -> tuple[GainFile, dict[str, Any]]:
    """The document in a gain file, of the right schema and with its own sha256; and the same as plain tables.

    Raises InputError as `read` does. It does not check that the gains fit the machine and stabilize it.
    """
    content = decode(path)
    for key, wanted in (("schema", SCHEMA), ("version", 2 if "law" in content else 1)):
        if content.get(key) != wanted:
            raise InputError(path, key, repr(content[key]) if key in content else "nothing", repr(wanted))
    file = validate(GainFile, content, path)
    plain = file.model_dump(by_alias=True, exclude_unset=True)
    if content_sha256(plain) != file.sha256:
        raise InputError(
            path, "sha256", "content that was changed or damaged", "the content that was written"
        )
    return file, plain

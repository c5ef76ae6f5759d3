"""A compensator as a record, from a gain matrix or a system of python-control."""

from __future__ import annotations

from typing import Any

import numpy as np

from malta.arguments import matrix, plural
from malta.errors import InputError
from malta.linear.conversion import from_control, is_transfer
from malta.linear.uncertain import Compensator


def compensator_of(law: Any, outputs: int, inputs: int) -> Compensator:
    """A compensator as a record, from a Compensator, a control.StateSpace or TransferFunction, or a gain matrix.

    Or from what has its fields as an attribute `compensator_fields`, as a Controller.

    Raises InputError when its inputs and outputs do not fit the system, or its sample time is unspecified.
    """

    wanted = "a Compensator, a proper control.StateSpace or TransferFunction, or a gain matrix"
    if isinstance(law, Compensator):
        found = law
    elif isinstance(fields := getattr(law, "compensator_fields", None), dict):  # a Controller, not known here
        found = Compensator(**fields)
    elif is_transfer(law) or hasattr(law, "dt") or hasattr(law, "ninputs") or isinstance(law, bool | None):
        own = from_control(law, "compensator", "law", expected=wanted)
        found = Compensator(own.A, own.B, own.C, own.D, sample_time=own.dt)
    else:
        D = matrix("compensator", "law", law, wanted)
        found = Compensator(np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0)), D)
    if found.D.shape != (inputs, outputs):
        raise InputError(
            "compensator",
            "D",
            f"shape {found.D.shape}",
            f"{(inputs, outputs)}: {plural(inputs, 'input')} u from {plural(outputs, 'output')} y",
        )
    return found

"""One scheduled law of several that are designed at places along an output."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from malta.errors import InputError
from malta.model.data import plant_of
from malta.model.linearize import linearize
from malta.model.plant import outputs_at
from malta.synthesis.controller import Controller
from malta.synthesis.schedule import SCHEDULED, Schedule

CALLER = "schedule_laws"
ALIKE = ("parameters", "sample_time", "states", "forces", "measurements")  # of all laws of a schedule


def schedule_laws(
    laws: Sequence[Controller], variable: str, *, about: Controller | None = None
) -> Controller:
    """Make one law of several, which are designed at places along an output: linear between them.

    The law takes the place from the reference of the output. Feedforward, limits, cost and noise are those of `about`:
    what else holds the machine elsewhere is left to the sums of errors.

    laws : LQG or PID controllers of one machine, whose operating points are the places
    variable : the output
    about : the controller whose operating point, feedforward and limits the law has; None: the middle one of `laws`

    Returns a Controller with a `schedule`.

    Raises InputError for another output, laws that differ in more than their matrices, laws of errors, and machines
    whose currents depend on the reading.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball_pid.toml")
    >>> models = [malta.linearize(spec.plant, spec.plant.at(q=q)) for q in (-1e-3, 1e-3)]
    >>> soft = spec.replace({"pid.Kp.f": 6e3})
    >>> laws = [malta.synthesize(one, model) for one, model in zip((soft, spec), models)]
    >>> law = malta.synthesis.schedule_laws(laws, "y")
    >>> law.schedule.places.tolist(), law.schedule.at(0.0)["K"].round(3).tolist()
    ([-0.001, 0.001], [[7000.0, 25.0]])
    """
    if not laws:
        raise InputError(CALLER, "laws", "none", "at least two")
    ordered = sorted(laws, key=lambda c: _place(c, variable))
    base = ordered[len(laws) // 2] if about is None else about
    for law in laws:
        _require_alike(base, law)
    made = Schedule(
        variable,
        _output(base, variable),
        np.array([_place(c, variable) for c in ordered]),
        **{name: np.array([getattr(c, name) for c in ordered]) for name in SCHEDULED},
    )
    here = _place(base, variable)
    if not made.places[0] <= here <= made.places[-1]:
        found = f"an operating point at {here:g}"
        raise InputError(CALLER, "about", found, f"one within the places, {made.places.tolist()}")
    return replace(base, **made.at(here), schedule=made)


def _output(c: Controller, variable: str) -> int:
    names = [s.name for s in c.measurements]
    if variable not in names:
        raise InputError(CALLER, "variable", repr(variable), "an output: " + " ".join(names))
    return names.index(variable)


def _place(c: Controller, variable: str) -> float:
    """Where the output is at a law's operating point, SI."""
    plant = plant_of(c.parameters)
    return float(outputs_at(plant, plant.point(c.operating_point[0]).x)[_output(c, variable)])


def _require_alike(base: Controller, law: Controller) -> None:
    """Raise InputError for laws that no schedule takes together."""
    if law.tracks == "errors":
        raise InputError(CALLER, law.name, "a law of errors, as of a structure", "an LQG or a PID")
    if law.schedule is not None or law.commutation is not None:
        found = "a scheduled law" if law.schedule is not None else "a law that commutates ahead"
        raise InputError(CALLER, law.name, found, "a plain LQG or PID")
    for name in ALIKE:
        if getattr(law, name) != getattr(base, name):
            raise InputError(CALLER, law.name, f"another {name.replace('_', ' ')}", "laws of one form")
    plant = plant_of(law.parameters)
    if linearize(plant, plant.point(law.operating_point[0])).E.any():  # their pull is in the law's references
        expected = "a machine whose currents do not depend on where it is"
        raise InputError(CALLER, law.name, "currents that are held", expected)

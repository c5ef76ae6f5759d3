"""The controller that a design file asks for: an LQG, a PID, a law of a given structure; or several as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError, relocate_errors
from malta.model.linearize import LinearModel, linearize
from malta.model.places import outputs_at
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.feedforward import commutate_ahead
from malta.synthesis.law import point_at
from malta.synthesis.lqg import lqg
from malta.synthesis.pid import pid
from malta.synthesis.riccati import Solver
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule
from malta.synthesis.spec import Spec
from malta.synthesis.structure import structured_controller

CALLER = "schedule_laws"
COMMON_FIELDS = ("parameters", "sample_time", "states", "forces", "measurements")  # of all laws of a schedule


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
        **{name: np.array([getattr(c, name) for c in ordered]) for name in SCHEDULED_MATRICES},
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
    for name in COMMON_FIELDS:
        if getattr(law, name) != getattr(base, name):
            raise InputError(CALLER, law.name, f"another {name.replace('_', ' ')}", "laws of one form")
    plant = plant_of(law.parameters)
    if linearize(plant, plant.point(law.operating_point[0])).E.any():  # their pull is in the law's references
        expected = "a machine whose currents do not depend on where it is"
        raise InputError(CALLER, law.name, "currents that are held", expected)


@on_one_thread
def synthesize(spec: Spec, model: LinearModel, *, solver: Solver = "python-control") -> Controller:
    """Design the controller that a design file asks for.

    spec : from `malta.read_design`
    model : the machine's linear model at the design's operating point
    solver : of the Riccati equations of an LQG, as of `malta.lqg`

    Returns a Controller.

    Raises InputError and CheckError, which name the file.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> controller.name, controller.K.shape  # position, rate, and a stored force
    ('ball', (1, 3))
    """
    controller = _law_at(spec, model, solver)
    if spec.schedule is not None:
        plant, (variable, places) = spec.plant, spec.schedule
        points = [point_at(plant, model.operating_point.x, variable, place) for place in places]
        laws = [_law_at(spec, linearize(plant, point), solver) for point in points]
        with relocate_errors(spec.path, "schedule"):
            controller = schedule_laws(laws, variable, about=controller)
    if spec.inertia_feedforward != 1:
        old = controller.feedforward
        scaled = replace(old, inertia=spec.inertia_feedforward * np.asarray(old.inertia))
        controller = replace(controller, feedforward=scaled)
    if spec.commutation == "predicted":
        with relocate_errors(spec.path):
            controller = commutate_ahead(controller, model)
    if spec.pause and not controller.integrating:
        raise InputError(
            spec.path, "pause", "a law without sums of errors", "one with integrals, or no pause"
        )
    references = np.array(spec.references) if spec.references else controller.references
    return replace(
        controller,
        spec_sha256=spec.sha256,
        pause=np.array(spec.pause),
        braking=braking_errors(controller, spec.braking, spec.path),
        references=references,
    )


def _law_at(spec: Spec, model: LinearModel, solver: Solver) -> Controller:
    """The law alone at the operating point of a model. Raises InputError and CheckError, which name the file."""
    named: dict[str, Any] = {
        "name": spec.name,
        "current_loop_delay": spec.current_loop_delay,
        "position_feedforward": spec.position_feedforward,
    }
    try:
        if spec.structure is not None:
            del named["current_loop_delay"]
            controller = structured_controller(model, spec.structure, spec.sample_time, **named)
        elif spec.pid is not None:
            controller = pid(model, spec.pid, spec.sample_time, **named)
        else:
            named |= {"current_lag": spec.current_lag, "solver": solver}
            controller = lqg(model, spec.weights, spec.sample_time, spec.discretization, spec.delay, **named)
    except InputError as error:
        raise InputError(spec.path, f"{error.where}: {error.field}", error.found, error.expected) from error
    except (CheckError, np.linalg.LinAlgError) as error:
        raise CheckError(f"{spec.path}: {error}") from error
    return controller


def braking_errors(c: Controller, decelerations: Sequence[float], path: str | Path) -> FloatArray:
    """Errors from which axes brake at these decelerations, m/s^2: a / rate^2, with the rate of approach of each axis.

    Within them speed follows the error, v = rate times error, where rate = K_position / K_rate; beyond them it is the
    speed from which the deceleration a stops, v^2 = 2 a (error - a / rate^2 / 2). Both meet with one slope.

    Raises InputError for an axis whose own force does not answer its position and its rate.
    """
    found, half = np.array(decelerations), len(c.A) // 2
    for k in np.flatnonzero(found):
        near, damped = c.K[k, k], c.K[k, half + k] if half + k < len(c.A) else 0.0
        if not (near > 0 and damped > 0):
            name = c.measurements[k].name
            raise InputError(
                path, f"braking.{name}", "an axis without both", "a feedback of position and of rate"
            )
        found[k] /= (near / damped) ** 2
    return found

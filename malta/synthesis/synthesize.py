"""The controller that a design file asks for: an LQG, a PID, or a law of a given structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import CheckError, InputError
from malta.model.linearize import LinearModel, linearize
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.feedforward import commutate_ahead
from malta.synthesis.lqg import lqg
from malta.synthesis.pid import pid
from malta.synthesis.schedule import point_at
from malta.synthesis.scheduling import schedule_laws
from malta.synthesis.spec import Spec
from malta.synthesis.structure import structured_controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


@on_one_thread
def synthesize(spec: Spec, model: LinearModel) -> Controller:
    """Design the controller that a design file asks for.

    spec : from `malta.read_design`
    model : the machine's linear model at the design's operating point

    Returns a Controller.

    Raises InputError and CheckError, which name the file.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> controller.name, controller.K.shape  # position, rate, and a stored force
    ('ball', (1, 3))
    """
    controller = _law_at(spec, model)
    if spec.schedule is not None:
        plant, (variable, places) = spec.plant, spec.schedule
        points = [point_at(plant, model.operating_point.x, variable, place) for place in places]
        laws = [_law_at(spec, linearize(plant, point)) for point in points]
        try:
            controller = schedule_laws(laws, variable, about=controller)
        except InputError as error:
            raise InputError(spec.path, "schedule", error.found, error.expected) from error
    if spec.inertia_feedforward != 1:
        old = controller.feedforward
        scaled = replace(old, inertia=spec.inertia_feedforward * np.asarray(old.inertia))
        controller = replace(controller, feedforward=scaled)
    if spec.commutation == "predicted":
        try:
            controller = commutate_ahead(controller, model)
        except InputError as error:
            raise InputError(spec.path, error.field, error.found, error.expected) from error
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


def _law_at(spec: Spec, model: LinearModel) -> Controller:
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
            named["current_lag"] = spec.current_lag
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

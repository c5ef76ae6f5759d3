"""The document of a gain file -> the controller in it, with every check that the schema cannot make."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError, relocate_errors, require_known
from malta.files import require_plain_name
from malta.gains.schema import GainFile, LinearTable, PlantTable
from malta.model.faults import fault_of
from malta.model.linear.parameters import linear_parameters
from malta.model.machines import build_plant, machine, parameters_record
from malta.model.parameters import Parameters, later_parameters, units_of
from malta.model.places import outputs_at
from malta.model.signals import Coordinates, Signal
from malta.synthesis.controller import (
    Commutation,
    Controller,
    Cost,
    CurrentLoop,
    Feedforward,
    Limits,
    Noise,
    disturbances,
    lagging_forces,
    stored_forces,
)
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule

if TYPE_CHECKING:
    from malta.model.plant import Plant

# The table of a machine from plain matrices in a gain file, from and to its parameters.


MATRIX_TOLERANCE = 1e-9  # of the largest entry: matrices that are the same but for rounding
LINEAR_MACHINE_NAME = "linear"  # the name of all such machines; their own names are their presets


def _linear_parameters(plant: PlantTable, given: LinearTable, path: str | Path) -> Parameters:
    """The parameters of a machine from plain matrices."""
    if plant.name != LINEAR_MACHINE_NAME:
        raise InputError(
            path, "plant.linear", f"matrices of a {plant.name}", f"those of {LINEAR_MACHINE_NAME!r}"
        )
    require_plain_name(plant.preset, path, "plant.preset")
    parameters, terms = plant.parameters or {}, given.terms or {}
    for key, q in parameters.items():
        if q.unit != "1":
            raise InputError(path, f"plant.parameters.{key}.unit", repr(q.unit), "'1'")
    signals = {
        key: [Signal(s.name, s.unit) for s in getattr(given, key)] for key in ("states", "inputs", "outputs")
    }
    with relocate_errors(path, "plant.linear.{}"):
        return linear_parameters(
            **given.matrices.model_dump(),
            **cast("Any", signals),
            name=plant.preset,
            nominal={key: q.value for key, q in parameters.items()},
            terms={key: (M.A, M.B, M.C) for key, M in terms.items()},
            formulas=given.formulas or {},
            limits={
                name: (
                    -math.inf if one.above is None else one.above,
                    math.inf if one.below is None else one.below,
                )
                for name, one in (given.parameter_limits or {}).items()
            },
            limit=math.inf if given.limit is None else given.limit,
            noise=given.noise,
            dead_time=given.dead_time,
            computation_time=given.computation_time,
            range=0.0 if given.range is None else given.range,
        )


class _Layout(NamedTuple):
    """The signals of a controller, as its file names them and its machine has them."""

    plant: Plant
    states: tuple[Signal, ...]  # mechanical states, lagging forces, those stored for the delay, disturbances
    observed: tuple[Signal, ...]  # the last of the states: disturbances that the filter observes
    grid: int  # positions of the table of v0
    coordinates: Coordinates  # of the integrals and of process noise
    correlated: int  # correlations of noise
    holding: int  # rows of feedforward.position
    places: int  # of a schedule; 0 without one

    def shapes(self) -> dict[str, dict[str, tuple[int, ...]]]:
        """Shapes of all arrays of a file, by table and key."""
        plant = self.plant
        n, n0 = len(self.states), len(plant.design_states)
        m, p = len(plant.inputs), len(plant.outputs)
        g, coils = self.grid, len(plant.actuator.coils)
        in_positions, half, places = self.coordinates == "positions", n0 // 2, self.places
        sampled: dict[str, tuple[int, ...]] = {"Ad": (n, n), "Bd": (n, m), "Cd": (p, n)}
        gains: dict[str, tuple[int, ...]] = {"K": (m, n), "Ki": (m, p), "L": (n, p)}
        return {
            "model": {"A": (n0, n0), "B": (n0, m), "C": (p, n0)} | sampled,
            "gains": gains,
            "operating_point": {"x": (n0,), "u": (m,)},
            "feedforward": {
                "inertia": (m,),
                "speed": (m, p),
                "rate": (_of_machine(plant, "f", lambda: plant.coordinates), p),
                "z_grid": (g,),
                "v0": (g, m),
                "position": (m, half) if self.holding else (0, 0),
            },
            "limits": {"current": (coils,), "force": (m,), "voltage": (coils,)},
            "cost": {"state": (n0,), "input": (m,), "integral": (half if in_positions else p,)},
            "commutation": {"pull": (m, p)},
            "schedule": {
                "places": (places,),
                **{key: (places * rows, columns) for key, (rows, columns) in (sampled | gains).items()},
            },
            "noise": {
                "process": (half if in_positions else m,),
                "sensor": (p,),
                "drift": (len(self.observed),),
                "correlation": (half if self.correlated else 0,),
            },
        }


def build_controller(file: GainFile, path: str | Path) -> Controller:
    """The controller in a gain file.

    Raises InputError, naming file and field, for an unknown machine, parameters or signals that the machine does not
    have, arrays of the wrong shape, a grid of positions that does not rise, and values of the wrong sign.
    """
    if file.plant.linear is not None and file.law is None:
        raise InputError(path, "plant.linear", "a table", "none without a table law, as version 2 has it")
    if file.commutation is not None and file.law is None:
        raise InputError(path, "commutation", "a table", "none without a table law, as version 2 has it")
    if file.schedule is not None and (file.law is None or _tracks_errors(file)):
        raise InputError(path, "schedule", "a table", 'none without law.tracks = "states"')
    require_plain_name(file.design.name, path, "design.name")
    par = _parameters(file.plant, path)
    layout = _layout(file, par, path)
    if (file.cost is None) != (file.noise is None):
        raise InputError(path, "noise", "null" if file.noise is None else "some", "null where cost is null")
    arrays, unlimited = _arrays(file, layout, path)
    _check_values(arrays, path)
    errors, p = _tracks_errors(file), len(layout.plant.outputs)
    if errors:
        _check_error_law(file, arrays, path)
    fields: dict[str, Any] = dict(
        name=file.design.name,
        spec_sha256=file.design.spec_sha256,
        parameters=par,
        operating_point=(arrays["operating_point"]["x"], arrays["operating_point"]["u"]),
        sample_time=file.sample_time,
        states=layout.states,
        forces=layout.plant.inputs,
        measurements=layout.plant.outputs,
        **cast("dict[str, Any]", arrays["model"] | arrays["gains"]),
        cost=Cost(**arrays["cost"], coordinates=layout.coordinates) if "cost" in arrays else None,
        noise=Noise(**arrays["noise"]) if "noise" in arrays else None,
        feedforward=Feedforward(**arrays["feedforward"]),
        current_loop=None if file.current_loop is None else CurrentLoop(**file.current_loop.model_dump()),
        limits=Limits(**(unlimited | arrays["limits"])),
        tracks="errors" if errors else "states",
        pause=_law_entry(file, "pause", (p,), path, "rates"),
        braking=_law_entry(file, "braking", (p,), path, "errors"),
        references=_law_entry(file, "references", (3, p), path, "limits"),
        commutation=None
        if file.commutation is None
        else Commutation(file.commutation.lead, **arrays["commutation"]),
        schedule=_schedule(file, arrays, layout, path),
        fraction=_fraction(file, layout, path),
    )
    with relocate_errors(path, "law.{}"):  # the record does not know the file
        return Controller(**fields)


def _fraction(file: GainFile, layout: _Layout, path: str | Path) -> float:
    """The fraction of a sample of delay. Raises InputError for one of a law without stored forces."""
    fraction = 0.0 if file.law is None else file.law.fraction
    if fraction and not set(layout.states) & set(stored_forces(layout.plant.inputs, 1)):
        raise InputError(path, "law.fraction", f"{fraction:g}", "0, as no forces are stored")
    return fraction


def _schedule(file: GainFile, arrays: Arrays, layout: _Layout, path: str | Path) -> Schedule | None:
    """The matrices at the places of a schedule; None where the file has none.

    Raises InputError for an unknown output, places that do not rise, and matrices at the operating point that are not
    the file's own.
    """
    if file.schedule is None:
        return None
    plant, given = layout.plant, arrays["schedule"]
    names = [s.name for s in plant.outputs]
    require_known([file.schedule.variable], names, path, "schedule.variable")
    output, places = names.index(file.schedule.variable), given["places"]
    stacked = {key: given[key].reshape(len(places), -1, given[key].shape[1]) for key in SCHEDULED_MATRICES}
    with relocate_errors(path, "schedule.places"):
        made = Schedule(file.schedule.variable, output, places, **stacked)
    x = np.zeros(len(plant.states))
    x[list(plant.controlled)] = arrays["operating_point"]["x"]
    here = made.at(float(_of_machine(plant, "h", lambda: outputs_at(plant, x))[output]))
    for key, M in (arrays["model"] | arrays["gains"]).items():
        if key in here and not np.abs(M - here[key]).max() <= MATRIX_TOLERANCE * np.abs(M).max(initial=0.0):
            raise InputError(
                path, f"schedule.{key}", "other numbers at the operating point", "those beside it"
            )
    return made


def _law_entry(file: GainFile, name: str, shape: tuple[int, ...], path: str | Path, what: str) -> FloatArray:
    """An entry of the table law whose numbers are not below 0, `what` in a message; empty where the file has none."""
    given = None if file.law is None else getattr(file.law, name)
    if given is None:
        return np.zeros((0,) * len(shape))
    found = _array(given, shape, path, f"law.{name}")
    if (found < 0).any():
        raise InputError(path, f"law.{name}", str(found.tolist()), f"{what} of at least 0")
    return found


def _tracks_errors(file: GainFile) -> bool:
    """Whether the control law takes errors, and not states."""
    return file.law is not None and file.law.tracks == "errors"


def _layout(file: GainFile, par: Parameters, path: str | Path) -> _Layout:
    """The signals of a file, compared with those of its machine; the states of a law of errors are its own."""
    try:
        plant = build_plant(par)
    except CheckError as error:
        raise InputError(path, "plant.parameters", str(error), "a machine that can be controlled") from error
    states, forces, measurements = (
        tuple(Signal(s.name, s.unit) for s in getattr(file.signals, key))
        for key in ("states", "forces", "measurements")
    )
    mechanical, errors = plant.design_states, _tracks_errors(file)
    for key, found, wanted in (
        ("states", states[: len(mechanical)], states[: len(mechanical)] if errors else mechanical),
        ("forces", forces, plant.inputs),
        ("measurements", measurements, plant.outputs),
    ):
        if found != wanted:
            raise InputError(path, f"signals.{key}", _names(found), f"{_names(wanted)} of the {plant.name}")
    observed = () if errors else _observed_signals(file, states, forces, len(mechanical), path)
    correlated = len((file.noise and file.noise.correlation) or ())
    coordinates: Coordinates = file.law.coordinates if file.law else "signals"
    if coordinates == "positions" or correlated:
        _require_positions(file, plant, path)
    holding = len(file.feedforward.position or ())
    places = 0 if file.schedule is None else len(file.schedule.places)
    grid = len(file.feedforward.z_grid)
    return _Layout(plant, states, observed, grid, coordinates, correlated, holding, places)


def _of_machine(plant: Plant, name: str, evaluate: Callable[[], Any]) -> Any:
    """What a function of the machine gives. Raises InputError, with its line, for one that fails."""
    try:
        return evaluate()
    except Exception as error:  # a user's function may raise anything
        raise fault_of(error, plant.name, name) from error


def _require_positions(file: GainFile, plant: Plant, path: str | Path) -> None:
    """InputError for positions' coordinates of a machine without, of a law without a cost; correlations need them."""
    if file.law is None or file.law.coordinates != "positions":
        raise InputError(path, "noise.correlation", "some", 'none without law.coordinates "positions"')
    if file.cost is None:
        raise InputError(path, "law.coordinates", "positions", "signals where cost is null")
    if not _of_machine(plant, "f", lambda: plant.second_order):
        raise InputError(path, "law.coordinates", "positions", f"signals of the {plant.name}")


Arrays = dict[str, dict[str, "FloatArray"]]  # by table and key


def _arrays(file: GainFile, layout: _Layout, path: str | Path) -> tuple[Arrays, dict[str, FloatArray]]:
    """The arrays of a file without the tables that are null, and infinite limits for those that are null."""
    shapes = layout.shapes()
    unlimited = {key: np.full(size, np.inf) for key, size in shapes["limits"].items() if _endless(file, key)}
    for key in unlimited:
        del shapes["limits"][key]
    arrays = {
        table: {
            key: _array(getattr(getattr(file, table), key) or [], shape, path, f"{table}.{key}")
            for key, shape in keys.items()
        }
        for table, keys in shapes.items()
        if getattr(file, table) is not None
    }
    return arrays, unlimited


def _check_values(arrays: Mapping[str, Mapping[str, FloatArray]], path: str | Path) -> None:
    """Raise InputError for a grid that does not rise, for limits, variances and weights of the wrong sign, and for
    forces v0 beyond the limits."""
    z_grid = arrays["feedforward"]["z_grid"]
    if len(z_grid) < 2 or not (np.diff(z_grid) > 0).all():
        raise InputError(
            path, "feedforward.z_grid", "values that do not rise", "at least two rising positions"
        )
    for table, expected in (("limits", "limits above 0"), ("noise", "variances above 0")):
        for key, values in arrays.get(table, {}).items():
            if key == "correlation":
                if not (np.abs(values) < 1).all():
                    raise InputError(
                        path, "noise.correlation", str(values.tolist()), "numbers between -1 and 1"
                    )
            elif not (values > 0).all():
                raise InputError(path, f"{table}.{key}", str(values.tolist()), expected)
    for key, weight in arrays.get("cost", {}).items():
        if (weight < 0).any() or (key == "input" and not (weight > 0).all()):
            expected = "weights above 0" if key == "input" else "none below 0"
            raise InputError(path, f"cost.{key}", str(weight.tolist()), expected)
    force = arrays["limits"].get("force")
    if force is not None and not (np.abs(arrays["feedforward"]["v0"]) <= force).all():
        largest = np.abs(arrays["feedforward"]["v0"]).max(axis=0).tolist()
        raise InputError(
            path, "feedforward.v0", f"up to {largest}", f"at most limits.force, {force.tolist()}"
        )


def _observed_signals(
    file: GainFile, states: tuple[Signal, ...], forces: tuple[Signal, ...], n0: int, path: str | Path
) -> tuple[Signal, ...]:
    """The disturbances among the states, after stored forces. Raises InputError for other states."""
    n, m = len(states), len(forces)
    if (n - n0) % m:
        raise InputError(path, "signals.states", f"{n} states", f"{n0} and a multiple of {m} stored forces")
    observed = disturbances(forces) if states[-m:] == disturbances(forces) else ()
    lagging = lagging_forces(forces) if states[n0 : n0 + m] == lagging_forces(forces) else ()
    if lagging and file.law is None:
        raise InputError(path, "signals.states", _names(lagging), "a table law, as version 2 has it")
    stored = lagging + stored_forces(forces, (n - n0 - len(lagging + observed)) // m) + observed
    if states[n0:] != stored:
        raise InputError(path, "signals.states", _names(states[n0:]), f"stored forces, as {_names(stored)}")
    if observed and any(any(row) for row in file.gains.Ki):
        both = "sums of errors beside observed disturbances"
        raise InputError(path, "gains.Ki", both, "zeros: one of them takes off loads")
    return observed


def _check_error_law(
    file: GainFile, arrays: Mapping[str, Mapping[str, FloatArray]], path: str | Path
) -> None:
    """Raise InputError for matrices that are not those of a law of errors, as synthesis/controller.py has them."""
    model, gains = arrays["model"], arrays["gains"]
    n, p = gains["L"].shape
    if n < p:
        raise InputError(path, "signals.states", f"{n} states", f"{p} at least, the last errors")
    zeros = {"model.Bd": model["Bd"], "model.Cd": model["Cd"], "gains.Ki": gains["Ki"]}
    zeros["model.Ad"] = model["Ad"][n - p :]
    zeros["gains.L"] = gains["L"] - np.eye(n, p, p - n)
    for key, M in zeros.items():
        if M.any():
            raise InputError(path, key, "other entries", "those of a law that tracks errors")
    if file.cost is not None:
        raise InputError(path, "cost", "some", "null of a law that tracks errors")


def _endless(file: GainFile, key: str) -> bool:
    """Whether the file has null for a limit that may be null."""
    return getattr(file.limits, key) is None and (key == "voltage" or file.law is not None)


def _parameters(plant: PlantTable, path: str | Path) -> Parameters:
    """The machine's record of the parameters in a file, whose names and units have to be the machine's."""
    if plant.linear is not None:
        return _linear_parameters(plant, plant.linear, path)
    try:
        record = parameters_record(machine(plant.name), path)
    except InputError as error:
        if error.where != "machine":
            raise
        raise InputError(path, "plant.name", error.found, error.expected) from error
    units, given = units_of(record), plant.parameters or {}
    needed = set(units) - set(later_parameters(record))
    if unknown := sorted(set(given) - set(units)):
        raise InputError(path, "plant.parameters", f"{unknown[0]!r}, unknown", "one of " + " ".join(units))
    if missing := sorted(needed - set(given)):
        raise InputError(path, "plant.parameters", f"{missing[0]} missing", "all of " + " ".join(units))
    for key, q in given.items():
        if q.unit != units[key]:
            raise InputError(path, f"plant.parameters.{key}.unit", repr(q.unit), repr(units[key]))
    with relocate_errors(path, "plant.parameters.{}"):
        return record(**{k: q.value for k, q in given.items()}, preset=plant.preset)  # type: ignore[call-arg]


def _array(value: list[Any], shape: tuple[int, ...], path: str | Path, field: str) -> FloatArray:
    """A vector or matrix of the expected shape."""
    if not value and 0 in shape:
        return np.zeros(shape)
    rows = {len(row) for row in value} if len(shape) == 2 else set()
    found = (len(value), *rows) if len(rows) <= 1 else None
    if found != shape:
        text = "rows of unequal length" if found is None else f"shape {found}"
        raise InputError(path, field, text, f"shape {shape}")
    return np.array(value, dtype=float)


def _names(signals: tuple[Signal, ...]) -> str:
    """Signals with their units, as a message lists them."""
    return " ".join(f"{s.name} [{s.unit}]" for s in signals) or "nothing"


def uncertainty_of(content: Mapping[str, Any], published: Mapping[str, Any] | None) -> dict[str, float]:
    """The uncertain parameters of a gain file with their shares, else those that the machine's paper names; or none."""
    robust = content.get("verification", {}).get("robust") or {}
    own = robust.get("uncertainty") or (published or {}).get("position_controller", {}).get("uncertainty")
    return {name: float(value) for name, value in (own or {}).items()}

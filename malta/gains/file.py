"""The gain file: everything that a digital implementation needs, as .json, .npz or .mat.

    schema "malta-gains", version 1; 2 with what is below
    design           name, spec_sha256
    plant            name, preset, parameters {name: {value, unit}}
    operating_point  x [n0], u [m]
    sample_time      s
    signals          states [n], forces [m], measurements [p]: {name, unit} each, SI
    model            A n0 x n0, B n0 x m, C p x n0 (continuous, n0 mechanical states); Ad n x n, Bd n x m, Cd p x n
    gains            K m x n, Ki m x p, L n x p (filter form)
    cost             state n0, input m, integral p: diagonals of Q, R, Q_i that the regulator minimizes, SI
    noise            process [N^2] m, sensor [m^2] p: variances that the filter was designed for; drift [N^2] m or null
    feedforward      inertia [kg or kg m^2] m, speed m x p [N s/m], rate n0/2 x p, z_grid [g] [m], v0 g x m [N]
    current_loop     Kp [V/A], Ki [V/(A s)], sample_time [s]
    limits           current [A], voltage [V]: of each of c coils; force [N or N m]: m
    verification     poles {open_loop, regulator, filter, closed_loop} as rows [re, im] in rad/s, bandwidth [rad/s],
                     peak_sensitivity, robust {uncertainty, lower, upper, witness [SI]} or null: the margin over
                     the travel in multiples of the uncertainty; lower null: not proven, upper null: no witness
    provenance       versions of malta, python, numpy, scipy, control, casadi
    sha256           of the rest as compact JSON with sorted keys

n = n0 + m d where the design models a delay of d samples: the mechanical states first, then stored forces; m more where
the filter observes forces of disturbance. The control law is in controller.py. For a PID controller, which is the same
law, cost and noise are null, as its poles of regulator and filter; current_loop is null where currents follow
their commands at once, limits.voltage where there are none.

Version 2 is what has one more table, and may have another:

    law              tracks "states" or "errors": what the control law takes, see controller.py
    plant.linear     of a machine from plain matrices, whose name is "linear" and whose preset its own name:
                     states, inputs, outputs: signals; matrices A, B, C; terms {parameter: A, B, C}; limit [m],
                     noise [p], dead_time [s], as model/linear.py takes them

There plant.parameters and its terms are null without parameters, feedforward.rate without rates among the states, and
limits.current and limits.force without limits. The states of a law of errors are its own, then its last errors.
All else stays version 1, and readers of it read these files.

The JSON is the specification: matrices row by row with round-trip precision, no time stamp, so the same inputs give the
same file. The .npz has the same names joined by dots ("gains.K"), the .mat the same names as nested structs; in both a
list of signals is two lists, name and unit, and null is an empty array. The sha256 has a damaged or edited file refused
rather than flown; a .mat holds one of its bytes in its header too.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from malta.errors import CheckError, InputError
from malta.files import located, replace_files
from malta.gains.encodings import SUFFIXES as SUFFIXES
from malta.gains.encodings import content_sha256, decode, encode
from malta.gains.linear import LINEAR, linear_parameters, linear_table, signal_tables
from malta.gains.schema import GainFile, PlantTable
from malta.margins.verify import require_stable, unstable_gain
from malta.model.data import (
    parameters_record,
    plant_of,
    units_of,
    validated,
)
from malta.model.linear import is_linear
from malta.model.machines import machine
from malta.model.plant import Signal
from malta.synthesis.controller import (
    Controller,
    Cost,
    CurrentLoop,
    Feedforward,
    Limits,
    Noise,
    disturbances,
    stored_forces,
)

if TYPE_CHECKING:
    from malta.margins.verify import Margins
    from malta.model.plant import FloatArray, Parameters

SCHEMA = "malta-gains"


def document(controller: Controller, margins: Margins) -> dict[str, Any]:
    """The content of the gain file of a controller, as plain tables, lists and numbers.

    Raises CheckError when the loop is not stable: such gains are for no file.
    """
    require_stable(margins, controller.name)
    c = controller
    units, linear = units_of(c.parameters), is_linear(c.parameters)
    extended = linear or c.tracks == "errors" or not c.feedforward.rate.size
    tables: dict[str, Any] = {
        "schema": SCHEMA,
        "version": 2 if extended else 1,
        "design": {"name": c.name, "spec_sha256": c.spec_sha256},
        "plant": {
            "name": LINEAR if linear else plant_of(c.parameters).name,
            "preset": c.parameters.preset,
            "parameters": {k: {"value": getattr(c.parameters, k), "unit": u} for k, u in units.items()},
            **({"linear": linear_table(c.parameters)} if linear else {}),
        },
        "operating_point": {"x": c.operating_point[0], "u": c.operating_point[1]},
        "sample_time": c.sample_time,
        **({"law": {"tracks": c.tracks}} if extended else {}),
        "signals": signal_tables(c, "states", "forces", "measurements"),
        "model": {key: getattr(c, key) for key in ("A", "B", "C", "Ad", "Bd", "Cd")},
        "gains": {key: getattr(c, key) for key in ("K", "Ki", "L")},
        "cost": _table(c.cost, "state", "input", "integral"),
        "noise": _table(c.noise, "process", "sensor", "drift"),
        "feedforward": _table(c.feedforward, "inertia", "speed", "rate", "z_grid", "v0"),
        "current_loop": _table(c.current_loop, "Kp", "Ki", "sample_time"),
        "limits": _table(c.limits, "current", "voltage", "force"),
        "verification": {
            "poles": margins.poles.pairs(),
            "bandwidth": dict(margins.bandwidth),
            "peak_sensitivity": dict(margins.peak_sensitivity),
            "robust": _robust(margins),
        },
        "provenance": {"malta": version("malta"), "python": platform.python_version()}
        | {name: version(name) for name in ("numpy", "scipy", "control", "casadi")},
    }
    for key, limit in tables["limits"].items():
        if not np.isfinite(limit).all():
            tables["limits"][key] = None
    plain: dict[str, Any] = _plain(tables)
    plain["sha256"] = content_sha256(plain)
    return plain


def _table(record: Any, *keys: str) -> dict[str, Any] | None:
    return None if record is None else {key: getattr(record, key) for key in keys}


def _robust(margins: Margins) -> dict[str, Any] | None:
    """The bounds over the travel: lower is null where nothing is proven, upper where no witness is known."""
    margin = margins.robust
    if margin is None:
        return None
    return {
        "uncertainty": dict(margins.uncertainty),
        "lower": margin.lower,
        "upper": None if margin.exhausted else margin.upper,
        "witness": None if margin.witness is None else dict(margin.witness),
    }


def write(controller: Controller, margins: Margins, *paths: str | Path) -> None:
    """Write a controller to gain files; the suffix (.json, .npz, .mat) says which form.

    All files are completed beside their targets before any is renamed into place, so a failure leaves the old ones.

    Raises InputError for an unknown suffix or a folder that cannot be written to.
    """
    content = document(controller, margins)
    replace_files({Path(path): encode(content, Path(path)) for path in paths})


def read(path: str | Path) -> Controller:
    """Read a gain file (.json, .npz or .mat) and check it.

    Raises InputError, naming file and field: not such a file, another schema or version, a missing or extra entry, a
    wrong shape, NaN or infinity, a non-positive sample time, content that does not match its sha256, gains that do not
    stabilize the file's own model.
    """
    path = located(path)
    file, _ = content_of(path)
    controller = _controller(file, path)
    try:
        with np.errstate(all="ignore"):
            unstable = unstable_gain(controller)
    except CheckError as error:
        raise InputError(path, "model", str(error), "a model whose numbers can be multiplied") from error
    if unstable is not None:
        name, radius = unstable
        whose = (
            "the file's own model" if controller.cost is not None else "the loop on the file's own machine"
        )
        found = f"a pole of {whose} at |lambda| = {radius:.7g}"
        raise InputError(path, f"gains.{name}", found, "gains that stabilize it")
    return controller


def content_of(path: Path) -> tuple[GainFile, dict[str, Any]]:
    """The document in a gain file, of the right schema and with its own sha256; and the same as plain tables.

    Raises InputError as `read`; whether the gains fit the machine and stabilize it is not looked at.
    """
    content = decode(path)
    for key, wanted in (("schema", SCHEMA), ("version", 2 if "law" in content else 1)):
        if content.get(key) != wanted:
            raise InputError(path, key, repr(content[key]) if key in content else "nothing", repr(wanted))
    file = validated(GainFile, content, path)
    plain = file.model_dump(by_alias=True, exclude_unset=True)
    if content_sha256(plain) != file.sha256:
        raise InputError(
            path, "sha256", "content that was changed or damaged", "the content that was written"
        )
    return file, plain


def _controller(file: GainFile, path: str | Path) -> Controller:
    if file.plant.linear is not None and file.law is None:
        raise InputError(path, "plant.linear", "a table", "none without a table law, as version 2 has it")
    par = _parameters(file.plant, path)
    try:
        plant = plant_of(par)
    except CheckError as error:
        raise InputError(path, "plant.parameters", str(error), "a machine that can be controlled") from error
    states, forces, measurements = (
        tuple(Signal(s.name, s.unit) for s in getattr(file.signals, key))
        for key in ("states", "forces", "measurements")
    )
    mechanical, errors = plant.design_states, file.law is not None and file.law.tracks == "errors"
    for key, found, wanted in (
        ("states", states[: len(mechanical)], states[: len(mechanical)] if errors else mechanical),
        ("forces", forces, plant.inputs),
        ("measurements", measurements, plant.outputs),
    ):
        if found != wanted:
            raise InputError(path, f"signals.{key}", _names(found), f"{_names(wanted)} of the {plant.name}")
    n, n0, m, p = len(states), len(mechanical), len(forces), len(measurements)
    g, coils = len(file.feedforward.z_grid), len(plant.actuator.coils)
    observed = () if errors else _observed(file, states, forces, n0, path)
    if (file.cost is None) != (file.noise is None):
        raise InputError(path, "noise", "null" if file.noise is None else "some", "null where cost is null")
    shapes: dict[str, dict[str, tuple[int, ...]]] = {
        "model": {"A": (n0, n0), "B": (n0, m), "C": (p, n0), "Ad": (n, n), "Bd": (n, m), "Cd": (p, n)},
        "gains": {"K": (m, n), "Ki": (m, p), "L": (n, p)},
        "operating_point": {"x": (n0,), "u": (m,)},
        "feedforward": {
            "inertia": (m,),
            "speed": (m, p),
            "rate": (plant.coordinates, p),
            "z_grid": (g,),
            "v0": (g, m),
        },
        "limits": {"current": (coils,), "force": (m,), "voltage": (coils,)},
    }
    unlimited = {key: np.full(size, np.inf) for key, size in shapes["limits"].items() if _endless(file, key)}
    for key in unlimited:
        del shapes["limits"][key]
    if file.cost is not None:
        shapes["cost"] = {"state": (n0,), "input": (m,), "integral": (p,)}
    if file.noise is not None:
        shapes["noise"] = {"process": (m,), "sensor": (p,), "drift": (len(observed),)}
    arrays: dict[str, dict[str, FloatArray]] = {
        table: {
            key: _array(getattr(getattr(file, table), key) or [], shape, path, f"{table}.{key}")
            for key, shape in keys.items()
        }
        for table, keys in shapes.items()
    }
    z_grid = arrays["feedforward"]["z_grid"]
    if g < 2 or not (np.diff(z_grid) > 0).all():
        raise InputError(
            path, "feedforward.z_grid", "values that do not rise", "at least two rising positions"
        )
    for key, limit in arrays["limits"].items():
        if not (limit > 0).all():
            raise InputError(path, f"limits.{key}", str(limit.tolist()), "limits above 0")
    for key, variance in arrays.get("noise", {}).items():
        if not (variance > 0).all():
            raise InputError(path, f"noise.{key}", str(variance.tolist()), "variances above 0")
    for key, weight in arrays.get("cost", {}).items():
        if (weight < 0).any() or (key == "input" and not (weight > 0).all()):
            raise InputError(
                path,
                f"cost.{key}",
                str(weight.tolist()),
                "weights above 0" if key == "input" else "none below 0",
            )
    if errors:
        _check_error_law(file, arrays, path)
    return Controller(
        name=file.design.name,
        spec_sha256=file.design.spec_sha256,
        parameters=par,
        operating_point=(arrays["operating_point"]["x"], arrays["operating_point"]["u"]),
        sample_time=file.sample_time,
        states=states,
        forces=forces,
        measurements=measurements,
        **cast("dict[str, Any]", arrays["model"] | arrays["gains"]),
        cost=Cost(**arrays["cost"]) if "cost" in arrays else None,
        noise=Noise(**arrays["noise"]) if "noise" in arrays else None,
        feedforward=Feedforward(**arrays["feedforward"]),
        current_loop=None if file.current_loop is None else CurrentLoop(**file.current_loop.model_dump()),
        limits=Limits(**(unlimited | arrays["limits"])),
        tracks="errors" if errors else "states",
    )


def _observed(
    file: GainFile, states: tuple[Signal, ...], forces: tuple[Signal, ...], n0: int, path: str | Path
) -> tuple[Signal, ...]:
    """The disturbances among the states, after stored forces. InputError for others."""
    n, m = len(states), len(forces)
    if (n - n0) % m:
        raise InputError(path, "signals.states", f"{n} states", f"{n0} and a multiple of {m} stored forces")
    observed = disturbances(forces) if states[-m:] == disturbances(forces) else ()
    stored = stored_forces(forces, (n - n0 - len(observed)) // m) + observed
    if states[n0:] != stored:
        raise InputError(path, "signals.states", _names(states[n0:]), f"stored forces, as {_names(stored)}")
    if observed and any(any(row) for row in file.gains.Ki):
        both = "sums of errors beside observed disturbances"
        raise InputError(path, "gains.Ki", both, "zeros: one of them takes off loads")
    return observed


def _check_error_law(
    file: GainFile, arrays: Mapping[str, Mapping[str, FloatArray]], path: str | Path
) -> None:
    """InputError where the matrices are not those of a law of errors, as controller.py has them."""
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
    """Whether there is no such limit, as a file may say."""
    return getattr(file.limits, key) is None and (key == "voltage" or file.law is not None)


def _parameters(plant: PlantTable, path: str | Path) -> Parameters:
    if plant.linear is not None:
        return linear_parameters(plant, plant.linear, path)
    try:
        record = parameters_record(machine(plant.name), path)
    except InputError as error:
        if error.where != "machine":
            raise
        raise InputError(path, "plant.name", error.found, error.expected) from error
    units, given = units_of(record), plant.parameters or {}
    if set(given) != set(units):
        odd = sorted(set(given) ^ set(units))
        raise InputError(path, "plant.parameters", f"{odd[0]} missing or unknown", " ".join(units))
    for key, q in given.items():
        if q.unit != units[key]:
            raise InputError(path, f"plant.parameters.{key}.unit", repr(q.unit), repr(units[key]))
    try:
        return record(**{k: q.value for k, q in given.items()}, preset=plant.preset)  # type: ignore[call-arg]
    except InputError as error:
        raise InputError(path, f"plant.parameters.{error.field}", error.found, error.expected) from error


def _array(value: list[Any], shape: tuple[int, ...], path: str | Path, field: str) -> FloatArray:
    if not value and 0 in shape:
        return np.zeros(shape)
    rows = {len(row) for row in value} if len(shape) == 2 else set()
    found = (len(value), *rows) if len(rows) <= 1 else None
    if found != shape:
        text = "rows of unequal length" if found is None else f"shape {found}"
        raise InputError(path, field, text, f"shape {shape}")
    return np.array(value, dtype=float)


def _names(signals: tuple[Signal, ...]) -> str:
    return " ".join(f"{s.name} [{s.unit}]" for s in signals) or "nothing"


def _plain(value: Any) -> Any:
    """Tables, lists, numbers and nulls for empty ones; no negative zeros, which some readers of JSON may lose."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()} or None
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list):
        return [_plain(entry) for entry in value] or None
    return value + 0.0 if isinstance(value, float) else value

"""The gain file, version 1: everything that a digital implementation needs, as .json, .npz or .mat.

    schema "malta-gains", version 1
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
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, StrictInt, StrictStr

from malta.errors import CheckError, InputError
from malta.files import located, replace_files
from malta.gains.encodings import SUFFIXES as SUFFIXES
from malta.gains.encodings import content_sha256, decode, encode
from malta.margins.verify import require_stable, unstable_gain
from malta.model.data import (
    Finite,
    Quantity,
    Record,
    parameters_record,
    plant_of,
    units_of,
    validated,
)
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

SCHEMA, VERSION = "malta-gains", 1

Vector = list[Finite]
Matrix = list[list[Finite]]


def _rows(value: Any) -> Any:
    """Signals as the binary files hold them, two columns, back to a list of rows."""
    if isinstance(value, dict) and set(value) == {"name", "unit"}:
        names, units = value["name"], value["unit"]
        if isinstance(names, list) and isinstance(units, list) and len(names) == len(units):
            return [{"name": n, "unit": u} for n, u in zip(names, units, strict=True)]
    return value


class _Signal(Record):
    name: StrictStr
    unit: StrictStr


_Signals = Annotated[list[_Signal], BeforeValidator(_rows)]


class _Design(Record):
    name: StrictStr
    spec_sha256: StrictStr


class _Plant(Record):
    name: StrictStr
    preset: StrictStr
    parameters: dict[StrictStr, Quantity]


class _OperatingPoint(Record):
    x: Vector
    u: Vector


class _SignalTable(Record):
    states: _Signals
    forces: _Signals
    measurements: _Signals


class _Model(Record):
    A: Matrix
    B: Matrix
    C: Matrix
    Ad: Matrix
    Bd: Matrix
    Cd: Matrix


class _Gains(Record):
    K: Matrix
    Ki: Matrix
    L: Matrix


class _Cost(Record):
    state: Vector
    input: Vector
    integral: Vector


class _Noise(Record):
    process: Vector
    sensor: Vector
    drift: Vector | None


class _Feedforward(Record):
    inertia: Vector
    speed: Matrix
    rate: Matrix
    z_grid: Vector
    v0: Matrix


class _CurrentLoop(Record):
    Kp: Annotated[Finite, Field(gt=0)]
    Ki: Annotated[Finite, Field(gt=0)]
    sample_time: Annotated[Finite, Field(gt=0)]


class _Limits(Record):
    current: Vector
    voltage: Vector | None
    force: Vector


class _Poles(Record):
    open_loop: Matrix
    regulator: Matrix | None
    filter: Matrix | None
    closed_loop: Matrix


class _Robust(Record):
    uncertainty: dict[StrictStr, Finite]
    lower: Finite | None
    upper: Finite | None
    witness: dict[StrictStr, Finite] | None


class _Verification(Record):
    poles: _Poles
    bandwidth: dict[StrictStr, Finite]
    peak_sensitivity: dict[StrictStr, Finite]
    robust: _Robust | None


class _Provenance(Record):
    malta: StrictStr
    python: StrictStr
    numpy: StrictStr
    scipy: StrictStr
    control: StrictStr
    casadi: StrictStr


class GainFile(Record):
    """The document that a gain file holds."""

    schema_: Annotated[Literal["malta-gains"], Field(alias="schema")]
    version: Annotated[StrictInt, Field(ge=VERSION, le=VERSION)]
    design: _Design
    plant: _Plant
    operating_point: _OperatingPoint
    sample_time: Annotated[Finite, Field(gt=0)]
    signals: _SignalTable
    model: _Model
    gains: _Gains
    cost: _Cost | None
    noise: _Noise | None
    feedforward: _Feedforward
    current_loop: _CurrentLoop | None
    limits: _Limits
    verification: _Verification
    provenance: _Provenance
    sha256: StrictStr


def document(controller: Controller, margins: Margins) -> dict[str, Any]:
    """The content of the gain file of a controller, as plain tables, lists and numbers.

    Raises CheckError when the loop is not stable: such gains are for no file.
    """
    require_stable(margins, controller.name)
    c = controller
    units = units_of(c.parameters)
    tables: dict[str, Any] = {
        "schema": SCHEMA,
        "version": VERSION,
        "design": {"name": c.name, "spec_sha256": c.spec_sha256},
        "plant": {
            "name": plant_of(c.parameters).name,
            "preset": c.parameters.preset,
            "parameters": {k: {"value": getattr(c.parameters, k), "unit": u} for k, u in units.items()},
        },
        "operating_point": {"x": c.operating_point[0], "u": c.operating_point[1]},
        "sample_time": c.sample_time,
        "signals": {
            key: [s._asdict() for s in getattr(c, key)] for key in ("states", "forces", "measurements")
        },
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
    if not np.isfinite(c.limits.voltage).all():
        tables["limits"]["voltage"] = None
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
    for key, wanted in (("schema", SCHEMA), ("version", VERSION)):
        if content.get(key) != wanted:
            raise InputError(path, key, repr(content[key]) if key in content else "nothing", repr(wanted))
    file = validated(GainFile, content, path)
    plain = file.model_dump(by_alias=True)
    if content_sha256(plain) != file.sha256:
        raise InputError(
            path, "sha256", "content that was changed or damaged", "the content that was written"
        )
    return file, plain


def _controller(file: GainFile, path: str | Path) -> Controller:
    par = _parameters(file.plant, path)
    try:
        plant = plant_of(par)
    except CheckError as error:
        raise InputError(path, "plant.parameters", str(error), "a machine that can be controlled") from error
    states, forces, measurements = (
        tuple(Signal(s.name, s.unit) for s in getattr(file.signals, key))
        for key in ("states", "forces", "measurements")
    )
    mechanical = plant.design_states
    for key, found, wanted in (
        ("states", states[: len(mechanical)], mechanical),
        ("forces", forces, plant.inputs),
        ("measurements", measurements, plant.outputs),
    ):
        if found != wanted:
            raise InputError(path, f"signals.{key}", _names(found), f"{_names(wanted)} of the {plant.name}")
    n, n0, m, p = len(states), len(mechanical), len(forces), len(measurements)
    g, coils = len(file.feedforward.z_grid), len(plant.actuator.coils)
    if (n - n0) % m:
        raise InputError(path, "signals.states", f"{n} states", f"{n0} and a multiple of {m} stored forces")
    observed = disturbances(forces) if states[-m:] == disturbances(forces) else ()
    stored = stored_forces(forces, (n - n0 - len(observed)) // m) + observed
    if states[n0:] != stored:
        raise InputError(path, "signals.states", _names(states[n0:]), f"stored forces, as {_names(stored)}")
    if observed and any(any(row) for row in file.gains.Ki):
        both = "sums of errors beside observed disturbances"
        raise InputError(path, "gains.Ki", both, "zeros: one of them takes off loads")
    if (file.cost is None) != (file.noise is None):
        raise InputError(path, "noise", "null" if file.noise is None else "some", "null where cost is null")
    shapes: dict[str, dict[str, tuple[int, ...]]] = {
        "model": {"A": (n0, n0), "B": (n0, m), "C": (p, n0), "Ad": (n, n), "Bd": (n, m), "Cd": (p, n)},
        "gains": {"K": (m, n), "Ki": (m, p), "L": (n, p)},
        "operating_point": {"x": (n0,), "u": (m,)},
        "feedforward": {"inertia": (m,), "speed": (m, p), "rate": (n0 // 2, p), "z_grid": (g,), "v0": (g, m)},
        "limits": {"current": (coils,), "force": (m,)},
    }
    if file.limits.voltage is not None:
        shapes["limits"]["voltage"] = (coils,)
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
    return Controller(
        name=file.design.name,
        spec_sha256=file.design.spec_sha256,
        parameters=par,
        operating_point=(arrays["operating_point"]["x"], arrays["operating_point"]["u"]),
        sample_time=file.sample_time,
        states=states,
        forces=forces,
        measurements=measurements,
        **arrays["model"],
        **arrays["gains"],
        cost=Cost(**arrays["cost"]) if "cost" in arrays else None,
        noise=Noise(**arrays["noise"]) if "noise" in arrays else None,
        feedforward=Feedforward(**arrays["feedforward"]),
        current_loop=None if file.current_loop is None else CurrentLoop(**file.current_loop.model_dump()),
        limits=Limits(**({"voltage": np.full(coils, np.inf)} | arrays["limits"])),
    )


def _parameters(plant: _Plant, path: str | Path) -> Parameters:
    try:
        record = parameters_record(machine(plant.name), path)
    except InputError as error:
        if error.where != "machine":
            raise
        raise InputError(path, "plant.name", error.found, error.expected) from error
    units = units_of(record)
    if set(plant.parameters) != set(units):
        odd = sorted(set(plant.parameters) ^ set(units))
        raise InputError(path, "plant.parameters", f"{odd[0]} missing or unknown", " ".join(units))
    for key, q in plant.parameters.items():
        if q.unit != units[key]:
            raise InputError(path, f"plant.parameters.{key}.unit", repr(q.unit), repr(units[key]))
    try:
        return record(**{k: q.value for k, q in plant.parameters.items()}, preset=plant.preset)  # type: ignore[call-arg]
    except InputError as error:
        raise InputError(path, f"plant.parameters.{error.field}", error.found, error.expected) from error


def _array(value: list[Any], shape: tuple[int, ...], path: str | Path, field: str) -> FloatArray:
    rows = {len(row) for row in value} if len(shape) == 2 else set()
    found = (len(value), *rows) if len(rows) <= 1 else None
    if found != shape:
        text = "rows of unequal length" if found is None else f"shape {found}"
        raise InputError(path, field, text, f"shape {shape}")
    return np.array(value, dtype=float)


def _names(signals: tuple[Signal, ...]) -> str:
    return " ".join(f"{s.name} [{s.unit}]" for s in signals) or "nothing"


def _plain(value: Any) -> Any:
    """Tables, lists, numbers and nulls for empty lists; no negative zeros, which some readers of JSON may lose."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list):
        return [_plain(entry) for entry in value] or None
    return value + 0.0 if isinstance(value, float) else value

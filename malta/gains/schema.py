"""The tables of a gain file, as pydantic checks them. What they mean stands in file.py."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, StrictInt, StrictStr

from malta.synthesis.controller import Tracks
from malta.synthesis.spec import Coordinates
from malta.tables import Finite, Quantity, Record

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


class _Matrices(Record):
    A: Matrix
    B: Matrix
    C: Matrix


class LinearTable(Record):
    states: _Signals
    inputs: _Signals
    outputs: _Signals
    matrices: _Matrices
    terms: dict[StrictStr, _Matrices] | None
    limit: Vector | None
    noise: Vector
    dead_time: Finite


class PlantTable(Record):
    name: StrictStr
    preset: StrictStr
    parameters: dict[StrictStr, Quantity] | None
    linear: LinearTable | None = None


class _Law(Record):
    tracks: Tracks
    coordinates: Coordinates = "signals"
    pause: Vector | None = None


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
    correlation: Vector | None = None


class _Feedforward(Record):
    inertia: Vector
    speed: Matrix
    rate: Matrix | None
    z_grid: Vector
    v0: Matrix
    position: Matrix | None = None


class _CurrentLoop(Record):
    Kp: Annotated[Finite, Field(gt=0)]
    Ki: Annotated[Finite, Field(gt=0)]
    sample_time: Annotated[Finite, Field(gt=0)]


class _Commutation(Record):
    lead: Annotated[Finite, Field(gt=0)]
    pull: Matrix


class _Limits(Record):
    current: Vector | None
    voltage: Vector | None
    force: Vector | None


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
    version: StrictInt
    design: _Design
    plant: PlantTable
    operating_point: _OperatingPoint
    sample_time: Annotated[Finite, Field(gt=0)]
    law: _Law | None = None
    signals: _SignalTable
    model: _Model
    gains: _Gains
    cost: _Cost | None
    noise: _Noise | None
    feedforward: _Feedforward
    current_loop: _CurrentLoop | None
    commutation: _Commutation | None = None
    limits: _Limits
    verification: _Verification
    provenance: _Provenance
    sha256: StrictStr

"""The tables of a design file, as pydantic checks them: keys, kinds and ranges. Units are converted by design_file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, StrictBool, StrictInt, StrictStr, create_model

from malta.synthesis.recovery import RecoveryTable
from malta.synthesis.requirements import Requirement
from malta.synthesis.spec import Coordinates, Discretization, PidAxes, Place
from malta.tables import Finite, Quantity, Record, validate


def _table_or_SI(value: Any) -> Any:
    if isinstance(value, str) and value != "SI":
        raise ValueError('a table of quantities, or "SI"')
    return None if value == "SI" else value


_Bases = Annotated[dict[StrictStr, Quantity] | None, BeforeValidator(_table_or_SI)]


class WeightsTable(Record):
    """[weights]: dimensionless, by the names of states, inputs and outputs."""

    state: dict[StrictStr, Finite]
    input: dict[StrictStr, Finite]
    integral: dict[StrictStr, Finite]


class BasesTable(Record):
    """[bases]: what a weight of 1 is worth, or "SI" for one SI unit each."""

    state: _Bases
    input: _Bases
    integral: _Bases


class NoiseTable(Record):
    """[noise]: of one sample, as standard deviations or variances; correlations of positions with accelerations."""

    process: dict[StrictStr, Quantity]
    correlation: dict[StrictStr, Annotated[Finite, Field(gt=-1, lt=1)]] | None = None
    sensor: dict[StrictStr, Quantity]
    drift: dict[StrictStr, Quantity] | None = None


class PidTable(Record):
    """[pid]: gains by axis, and the time constant of the measured rates: one of all, or one of each axis."""

    axes: PidAxes | None = None
    Kp: dict[StrictStr, Quantity]
    Ki: dict[StrictStr, Quantity]
    Kd: dict[StrictStr, Quantity]
    filter: Quantity | None = None
    filters: dict[StrictStr, Quantity] | None = None


class CostTable(Record):
    """[cost]: the loads that a PID is judged by."""

    load: dict[StrictStr, Quantity]
    force_noise: dict[StrictStr, Quantity] | None = None
    sensor_noise: dict[StrictStr, Quantity] | None = None


class Range(Record):
    """An entry of [search.numbers]: one number, and the entries of the file that share it."""

    vary: Annotated[list[StrictStr], Field(min_length=1)]
    low: Annotated[Finite, Field(gt=0)]
    high: Annotated[Finite, Field(gt=0)]
    unit: StrictStr = "1"


class SearchTable(Record):
    """[search]: what `malta tune` may vary."""

    delay: list[Annotated[StrictInt, Field(ge=0, le=10)]] = Field(default_factory=list)
    numbers: dict[StrictStr, Range]


class DesignFile(Record):
    """A design file; [specification] is checked once the machine is known, see `specification_table`."""

    name: Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    summary: StrictStr
    machine: StrictStr
    preset: StrictStr
    sample_time: Quantity
    discretization: Discretization = "sampled-data"
    delay: Annotated[StrictInt, Field(ge=0, le=10)] = 0
    current_loop_delay: StrictBool
    current_lag: StrictBool = False
    coordinates: Coordinates = "signals"
    position_feedforward: StrictBool = False
    pause: dict[StrictStr, Quantity] | None = None
    commutation: Place = "measured"
    operating_point: dict[StrictStr, Quantity]
    weights: WeightsTable | None = None
    bases: BasesTable | None = None
    noise: NoiseTable | None = None
    pid: PidTable | None = None
    uncertainty: dict[StrictStr, Annotated[Finite, Field(gt=0, lt=1)]]
    cost: CostTable | None = None
    specification: dict[StrictStr, Any] | None = None
    search: SearchTable | None = None


def specification_table(requirements: Iterable[Requirement], given: Mapping[str, Any], path: Path) -> Record:
    """Check [specification] against a schema that is made of the requirements: one optional key for each.

    Raises InputError for an unknown key, another kind of value, or a number out of range.
    """
    keys: dict[str, Any] = {r.name: (_kind(r) | None, None) for r in requirements}
    table = create_model("Specification", __base__=Record, **keys)
    whole = create_model("DesignFile", __base__=Record, specification=(table, ...))
    checked: Any = validate(whole, {"specification": given}, path)
    found: Record = checked.specification
    return found


def _kind(requirement: Requirement) -> Any:
    """What stands in the file behind the key of a requirement."""
    if requirement.form == "switch":
        return StrictBool
    if requirement.form == "loads":
        return dict[StrictStr, RecoveryTable]
    if requirement.form in ("outputs", "inputs"):
        return dict[StrictStr, Quantity]
    if requirement.unit == "1":
        return Annotated[Finite, Field(gt=requirement.above)]
    return Quantity

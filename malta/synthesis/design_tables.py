"""The tables of a design file, as pydantic checks them: keys, kinds and ranges. Units are converted by design_file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, StrictStr, create_model

from malta.errors import InputError
from malta.linear.sampling import whole_or_not
from malta.model.signals import Coordinates
from malta.synthesis.recovery import RecoveryTable
from malta.synthesis.requirements import Requirement
from malta.synthesis.spec import Discretization, PidAxes, Place
from malta.tables import Finite, Positive, Quantity, Record, entry, validate


def _table_or_SI(value: Any) -> Any:
    if isinstance(value, str) and value != "SI":
        raise ValueError('a table of quantities, or "SI"')
    return None if value == "SI" else value


Bases = Annotated[
    dict[StrictStr, Quantity] | None,
    BeforeValidator(_table_or_SI, json_schema_input_type=dict[StrictStr, Quantity] | Literal["SI"]),
]


class WeightsTable(Record):
    """[weights]: dimensionless, by the names of states, inputs and outputs."""

    state: dict[StrictStr, Finite] = entry("by state, at least 0", "1")
    input: dict[StrictStr, Finite] = entry("by input, above 0", "1")
    integral: dict[StrictStr, Finite] = entry(
        "by output, or by position, at least 0; 0: no integral, as of outputs that a machine with fewer inputs leaves "
        "out",
        "1",
    )


class BasesTable(Record):
    """[bases]: what a weight of 1 is worth, or "SI" for one SI unit each."""

    state: Bases = entry("by state")
    input: Bases = entry("by input")
    integral: Bases = entry("by output, or by position, times s")


class NoiseTable(Record):
    """[noise]: of one sample, as standard deviations or variances; correlations of positions with accelerations."""

    process: dict[StrictStr, Quantity] = entry("by input, a force; or by position, an acceleration")
    correlation: dict[StrictStr, Annotated[Finite, Field(gt=-1, lt=1)]] | None = entry(
        "by position, of its noise with the acceleration before", "1", default=None
    )
    sensor: dict[StrictStr, Quantity] = entry("by output")
    drift: dict[StrictStr, Quantity] | None = entry(
        "by input or by position: how far a constant disturbance goes in a sample; the filter observes it",
        default=None,
    )


class PidTable(Record):
    """[pid]: gains by axis, and the time constant of the measured rates: one of all, or one of each axis."""

    axes: PidAxes | None = entry("what an axis is; without it, an output with its input", default=None)
    Kp: dict[StrictStr, Quantity] = entry("proportional gains, by input")
    Ki: dict[StrictStr, Quantity] = entry("integral gains, by input")
    Kd: dict[StrictStr, Quantity] = entry("derivative gains, by input")
    filter: Quantity | None = entry("time constant of all measured rates; this or filters", default=None)
    filters: dict[StrictStr, Quantity] | None = entry("time constants by input; this or filter", default=None)


Numbers = dict[StrictStr, Quantity]
Signals = Annotated[list[StrictStr], Field(min_length=1)]
Coefficients = Annotated[list[Finite], Field(min_length=1, max_length=30)]


class ElementTable(Record):
    """[structure.elements.NAME]: numbers at which a search starts; the kind says which."""

    kind: Literal["gain", "pid", "lead", "notch", "transfer", "lqg"] = entry("what the element is")
    value: Quantity | None = entry("of a gain", default=None)
    Kp: Quantity | None = entry("of a pid", default=None)
    Ki: Quantity | None = entry("of a pid; without it, none", default=None)
    Kd: Quantity | None = entry("of a pid; without it, none", default=None)
    filter: Quantity | None = entry("time constant of the rate of a pid with Kd", default=None)
    zero: Quantity | None = entry("of a lead", "rad/s", default=None)
    pole: Quantity | None = entry("of a lead", "rad/s", default=None)
    frequency: Quantity | None = entry("of a notch", "rad/s", default=None)
    depth: Positive | None = entry("damping ratio of the zeros of a notch", "1", default=None)
    damping: Positive | None = entry("damping ratio of the poles of a notch", "1", default=None)
    numerator: Coefficients | None = entry("of a transfer, highest power first, SI", default=None)
    denominator: Coefficients | None = entry("of a transfer, highest power first, SI", default=None)
    state: Numbers | None = entry("of an lqg: a state weighs (x / this)^2; without an entry, 0", default=None)
    integral: Numbers | None = entry(
        "of an lqg: the integral of an error weighs (s / this)^2; else none", default=None
    )
    input: Numbers | None = entry("of an lqg: an input weighs (u / this)^2", default=None)
    process: Numbers | None = entry("of an lqg: standard deviations of noise, by input", default=None)
    sensor: Numbers | None = entry("of an lqg: standard deviations of noise, by output", default=None)
    low: Numbers = entry(
        'smallest values of some of these numbers; of an lqg by "state.x" and so on', default={}
    )
    high: Numbers = entry("largest values", default={})


class StructureTable(Record):
    """[structure]: a law of named elements, in place of weights, bases and noise, or of [pid]."""

    axes: PidAxes | None = entry("what an axis is; without it, an output with its input", default=None)
    law: dict[StrictStr, list[StrictStr]] = entry(
        'by output, or by position: elements, one behind the other; an lqg under "all"'
    )
    elements: dict[Annotated[StrictStr, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")], ElementTable] = entry(
        "elements by a name of your choice"
    )


class WeightTable(Record):
    """A stable transfer function, coefficients in SI, the highest power first."""

    numerator: Coefficients = entry("coefficients", "1")
    denominator: Coefficients = entry("coefficients", "1")


class GoalTable(Record):
    """[goals.NAME]: what the law is tuned for beside [specification]; the kind says which entries there are."""

    kind: Literal[
        "sensitivity", "disk_margin", "gain_limit", "noise_limit", "tracking", "poles", "stable_law"
    ] = entry("a goal of malta.structured")
    soft: StrictBool = entry("whether it is made as small as hard goals allow", default=False)
    peak: Annotated[Finite, Field(gt=1)] | None = entry("of a sensitivity or tracking", "1", default=None)
    least: Annotated[Finite, Field(gt=0, lt=2)] | None = entry("of a disk_margin", "1", default=None)
    at: Literal["sensors", "forces"] | None = entry("where a sensitivity or disk is measured", default=None)
    channels: Signals | None = entry("outputs, or inputs at forces; without it, all", default=None)
    inputs: Signals | None = entry('of a gain_limit, as "load fx_B1"', default=None)
    outputs: Signals | None = entry('of a gain_limit or noise_limit, as "output x1"', default=None)
    limit: Quantity | None = entry("of a gain, outputs over inputs, or of noise, rms", default=None)
    weight: WeightTable | None = entry("in front of a gain", default=None)
    levels: Numbers | None = entry(
        "of noise by input, of one sample; without it, of the sensors", default=None
    )
    time: Quantity | None = entry("of tracking", "s", default=None)
    steady: Positive | None = entry("|S| at rest, of tracking", "1", default=None)
    decay: Quantity | None = entry("least decay of poles", "1/s", default=None)
    damping: Annotated[Finite, Field(ge=0, lt=1)] | None = entry("least damping of poles", "1", default=None)
    fastest: Quantity | None = entry("largest size of poles", "rad/s", default=None)


class CostTable(Record):
    """[cost]: the loads that a PID is judged by."""

    load: dict[StrictStr, Quantity] = entry("constant force on each input, one at a time")
    force_noise: dict[StrictStr, Quantity] | None = entry("rms by input; without it, none", default=None)
    sensor_noise: dict[StrictStr, Quantity] | None = entry(
        "rms by output; without it, that of the machine", default=None
    )


class ReferencesTable(Record):
    """[references]: limits of what may be asked of the machine, by output; by default those of the machine."""

    position: dict[StrictStr, Quantity] | None = entry("largest reference, either way", default=None)
    speed: dict[StrictStr, Quantity] | None = entry("its largest rate", default=None)
    acceleration: dict[StrictStr, Quantity] | None = entry("its largest acceleration", default=None)


class ScheduleTable(Record):
    """[schedule]: the law is designed at places of an output and interpolated between them."""

    variable: StrictStr = entry("output whose reference chooses the matrices of the law")
    places: Annotated[list[Finite], Field(min_length=2, max_length=20)] = entry(
        "rising places of the output, at each of which the machine is linearized, in the unit beside them"
    )
    unit: StrictStr = entry("unit of the places")


class Range(Record):
    """An entry of [search.numbers]: one number, and the entries of the file that share it."""

    vary: Annotated[list[StrictStr], Field(min_length=1)] = entry('entries of the file, as "bases.state.x"')
    low: Positive = entry("smallest value, in the unit beside it")
    high: Positive = entry("largest value")
    unit: StrictStr = entry("unit of low and high", default="1")


Delay = Annotated[Finite, Field(ge=0, le=10), AfterValidator(whole_or_not)]


class SearchTable(Record):
    """[search]: what `malta tune` may vary."""

    delay: list[Delay] = entry("delays to choose from; without it, that of the design", "samples", default=[])
    numbers: dict[StrictStr, Range] = entry("numbers by a name of your choice")


class DesignFile(Record):
    """A design file; [specification] is checked once the machine is known, see `specification_table`."""

    name: Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] = entry(
        "name of the design and of its gain files"
    )
    summary: StrictStr = entry("one sentence on the design")
    machine: StrictStr = entry("path of the machine's data file, from this file")
    preset: StrictStr = entry('preset of the data file; "data" where it has none')
    sample_time: Quantity = entry("control period, a time")
    discretization: Discretization = entry("of the design model; of an LQG", default="sampled-data")
    delay: Delay = entry("between measurement and force in the design model; of an LQG", "samples", default=0)
    current_loop_delay: StrictBool = entry("whether current loops are designed with the machine's dead time")
    current_lag: StrictBool = entry(
        "whether the lag of the current loops is in the design model", default=False
    )
    coordinates: Coordinates = entry(
        "of integrals and process noise: outputs and inputs, or positions and accelerations",
        default="signals",
    )
    position_feedforward: StrictBool = entry(
        "whether the forces that hold the machine at its reference are fed forward", default=False
    )
    inertia_feedforward: Annotated[Finite, Field(ge=0, le=10)] = entry(
        "multiple of the machine's inertia that is fed forward along the reference", "1", default=1.0
    )
    pause: dict[StrictStr, Quantity] | None = entry(
        "by output: rate of the reference above which the sum of its errors waits", default=None
    )
    braking: dict[StrictStr, Quantity] | None = entry(
        "by output: deceleration at which the law brakes from errors that are too large to brake in proportion",
        default=None,
    )
    references: ReferencesTable | None = entry(
        "limits of what may be asked of the machine, which exported controllers obey", default=None
    )
    commutation: Place = entry("position for which currents are commutated", default="measured")
    operating_point: dict[StrictStr, Quantity] = entry("states by name; the others are zero")
    weights: WeightsTable | None = entry("weights of an LQG", default=None)
    bases: BasesTable | None = entry("what a weight of 1 is worth", default=None)
    noise: NoiseTable | None = entry("noise of one sample that the filter expects", default=None)
    pid: PidTable | None = entry("gains of a PID, in place of weights, bases and noise", default=None)
    structure: StructureTable | None = entry("a law of named elements, in place of both", default=None)
    goals: dict[StrictStr, GoalTable] | None = entry("what a law of [structure] is tuned for", default=None)
    schedule: ScheduleTable | None = entry("places of an output at which a law is designed", default=None)
    uncertainty: dict[StrictStr, Annotated[Finite, Field(gt=0, lt=1)]] = entry(
        "by parameter: half width of the box of the margin, relative", "1"
    )
    cost: CostTable | None = entry("loads that a PID is judged by", default=None)
    specification: dict[StrictStr, Any] | None = entry(
        "requirements by name, which `malta tune` is to reach and `malta tune --check` measures", default=None
    )
    search: SearchTable | None = entry("what `malta tune` may vary", default=None)


def specification_table(requirements: Iterable[Requirement], given: Mapping[str, Any], path: Path) -> Record:
    """Check [specification] against a schema that is made of the requirements: one optional key for each.

    Raises InputError for an unknown key, another kind of value, or a number out of range.
    """
    checked: Any = validate(_specification_document(tuple(requirements)), {"specification": given}, path)
    found: Record = checked.specification
    return found


# pydantic takes longer to make it than to check with it; requirements compare by identity.
@lru_cache(maxsize=16)
def _specification_document(requirements: tuple[Requirement, ...]) -> type[Record]:
    return create_model(
        "DesignFile", __base__=Record, specification=(specification_record(requirements), ...)
    )


def specification_record(requirements: Iterable[Requirement]) -> type[Record]:
    """Make the table [specification] of some requirements: one optional key for each."""
    keys: dict[str, Any] = {
        r.name: (_kind(r) | None, entry(r.meaning, r.unit.removeprefix("1"), default=None))
        for r in requirements
    }
    return create_model("Specification", __base__=Record, **keys)


# What may stand behind the key of a requirement whose machine is not known.
AnyBound = StrictBool | Positive | Quantity | dict[StrictStr, Quantity] | dict[StrictStr, RecoveryTable]


def _kind(requirement: Requirement) -> Any:
    """What stands in the file behind the key of a requirement."""
    if requirement.form == "switch":
        return StrictBool
    if requirement.form == "loads":
        return dict[StrictStr, RecoveryTable]
    if requirement.form in ("outputs", "inputs", "disturbances"):
        return dict[StrictStr, Quantity]
    if requirement.unit == "1":
        return Annotated[Finite, Field(gt=requirement.above)]
    return Quantity


# References of a design file to published figures: `{ published = "table_II.state" }` -> the numbers.


def with_published(
    node: Any, printed: Callable[[], dict[str, Any]], machine_file: Path, where: Path, field: str = ""
) -> Any:
    """Put the published numbers in the place of every `{ published = "..." }`.

    node : a table of the file, or what is in it
    printed : gives the published figures
    machine_file : the machine's data file, beside which they stand
    where, field : the file and the key that an error names

    Raises InputError for an unknown name, and for an entry that is no number, no quantity and no table of them.
    """
    if isinstance(node, dict):
        if set(node) == {"published"}:
            found: Any = printed()
            tables = {name: table for name, table in found.items() if isinstance(table, dict)}
            known = [*found, *(f"{name}.{key}" for name, table in tables.items() for key in table)]
            for key in str(node["published"]).split("."):
                if not isinstance(found, dict) or key not in found:
                    source = machine_file.parent / "published" / machine_file.name
                    raise InputError(where, field, repr(node["published"]), f"a table of {source}", known)
                found = found[key]
            if not _is_numeric(found):
                expected = "the name of a number, a quantity or a table of them"
                raise InputError(where, field, repr(node["published"]), expected)
            return found
        return {
            k: with_published(v, printed, machine_file, where, f"{field}.{k}".lstrip("."))
            for k, v in node.items()
        }
    return node


def _is_numeric(found: Any) -> bool:
    """Whether a published entry is a number, a quantity, or a table of them."""

    def is_number(value: Any) -> bool:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number or (isinstance(value, dict) and "value" in value)

    return is_number(found) or (isinstance(found, dict) and all(map(is_number, found.values())))

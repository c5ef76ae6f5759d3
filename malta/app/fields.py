"""The numbers of a design that can be moved: what stands in the design file, and the parameters of its machine.

Nothing here knows a machine: names, units and ranges come from the files, the Spec and the fields of Parameters.
A field keeps the unit that its file has.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Protocol, TypeGuard, get_args

from malta.errors import InputError
from malta.model.currents import is_commutated
from malta.synthesis.design_tables import DesignFile
from malta.synthesis.spec import Discretization, Place, Spec
from malta.units import to_si

MACHINE = "machine."  # begins keys of machine parameters; those of the design file are its own
DECADES = 2.0  # of a slider, either way of the file's number
LIMIT = 1e300  # what no number of a design comes near
SPAN = 4.0  # factor, either way, of a machine's parameters and of the sample time

Kind = Literal["log", "linear", "integer", "switch", "choice", "number"]
TITLES = {
    "weights.state": "Weights of the states",
    "weights.input": "Weights of the inputs",
    "weights.integral": "Weights of the integrals",
    "bases.state": "Bases of the states",
    "bases.input": "Bases of the inputs",
    "bases.integral": "Bases of the integrals",
    "noise.process": "Process noise",
    "noise.drift": "Drift of the disturbances",
    "noise.correlation": "Correlations",
    "noise.sensor": "Sensor noise",
    "pid.Kp": "Proportional gains",
    "pid.Ki": "Integral gains",
    "pid.Kd": "Derivative gains",
    "pid.filters": "Filters of the rates",
    "pid": "Filter of the rates",
}


@dataclass(frozen=True)
class PageField:
    """One number, switch or choice, as the page shows it.

    key : of the entry, as "bases.state.x" or "machine.m"
    low, high : of the slider; a field accepts any number that the files accept
    zero : whether 0 is allowed beside a logarithmic slider
    tuning : the name of the [search] number that moves this entry together with `linked`, or of a slider of equal
        numbers where there is no [search]; "": none
    factor : from the unit of that number to the entry's own
    """

    key: str
    group: str
    label: str
    value: float | bool | str
    unit: str = ""
    kind: Kind = "log"
    low: float = 0.0
    high: float = 1.0
    zero: bool = False
    choices: tuple[str, ...] = ()
    tuning: str = ""
    linked: tuple[str, ...] = ()
    factor: float = 1.0
    note: str = ""


class Files(Protocol):
    """What fields are made of: a design file and its machine's data file."""

    @property
    def spec(self) -> Spec: ...
    @property
    def content(self) -> dict[str, Any]: ...
    def expand(self, table: str) -> dict[str, Any]: ...
    def machine_entry(self, name: str) -> dict[str, Any] | None: ...


def fields_of(files: Files) -> tuple[PageField, ...]:
    """All fields of a design, in the order of its file; the machine's parameters come last."""
    law = tuple(_law_fields(files))
    return (
        *(law if files.spec.search else _with_sliders(law, files)),
        *_asked_fields(files),
        *_sampling_fields(files),
        *_place_fields(files),
        *_machine_fields(files),
    )


def _law_fields(files: Files) -> Iterator[PageField]:
    """Weights, bases, noise, the gains of a PID, and the numbers of elements."""
    variables = {entry: v for v in files.spec.search for entry in v.entries}
    for table in ("weights", "bases", "noise", "pid", "structure"):
        for path, entries in _tables(files.content.get(table, {}), table):
            if table == "structure" and path.endswith((".low", ".high")):  # bounds of a search
                continue
            for name, entry in (files.expand(path) if entries is None else entries).items():
                key = f"{path}.{name}"
                value, unit = (entry["value"], entry["unit"]) if isinstance(entry, Mapping) else (entry, "")
                variable = variables.get(key)
                low, high, kind = _range(value, zero=path.startswith("weights"), share="correlation" in path)
                scale = 1.0
                if variable is not None:
                    si = files.spec.place_of(key)[2]
                    if unit:
                        scale = to_si(1.0, variable.unit, si, "", key) / to_si(1.0, unit, si, "", key)
                    low, high = min(value, variable.low * scale), max(value, variable.high * scale)
                yield PageField(
                    key, _title_of(path), name, value, unit, kind, low, high,
                    zero=path.startswith("weights"),
                    tuning="" if variable is None else variable.name,
                    linked=() if variable is None else variable.entries,
                    factor=scale,
                )  # fmt: skip


def _asked_fields(files: Files) -> Iterator[PageField]:
    """The bounds of [specification] that are one number."""
    for path, entries in _tables(files.content.get("specification", {}), "specification"):
        if path.endswith((".load", ".load_slope")):
            continue
        for name, entry in (entries or {}).items():
            value, unit = (entry["value"], entry["unit"]) if isinstance(entry, Mapping) else (entry, "")
            key = f"{path}.{name}"
            label = key.removeprefix("specification.").replace(".", " ")
            yield PageField(key, "Requirements", label, value, unit, "log", value / SPAN, value * SPAN)


def _title_of(path: str) -> str:
    """The title of a table's entries: that of TITLES, "element radial lead" of [structure.elements.radial_lead]."""
    words = path.removeprefix("structure.elements.").replace("_", " ")
    return TITLES.get(path, path if words == path else f"Element {words}")


def _with_sliders(law: tuple[PageField, ...], files: Files) -> tuple[PageField, ...]:
    """The fields of a law whose file has no [search], with a slider for what most often moves: equal numbers together.

    Of an LQG these are the bases of weighted states and integrals, or the weights where bases stand as "SI", and the
    noise of process and disturbances; of a PID its gains and filters; of a law of [structure] those of its elements.
    """
    weighted = {f.key for f in law if f.key.startswith("weights.") and f.value != 0}
    plain = {
        f"bases.{part}" for part in ("state", "integral") if files.content.get("bases", {}).get(part) == "SI"
    }
    together: dict[tuple[str, str, object], list[PageField]] = {}
    for f in law:
        table, _, name = f.key.rpartition(".")
        part = table.rpartition(".")[2]
        moves = table.startswith(("noise.process", "noise.drift", "pid", "structure"))
        if part in ("state", "integral") and f"weights.{part}.{name}" in weighted:
            moves = table.startswith("weights" if f"bases.{part}" in plain else "bases")
        if moves and f.kind == "log" and f.value:
            together.setdefault((table, f.unit, f.value), []).append(f)
    named: dict[str, PageField] = {}
    for members in together.values():
        names = " ".join(f.label for f in members)
        for f in members:
            linked = tuple(one.key for one in members)
            named[f.key] = replace(f, tuning=f"{f.group[0].lower()}{f.group[1:]}: {names}", linked=linked)
    return tuple(named.get(f.key, f) for f in law)


def _tables(table: Mapping[str, Any], path: str) -> Iterator[tuple[str, Mapping[str, Any] | None]]:
    """The innermost tables of numbers with their paths; None for a table that stands as "SI"."""
    plain = {k: v for k, v in table.items() if is_number(v) or (isinstance(v, Mapping) and "value" in v)}
    if plain:
        yield path, plain
    for name, entry in table.items():
        if entry == "SI":
            yield f"{path}.{name}", None
        elif isinstance(entry, Mapping) and name not in plain:
            yield from _tables(entry, f"{path}.{name}")


def _range(value: float, *, zero: bool, share: bool) -> tuple[float, float, Kind]:
    if share:
        return -0.99, 0.99, "linear"
    if value > 0:
        return value / 10**DECADES, value * 10**DECADES, "log"
    if value == 0 and zero:
        return 1e-3, 1e3, "log"
    return (0.0, 0.0, "number") if value == 0 else (-SPAN * abs(value), SPAN * abs(value), "linear")


def _sampling_fields(files: Files) -> Iterator[PageField]:
    """Sample time, delay, and the switches of the design model."""
    content, group, lqg = files.content, "Sampling", files.spec.kind == "LQG"
    time = content["sample_time"]
    low, high = time["value"] / SPAN, time["value"] * SPAN
    yield PageField("sample_time", group, "sample time", time["value"], time["unit"], "log", low, high)
    defaults = {name: f.default for name, f in DesignFile.model_fields.items()}
    if lqg:
        delay = float(content.get("delay", 0))
        kind: Kind = "integer" if delay.is_integer() else "linear"
        yield PageField("delay", group, "delay in the design model", delay, "samples", kind, 0, 10)
        choices = get_args(Discretization)
        yield PageField(
            "discretization",
            group,
            "discretization",
            content["discretization"],
            kind="choice",
            choices=choices,
        )
    switches = {
        "current_loop_delay": "dead time in the current loops",
        "position_feedforward": "position feedforward",
    }
    if lqg and math.isfinite(files.spec.plant.actuator.crossover):
        switches["current_lag"] = "current lag in the design model"
    if not files.spec.plant.second_order:
        del switches["position_feedforward"]
    for key, label in switches.items():
        yield PageField(key, group, label, bool(content.get(key, defaults[key])), kind="switch")
    if is_commutated(files.spec.plant):
        place = content.get("commutation", defaults["commutation"])
        yield PageField(
            "commutation", group, "place of commutation", place, kind="choice", choices=get_args(Place)
        )


def _place_fields(files: Files) -> Iterator[PageField]:
    """The operating point and the box of the uncertainty."""
    plant, content = files.spec.plant, files.content
    for name, q in content["operating_point"].items():
        reach = 2 * abs(q["value"]) or 1.0
        if name == plant.stroke.name:
            reach = plant.stroke.travel / to_si(1.0, q["unit"], "m", "", name)
        yield PageField(
            f"operating_point.{name}", "Operating point", name, q["value"], q["unit"], "linear", -reach, reach
        )
    for name, share in content["uncertainty"].items():
        note = f"share of {name}, either way, at a margin of 100 %"
        yield PageField(
            f"uncertainty.{name}", "Uncertainty box", f"{name} ±", share, "", "log", 0.005, 0.9, note=note
        )


def _machine_fields(files: Files) -> Iterator[PageField]:
    """The parameters of the machine in the units of its data file, with their sources as notes."""
    par = files.spec.parameters
    for f in fields(par):
        if "unit" not in f.metadata:
            continue
        entry, si = files.machine_entry(f.name), f.metadata["unit"]
        unit, note = (entry["unit"], f"{entry['tag']}: {entry['source']}") if entry else (si, "default")
        value = entry["value"] if entry else getattr(par, f.name)
        scale = to_si(1.0, unit, si, files.spec.machine_file, f.name)
        low, high, kind = _machine_range(value, f.metadata, scale)
        yield PageField(
            MACHINE + f.name,
            "Machine",
            f.name,
            value,
            "" if unit == "1" else unit,
            kind,
            low,
            high,
            note=note,
        )


def _machine_range(value: float, declared: Mapping[str, Any], scale: float) -> tuple[float, float, Kind]:
    """A slider within the limits of a parameter; a whole number that shapes the model, and 0, have none."""
    if declared.get("shapes") or value == 0:
        return 0.0, 0.0, "number"
    low, high = sorted((value / SPAN, value * SPAN)) if value > 0 else (SPAN * value, -SPAN * value)
    least = declared.get("at_least") if declared.get("above") is None else declared.get("above")
    below = declared.get("below")
    low = low if least is None else max(low, least / scale)
    high = high if below is None else min(high, below / scale)
    return (low, high, "log") if value > 0 and low > 0 else (low, high, "linear")


def check_value(field: PageField, value: object, where: str) -> float | int | bool | str:
    """Return a value that a client sent for a field. Raises InputError for another kind of value."""
    if field.kind == "switch" and isinstance(value, bool):
        return value
    if field.kind == "choice" and isinstance(value, str):
        return value
    if field.kind not in ("switch", "choice") and is_number(value):
        number = float(value)
        if field.kind == "integer" and number.is_integer():
            return int(number)
        if field.kind != "integer":
            return number
    expected = {"switch": "true or false", "choice": "one of its words", "integer": "a whole number"}
    raise InputError(where, field.key, repr(value), expected.get(field.kind, "a finite number"))


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a number that a float can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LIMIT < value < LIMIT

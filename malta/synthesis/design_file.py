"""Design files: design/NAME.toml -> read_design() -> Spec, with the uncertainty box that its gain file bears.

Wherever numbers are expected, `{ published = "table_II.state" }` stands for what the machine's paper prints under that
name in data/published/. What `malta tune` is to reach and what it may vary stand in [specification] and [search], and
what it makes small for a PID in [cost]; they shape no gains by themselves.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError, relocate_errors, require_known
from malta.files import locate
from malta.model.data import read
from malta.model.parameters import units_of
from malta.model.plant import Parameters, Plant, Signal
from malta.model.plants import plant_of
from malta.model.printed import read_published
from malta.synthesis.design_tables import (
    BasesTable,
    DesignFile,
    PidTable,
    ReferencesTable,
    ScheduleTable,
    SearchTable,
    WeightsTable,
    specification_table,
    with_published,
)
from malta.synthesis.recovery import (
    RecoveryBound,
    bases,
    numbers,
    order_entries,
    positive,
    quantities,
    recovery_bounds,
    variances,
)
from malta.synthesis.requirements import Requirement, requirements_for
from malta.synthesis.spec import (
    Loads,
    Pid,
    PidAxes,
    Spec,
    StructuredLaw,
    Variable,
    integral_signals,
    pid_signals,
    process_signals,
)
from malta.synthesis.structure import read_structure
from malta.synthesis.weighting import Weights
from malta.tables import Quantity, load_toml, validate
from malta.units import to_si


def read_design(
    path: str | Path, parameters: Mapping[str, float] | None = None, entries: Mapping[str, Any] | None = None
) -> Spec:
    """Read a design file, and the data of the machine that it names.

    path : the design file, as design/table2.toml
    parameters : values of the machine's parameters that differ from its data file, SI
    entries : entries of the design file that differ from it, by dotted name, as {"bases.state.x": {"value": 50,
        "unit": "um"}}

    Returns a Spec, in SI.

    Raises InputError, naming file and field, for anything missing, unknown, of a wrong unit or out of range.

    >>> import malta
    >>> spec = malta.read_design("design/calibrated.toml", {"m": 0.4})
    >>> spec.name, spec.sample_time, spec.plant.name, spec.parameters.m
    ('calibrated', 5e-05, 'tubular', 0.4)
    """
    path = locate(path)
    raw = load_toml(path)
    if entries:  # also those within a table that is published
        raw = _with_entries(resolve_published(raw, path), entries, path)
    return spec_of(raw, path, parameters or None)


def machine_file_of(raw: Mapping[str, Any], path: Path) -> Path:
    """The data file that the content of a design file names. Raises InputError where it names none."""
    machine = raw.get("machine")
    if not isinstance(machine, str):
        found = "nothing" if machine is None else repr(machine)
        raise InputError(path, "machine", found, "the path of the machine's data file")
    return Path(os.path.normpath(path.parent / machine))


def resolve_published(raw: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The content of a design file with the published numbers in the place of every `{ published = "..." }`.

    Raises InputError for a reference to what is not published.
    """
    machine_file = machine_file_of(raw, path)
    printed = cache(partial(read_published, machine_file))  # read once, and only where something refers to it
    found: dict[str, Any] = with_published(raw, printed, machine_file, path)
    return found


def spec_of(
    raw: Mapping[str, Any], path: Path, parameters: Parameters | Mapping[str, float] | None = None
) -> Spec:
    """Check the content of a design file, as TOML gives it.

    path : the file, which errors name and relative paths start at
    parameters : of the machine, in place of those in its data file, or values that differ from it; None: the file's

    Raises InputError as `read_design`.
    """
    machine_file = machine_file_of(raw, path)
    content = validate(DesignFile, resolve_published(raw, path), path)
    _require_law(content, raw, path)
    if isinstance(parameters, Mapping):
        par = read(machine_file, content.preset)
        par = replace(par, **parameters, preset=f"{par.preset}, changed")
    else:
        par = read(machine_file, content.preset) if parameters is None else parameters
    try:
        plant = plant_of(par)
    except CheckError as error:
        raise InputError(path, "preset", str(error), "a machine that can be controlled") from error
    require_known(content.uncertainty, units_of(par), path, "uncertainty.{}", "an unknown parameter")
    for name, share in content.uncertainty.items():
        if getattr(par, name) == 0:
            found = f"a share of {share:g} of its value, which is 0"
            raise InputError(
                path, f"uncertainty.{name}", found, "a parameter that is not 0, or in Python an interval"
            )
    spec = Spec(
        name=content.name,
        summary=content.summary,
        path=path,
        machine_file=machine_file,
        sha256=_fingerprint(content),
        parameters=par,
        operating_point=_operating_point(content.operating_point, plant, path),
        sample_time=_sample_time(content, path),
        discretization=content.discretization,
        delay=content.delay,
        current_loop_delay=content.current_loop_delay,
        current_lag=content.current_lag,
        position_feedforward=content.position_feedforward,
        inertia_feedforward=content.inertia_feedforward,
        pause=_rates(content.pause, plant, path, "pause"),
        braking=_rates(content.braking, plant, path, "braking", " / s^2"),
        references=_references(content.references, plant, path),
        commutation=content.commutation,
        law=_law(content, plant, path),
        schedule=_schedule(content.schedule, plant, path),
        uncertainty=dict(content.uncertainty),
    )
    return replace(
        spec,
        loads=_loads(content, spec),
        **_specification(content, spec),
        **_search(content.search, raw, spec),
    )


LATER_KEYS = (
    "current_lag",
    "coordinates",
    "position_feedforward",
    "inertia_feedforward",
    "commutation",
    "references",
    "structure",
    "schedule",
)  # keys that change no design without them


def _fingerprint(content: DesignFile) -> str:
    """SHA-256 of all that shapes the design."""
    other = {"summary", "machine", "cost", "specification", "search", "goals"}
    other |= {name for name in LATER_KEYS if getattr(content, name) == DesignFile.model_fields[name].default}
    shaping = json.dumps(content.model_dump(exclude=other, exclude_none=True), sort_keys=True)
    return hashlib.sha256(shaping.encode()).hexdigest()


def _rates(
    given: Mapping[str, Quantity] | None, plant: Plant, path: Path, key: str, per: str = " / s"
) -> tuple[float, ...]:
    """Positive numbers of the outputs, as rates above which sums of errors wait; 0 where one is not given."""
    if given is None:
        return ()
    units = {s.name: f"{s.unit}{per}" for s in plant.outputs}
    rates = {
        name: positive(rate, path, f"{key}.{name}", units[name])
        for name, rate in quantities(given, units, path, key, "output").items()
    }
    return tuple(rates.get(name, 0.0) for name in units)


def _references(given: ReferencesTable | None, plant: Plant, path: Path) -> tuple[tuple[float, ...], ...]:
    """Limits of positions, speeds and accelerations of references, of each output; 0 where one is not given."""
    if given is None:
        return ()
    limits = (
        ("position", given.position, ""),
        ("speed", given.speed, " / s"),
        ("acceleration", given.acceleration, " / s^2"),
    )
    return tuple(_rates(of or {}, plant, path, f"references.{key}", per) for key, of, per in limits)


def _schedule(given: ScheduleTable | None, plant: Plant, path: Path) -> tuple[str, tuple[float, ...]] | None:
    """The output and the places of a schedule, SI; None without one."""
    if given is None:
        return None
    units = {s.name: s.unit for s in plant.outputs}
    require_known([given.variable], units, path, "schedule.variable")
    unit = units[given.variable]
    places = [to_si(place, given.unit, unit, path, "schedule.places") for place in given.places]
    if not all(a < b for a, b in pairwise(places)):
        raise InputError(path, "schedule.places", str(given.places), "places that rise")
    return given.variable, tuple(places)


def _sample_time(content: DesignFile, path: Path) -> float:
    """In s. InputError for none, and for a delay that the discretization does not know."""
    Ts = to_si(content.sample_time.value, content.sample_time.unit, "s", path, "sample_time")
    if not Ts > 0:
        raise InputError(path, "sample_time", f"{Ts:g} s", "more than 0 s")
    if content.delay and content.discretization == "backward-euler":
        found = f"{content.delay} with backward-euler, which has none"
        raise InputError(path, "delay", found, "0, or zoh or sampled-data")
    return Ts


def _law(content: DesignFile, plant: Plant, path: Path) -> Weights | Pid | StructuredLaw:
    with relocate_errors(path):  # the record does not know the file
        if content.structure is not None:
            Ts = _sample_time(content, path)
            return read_structure(content.structure, content.goals or {}, plant, Ts, path)
        return _weights(content, plant, path) if content.pid is None else _pid(content.pid, plant, path)


LQG = ("discretization", "delay", "weights", "bases", "noise")
LQG_ONLY_KEYS = (*LQG, "current_lag", "coordinates")
EXCLUDED_TABLES = {
    "pid": (),
    "structure": ("pid", "cost", "search", "pause", "braking", "commutation", "schedule"),
}


def _require_law(content: DesignFile, raw: Mapping[str, Any], path: Path) -> None:
    """InputError unless the file describes an LQG, a PID or a law of a given structure, whole and alone."""
    other = next((name for name in ("structure", "pid") if getattr(content, name) is not None), None)
    if other is None:
        missing = next((name for name in LQG if name not in raw), None)
        if missing is not None:
            raise InputError(path, missing, "nothing", "this key")
    for name in () if other is None else (*LQG_ONLY_KEYS, *EXCLUDED_TABLES[other]):
        if name in raw:
            expected = "one of them: an LQG, a PID, or a law of a given structure"
            raise InputError(path, name, f"this key beside [{other}]", expected)
    if content.schedule is not None and content.search is not None:
        raise InputError(
            path, "search", "this table beside [schedule]", "one of them: no search is scheduled"
        )
    if content.goals is not None and other != "structure":
        raise InputError(
            path, "goals", "this table without [structure]", "[specification], or a law of [structure]"
        )
    if other == "structure" and not content.current_loop_delay:
        raise InputError(
            path, "current_loop_delay", "false beside [structure]", "true: such a law is tuned with it"
        )


def _weights(content: DesignFile, plant: Plant, path: Path) -> Weights:
    states, inputs, outputs = plant.design_states, plant.inputs, plant.outputs
    in_positions = content.coordinates == "positions"
    if in_positions:
        plant.require_second_order("coordinates")
    integrals = integral_signals(plant, content.coordinates)
    forces = process_signals(plant, content.coordinates)
    each = "positions" if in_positions else "measured signals"
    q, base, noise = content.weights, content.bases, content.noise
    assert q is not None
    assert base is not None
    assert noise is not None
    if len(outputs) > len(inputs) and not in_positions:  # not all of them can be held
        q, base = _with_free_outputs(q, base, integrals)
    given: dict[str, Any] = {}
    if noise.drift is not None:
        given["drift_variance"] = variances(
            noise.drift, forces, path, "noise.drift", "positions" if in_positions else "inputs"
        )
    if noise.correlation is not None:
        if not in_positions:
            raise InputError(
                path, "noise.correlation", "this table", 'it with coordinates = "positions" alone'
            )
        given["correlation"] = np.array(
            order_entries(noise.correlation, forces, path, "noise.correlation", "positions"), dtype=float
        )
    return Weights(
        q=numbers(q.state, states, path, "weights.state", "states"),
        q_base=bases(base.state, states, path, "bases.state", "states"),
        r=numbers(q.input, inputs, path, "weights.input", "inputs", above=True),
        r_base=bases(base.input, inputs, path, "bases.input", "inputs"),
        q_i=numbers(q.integral, integrals, path, "weights.integral", each),
        q_i_base=bases(base.integral, integrals, path, "bases.integral", each),
        process_variance=variances(
            noise.process, forces, path, "noise.process", "positions" if in_positions else "inputs"
        ),
        sensor_variance=variances(noise.sensor, outputs, path, "noise.sensor", "measured signals"),
        coordinates=content.coordinates,
        **given,
    )


def _with_free_outputs(
    q: WeightsTable, base: BasesTable, integrals: Sequence[Signal]
) -> tuple[WeightsTable, BasesTable]:
    """The tables with a weight of 0 for each integral that is left out, on a base of 1 where that is left out too."""
    unit = {s.name: Quantity(value=1.0, unit=s.unit) for s in integrals if not q.integral.get(s.name)}
    weights = {s.name: 0.0 for s in integrals} | q.integral
    given = None if base.integral is None else unit | base.integral
    return q.model_copy(update={"integral": weights}), base.model_copy(update={"integral": given})


def _pid(table: PidTable, plant: Plant, path: Path) -> Pid:
    axes: PidAxes = table.axes or "decentralized"
    gains = {}
    for name, signals in pid_signals(plant, axes).items():
        given = getattr(table, name)
        if given is None:
            continue
        entries = order_entries(given, signals, path, f"pid.{name}", "axes" if table.axes else "inputs")
        gains[name] = np.array(
            [
                to_si(q.value, q.unit, s.unit, path, f"pid.{name}.{s.name}")
                for q, s in zip(entries, signals, strict=True)
            ]
        )
    if (table.filter is None) == (table.filters is None):
        found = "nothing" if table.filter is None else "this key beside [pid.filters]"
        raise InputError(path, "pid.filter", found, "one time of all axes, or [pid.filters] with one of each")
    times = gains.pop("filters", None)
    if table.filter is not None:
        times = np.array(to_si(table.filter.value, table.filter.unit, "s", path, "pid.filter"))
    assert times is not None
    return Pid(**gains, filter=times, axes=axes)


def _loads(content: DesignFile, spec: Spec) -> Loads | None:
    """What a PID is judged by, in SI. Noise that is not given: none of forces, the machine's own of sensors."""
    table, path, plant, terms = content.cost, spec.path, spec.plant, spec.pid
    if table is None:
        return None
    if terms is None:
        raise InputError(
            path, "cost", "this table without [pid]", "the weights of an LQG, which are its cost"
        )
    for signal, gain in zip(pid_signals(plant, terms.axes)["Ki"], terms.Ki, strict=True):
        if not gain:
            expected = "an integral gain, as a constant force leaves an error without one"
            raise InputError(path, "cost.load", f"pid.Ki.{signal.name} of 0", expected)
    force: FloatArray = np.zeros(len(plant.inputs))
    if table.force_noise is not None:
        force = bases(table.force_noise, plant.inputs, path, "cost.force_noise", "inputs")
    sensor: FloatArray = np.sqrt(np.square(plant.sensors.noise) + np.square(plant.sensors.resolution) / 12)
    if table.sensor_noise is not None:
        sensor = bases(table.sensor_noise, plant.outputs, path, "cost.sensor_noise", "measured signals")
    load = bases(table.load, plant.inputs, path, "cost.load", "inputs")
    return Loads(tuple(load.tolist()), tuple(force.tolist()), tuple(sensor.tolist()))


def _specification(content: DesignFile, spec: Spec) -> dict[str, Any]:
    """What is asked for, in SI, and of which loads.

    InputError for what no design could reach or what contradicts itself.
    """
    table, path = content.specification, spec.path
    if table is None:
        return {}
    known = requirements_for(spec.plant)
    able = {name: r for name, r in known.items() if r.suits(spec.kind)}
    for name in table:
        if name in known and name not in able:
            other = " or ".join(f"an {one}" if one == "LQG" else f"a {one}" for one in known[name].laws)
            raise InputError(path, f"specification.{name}", f"a requirement of {other}", " ".join(able))
        require_known([name], able, path, "specification.{}", "an unknown requirement")
    given = specification_table(able.values(), table, path)
    asked: dict[str, float] = {}
    recovery: dict[str, RecoveryBound] = {}
    for name, requirement in able.items():
        entry = getattr(given, name)
        if requirement.form == "loads":
            bounds = recovery_bounds(entry or {}, spec.plant, path, f"specification.{name}")
            recovery |= {bound.name: bound for bound in bounds}
            asked |= {f"{name} {bound.name}": bound.limit for bound in bounds}
        else:
            asked |= _bounds(requirement, entry, spec)
    if not asked:
        raise InputError(path, "specification", "nothing to reach", "at least one of " + " ".join(able))
    _require_possible(asked, spec)
    return {"specification": asked, "recovery": recovery}


def _bounds(requirement: Requirement, given: Any, spec: Spec) -> dict[str, float]:
    """The bounds of one requirement, in SI, by its name and, where it bounds signals, the signal's."""
    name = requirement.name
    field = f"specification.{name}"
    if given is None or given is False:
        return {}
    if isinstance(given, Quantity):
        si = to_si(given.value, given.unit, requirement.unit, spec.path, field)
        return {name: positive(si, spec.path, field, requirement.unit)}
    if not isinstance(given, Mapping):
        return {name: float(given)}
    units = {s.name: s.unit for s in requirement.signals(spec.plant)}
    return {
        f"{name} {signal}": positive(bound, spec.path, f"{field}.{signal}", units[signal])
        for signal, bound in quantities(given, units, spec.path, field, "signal").items()
    }


def _require_possible(asked: Mapping[str, float], spec: Spec) -> None:
    """InputError for a margin that takes a parameter to zero, and a bandwidth beyond half of sampling."""
    path, margin, bandwidth = spec.path, asked.get("margin"), asked.get("bandwidth")
    if margin is not None:
        if not spec.uncertainty:
            raise InputError(path, "specification.margin", "no uncertainty in the file", "its parameters")
        widest = max(spec.uncertainty, key=lambda name: spec.uncertainty[name])
        most = 1 / spec.uncertainty[widest]
        if margin >= most:
            expected = f"less than {most:g}, where {widest} is zero"
            raise InputError(path, "specification.margin", f"{margin:g}", expected)
    nyquist = math.pi / spec.sample_time
    if bandwidth is not None and bandwidth >= nyquist:
        expected = f"less than half of sampling, {nyquist:.0f}"
        raise InputError(path, "specification.bandwidth", f"{bandwidth:g} rad/s", expected)


def _search(table: SearchTable | None, raw: Mapping[str, Any], spec: Spec) -> dict[str, Any]:
    """Variables and delays. An entry belongs to one variable, and stands in the file as a number of its own."""
    if table is None:
        return {}
    path, seen, variables = spec.path, set[str](), []
    for name, given in table.numbers.items():
        where = f"search.numbers.{name}"
        for entry in given.vary:
            _, _, unit, _ = spec.place_of(entry, f"{where}.vary")
            if unit == "1" and given.unit != "1":
                raise InputError(path, f"{where}.unit", repr(given.unit), f"no unit, as {entry} has none")
            if unit != "1":
                to_si(1.0, given.unit, unit, path, where)
            if not _stands(entry, raw):
                expected = "a number of the file itself, not SI or published"
                raise InputError(path, f"{where}.vary", f"{entry}, which is none", expected)
            if entry in seen:
                raise InputError(path, f"{where}.vary", f"{entry} a second time", "each entry once")
            seen.add(entry)
        if not given.low < given.high:
            raise InputError(path, where, f"{given.low:g} to {given.high:g}", "low below high")
        variables.append(Variable(name, tuple(given.vary), given.low, given.high, given.unit))
    if not variables:
        raise InputError(path, "search.numbers", "nothing to vary", "at least one number")
    if table.delay and spec.pid is not None:
        raise InputError(path, "search.delay", str(table.delay), "none, as a PID has no model of a delay")
    if any(table.delay) and spec.discretization == "backward-euler":
        raise InputError(path, "search.delay", str(table.delay), "0 with backward-euler, which has no delay")
    return {"search": tuple(variables), "delays": tuple(dict.fromkeys(table.delay)) or (spec.delay,)}


def _stands(entry: str, raw: Mapping[str, Any]) -> bool:
    node: Any = raw
    for key in entry.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node is not None and (not isinstance(node, Mapping) or "value" in node)


def _with_entries(content: dict[str, Any], entries: Mapping[str, Any], where: Path) -> dict[str, Any]:
    """Put entries in the place of those with their dotted names. InputError where such a place is no table."""
    changed = deepcopy(content)
    for name, value in entries.items():
        *tables, key = name.split(".")
        node: Any = changed
        for depth, table in enumerate(tables):
            node = node.setdefault(table, {})
            if not isinstance(node, dict):
                raise InputError(
                    where, ".".join(tables[: depth + 1]), repr(node), "a table, to change an entry of"
                )
        node[key] = value
    return changed


def _operating_point(entries: Mapping[str, Quantity], plant: Plant, where: Path) -> dict[str, float]:
    """States of the design model by name; the others are zero."""
    units = {s.name: s.unit for s in plant.design_states}
    values = quantities(entries, units, where, "operating_point", "state")
    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(where, f"operating_point.{name}", str(value), "a finite number")
    return values

"""A design file with [structure]: its goals, and the numbers of its elements that hold them."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from malta.errors import CheckError, InputError, relocate_errors
from malta.loops.noise import noise_variance
from malta.model.linearize import linearize
from malta.structured import goals as kinds
from malta.structured.goals import Goal, noise_limit, sensitivity, soft
from malta.structured.rounds import Tuned, tune
from malta.synthesis.requirements import requirements_for
from malta.synthesis.spec import Spec, StructuredGoal
from malta.synthesis.structure import places_in, with_values
from malta.units import to_si

DIGITS = 6  # of numbers in a design file


@dataclass(frozen=True, eq=False)
class TunedDesign:
    """A design whose numbers hold its goals.

    spec : with these numbers
    tuned : the law, what it reaches and what is proven of it
    """

    spec: Spec
    tuned: Tuned


def tune_design(
    spec: Spec, *, keep: bool = False, starts: int = 1, note: Callable[[str], None] | None = None
) -> TunedDesign:
    """Tune the law of a design file for its [goals] and for its [specification], until the margin is proven.

    Of [specification] these are goals: the margin, the peak sensitivity, and noise of forces and motions at rest.
    Others, as flights, are judged by `malta tune --check`. Goals hold in the middle of the travel and at its ends, and
    at the ends of what proofs cover, as rest and full speed of a rotor. All else is at the design's operating point.

    spec : a design with [structure], from `malta.read_design`
    keep : leave numbers that hold all hard goals, with the proof, as they stand
    starts : of the search, the first from the file's numbers; further ones have fixed seeds
    note : called with what is being done

    Returns the `spec` with the numbers that were found, and `tuned`, what they reach and what is proven of them.

    Raises InputError for another design, one without goals, and a structure that does not stabilize the machine.
    Raises CheckError where no law meets the hard goals, with two that conflict.

    >>> import malta
    >>> spec = malta.read_design("design/structured.toml")
    >>> found = malta.structured.tune_design(spec, keep=True)
    >>> found.spec is spec, found.tuned.closed
    (True, True)
    """
    law, plant = spec.structure, spec.plant
    if law is None:
        raise InputError(spec.path, "structure", "nothing", "this table: elements that can be tuned")
    asked = design_goals(spec)
    if not asked and "margin" not in spec.specification:
        raise InputError(spec.path, "goals", "nothing", "a goal, or a margin in [specification]")
    own = places_in(law, linearize(plant, plant.at(**spec.operating_point)))
    shares = (0.0, 1.0, -1.0) if plant.has_stroke else (None,)
    places = [
        dict(spec.operating_point)
        | ({} if share is None else {plant.stroke.name: share * plant.stroke.travel})
        | dict(zip(plant.over, ends, strict=True))
        for share in shares
        for ends in itertools.product(*plant.over.values())
    ]
    try:
        found = tune(
            plant, own, asked,
            ranges=spec.uncertainty or None, margin=spec.specification.get("margin"),
            sample_time=spec.sample_time, places=places, starts=starts, name=spec.name, keep=keep, note=note,
        )  # fmt: skip
    except InputError as error:
        raise InputError(spec.path, f"structure: {error.field}", error.found, error.expected) from error
    except CheckError as error:
        raise CheckError(f"{spec.path}: {error}") from error
    values = {name: value for place in own for name, value in place.element.values.items()}
    if all(math.isclose(found.values[name], value, rel_tol=1e-12) for name, value in values.items()):
        return TunedDesign(spec, found)
    return TunedDesign(replace(spec, law=with_values(law, found.values)), found)


def design_goals(spec: Spec) -> list[Goal]:
    """The goals of a design: those of [specification] that are figures of its linear loop, then [goals]."""
    plant, found = spec.plant, list[Goal]()
    sensors = {
        f"reference {s.name}": float(level)
        for s, level in zip(plant.outputs, np.sqrt(noise_variance(plant)), strict=True)
        if level > 0
    }
    known = requirements_for(plant)
    for name, bound in spec.specification.items():
        base, _, signal = name.partition(" ")
        if base == "peak_sensitivity":
            found.append(sensitivity(bound))
        requirement = known[base]
        own = {"force": ("force", plant.inputs), "motion": ("output", plant.outputs)}
        if requirement.trade is None or not sensors:
            continue
        kind, signals = own[requirement.trade]
        of = requirement.indices
        names = [signal] if of is None else [signals[k].name for k in of(plant)]
        found += [noise_limit(sensors, f"{kind} {n}", bound, name=f"{base} {n}") for n in names]
    assert spec.structure is not None
    for given in spec.structure.goals:
        with relocate_errors(spec.path, f"goals.{given.name}"):
            goal = _goal(given, sensors)
        found.append(soft(goal) if given.soft else goal)
    return found


def _goal(given: StructuredGoal, sensors: dict[str, float]) -> Goal:
    arguments = dict(given.arguments)
    if given.kind == "noise_limit":
        arguments.setdefault("levels", sensors)
    if "weight" in arguments:
        import control  # imports matplotlib and takes a second: only where it is used

        arguments["weight"] = control.tf(*map(list, arguments["weight"]))
    if given.kind in ("gain_limit", "noise_limit"):
        arguments["name"] = given.name
    made: Goal = getattr(kinds, given.kind)(**arguments)
    return made


def structured_text(spec: Spec, target: Path) -> str:
    """Write the text of a design file with the numbers of a spec, for another folder; all else stays as it stands."""
    document = tomlkit.parse(spec.path.read_text(encoding="utf-8"))
    folder = target.resolve().parent
    document["machine"] = Path(os.path.relpath(spec.machine_file.resolve(), folder)).as_posix()
    tables: Any = document
    assert spec.structure is not None
    for element in spec.structure.elements:
        own = tables["structure"]["elements"][element.name]
        for place, value in element.numbers.items():
            *within, key = place.split(".")  # "state.x" of an LQG
            table = own[within[0]] if within else own
            if isinstance(value, tuple):
                table[key] = [float(f"{v:.{DIGITS}g}") for v in value]
            elif hasattr(table[key], "items"):
                unit = to_si(1.0, table[key]["unit"], element.units[place], spec.path, place)
                table[key]["value"] = tomlkit.value(f"{value / unit:.{DIGITS}g}")
            else:
                table[key] = tomlkit.value(f"{value:.{DIGITS}g}")
    return tomlkit.dumps(document)

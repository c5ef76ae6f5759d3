"""What a certificate claims beside what a gain file says: machine, law, stage, box, travel and loops.

The checker of the proof (malta/checker) imports nothing of malta. Whose loop it is has to come from the gain file,
through the machine's model, which is what is proven: this module rebuilds that, with the code of `malta verify`.
Boxes are compared as exact numbers, loops to the last digit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from malta.bound import at_least
from malta.checker.check import CertificateVerdict, check as prove_again
from malta.checker.file import (
    MAX_NAME_LENGTH,
    Document,
    StabilityClaim,
    StatedLoop,
    StatedOrigin as Named,
    StatedParameter,
    StatedPlaces,
    double,
)
from malta.errors import CheckError, InputError, shorten
from malta.files import locate
from malta.gains.contents import uncertainty_of
from malta.gains.encodings import content_sha256
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.gains.writing import UNCOMPARED_TABLES
from malta.linear.expressions import NotAnalytic, exact
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.windings import LAST_STAGE, CurrentLoops, chosen_loops
from malta.margins.travel import ENDS, extent_of, travel_loops
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.model.printed import published_figures
from malta.proof.box import box_of, sides_of
from malta.proof.certificate import DERIVED_UNIT, LoopOrigin, loops_of, refused_as_input
from malta.proof.margin import Ranges
from malta.synthesis.controller import Controller


def check(
    path: str | Path,
    gains: str | Path | None = None,
    seconds: float = 600.0,
    uncertain: Mapping[str, float | tuple[float, float]] | None = None,
) -> CertificateVerdict:
    """Whether a certificate holds; with `gains`, whether what it claims is of that gain file and its box.

    path : of the certificate
    gains : a gain file, from which loops, box and travel are rebuilt; None: those in the certificate are believed
    seconds : s, the longest check of the proof
    uncertain : share or interval (SI) of each parameter that the claim counts in; None: those in the gain file, else
        those of the machine's paper

    Raises InputError for files that are no certificates or no gain files, and for `uncertain` without `gains`.
    """
    if gains is None and uncertain is not None:
        raise InputError("check", "uncertain", "no gain file", "the gain file whose uncertainty it is")
    compare = None if gains is None else partial(disagreement, gains=gains, uncertain=uncertain)
    with refused_as_input():
        return prove_again(path, seconds, compare)


def origin_of(
    gains: str | Path, plant: Plant, controller: Controller, current_loops: CurrentLoops, loops: int
) -> LoopOrigin:
    """The machine and the law that a certificate names.

    gains : the file of the controller
    plant : the machine, which may differ from the one in the file
    current_loops : the stage, see `chosen_loops`
    loops : how many; several are those of places along the travel

    Raises InputError for a file of another kind, and for a scheduled law, whose proof the checker does not know.
    """
    if controller.schedule is not None:
        raise InputError(
            gains, "schedule", "a scheduled law", "a law of one set of matrices for a certificate"
        )
    content = content_of(locate(Path(gains)))[1]
    law = {key: value for key, value in content.items() if key not in UNCOMPARED_TABLES}
    stage = chosen_loops(plant, controller, current_loops)
    machine, preset, design = (
        shorten(text, MAX_NAME_LENGTH) for text in (plant.name, plant.parameters.preset, controller.name)
    )
    named = Named(machine, preset, design, content_sha256(law), stage)
    units = units_of(plant.parameters) | ({plant.stroke.name: "m"} if plant.has_stroke else {})
    at = tuple(exact(share * plant.stroke.travel) for share in ENDS)
    return LoopOrigin(named, units, StatedPlaces(plant.stroke.name, "m", at) if loops > 1 else None)


def disagreement(
    document: Document, gains: str | Path, uncertain: Mapping[str, float | tuple[float, float]] | None = None
) -> str:
    """Where a certificate claims less than the uncertainty and the travel of a gain file, or something else.

    uncertain : share or interval (SI) of each parameter; None: those in the gain file, else in the machine's paper

    Returns one sentence, empty where the claim covers those of the gain file.

    Raises InputError for a file of another kind, for one without uncertain parameters, and for unknown ones.
    """
    claim, path = document.claim, locate(Path(gains))
    controller, content = read_stable(path), content_of(path)[1]
    plant = plant_of(controller.parameters)
    ranges = uncertain
    if ranges is None:
        ranges = uncertainty_of(content, published_figures(plant.name))
        if not ranges:
            raise InputError(path, "verification.robust", "no uncertain parameters", "them, or `uncertain`")
    if claim.origin is None:
        return f"it is of matrices alone and names no machine, expected that of {gains}"
    stage = cast("CurrentLoops", claim.origin.current_loops)
    own = origin_of(path, plant, controller, LAST_STAGE, len(document.loops))
    if different := _of_another(claim, own, controller, str(gains)):
        return different
    places = _loops_of(claim, plant, controller, stage)
    if isinstance(places, str):
        return f"no such loop can be made of {gains} ({places})"
    system = places[0][0]
    return (
        _of_other_values(claim, plant, own, system, str(gains))
        or _less(claim, plant, ranges, own, system, str(gains))
        or _of_other_loops(document, places, str(gains))
    )


def _loops_of(
    claim: StabilityClaim, plant: Plant, controller: Controller, stage: CurrentLoops
) -> list[tuple[UncertainSystem, Compensator]] | str:
    """The loops of the gain file in the parameters of the claim; or why there are none."""
    still = {p.name for p in claim.parameters if not (p.down or p.up)}
    along = {plant.stroke.name, *(name for name in plant.over if name in still)}
    names = tuple(
        p.name for p in claim.parameters if p.name in units_of(plant.parameters) and p.name not in along
    )
    try:
        return travel_loops(plant, controller, names, stage)[0]
    except (InputError, CheckError, NotAnalytic) as error:
        return str(error)


def _of_another(claim: StabilityClaim, own: LoopOrigin, controller: Controller, gains: str) -> str:
    """Whether machine, law, stage, sample time or places are those of the gain file."""
    assert claim.origin is not None
    found, wanted = claim.origin, own.named
    for what, one, two in (
        ("machine", found.machine, wanted.machine),
        ("preset of the machine", found.preset, wanted.preset),
        ("law", found.law, wanted.law),
        ("sha256 of the law", found.sha256, wanted.sha256),
        ("stage of current loops", found.current_loops, wanted.current_loops),
        ("sample time", _time_text(claim.sample_time), _time_text(exact(controller.sample_time))),
        ("place of each loop", _places_text(claim.places), _places_text(own.places)),
    ):
        if one != two:
            return f"the {what} is {one}, that of {gains} is {two}"
    return ""


def _time_text(T: Any) -> str:
    return "none" if T is None else f"{double(T)!r} s"


def _places_text(places: StatedPlaces | None) -> str:
    if places is None:
        return "none"
    return f"{places.name} = {', '.join(repr(double(x)) for x in places.at)} {places.unit}"


def _of_other_values(
    claim: StabilityClaim, plant: Plant, own: LoopOrigin, system: UncertainSystem, gains: str
) -> str:
    """Whether each parameter is one of the loop, in its unit and about its value."""
    units = _units_in(own, system)
    for p in claim.parameters:
        if p.name not in units or (p.name == plant.stroke.name and claim.places is not None):
            return f"{p.name} is no parameter of the loop of {gains}"
        if p.unit != units[p.name]:
            return f"the unit of {p.name} is {p.unit}, that of {gains} is {units[p.name]}"
        nominal = _nominal(plant, system, p.name)
        if p.nominal != exact(nominal):
            return f"the nominal {p.name} is {double(p.nominal)!r} {p.unit}, that of {gains} is {nominal!r}"
    return ""


def _less(
    claim: StabilityClaim, plant: Plant, ranges: Ranges, own: LoopOrigin, system: UncertainSystem, gains: str
) -> str:
    """Whether the box at `lower` covers the uncertainty that many times, and the travel."""
    names = tuple(name for name in units_of(plant.parameters))
    extent = extent_of(plant, ranges)
    nominal = np.array([_nominal(plant, system, name) for name in names])
    box_of(names, nominal, (), ranges, extent.over, caller="check")  # which says what is wrong with a range
    given: dict[str, StatedParameter] = {p.name: p for p in claim.parameters}
    intervals = system.spread(dict(extent.over) if own.places else extent.intervals)
    units = _units_in(own, system)
    for name, value in (*ranges.items(), *intervals.items()):
        low, high = sides_of(_nominal(plant, system, name), value)
        at = f"at {at_least(double(claim.lower)).percent()} of the uncertainty"
        if name not in intervals:
            middle = exact(_nominal(plant, system, name))
            low, high = middle - claim.lower * (middle - low), middle + claim.lower * (high - middle)
        if name not in given:
            return (
                f"{name} is not among its parameters, and {gains} has it from {_ends(low, high, units[name])}"
            )
        first, last = given[name].sides(claim.lower)
        if not (first <= low and high <= last):
            what = "travel" if name == plant.stroke.name else "box"
            found, wanted = _ends(first, last, units[name]), _ends(low, high, units[name])
            return f"its {what} is too small: {name} from {found} {at}, that of {gains} from {wanted}"
    return ""


def _ends(low: Any, high: Any, unit: str) -> str:
    return f"{double(low):.7g} to {double(high):.7g} {unit}".removesuffix(" 1")


def _of_other_loops(
    document: Document, places: Sequence[tuple[UncertainSystem, Compensator]], gains: str
) -> str:
    """Whether the loops are those that the gain file's law closes on its machine, to the last digit."""
    names = tuple(p.name for p in document.claim.parameters)
    if names != places[0][0].names:
        return f"its parameters are not {' '.join(places[0][0].names)}, as in the loop of {gains}"
    try:
        if why := next((system.approximate for system, _ in places if system.approximate), ""):
            return f"nothing is proven of the loop of {gains} ({why})"
        wanted = loops_of(places)
    except (InputError, CheckError, NotAnalytic) as error:
        return f"no such loop can be made of {gains} ({error})"
    found = tuple(_bare(loop) for loop in document.loops)
    return "" if found == tuple(_bare(loop) for loop in wanted) else f"the loops are not those of {gains}"


def _bare(loop: StatedLoop) -> StatedLoop:
    """A loop without what is chosen for its proof."""
    return replace(loop, units=(), groups=())


def _units_in(own: LoopOrigin, system: UncertainSystem) -> dict[str, str]:
    """The units of the parameters of a loop."""
    derived = () if system.derived is None else system.derived.intervals
    return {**own.units, **dict.fromkeys(derived, DERIVED_UNIT)}


def _nominal(plant: Plant, system: UncertainSystem, name: str) -> float:
    """The value of a parameter of the loop, SI; else of one of the machine, whose position is 0."""
    if name in system.names:
        return float(system.nominal[system.names.index(name)])
    return 0.0 if name == plant.stroke.name else float(getattr(plant.parameters, name))

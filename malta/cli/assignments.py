"""Options of the form NAME=VALUE, read as numbers in SI."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.model.plant import Parameters, Plant


class GeneralOption(NamedTuple):
    """An option that every scenario takes."""

    default: Any  # of the type that is read
    meaning: str


# Fields of Scenario; each may be given as `--option NAME=VALUE`.
GENERAL: Mapping[str, GeneralOption] = {
    "fidelity": GeneralOption(
        "", "force, dq (PI loops on the windings) or phase; the scenario's own without it"
    ),
    "noise": GeneralOption(0.0, "of the sensors, in multiples"),
    "settle": GeneralOption(
        0.0, "rest before the reference, of which no figure tells; yields of strokes have one"
    ),
    "estimator": GeneralOption("steady-state", "steady-state, kalman (time-varying) or extended"),
    "quantize": GeneralOption(False, "sensors with the machine's resolution"),
    "bearing": GeneralOption(False, "touchdown bearings push back, or a touchdown ends the run"),
    "scheduled": GeneralOption(False, "C(z) of the measured z in the filter"),
    "feedforward": GeneralOption("own", "axial, as printed, or attraction: also what holds it off centre"),
    "bearing_axes": GeneralOption(
        "fixed", "current controllers fixed, or turning with the force, as printed"
    ),
    "real_pwm": GeneralOption(False, "in phase: duty cycles in steps, dead time of the half-bridges"),
    "delay": GeneralOption(0, "samples between measurement and command"),
    "substeps": GeneralOption(0, "Runge-Kutta steps a sample; the error is estimated"),
}
LENGTHS = {"distance": "m", "rise": "s", "settle": "s"}  # units of options that many machines have
NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)"  # a number, and the unit that may follow it
EXAMPLES = {"--set": "m=0.56 or l_B=45mm", "--spread": "20% or m=10%"}  # in the errors of these options
EXAMPLE = "gain_x1=0.02 or offset_y2=5um"  # of the others


def read_assignments(option: str, texts: list[str] | None, units: Mapping[str, str]) -> dict[str, float]:
    """Read `NAME=VALUE`, each value with the unit that may follow it, as numbers in SI.

    units : SI unit of each name that may be assigned; "1" for a number without unit, or in %

    Raises InputError for another form, an unknown name, a name given twice or a unit that does not fit.

    >>> read_assignments("--set", ["l_B=45mm"], {"l_B": "m"})
    {'l_B': 0.045}
    """
    values: dict[str, float] = {}
    for text in texts or ():
        name, value = _split(text)
        number = re.fullmatch(NUMBER, value)
        if number is None or not name.isidentifier():
            raise InputError(option, "", repr(text), f"NAME=VALUE, as {EXAMPLES.get(option, EXAMPLE)}")
        if name not in units:
            kind = "sensor error" if option == "--sensor" else "parameter"
            raise InputError(option, name, f"an unknown {kind}", "one of " + " ".join(units))
        _require_once(option, name, value, values)
        values[name] = _in_si(number, units[name], option, name)
    return values


def read_entries(option: str, texts: list[str]) -> dict[str, Any]:
    """Read `NAME=VALUE` as entries of a design file: a number, one with its unit, true or false, or a word.

    Raises InputError for another form, and for a name given twice.

    >>> read_entries("--set", ["bases.state.x=50um", "delay=1", "uncertainty.m=30%"])
    {'bases.state.x': {'value': 50.0, 'unit': 'um'}, 'delay': 1, 'uncertainty.m': 0.3}
    """
    entries: dict[str, Any] = {}
    for text in texts:
        name, value = _split(text)
        if not all(part.isidentifier() for part in name.split(".")) or not value:
            raise InputError(option, "", repr(text), f"NAME=VALUE, as {EXAMPLES[option]}")
        _require_once(option, name, value, entries)
        number = re.fullmatch(NUMBER, value)
        if number is None:
            entries[name] = {"true": True, "false": False}.get(value, value)
        elif number[2] in ("%", "percent"):
            entries[name] = float(number[1]) / 100
        elif number[2]:
            entries[name] = {"value": float(number[1]), "unit": number[2]}
        else:
            entries[name] = int(number[1]) if re.fullmatch(r"[-+]?\d+", number[1]) else float(number[1])
    return entries


def read_sensor_errors(texts: list[str] | None, plant: Plant) -> dict[str, float]:
    """Read `--sensor NAME=VALUE`, errors of a machine's sensors, in SI; raises as `read_assignments` does."""
    return read_assignments("--sensor", texts, {error.name: error.unit for error in plant.sensor_errors})


def read_shares(
    gains: Path,
    texts: list[str] | None,
    parameters: Parameters,
    published: Mapping[str, Any] | None,
    option: str = "--spread",
) -> dict[str, float]:
    """Read how far parameters vary: `SHARE` for all that are uncertain, `NAME=SHARE` for one.

    Without a text these are the shares in the gain file. The spread of a difference or an offset is in its own unit.

    Raises InputError for two shares for all, and as `read_assignments` does.
    """
    from malta.campaigns.plan import box_of
    from malta.model.parameters import differences, units_of

    named = [text for text in texts or () if "=" in text]
    general = [text for text in texts or () if "=" not in text]
    if len(general) > 1:
        raise InputError(option, "", " and ".join(general), "one share for all, others as NAME=SHARE")
    shares: dict[str, float] = {}
    if general or not named:
        shares = box_of(gains, published, option)
    if general:
        share = read_assignments(option, [f"all={general[0]}"], {"all": "1"})["all"]
        shares = dict.fromkeys(shares, share)
    own = differences(parameters) if option == "--spread" else {}
    units = dict.fromkeys(units_of(parameters), "1") | own
    return shares | read_assignments(option, named, units)


def read_uncertainty(
    gains: Path, texts: list[str] | None, parameters: Parameters, published: Mapping[str, Any] | None
) -> dict[str, float]:
    """Read `--uncertain`, the box of a margin: shares above 0. Raises InputError as `read_shares`."""
    box = read_shares(gains, texts, parameters, published, option="--uncertain")
    for name, share in box.items():
        if not 0 < share < math.inf:
            raise InputError("--uncertain", name, f"{100 * share:g} %", "a share above 0 %")
    return box


def read_options(texts: list[str] | None, scenario: str, plant: Plant) -> dict[str, Any]:
    """Read the scenario's own options and general ones, `--option NAME=VALUE`, in SI and of the type of their defaults.

    Raises InputError for an unknown option, one that is given twice, or a value of another type.
    """
    from malta.simulation.catalogue import option_of
    from malta.simulation.experiments import setting

    units = LENGTHS | setting(plant, "OPTION_UNITS", {})
    merged: dict[str, Any] = {}
    for text in texts or ():
        name, value = _split(text)
        if not (name and value):
            raise InputError("--option", "", repr(text), "NAME=VALUE")
        default = GENERAL[name].default if name in GENERAL else option_of(scenario, plant, name)
        _require_once("--option", name, value, merged)
        merged[name] = _read_like(default, value, units.get(name, "1"), name)
    return merged


def _read_like(default: Any, text: str, si_unit: str, name: str) -> Any:
    """Read the value of a scenario's option with the type of its default."""
    if isinstance(default, str) or default is None:
        return text
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise InputError("--option", name, repr(text), "true or false")
        return text == "true"
    several = isinstance(default, tuple)
    numbers = [re.fullmatch(NUMBER, part.strip()) for part in (text.split(",") if several else [text])]
    values = [_in_si(number, si_unit, "--option", name) for number in numbers if number is not None]
    if len(values) < len(numbers):
        raise InputError("--option", name, repr(text), "numbers" if several else "a number")
    if several:
        return tuple(values)
    return int(values[0]) if isinstance(default, int) and values[0].is_integer() else values[0]


def _require_once(option: str, name: str, value: str, known: Mapping[str, Any]) -> None:
    """Raise InputError for a name that has a value already."""
    if name in known:
        raise InputError(option, name, f"{value!r} for the second time", "it once")


def _split(text: str) -> tuple[str, str]:
    """The name and the value of `NAME=VALUE`; the value is empty where there is none."""
    name, _, value = (part.strip() for part in text.partition("="))
    return name, value


def _in_si(number: re.Match[str], si_unit: str, option: str, name: str) -> float:
    """The value in SI of a match of NUMBER."""
    from malta.units import to_si

    value, unit = float(number[1]), number[2]
    if si_unit != "1":
        return to_si(value, unit or si_unit, si_unit, option, name)
    if unit not in ("", "%", "percent"):
        raise InputError(option, f"{name}.unit", repr(unit), "no unit, or %")
    return value * (0.01 if unit else 1.0)

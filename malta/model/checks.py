"""Checks that the fields of a plant fit each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Real
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np

from malta.display import quantity
from malta.errors import InputError
from malta.model.faults import fault_of
from malta.model.parameters import symbolic_names
from malta.model.plant import Plant, Signal, outputs_themselves, symbolic

SIGNALS = ("states", "inputs", "outputs", "disturbances")
BY_SENSOR = ("sensors.lag", "sensors.noise", "sensors.resolution", "sensors.range")
LEAST_RANGE = 6  # of a sensor, in standard deviations of its noise
TIMES = ("sensors.dead_time", "actuator.dead_time", "actuator.computation_time")


def _check_forms(plant: Plant) -> None:
    """Raise InputError for one signal or number where there may be several, and for several where there is one."""
    for key in SIGNALS:
        given = attrgetter(key)(plant)
        if not isinstance(given, tuple | list) or not all(isinstance(s, Signal) for s in given):
            found = repr(given) if len(repr(given)) < 60 else f"a {type(given).__name__}"
            raise InputError(plant.name, key, found, 'Signals in a tuple, as (Signal("u", "V"),)')
    for key in (*BY_SENSOR, "inertia"):
        given = attrgetter(key)(plant)
        if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
            of = "inputs" if key == "inertia" else "outputs"
            raise InputError(plant.name, key, repr(given), f"a tuple, a number for each of the {of}")
    for key in TIMES:
        given = attrgetter(key)(plant)
        if isinstance(given, str | Sequence):
            raise InputError(plant.name, key, repr(given), "one number, s")


def check_signals(plant: Plant) -> None:
    """Raise InputError unless the names and lengths of a plant's fields fit each other."""
    _check_forms(plant)
    names = {key: [s.name for s in attrgetter(key)(plant)] for key in (*SIGNALS, "sensors.errors")}
    for key, own in names.items():
        if len(set(own)) < len(own):
            raise InputError(plant.name, key, " ".join(own), "names that differ")
    for key in ("states", "inputs", "outputs"):
        if not names[key]:
            raise InputError(plant.name, key, "none", "at least one")
    for key, of in {**dict.fromkeys(BY_SENSOR, "outputs"), "inertia": "inputs"}.items():
        found = f"{len(attrgetter(key)(plant))} entries"
        if len(attrgetter(key)(plant)) != len(names[of]):
            raise InputError(plant.name, key, found, f"{len(names[of])}, one for each of the {of}")
    _check_ranges(plant)
    late = (*plant.sensors.lag, plant.sensors.dead_time)
    times = [time for time in late if isinstance(time, int | float)]
    if not all(0 <= time < math.inf for time in times):
        raise InputError(plant.name, "sensors", f"lags and dead time {times} s", "times of 0 s or more")
    times = [plant.actuator.dead_time, plant.actuator.computation_time]
    given = [time for time in times if isinstance(time, int | float)]
    if not all(0 <= time < math.inf for time in given) or (len(given) == len(times) and all(given)):
        found = f"dead time and computation time {times} s"
        raise InputError(plant.name, "actuator", found, "one time above 0 s, or none")
    both = [name for name in names["outputs"] if name in names["states"]]
    if plant.stroke.name not in ("", *both):
        expected = "an output that is a state of the same name" + (f", as {' '.join(both)}" if both else "")
        raise InputError(plant.name, "stroke.name", repr(plant.stroke.name), expected)
    if plant.stroke.thrust not in ("", *names["inputs"]):
        raise InputError(
            plant.name, "stroke.thrust", repr(plant.stroke.thrust), "one of " + " ".join(names["inputs"])
        )
    if bool(plant.stroke.name) != bool(plant.stroke.thrust):
        raise InputError(plant.name, "stroke", repr(plant.stroke.name), "stroke and thrust, or neither")
    _check_intervals(plant)
    for name in plant.uncontrolled:
        if name not in names["states"]:
            raise InputError(plant.name, "uncontrolled", repr(name), "one of " + " ".join(names["states"]))


def _check_ranges(plant: Plant) -> None:
    """Raise InputError for a range of a sensor that is no size, as a pair, or that its noise fills: of another unit."""
    for s, most, noise in zip(plant.outputs, plant.sensors.range, plant.sensors.noise, strict=True):
        none = most is None or isinstance(most, Sequence | np.ndarray)
        if none or (isinstance(most, Real) and not 0 <= most < math.inf):
            expected = f"its largest reading either way, {s.unit}, or 0: not declared"
            raise InputError(plant.name, f"sensors.range: {s.name}", repr(most), expected)
        if isinstance(most, Real) and isinstance(noise, Real) and 0 < most < LEAST_RANGE * noise:
            found = (
                f"{quantity(float(most), s.unit)}, which its noise of {quantity(float(noise), s.unit)} fills"
            )
            expected = f"its largest reading either way, {s.unit}, at least {LEAST_RANGE} times its noise"
            raise InputError(plant.name, f"sensors.range: {s.name}", found, expected)


def _check_intervals(plant: Plant) -> None:
    """Raise InputError unless every interval of `over` contains the value of a parameter that may be a symbol."""
    entering = symbolic_names(plant.parameters)
    for name, interval in plant.over.items():
        if name not in entering:
            raise InputError(plant.name, "over", repr(name), "one of " + " ".join(entering))
        value, ends = getattr(plant.parameters, name), tuple(interval)
        if not (len(ends) == 2 and -math.inf < ends[0] <= value <= ends[1] < math.inf and ends[0] < ends[1]):
            raise InputError(plant.name, f"over.{name}", f"{ends}", f"(low, high) about its value, {value:g}")


def check_numbers(plant: Plant) -> None:
    """Raise InputError when a plant's fields do not fit, or a function of it fails or has a wrong size."""
    check_signals(plant)
    check_equations(plant)


def check_equations(plant: Plant) -> None:
    """Raise InputError when a function of a plant fails or returns a wrong number of entries."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    x, u = kind.sym("x", len(plant.states)), kind.sym("u", len(plant.inputs))
    w, y = kind.sym("w", len(plant.disturbances)), kind.sym("y", len(plant.outputs))
    i = kind.sym("i", len(plant.actuator.coils))
    asked: dict[str, tuple[Callable[[], Any], int, str]] = {
        "f": (lambda: plant.f(x, u, w), len(plant.states), "states"),
        "h": (lambda: plant.h(x, u), len(plant.outputs), "outputs"),
        "load": (lambda: plant.load(x), len(plant.disturbances), "disturbances"),
        "actuator.currents": (lambda: plant.actuator.currents(y, u), len(plant.actuator.coils), "coils"),
        "actuator.forces": (lambda: plant.actuator.forces(x, i), len(plant.inputs), "inputs"),
        "contacts.contact": (lambda: plant.contacts.contact(x), len(plant.contacts.names), "contacts"),
    }
    for name, question in asked.items():
        found = _check_size(plant, name, *question)
        _check_expression(plant, name, found, (x, u, w, y, i))
    half, states = plant.coordinates, len(plant.controlled)
    if not half and plant.position_of is outputs_themselves and states == 2 * len(plant.outputs):
        found = "rates of the first half of the states that are not the second half"
        expected = "f = (q', q'') for states (q, q'), or a `position_of` that gives all states at rest"
        raise InputError(plant.name, "f", found, expected)
    size, of = (half, "controlled positions") if half else (states, "controlled states")
    _check_size(plant, "position_of", lambda: plant.position_of(y), size, of)


def _check_size(plant: Plant, name: str, evaluate: Callable[[], Any], size: int, of: str) -> Any:
    """What a function returns. Raises InputError unless it has so many entries."""
    try:
        found = evaluate()
        entries = ca.vertcat(found).numel()
    except Exception as error:  # a user's function may raise anything
        raise fault_of(error, plant.name, name) from error
    if isinstance(found, np.ndarray | list | tuple):
        kind = "an array of numpy" if isinstance(found, np.ndarray) else f"a {type(found).__name__} of Python"
        raise InputError(plant.name, name, kind, "a vector of CasADi, as ca.vertcat(...) makes it")
    if entries != size:
        raise InputError(plant.name, name, f"{entries} entries", f"{size}, one for each of the {of}")
    return found


def _check_expression(plant: Plant, name: str, expression: Any, arguments: Sequence[Any]) -> None:
    """Raise InputError for an expression of symbols that are no arguments, and for one that holds NaN."""
    if not isinstance(expression, ca.SX | ca.MX):
        return
    known = {symbol.__hash__() for argument in arguments for symbol in ca.symvar(argument)}
    free = [str(symbol) for symbol in ca.symvar(expression) if symbol.__hash__() not in known]
    if free:
        expected = "a function of its arguments and of numbers, as par.m"
        raise InputError(plant.name, name, f"symbols of its own ({' '.join(free)})", expected)
    if isinstance(expression, ca.SX) and _has_nan(ca.Function("expression", list(arguments), [expression])):
        expected = "CasADi's functions, as ca.sin, in place of math's, which make NaN of a symbol"
        raise InputError(plant.name, name, "NaN in its expression", expected)


def _has_nan(function: ca.Function) -> bool:
    """Whether an SX function computes with a constant that is NaN."""
    constants = (k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CONST)
    return any(math.isnan(function.instruction_constant(k)) for k in constants)


def check_symbols(plant: Plant) -> None:
    """Raise InputError when a plant cannot be built from symbols, which margins and simulations use for parameters.

    CasADi returns NaN without an error when a function takes a symbol for a number, as `math.sin(par.slope)` does.
    """
    if plant.actuator.tabulated:  # its table holds numbers; using symbols raises an error there
        return
    names = symbolic_names(plant.parameters)
    bad = _fault_with_symbols(plant, names)
    if bad:
        name = next((name for name in names if _fault_with_symbols(plant, [name])), "its parameters")
        expected = f"CasADi's functions of it, as ca.sin, or si(..., shapes=True) where {name} stays a number"
        raise InputError(plant.name, bad, f"{name}, taken for a number", expected)


def _fault_with_symbols(plant: Plant, names: Sequence[str]) -> str:
    """The name of a plant's function that fails or returns NaN when these parameters are symbols; "" for none."""
    symbols = {name: ca.SX.sym(name) for name in names}
    values = [getattr(plant.parameters, name) for name in names]
    try:
        machine = plant.variant(symbolic(plant.parameters, symbols))
    except Exception:  # a user's function may raise anything
        return "plant"
    for field in ("dead_time", "computation_time"):  # of which the number of states depends
        if isinstance(getattr(machine.actuator, field), ca.SX):
            return f"actuator.{field}"
    x, u, w = ca.DM(plant.at().x), ca.DM.zeros(len(plant.inputs)), ca.DM.zeros(len(plant.disturbances))
    y, i = ca.DM(plant.h(x, u)), ca.DM.zeros(len(plant.actuator.coils))
    at = {
        "f": (x, u, w),
        "h": (x, u),
        "load": (x,),
        "actuator.currents": (y, u),
        "actuator.forces": (x, i),
        "contacts.contact": (x,),
    }
    for key, arguments in at.items():
        try:
            found = ca.SX(attrgetter(key)(machine)(*map(ca.SX, arguments)))
        except Exception:  # likewise
            return key
        numbers = ca.Function("found", [ca.vertcat(*symbols.values())], [found])(ca.DM(values))
        if ca.DM(numbers).is_regular() < ca.DM(attrgetter(key)(plant)(*arguments)).is_regular():
            return key
    return ""

"""Whether columns of a log are the signals that they are called: by what an excitation does in the gain file's loop.

At the lines of an excitation d each reading, current and command has a predicted vector P of Fourier coefficients. A
column with the vector M fits the signal s by |P_s^H M| / (|P_s| |M|), and is P_s^H M / |P_s|^2 times as large. Columns
that are swapped, in another unit, of the other sign or in rms values are named by these two numbers, whose bounds leave
room for machines that differ from the gain file's by half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.display import quantity
from malta.errors import CheckError, InputError
from malta.firmware.signals import place_of_readings
from malta.identification.excite import cut_loop, model_at
from malta.identification.log import Log, require_currents, require_same_law
from malta.identification.readers.raw import GROUPS
from malta.identification.response import axes_of
from malta.identification.spectra import (
    excited_lines,
    in_axes,
    last_excitation,
    require_independent,
    whole_periods,
)
from malta.loops.loop import loop as loop_of
from malta.model.places import outputs_at
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller

MOST_PERIODS = 4  # of the excitation, that are looked at
GOOD_FIT = 0.9  # a column that fits its own signal worse, and another one better, may be that
MISFIT_RATIO = 10.0  # of the power that its own signal leaves of a column, over what another one leaves
UNIT_FACTORS = {1e3: "1000 times", 1e6: "a million times", 1e-3: "1/1000 of", 1e-6: "a millionth of"}
UNIT_SPREAD = 2.0  # factor within which a size tells another unit
RMS = 0.5**0.5
RMS_SPREAD, RMS_FIT = 0.015, 0.98  # of all currents: how near to rms values, while readings are as predicted
LIMIT_SLACK = 1.5  # of a limit, which a reading may pass


class SignalFit(NamedTuple):
    """How columns of a group fit predicted signals.

    names : of the columns, which are those of the signals
    fit : columns x signals, 0 to 1
    size : of each column over its own signal; complex: negative of the other sign
    """

    names: tuple[str, ...]
    fit: FloatArray
    size: ComplexArray


def driven_currents(plant: Plant) -> tuple[str, ...]:
    """The names of the currents that the law drives: those of all coils, or of the axes that its commands reach."""
    drive = plant.actuator.windings
    if drive is None:
        return tuple(signal.name for signal in plant.actuator.coils)
    unit = np.array(
        [np.array(drive.command(ca.DM(row))).ravel() for row in np.eye(len(plant.actuator.coils))]
    )
    return tuple(s.name for s, column in zip(drive.axes, unit.T, strict=True) if np.abs(column).max() > 1e-9)


def signal_fits(controller: Controller, plant: Plant, log: Log) -> dict[str, SignalFit]:
    """How the readings, currents and commands of a log fit what its excitation does in the gain file's loop.

    Returns nothing for a log without a periodic excitation, which tells nothing of it.
    """
    excitation = log.columns.get("excitation", np.zeros((0, 0)))
    try:
        N, periods = whole_periods(log, last_excitation(log), log.samples)
        each = N // periods
        N, periods = each * min(periods, MOST_PERIODS), min(periods, MOST_PERIODS)
        D = _coefficients(excitation, N)
        lines = excited_lines(log, D, periods)
        require_independent(log, D[lines])
    except CheckError:
        return {}
    w = 2 * np.pi * lines / (N * log.sample_time)
    loop = loop_of(plant, controller)
    cut, model = cut_loop(loop, w), model_at(loop, ())
    names = log.names("excitation")
    d = np.zeros((len(lines), len(plant.inputs)), dtype=complex)
    for k, signal in enumerate(plant.inputs):
        if signal.name in names:
            d[:, k] = D[lines][:, names.index(signal.name)]
    Y = np.einsum("kpm,km->kp", cut.G, d)
    V = np.einsum("kvp,kp->kv", cut.F, Y) + np.einsum("kvm,km->kv", cut.F_d, d)
    axes = [signal.name for signal in axes_of(plant)]
    driven = [axes.index(name) for name in driven_currents(plant) if name in axes]
    current = np.einsum("kmp,kp->km", np.linalg.pinv(model.response(model.start, w)[:, :, driven]), Y)
    predicted = {
        "y": ([s.name for s in plant.outputs], Y),
        "i": ([axes[k] for k in driven], current),
        "v": ([s.name for s in plant.inputs], V),
    }
    found = {}
    for group, (known, P) in predicted.items():
        there = [name for name in known if name in log.names(group)]
        if there:
            places = [log.names(group).index(name) for name in there]
            M = _coefficients(log.columns[group], N)[lines][:, places]
            found[group] = _fit(there, P[:, [known.index(name) for name in there]], M)
    return found


def _coefficients(table: FloatArray, N: int) -> ComplexArray:
    """Fourier coefficients of the last N rows of a table, without their means; missing readings are on the mean."""
    rows = np.asarray(table[len(table) - N :], dtype=float)
    middle = np.nanmean(rows, axis=0) if len(rows) else 0.0
    return np.asarray(np.fft.rfft(np.nan_to_num(rows - middle), axis=0) / N)


def _fit(names: Sequence[str], P: ComplexArray, M: ComplexArray) -> SignalFit:
    sizes = np.linalg.norm(M, axis=0)[:, None] * np.linalg.norm(P, axis=0)
    fit = np.abs(M.conj().T @ P) / np.where(sizes > 0, sizes, 1.0)
    power = (np.abs(P) ** 2).sum(axis=0)
    size = (P.conj() * M).sum(axis=0) / np.where(power > 0, power, 1.0)
    return SignalFit(tuple(names), fit, size)


def require_signals(controller: Controller, plant: Plant, log: Log) -> None:
    """Raise InputError for columns that are swapped, in another unit, of the other sign, or in rms values."""
    fits = signal_fits(controller, plant, log)
    for group, one in fits.items():
        for k, name in enumerate(one.names):
            _require_own(log.source, GROUPS[group], one, k, name)
    if {"y", "i"} <= set(fits) and np.diag(fits["y"].fit).min() > RMS_FIT:
        own, size = np.diag(fits["i"].fit), np.abs(fits["i"].size)
        if own.min() > RMS_FIT and np.abs(size / RMS - 1).max() < RMS_SPREAD:
            found = f"currents that are all {size.mean():.3f} of those that move the machine so"
            raise InputError(log.source, "i", found, "amplitudes: are they rms values?")


def _require_own(source: str, prefix: str, one: SignalFit, k: int, name: str) -> None:
    """Raise InputError for a column that is another signal, has another unit, or the other sign."""
    own, other = one.fit[k, k], int(one.fit[k].argmax())
    left = 1 - one.fit[k] ** 2
    if own < GOOD_FIT < one.fit[k, other] and left[k] > MISFIT_RATIO * left[other]:
        twin = one.names[other]
        both = one.fit[other, k] > GOOD_FIT
        found = f"what {prefix}{twin} does under this excitation ({one.fit[k, other]:.2f} of it, {own:.2f} of its own)"
        ask = f"are {prefix}{name} and {prefix}{twin} swapped?" if both else "is it another column?"
        raise InputError(source, prefix + name, found, f"{prefix}{name}: {ask}")
    if own < GOOD_FIT:
        return
    size = abs(one.size[k])
    for factor, words in UNIT_FACTORS.items():
        if factor / UNIT_SPREAD < size < factor * UNIT_SPREAD:
            found = f"values {words} those of this excitation ({size:.3g} times)"
            raise InputError(source, prefix + name, found, "its unit: say it as --columns NAME=COLUMN:UNIT")
    if one.size[k].real < -GOOD_FIT * size:
        raise InputError(
            source, prefix + name, "the other sign", f"a {prefix}{name} that follows its excitation"
        )


def findings_of_machine(controller: Controller, log: Log) -> list[str]:
    """What does not fit between a log and the machine and law of a gain file, in words."""
    plant = plant_of(controller.parameters)
    log = in_axes(log, plant)
    axes = [axis.name for axis in axes_of(plant)]
    found = list(machine_findings(log, plant))
    checks: tuple[Callable[[], None], ...] = (
        lambda: require_same_law(log, plant.name, controller.sample_time),
        lambda: require_currents(log, axes, driven_currents(plant) if log.names("i") else ()),
        lambda: require_signals(controller, plant, log),
    )
    for check in checks:
        try:
            check()
        except (CheckError, InputError) as error:
            found.append(str(error).removeprefix(f"{log.source}: "))
    return found


def machine_findings(log: Log, plant: Plant) -> tuple[str, ...]:
    """Values of a log that its machine cannot have: beyond a clearance, a travel, a sensor's range or a limit.

    Each reading is looked at with the others at rest.
    """
    found = _impossible_readings(log, plant)
    limits = {"i": dict.fromkeys(log.names("i"), float(plant.actuator.current_limit))}
    limits["v"] = dict(
        zip((s.name for s in plant.inputs), map(float, plant.actuator.force_limit), strict=False)
    )
    for group, known in limits.items():
        for signal in log.signals.get(group, ()):
            most, limit = max(map(abs, _ends(log, group, signal.name))), known.get(signal.name, 0.0)
            if 0 < LIMIT_SLACK * limit < most:
                unit = " (in another unit?)" if most > 100 * limit else ""
                beyond = f"beyond its limit of {quantity(limit, signal.unit)}{unit}"
                found.append(f"{signal.name} is {quantity(most, signal.unit)}, {beyond}")
    return tuple(found)


def _ends(log: Log, group: str, name: str) -> tuple[float, float]:
    """The least and the largest value of a signal."""
    unit = next(signal.unit for signal in log.signals[group] if signal.name == name)
    least, _, largest, _ = log.survey.statistics[f"{GROUPS[group]}{name} [{unit}]"]
    return least, largest


def _impossible_readings(log: Log, plant: Plant) -> list[str]:
    """Readings beyond the range of their sensor, the travel, or the clearance that is left for them."""
    found = []
    ranges = plant.sensors.range or (0.0,) * len(plant.outputs)
    y = ca.SX.sym("y", len(plant.outputs))
    used = ca.Function("used", [y], [ca.densify(plant.contacts.contact(place_of_readings(plant, y)))])
    rest = outputs_at(plant, plant.at().x)
    for k, signal in enumerate(plant.outputs):
        if signal not in log.signals["y"]:
            continue
        for end in set(_ends(log, "y", signal.name)):
            at = np.array(rest)
            at[k] = end
            share = float(np.max(np.array(used(at)), initial=0.0)) if plant.contacts.names else 0.0
            beyond = ""
            if ranges[k] and abs(end) > LIMIT_SLACK * ranges[k]:
                beyond = f"beyond the sensor's range of {quantity(float(ranges[k]), signal.unit)}"
            elif (
                plant.has_stroke and k == plant.stroke_output and abs(end) > LIMIT_SLACK * plant.stroke.travel
            ):
                beyond = f"beyond the travel of {quantity(plant.stroke.travel, signal.unit)}"
            elif share > LIMIT_SLACK:
                beyond = f"{share:.3g} times the clearance{' (in another unit?)' if share > 100 else ''}"
            if beyond:
                found.append(f"{signal.name} reads {quantity(end, signal.unit)}, {beyond}")
    return found

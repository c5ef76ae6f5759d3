"""Parameters of a machine from a log under excitation, with intervals: maximum likelihood at the excited lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import gammainccinv

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.identification.checks import check_loop, outside_of_box
from malta.identification.explanation import explain
from malta.identification.identified import Identified
from malta.identification.imperfections import bench_units, usual_size
from malta.identification.log import Log, last_rows, require_currents
from malta.identification.prediction import Predicted, predict
from malta.identification.response import (
    STEP,
    ResponseModel,
    acting_parameters,
    axes_of,
    candidates,
    deviations,
    information,
    plant_with,
    points_of_noise,
    require_parameters,
    units_of_model,
    well_found,
)
from malta.identification.signal_checks import driven_currents, require_signals
from malta.identification.spectra import (
    SIGMA,
    Spectrum,
    between_neighbours,
    distortion_of,
    explained_at_lines,
    in_axes,
    missing_shares,
    noise_of,
    readings,
    require_closed_loop,
    require_log,
    residuals_of,
    spectrum_of,
    straighten,
    weights_of,
    white_residuals,
    whiteness_of,
    whole,
    windowed_covariances,
)
from malta.identification.unmodelled import residual_bound
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller, given_law
from malta.work import is_stopped

IntArray = NDArray[np.integer[Any]]

GROUPS = ("y", "v", "i", "excitation")  # of a log, which are used
SHARE = 0.5  # of its value: a parameter that is found worse is not asked for by itself
LOST_SHARE = 1.0  # of its value: a combination of parameters that is found worse is not found
MIN_PROBABILITY = 1e-6  # probability below which chi2 refuses the model
SLACK = 1.1  # factor of chi2: the noise's covariance is estimated too
MAX_STRAIGHTENINGS = 12  # estimates at most, each with the curvature and the weights of the one before
SETTLED_STEP = 0.01  # standard deviations: what moves by less is settled
MAX_BEYOND = 3.0  # standard deviations, by which noise may take a parameter beyond its limit
MEASURED = 0.4  # times its usual size: what is known otherwise, where no interval is given
MAX_APART = 0.01  # of a value, by which two logs of one machine may differ in it, and
MAX_DEVIATIONS_APART = 6.0  # standard deviations, each with what its own log leaves
MIN_LINE_POWER = 4.0  # over the noise, of the output that moves most: below, nothing was excited


def identify(
    controller: Controller,
    log: Log | Sequence[Log],
    *,
    parameters: Sequence[str] = (),
    box: Mapping[str, float] | None = None,
    known: Mapping[str, Known] | None = None,
    start: Mapping[str, float] | None = None,
    robust: bool = False,
    in_time: bool = True,
) -> Identified:
    """Identify parameters of a machine from a log under a periodic excitation, with intervals.

    At the excited lines k the measured currents I and outputs Y obey e_k = Y_k - G(theta, w_k) I_k, where e is noise of
    the sensors alone, in closed loop too. The estimate minimizes

        sum over k of e_k^H C_k(theta)^-1 e_k,      C_k: covariance of the same e between the lines

    in which C depends on theta. So noise that the loop feeds back into the currents does not bias the result. This is
    maximum likelihood with errors in the variables (Pintelon and Schoukens, System Identification, 2nd ed., ch. 9).
    Loads act at the place where the log was made, with the mean currents there. What the machine's curvature adds at
    the lines is computed from the measured motion and subtracted.

    Then the same parameters are estimated from prediction errors in time (`malta.identification.prediction`), with the
    process noise that is found between the lines. Both are reported; a model that lacks something makes them differ.
    A machine whose sensors lag, or whose states are not (q, q'), is estimated at the lines alone.

    Last, everything that was taken as known, and the imperfections of any bench, are estimated beside the parameters,
    each with its usual size as a prior (`malta.identification.explanation`). That gives total intervals; where the
    parameters alone do not explain the log, it also gives their values, and what explains the rest. The loop of the
    identified machine is compared with S as the log has it.

    controller : the gain file that was running; its machine's parameters are where the search starts
    log : with measured currents and an excitation of whole periods; or several of the same machine, each at its own
        place, with its own noise, which are estimated together at the lines
    parameters : names of the machine's record or of its sensors' errors; (): those that the log determines to 50 %,
        but for masses and lengths, which are held
    box : shares by which parameters of the gain file may vary: a parameter outside is refused, and where none is named
        those of the box are identified that the log determines to 50 %
    known : parameters with values that were weighed or measured otherwise, SI; or (value, half of its 95 % interval)
    start : values from which the search starts, SI
    robust : take outliers among the readings for missing, with Student's likelihood in time
    in_time : whether to estimate in time too, where the estimate at the lines is not refused

    Up to 20 % of the readings may be missing: they are filled in with the predictions of the filter.

    Returns an Identified, also where its `refusal` says that the model does not explain the log.

    Raises InputError for unknown parameters, another machine's signals, and logs of different currents. Raises
    CheckError for logs that do not fit together, and for a log that tells nothing:
    too short, without excitation or with one that is not independent, an open loop, another sample time, a stuck or
    clipped sensor, parameters that only act together.

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> loop = malta.loop(plant, controller)
    >>> plan = malta.excite(loop, period=0.5, periods=4, band=(4, 400))
    >>> true = plant.variant(dataclasses.replace(plant.parameters, K_A=9000.0))
    >>> excited = malta.Scenario.excited(plan.signal, plan.duration)
    >>> run = malta.simulate(true, controller, excited)
    >>> found = malta.identify(
    ...     controller, malta.identification.log_of(run), parameters=["K_A", "K_B"]
    ... )
    >>> found.refusal, bool(abs(found.values[0] - 9000) < 20)
    ('', True)
    """
    controller = given_law("identify", controller)
    own = plant_of(controller.parameters)
    values, sizes = known_values(own, known or {})
    plant, box = known_plant(own, values, start or {}), dict(box or {})
    logs = [in_axes(one, plant) for one in ([log] if isinstance(log, Log) else log)]
    if not logs or (robust and len(logs) > 1):
        raise InputError("identify", "log", f"{len(logs)} logs", "one log" if logs else "at least one log")
    for one in logs:
        require_machine(controller, plant, one)
    signals = [(whole(one, "i"), readings(one, robust=robust)) for one in logs]
    log = _join_logs(logs)
    asked = parameters or tuple(name for name in box if name in units_of_model(plant))
    names = require_parameters(plant, asked) or candidates(plant)
    names = tuple(name for name in names if name not in values)
    made = [_record(plant, names, one, y, i) for one, (i, y) in zip(logs, signals, strict=True)]
    records, dropped = _choose(made, log.source, named=bool(parameters))
    found, model = _estimate_straightened(records, log, dropped), records[0].model
    _require_same_machine(records, logs, found)
    filled = robust or bool(missing_shares(log, "y", signals[0][1]).any())
    wanted = len(logs) == 1 and (filled or (in_time and found.chi2 <= found.limit))
    if wanted and not is_stopped() and not (plant.sensors.late or not plant.second_order or model.lag_named):
        found, records = _estimate_twice(records, found, signals[0], dropped, robust=robust)
    found = _with_everything_else(records, found, sizes)
    at = dict(zip(found.names, found.values.tolist(), strict=True))
    return replace(
        found,
        loop=check_loop(controller, found.plant, *logs),
        outside=outside_of_box(at, box, own.parameters),
    )


def _join_logs(logs: Sequence[Log]) -> Log:
    """The first log, under the names of all of them."""
    if len(logs) == 1:
        return logs[0]
    names = dict.fromkeys(s for log in logs for s in [log.source])
    return replace(logs[0], source=", ".join(names), sha256=" ".join(log.sha256 for log in logs).strip())


def _require_same_machine(records: Sequence[_Record], logs: Sequence[Log], found: Identified) -> None:
    """Raise for logs of different currents, and for those whose own parameters lie apart."""
    first = records[0].model.currents
    for r in records:
        if r.model.currents != first:
            expected = f"{' '.join(first)}, as {records[0].spectrum.source} has"
            raise InputError(r.spectrum.source, "i", " ".join(r.model.currents), expected)
    if len(records) == 1 or found.chi2 <= found.limit or is_stopped():
        return
    own = [_estimate_straightened([r], log, {}) for r, log in zip(records, logs, strict=True)]
    for a, b in combinations(own, 2):
        off = np.abs(a.values - b.values)
        sizes = off / np.sqrt(np.diag(a.covariance) + np.diag(b.covariance))
        far = np.where(off > MAX_APART * np.abs(found.values), sizes, 0.0)
        k = int(far.argmax())
        if far[k] > MAX_DEVIATIONS_APART:
            raise CheckError(
                f"{a.log.source} and {b.log.source} do not fit together: {found.names[k]} is {a.values[k]:.5g} by one "
                f"and {b.values[k]:.5g} by the other, {far[k]:.2g} standard deviations apart: the machine changed "
                "between them, or one is of another machine"
            )


def _estimate_twice(
    records: list[_Record],
    found: Identified,
    signals: tuple[FloatArray, FloatArray],
    dropped: Mapping[str, float],
    *,
    robust: bool,
) -> tuple[Identified, list[_Record]]:
    """The estimate in time too; where readings are missing, that at the lines again with predictions in their place.

    signals : currents and readings
    """
    (i, y), (model, spectrum, _), log = signals, records[0], found.log
    predicted = _estimate_in_time(model, spectrum, found, i, y, robust=robust)
    filled = robust or bool(missing_shares(log, "y", y).any())
    if filled:  # once more, with predictions in their place
        spectrum = spectrum_of(log, predicted.readings, i)
        records = [records[0]._replace(spectrum=spectrum)]
        found = _estimate_straightened(records, log, dropped)
        told = 1 - float(missing_shares(log, "y", y).mean())  # what was filled in tells nothing
        found = replace(found, covariance=found.covariance / told)
        predicted = _estimate_in_time(model, spectrum, found, i, y, robust=robust)
    return replace(found, in_time=predicted), records


Known = float | tuple[float, float]
"""A value, or a value and half of its 95 % interval, SI."""


def known_values(
    plant: Plant, known: Mapping[str, Known]
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Values of the machine's parameters; and values and standard deviations of all that is known, SI.

    A deviation is that of an interval, else so much less than that of a data file's value.
    """
    values = {name: one[0] if isinstance(one, tuple) else float(one) for name, one in known.items()}
    bench = bench_units(plant)
    own = {name: value for name, value in values.items() if name not in bench}
    believed = known_plant(plant, own, {})
    sizes = {
        name: one[1] / SIGMA
        if isinstance(one, tuple)
        else 0.0
        if name in bench
        else MEASURED * usual_size(believed, name)
        for name, one in known.items()
    }
    return own, {name: (values[name], size) for name, size in sizes.items()}


def _with_everything_else(
    records: Sequence[_Record], found: Identified, known: Mapping[str, tuple[float, float]]
) -> Identified:
    """What was found, with everything else uncertain; where the parameters alone do not explain the log, all of it."""
    parts = [(r.model, r.spectrum, r.added) for r in records]
    e = explain(parts, found.values, known, found.limit, refine=found.chi2 > found.limit and not is_stopped())
    found = replace(found, explanation=e)
    if found.chi2 > found.limit:
        plant = machine_of(records[0].model, e.values, e.covariance, found.log.source)
        found = replace(found, plant=plant, values=e.values, covariance=e.alone)
    left = residual_bound([(r.model, r.spectrum, r.at(found.values)) for r in records])
    return replace(found, unmodelled=left)


def weigh(
    controller: Controller,
    log: Log,
    loaded: Log,
    added: Mapping[str, float],
    *,
    parameters: Sequence[str] = (),
    known: Mapping[str, Known] | None = None,
) -> Identified:
    """Identify parameters from two logs of a machine, with and without a known mass on it: so its own mass comes out.

    One log determines ratios such as K_A / m, with a mass d the second one K_A / (m + d), both together K_A and m.
    The likelihood at the lines is that of both logs together, as `identify` has it for one; nothing is estimated in
    time.

    controller : the gain file that was running in both
    log : without the added mass
    loaded : with it
    added : what it adds to parameters, SI, as {"m": 0.1}; on the centre of gravity it adds no inertia
    parameters : as for `identify`; (): those that both logs determine to 50 %, and those of `added`
    known : parameters with values that were weighed or measured otherwise, SI

    Returns an Identified of the machine without the added mass, also where its `refusal` says that the model does not
    explain the logs; its log is the first one.

    Raises InputError and CheckError as `identify` does, and InputError where nothing is added.

    >>> import malta
    >>> malta.identification.weigh.__annotations__["return"]
    'Identified'
    """
    controller = given_law("weigh", controller)
    values, sizes = known_values(plant_of(controller.parameters), known or {})
    plant = known_plant(plant_of(controller.parameters), values, {})
    require_parameters(plant, list(added))
    if not any(added.values()):
        raise InputError("weigh", "added", "nothing", "what the second log's machine has more, as m=100g")
    names = require_parameters(plant, parameters) or (*candidates(plant), *added)
    names = tuple(name for name in dict.fromkeys(names) if name not in values)
    par = plant.parameters
    heavier = plant_with(plant, {name: float(getattr(par, name)) + more for name, more in added.items()})
    records = []
    for flown, machine in ((in_axes(log, plant), plant), (in_axes(loaded, plant), heavier)):
        require_machine(controller, machine, flown)
        records.append(_record(machine, names, flown, readings(flown, robust=False), whole(flown, "i")))
    records[1] = records[1]._replace(added=added)
    source = f"{log.source} and {loaded.source}"
    records, dropped = _choose(records, source, named=bool(parameters))
    return _with_everything_else(records, _estimate_straightened(records, log, dropped), sizes)


class _Record(NamedTuple):
    """A log as it is estimated from: the machine where it was made, its spectrum, and what that machine has more than
    the one that is asked for, SI."""

    model: ResponseModel
    spectrum: Spectrum
    added: Mapping[str, float] = MappingProxyType({})

    def at(self, theta: FloatArray) -> FloatArray:
        """The parameters of this log's machine."""
        return np.array([x + self.added.get(n, 0.0) for n, x in zip(self.model.names, theta, strict=True)])


def _record(plant: Plant, names: tuple[str, ...], log: Log, y: FloatArray, i: FloatArray) -> _Record:
    """The record of a log. Raises CheckError for a log that tells nothing."""
    s = spectrum_of(log, between_neighbours(y), i)
    mean = s.outputs[0].real, s.currents[0].real
    around = points_of_noise(last_rows(i, round(2 * np.pi / (s.rate * log.sample_time))), s.periods)
    model = ResponseModel(plant, names, tuple(log.names("i")), *mean, log.sample_time, around)
    require_closed_loop(log, float(np.linalg.eigvals(model.matrices(model.start)[0]).real.max()))
    return _Record(model, s)


def _choose(records: list[_Record], source: str, *, named: bool) -> tuple[list[_Record], dict[str, float]]:
    """The records with the parameters that are told, and the deviations of those that are not, as shares.

    Where they were named, all have to be told; else those that are not are left out.
    """
    model, dropped = records[0].model, {}
    told = [
        _information(r.model, straighten(r.model, r.spectrum, r.model.start), model.scale) for r in records
    ]
    F = np.sum(told, axis=0)
    if not named:
        left, sigma = well_found(F, model.names, SHARE / SIGMA), deviations(F)
        dropped = {
            n: float(sigma[k]) for k, n in enumerate(model.names) if k not in left and np.isfinite(sigma[k])
        }
        names = tuple(model.names[k] for k in left)
        records = [r._replace(model=replace(r.model, names=names)) for r in records]
        F = F[np.ix_(left, left)]
    require_identifiable(records[0].model, F, source)
    return records, dropped


def _estimate_straightened(records: Sequence[_Record], log: Log, dropped: Mapping[str, float]) -> Identified:
    """The estimate at the lines, with the machine's curvature at what was found, until that moves no more."""
    theta = records[0].model.start
    for _ in range(MAX_STRAIGHTENINGS):
        straight = [r._replace(spectrum=straighten(r.model, r.spectrum, r.at(theta))) for r in records]
        found = _search(straight, theta)
        _require_told(straight, found)
        moved = np.abs(found.theta - theta) / np.sqrt(np.diag(found.covariance))
        theta = found.theta
        if (moved < SETTLED_STEP).all() or is_stopped():
            break
    return _estimate(straight, log, dropped, found)


def _estimate_in_time(
    model: ResponseModel, s: Spectrum, found: Identified, i: FloatArray, y: FloatArray, *, robust: bool
) -> Predicted:
    """The estimate in time, from that at the lines on."""
    plain = straighten(model, s, found.values)
    noise = noise_of(model, plain, found.values, residuals_of(model, plain, found.values).between)
    return predict(model, found.values, noise, i, y, source=s.source, robust=robust)


def known_plant(plant: Plant, known: Mapping[str, float], start: Mapping[str, float]) -> Plant:
    """The machine with what is known of it."""
    values = {**start, **known}
    require_parameters(plant, list(values))
    if not values:
        return plant
    return plant_with(plant, values)


def require_machine(controller: Controller, plant: Plant, log: Log) -> None:
    """Raise for a log of another machine, without currents, or whose samples no model fits."""
    require_log(log, plant.name, controller.sample_time)
    log.table("y", [s.name for s in plant.outputs])
    if not log.names("i"):
        raise InputError(log.source, "i", "no measured currents", "a column for each axis, as i_dd1 [A]")
    require_currents(log, [axis.name for axis in axes_of(plant)], driven_currents(plant))
    found, Ts = log, controller.sample_time
    if found.jitter > 0.01 * Ts:
        raise CheckError(
            f"{log.source}: its samples jitter by {found.jitter:.3g} s, more than 1 % of {Ts:g} s"
        )
    require_signals(controller, plant, log)


def _information(model: ResponseModel, s: Spectrum, scale: FloatArray) -> FloatArray:
    """The Fisher information at the start, in units of `scale`, with the noise that is left between the lines."""
    C, _ = windowed_covariances(residuals_of(model, s, model.start).between)
    variance = np.einsum("kpp->kp", C).real
    power = (np.abs(s.outputs[s.lines]) ** 2 / variance).max(axis=1)
    if np.median(power) < MIN_LINE_POWER:
        raise CheckError(
            f"{s.source}: the excitation does not rise above the noise: at half of the lines the outputs move by "
            f"less than {np.sqrt(np.median(power)):.2g} standard deviations"
        )
    slopes = model.slopes(model.start, s.rate * s.lines) * (scale / model.scale)[:, None, None, None]
    return information(slopes, s.currents[s.lines], variance)


def require_identifiable(model: ResponseModel, F: FloatArray, source: str) -> None:
    """Raise CheckError where parameters are not told, alone or together, and say which combination it is."""
    if not model.names:
        raise CheckError(f"{source}: no parameter is told by this log to 50 %: name some, or excite more")
    blind = [name for name, f in zip(model.names, np.diag(F), strict=True) if f <= 0]
    if blind:
        raise CheckError(f"{source}: {' '.join(blind)} do not act on the response at all")
    values, vectors = np.linalg.eigh(F)
    if values[0] > 1 / LOST_SHARE**2 and values[0] > 1e-12 * values[-1]:
        return
    along = vectors[:, 0] / vectors[np.abs(vectors[:, 0]).argmax(), 0]
    parts = [(n, a) for n, a in zip(model.names, along, strict=True) if abs(a) > 0.02]
    text = ", ".join(f"{name} {100 * a:+.0f} %" for name, a in parts)
    if len(parts) == 1:
        raise CheckError(f"{source}: {parts[0][0]} is not told by this log: excite more, or name it as known")
    if all(abs(a - 1) < 0.02 for _, a in parts):
        one = next((n for n, _ in parts if units_of_model(model.plant)[n] == "kg"), parts[0][0])
        names = " ".join(name for name, _ in parts)
        raise CheckError(
            f"{source}: only ratios of {names} are identifiable: all of them larger by one factor make the same "
            f"response. Name one as known, as --known {one}={_starting_value(model, one):g}"
        )
    raise CheckError(
        f"{source}: these parameters are not identifiable together: {text} make the same response. Name one as known"
    )


def _starting_value(model: ResponseModel, name: str) -> float:
    return float(model.start[model.names.index(name)])


class Found(NamedTuple):
    """What a search ends with: parameters, their covariance, residuals of each record in standard deviations,
    chi2 / dof, dof."""

    theta: FloatArray
    covariance: FloatArray
    white: list[ComplexArray]
    chi2: float
    dof: int


def _search(records: Sequence[_Record], begin: FloatArray) -> Found:
    """The most likely parameters from `begin` on.

    The weights stay those of `begin` while the parameters move: with their own, parameters that make more of noise
    between the lines would look more likely.
    """
    scale, start = records[0].model.scale, records[0].model.start
    weights = [weights_of(r.model, r.spectrum, r.at(begin)) for r in records]
    size = 2 * sum(r.spectrum.lines.size * r.spectrum.outputs.shape[1] for r in records)

    def white(theta: FloatArray) -> list[ComplexArray]:
        pairs = zip(records, weights, strict=True)
        return [white_residuals(r.model, r.spectrum, r.at(theta), W) for r, W in pairs]

    def residuals(x: FloatArray) -> FloatArray:
        try:
            e = np.sqrt(2) * np.concatenate([part.ravel() for part in white(start + scale * (x - 1))])
        except (np.linalg.LinAlgError, ValueError):
            return np.full(size, 1e6)
        return np.concatenate([e.real, e.imag])

    # Parameters are counted from 1: differences for slopes are shares of them, well above rounding.
    x = 1 + (begin - start) / scale
    found = least_squares(residuals, x, method="lm", x_scale="jac", xtol=1e-9, diff_step=[STEP])
    theta = start + scale * (found.x - 1)
    parts, dof = white(theta), size - len(scale)
    chi2 = 2 * sum(float((np.abs(part) ** 2).sum()) for part in parts) / dof
    covariance = _covariance(np.asarray(found.jac), np.asarray(found.fun), max(1.0, chi2))
    return Found(theta, covariance * np.outer(scale, scale), parts, chi2, dof)


def _estimate(records: Sequence[_Record], log: Log, dropped: Mapping[str, float], found: Found) -> Identified:
    """The machine that was found, and how white the residuals are. Raises CheckError where it is none."""
    theta, covariance, white, chi2, dof = found
    model, s, _ = records[0]
    outputs = (np.abs(np.concatenate(white)) ** 2).mean(axis=0).tolist()
    par, plant = model.plant.parameters, model.plant
    others = replace(model, names=tuple(n for n in acting_parameters(plant) if n not in model.names))
    slopes = others.slopes(others.start, s.rate * s.lines)
    held = {n: float(getattr(par, n)) for n, slope in zip(others.names, slopes, strict=True) if slope.any()}
    most_likely = machine_of(model, theta, covariance, s.source)
    limit = float(SLACK * 2 * gammainccinv(dof / 2, MIN_PROBABILITY) / dof)
    parts = [(r.model, r.spectrum, r.at(theta)) for r in records]
    return Identified(
        log=log,
        plant=most_likely,
        names=model.names,
        values=theta,
        start=model.start,
        covariance=covariance,
        held=held,
        chi2=chi2,
        limit=limit,
        dof=dof,
        whiteness=whiteness_of(white, [r.spectrum for r in records]),
        distortion=float(np.mean([distortion_of(r.model, r.spectrum, r.at(theta)) for r in records])),
        by_output=dict(zip([o.name for o in plant.outputs], outputs, strict=True)),
        dropped=dropped,
        explained=explained_at_lines(parts) if chi2 > limit else {},
    )


def machine_of(model: ResponseModel, theta: FloatArray, covariance: FloatArray, source: str) -> Plant:
    """The machine with parameters; one that noise alone takes beyond its limit is at the limit.

    Raises CheckError where it is none.
    """
    values = dict(zip(model.names, theta.tolist(), strict=True))
    for name, half in zip(model.names, (MAX_BEYOND * np.sqrt(np.diag(covariance))).tolist(), strict=True):
        field = model.plant.parameters.__dataclass_fields__.get(name)
        least = None if field is None else field.metadata.get("at_least")
        if least is not None and least - half < values[name] < least:
            values[name] = float(least)
    try:
        return plant_with(model.plant, values)
    except InputError as error:
        raise CheckError(f"{source}: what explains the log best is no machine ({error})") from error


def _require_told(records: Sequence[_Record], found: Found) -> None:
    """Raise CheckError for a parameter that is not told: as a mass is not, where two logs are alike."""
    model, added = records[0].model, records[-1].added
    sigma = np.sqrt(np.diag(found.covariance)) / np.maximum(np.abs(found.theta), model.scale)
    lost = {n: one for n, one in zip(model.names, sigma.tolist(), strict=True) if not one < LOST_SHARE}
    if lost:
        name = next((n for n in added if n in lost), max(lost, key=lambda n: lost[n]))
        source = " and ".join(r.spectrum.source for r in records)
        raise CheckError(
            f"{source}: {name} is not told: its standard deviation is {100 * lost[name]:.2g} % of its value"
            + ("; is the second log that of another machine?" if added else "")
        )


def _covariance(slopes: FloatArray, e: FloatArray, spread: float) -> FloatArray:
    """The covariance of parameters from slopes of the residuals e in standard deviations.

    chi2 times (J' J)^-1; and where the lines that tell a parameter have larger residuals than others, the larger
    deviation of (J' J)^-1 J' diag(e^2) J (J' J)^-1, which takes each line's own (White, Econometrica 48(4), 1980).
    """
    inverse = np.linalg.pinv(slopes.T @ slopes)
    own = inverse @ (slopes.T * e**2) @ slopes @ inverse * len(e) / (len(e) - len(inverse))
    grown = np.sqrt(np.maximum(np.diag(own) / (spread * np.diag(inverse)), 1.0))
    return np.asarray(spread * inverse * np.outer(grown, grown))

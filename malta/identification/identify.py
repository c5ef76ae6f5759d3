"""Parameters of a machine from a log under excitation, with intervals: maximum likelihood at the excited lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.log import Log
from malta.identification.prediction import (
    Predicted,
    noise_between_lines,
    predict,
)
from malta.identification.response import (
    ResponseModel,
    acting,
    candidates,
    deviations,
    information,
    require_parameters,
    units_of_model,
    well_found,
)
from malta.identification.spectra import (
    SIGMA,
    Spectrum,
    between_neighbours,
    readings,
    require_closed_loop,
    require_log,
    spectrum_of,
    straightened,
    whole,
    windowed_covariances,
)
from malta.model.data import plant_of
from malta.model.parameters import symbolic_names, twins_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import ComplexArray, FloatArray, Plant
    from malta.synthesis.controller import Controller

    IntArray = NDArray[np.integer[Any]]

SHARE = 0.5  # of its value: a parameter that is found worse is not asked for by itself
LOST = 1.0  # of its value: a combination of parameters that is found worse is not found
LIKELY = 1e-6  # probability below which chi2 refuses the model
SLACK = 1.1  # factor of chi2: the noise's covariance is estimated too
WHITE = 5.0  # standard deviations of the correlation between neighbouring lines
STRAIGHTENED = 12  # estimates at most, each with the curvature and the weights of the one before
SETTLED = 0.01  # standard deviations: what moves by less is settled
DIFFERENT = 3.0  # standard deviations between the estimates at the lines and in time
QUIET = (
    4.0  # power at the lines over the noise, of the output that moves most, without which nothing was excited
)


@display
@dataclass(frozen=True, eq=False)
class Identified:
    """Parameters that were identified from a log.

    log : from which
    plant : the machine with these parameters
    names : of the parameters
    values : SI
    start : SI, with which the search began: those of the gain file
    covariance : of the values, SI
    held : parameters that act too and were taken as known, SI
    chi2 : of the residuals at the lines over their degrees of freedom; 1 where the model is right
    limit : of chi2 over its degrees of freedom, above which the model is refused
    dof : degrees of freedom
    whiteness : correlation of neighbouring lines' residuals in standard deviations
    distortion : power at multiples of 1 / period that were not excited, over the noise; 1 of a linear machine
    by_output : chi2 of each output
    dropped : parameters that this log does not tell by themselves, with their standard deviation as a share
    in_time : the same parameters from prediction errors in time; None where the machine's sensors lag, or its states
        are not (q, q')

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
    >>> found.names, len(found.intervals["K_A"])
    (('K_A', 'K_B'), 2)
    """

    log: Log
    plant: Plant
    names: tuple[str, ...]
    values: FloatArray
    start: FloatArray
    covariance: FloatArray
    held: Mapping[str, float]
    chi2: float
    limit: float
    dof: int
    whiteness: float
    distortion: float
    by_output: Mapping[str, float]
    dropped: Mapping[str, float]
    in_time: Predicted | None = None

    @property
    def half_widths(self) -> FloatArray:
        """Half of each 95 % interval, SI."""
        return np.asarray(SIGMA * np.sqrt(np.diag(self.covariance)))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The 95 % interval of each parameter, SI."""
        low, high = self.values - self.half_widths, self.values + self.half_widths
        return dict(zip(self.names, zip(low.tolist(), high.tolist(), strict=True), strict=True))

    @property
    def correlation(self) -> FloatArray:
        """Of the values."""
        sigma = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    @property
    def joint(self) -> float:
        """By how much the box of the intervals grows until it holds the 95 % ellipsoid of all parameters together."""
        return float(np.sqrt(chi2_distribution.ppf(0.95, len(self.names))) / SIGMA)

    @property
    def differences(self) -> dict[str, float]:
        """By parameter: the estimate in time less that at the lines, in standard deviations of the larger one.

        Both use the same readings, so that right models differ by much less than the deviation of either.
        """
        if self.in_time is None:
            return {}
        variance = np.maximum(np.diag(self.covariance), np.diag(self.in_time.covariance))
        off = (self.in_time.values - self.values) / np.sqrt(variance)
        return dict(zip(self.names, off.tolist(), strict=True))

    @property
    def refusal(self) -> str:
        """Why the model does not explain the log; "": it does."""
        worst = max(self.by_output, key=lambda name: self.by_output[name])
        if self.chi2 > self.limit:
            return (
                f"chi2 / dof is {self.chi2:.3g}, at most {self.limit:.3g} is noise: the machine's model does not "
                f"explain the log, {worst} least ({self.by_output[worst]:.3g})"
            )
        if abs(self.whiteness) > WHITE:
            return (
                f"residuals of neighbouring lines are correlated by {self.whiteness:.1f} standard deviations, at "
                f"most {WHITE:g} is noise: the machine's model lacks something"
            )
        if self.differences and self.in_time is not None:
            name, off = max(self.differences.items(), key=lambda item: abs(item[1]))
            k = self.names.index(name)
            if abs(off) > DIFFERENT:
                return (
                    f"{name} is {self.values[k]:.5g} at the lines and {self.in_time.values[k]:.5g} in time, "
                    f"{abs(off):.1f} standard deviations apart, at most {DIFFERENT:g} is noise: the machine's model "
                    "lacks something"
                )
        return ""

    @property
    def description(self) -> Description:
        """The values with their intervals, and how well they explain the log."""
        units = units_of_model(self.plant)
        rows = [
            (name, f"{value:.5g} +- {half:.2g} {units[name]}")
            for name, value, half in zip(self.names, self.values, self.half_widths, strict=True)
        ]
        rows.append(("chi2 / dof", f"{self.chi2:.3f} of {self.dof}, at most {self.limit:.3f}"))
        return Description(f"Identified from {self.log.source!r}", tuple(rows))


def identify(
    controller: Controller,
    log: Log,
    *,
    parameters: Sequence[str] = (),
    known: Mapping[str, float] | None = None,
    start: Mapping[str, float] | None = None,
    robust: bool = False,
    in_time: bool = True,
) -> Identified:
    """Identify parameters of a machine from a log under a periodic excitation, with intervals.

    At the excited lines k the measured currents I and outputs Y obey e_k = Y_k - G(theta, w_k) I_k, where e is noise of
    the sensors alone, in closed loop too. The estimate minimizes

        sum over k of e_k^H C_k(theta)^-1 e_k,      C_k: covariance of the same e between the lines

    in which C moves with theta: so the noise that the loop feeds back into the currents does not bias the result
    (maximum likelihood with errors in the variables; Pintelon and Schoukens, System Identification, 2nd ed., ch. 9).
    Loads act at the place where the log was made, with the mean currents there. What the machine's curvature adds at
    the lines is computed from the measured motion and taken off.

    Then the same parameters are estimated from prediction errors in time (`malta.identification.prediction`), with the
    process noise that is found between the lines. Both are reported; a model that lacks something makes them differ.
    A machine whose sensors lag, or whose states are not (q, q'), is estimated at the lines alone.

    controller : the gain file that flew; its machine's parameters are where the search starts
    log : with measured currents and an excitation of whole periods
    parameters : names of the machine's record or of its sensors' errors; (): those that the log tells to 50 %, but for
        masses and lengths, which are held
    known : parameters with values that were weighed or measured otherwise, SI
    start : values from which the search starts, SI
    robust : take outliers among the readings for missing, with Student's likelihood in time
    in_time : whether to estimate in time too, where the estimate at the lines is not refused

    Up to 20 % of the readings may be missing: they are filled in with the predictions of the filter.

    Returns an Identified, also where its `refusal` says that the model does not explain the log.

    Raises InputError for unknown parameters and another machine's signals; CheckError for a log that tells nothing:
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
    plant = _known_plant(plant_of(controller.parameters), known or {}, start or {})
    _require_machine(controller, plant, log)
    y, i = readings(log, robust=robust), whole(log, "i")
    spectrum = spectrum_of(log, between_neighbours(y), i)
    names = require_parameters(plant, parameters) or candidates(plant)
    names = tuple(name for name in names if name not in (known or {}))
    model = ResponseModel(
        plant,
        names,
        tuple(log.names("i")),
        spectrum.outputs[0].real,
        spectrum.currents[0].real,
        log.sample_time,
    )
    require_closed_loop(log, float(np.linalg.eigvals(model.matrices(model.start)[0]).real.max()))
    dropped: dict[str, float] = {}
    F = _information(model, straightened(model, spectrum, model.start))
    if not parameters:
        left = well_found(F, names, SHARE / SIGMA)
        sigma = deviations(F)
        dropped = {n: float(sigma[k]) for k, n in enumerate(names) if k not in left and np.isfinite(sigma[k])}
        model = replace(model, names=tuple(names[k] for k in left))
        F = F[np.ix_(left, left)]
    _require_identifiable(model, F, log.source)
    found = _estimate_straightened(model, spectrum, log, dropped)
    filled = robust or bool(np.isnan(y).any())
    wanted = filled or (in_time and not found.refusal)
    if not wanted or plant.sensors is not None or not plant.second_order:
        return found
    predicted = _predicted(model, spectrum, found, i, y, robust=robust)
    if filled:  # once more, with predictions in their place
        spectrum = spectrum_of(log, predicted.readings, i)
        found = _estimate_straightened(model, spectrum, log, dropped)
        told = float(np.isfinite(y).mean())  # what was filled in tells nothing
        found = replace(found, covariance=found.covariance / told)
        predicted = _predicted(model, spectrum, found, i, y, robust=robust)
    return replace(found, in_time=predicted)


def _estimate_straightened(
    model: ResponseModel, s: Spectrum, log: Log, dropped: Mapping[str, float]
) -> Identified:
    """The estimate at the lines, with the machine's curvature at what was found, until that moves no more."""
    theta = model.start
    for _ in range(STRAIGHTENED):
        straight = straightened(model, s, theta)
        found = _search(model, straight, theta)
        moved = np.abs(found.theta - theta) / np.sqrt(np.diag(found.covariance))
        theta = found.theta
        if (moved < SETTLED).all():
            break
    return _estimate(model, straight, log, dropped, found)


def _predicted(
    model: ResponseModel, s: Spectrum, found: Identified, i: FloatArray, y: FloatArray, *, robust: bool
) -> Predicted:
    """The estimate in time, from that at the lines on."""
    bins, places = np.unique(s.between.ravel(), return_index=True)
    e = _residuals(model, straightened(model, s, found.values), found.values).between
    samples = round(2 * np.pi / (s.rate * model.sample_time))
    noise = noise_between_lines(
        model, found.values, s.rate * bins, e.reshape(-1, e.shape[2])[places], samples
    )
    return predict(model, found.values, noise, i, y, source=s.source, robust=robust)


def _known_plant(plant: Plant, known: Mapping[str, float], start: Mapping[str, float]) -> Plant:
    """The machine with what is known of it."""
    values = {**start, **known}
    require_parameters(plant, list(values))
    if not values:
        return plant
    return _plant_with(plant, values)


def _plant_with(plant: Plant, values: Mapping[str, float]) -> Plant:
    """The machine with these parameters; those that are alike by declaration stay alike. Errors of sensors are none."""
    par: Any = plant.parameters
    own = {name: float(value) for name, value in values.items() if name in symbolic_names(par)}
    alike = {name: own[twin] for name, twin in twins_of(par).items() if twin in own}
    return plant_of(replace(par, **alike | own))


def _require_machine(controller: Controller, plant: Plant, log: Log) -> None:
    """Raise for a log of another machine, without currents, or whose samples no model fits."""
    require_log(log, plant.name, controller.sample_time)
    log.table("y", [s.name for s in plant.outputs])
    if not log.names("i"):
        raise InputError(log.source, "i", "no measured currents", "a column for each axis, as i_dd1 [A]")
    found, Ts = log.survey, controller.sample_time
    if found.jitter > 0.01 * Ts:
        raise CheckError(
            f"{log.source}: its samples jitter by {found.jitter:.3g} s, more than 1 % of {Ts:g} s"
        )


class Residuals(NamedTuple):
    """e = Y - G I - T c at some bins, with the c of least squares at lines and between them: bins x p each."""

    lines: ComplexArray
    between: ComplexArray  # lines x NEIGHBOURS x p
    harmonics: ComplexArray


def _residuals(model: ResponseModel, s: Spectrum, theta: FloatArray) -> Residuals:
    """The residuals of parameters theta.

    What noise leaves in the states from the begin of the record to its end acts at all bins alike. It is fitted and
    taken off, as it would correlate the residuals of all lines.
    """
    kinds = (s.lines, s.between.ravel(), s.harmonics)
    bins = np.concatenate(kinds)
    G, T = model.responses(theta, s.rate * bins)
    e = s.outputs[bins] - np.einsum("kpm,km->kp", G, s.currents[bins])
    fitted = len(bins) - len(s.harmonics)
    rows = (T[:fitted] * s.weight[:, None]).reshape(-1, T.shape[2])
    size = np.linalg.norm(rows, axis=0)
    rows = rows / np.where(size > 0, size, 1.0)
    right = (e[:fitted] * s.weight).ravel()
    normal, moments = (rows.conj().T @ rows).real, (rows.conj().T @ right).real
    c = np.linalg.lstsq(normal, moments, rcond=1e-12)[0] / np.where(size > 0, size, 1.0)
    e = e - T @ c
    lines, between, harmonics = np.split(e, np.cumsum([len(kind) for kind in kinds])[:2])
    return Residuals(lines, between.reshape(*s.between.shape, -1), harmonics)


def _weights(model: ResponseModel, s: Spectrum, theta: FloatArray) -> ComplexArray:
    """W at each line, so that W e has unit variance in every entry: the residuals between the lines are noise.

    The inverse of a covariance that is estimated from n bins is too large by n / (n - p).
    """
    C, counts = windowed_covariances(_residuals(model, s, theta).between)
    p = C.shape[1]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(C)) * np.sqrt((counts - p) / counts)[:, None, None])


def _white_residuals(model: ResponseModel, s: Spectrum, theta: FloatArray, W: ComplexArray) -> ComplexArray:
    """Residuals at the lines in standard deviations, lines x p; squares sum up to chi2 with twice as many entries."""
    return np.asarray(np.einsum("kab,kb->ka", W, _residuals(model, s, theta).lines))


def _information(model: ResponseModel, s: Spectrum) -> FloatArray:
    """The Fisher information at the start, with the noise that the start leaves between the lines."""
    C, _ = windowed_covariances(_residuals(model, s, model.start).between)
    variance = np.einsum("kpp->kp", C).real
    power = (np.abs(s.outputs[s.lines]) ** 2 / variance).max(axis=1)
    if np.median(power) < QUIET:
        raise CheckError(
            f"{s.source}: the excitation does not rise above the noise: at half of the lines the outputs move by "
            f"less than {np.sqrt(np.median(power)):.2g} standard deviations"
        )
    slopes = model.slopes(model.start, s.rate * s.lines)
    return information(slopes, s.currents[s.lines], variance)


def _require_identifiable(model: ResponseModel, F: FloatArray, source: str) -> None:
    """Raise CheckError where parameters are not told, alone or together, and say which combination it is."""
    if not model.names:
        raise CheckError(f"{source}: no parameter is told by this log to 50 %: name some, or excite more")
    blind = [name for name, f in zip(model.names, np.diag(F), strict=True) if f <= 0]
    if blind:
        raise CheckError(f"{source}: {' '.join(blind)} do not act on the response at all")
    values, vectors = np.linalg.eigh(F)
    if values[0] > 1 / LOST**2 and values[0] > 1e-12 * values[-1]:
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
            f"response. Name one as known, as --known {one}={_starting(model, one):g}"
        )
    raise CheckError(
        f"{source}: these parameters are not identifiable together: {text} make the same response. Name one as known"
    )


def _starting(model: ResponseModel, name: str) -> float:
    return float(model.start[model.names.index(name)])


class Found(NamedTuple):
    """What a search ends with: parameters, their covariance, residuals in standard deviations, chi2 / dof, dof."""

    theta: FloatArray
    covariance: FloatArray
    white: ComplexArray
    chi2: float
    dof: int


def _search(model: ResponseModel, s: Spectrum, begin: FloatArray) -> Found:
    """The most likely parameters from `begin` on.

    The weights stay those of `begin` while the parameters move: with their own, parameters that make more of noise
    between the lines would look more likely.
    """
    scale, start, W = model.scale, model.start, _weights(model, s, begin)

    def residuals(moved: FloatArray) -> FloatArray:
        try:
            e = np.sqrt(2) * _white_residuals(model, s, start + scale * moved, W).ravel()
        except (np.linalg.LinAlgError, ValueError):
            return np.full(2 * s.lines.size * s.outputs.shape[1], 1e6)
        return np.concatenate([e.real, e.imag])

    found = least_squares(residuals, (begin - start) / scale, method="lm", x_scale="jac", xtol=1e-9)
    theta = start + scale * found.x
    white = _white_residuals(model, s, theta, W)
    dof = 2 * white.size - len(scale)
    chi2 = float(2 * (np.abs(white) ** 2).sum() / dof)
    covariance = _covariance(np.asarray(found.jac), np.asarray(found.fun), max(1.0, chi2))
    return Found(theta, covariance * np.outer(scale, scale), white, chi2, dof)


def _estimate(
    model: ResponseModel, s: Spectrum, log: Log, dropped: Mapping[str, float], found: Found
) -> Identified:
    """The machine that was found, and how white the residuals are. Raises CheckError where it is none."""
    theta, covariance, white, chi2, dof = found
    outputs = (np.abs(white) ** 2).mean(axis=0).tolist()
    par, plant = model.plant.parameters, model.plant
    others = replace(model, names=tuple(n for n in acting(plant) if n not in model.names))
    slopes = others.slopes(others.start, s.rate * s.lines)
    held = {n: float(getattr(par, n)) for n, slope in zip(others.names, slopes, strict=True) if slope.any()}
    try:
        most_likely = _plant_with(plant, dict(zip(model.names, theta.tolist(), strict=True)))
    except InputError as error:
        raise CheckError(f"{s.source}: what explains the log best is no machine ({error})") from error
    return Identified(
        log=log,
        plant=most_likely,
        names=model.names,
        values=theta,
        start=model.start,
        covariance=covariance,
        held=held,
        chi2=chi2,
        limit=float(SLACK * chi2_distribution.isf(LIKELY, dof) / dof),
        dof=dof,
        whiteness=_whiteness(white, s),
        distortion=_distortion(model, s, theta),
        by_output=dict(zip([o.name for o in plant.outputs], outputs, strict=True)),
        dropped=dropped,
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


def _whiteness(white: ComplexArray, s: Spectrum) -> float:
    """The correlation of neighbouring lines of one axis, over its standard deviation where they are independent."""
    total, count = 0.0, 0
    for axis in np.unique(s.axis):
        own = white[s.axis == axis] / s.turn[s.axis == axis][:, None]
        total += float((own[1:].conj() * own[:-1]).real.sum())
        count += own[1:].size
    return total / float(np.sqrt(max(count, 1) / 2))


def _distortion(model: ResponseModel, s: Spectrum, theta: FloatArray) -> float:
    """The mean power of e at harmonics that were not excited, over that of the noise; NaN where there are none."""
    if not len(s.harmonics):
        return float("nan")
    e = _residuals(model, s, theta)
    C, _ = windowed_covariances(e.between)
    nearest = np.abs(s.lines - s.harmonics[:, None]).argmin(axis=1)
    solved = np.linalg.solve(C[nearest], e.harmonics[..., None])[..., 0]
    return float((e.harmonics.conj() * solved).real.sum() / e.harmonics.size)

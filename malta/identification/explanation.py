"""What a log says of parameters where everything else is known only so well: a penalized fit with all imperfections.

    minimize over (theta, eta)   sum over k of e_k^H C_k^-1 e_k + sum of ((eta_j - known_j) / size_j)^2

theta are the parameters that are asked for; eta are those that were taken as known, and the imperfections of
`malta.identification.imperfections`, each with its size before the log. This is the maximum a posteriori estimate, and
the inverse of its curvature is the covariance of all of them together: its part of theta says how well theta is known
with everything else uncertain (total), where that of theta alone is of noise only (conditional).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import gammainccinv

from malta.errors import CheckError
from malta.identification.bench import bench_imperfections, bench_slopes
from malta.identification.imperfections import Imperfection, own_imperfections
from malta.identification.response import STEP
from malta.identification.spectra import (
    SIGMA,
    WINDOW,
    residuals_of,
    straighten,
    weights_of,
    white_residuals,
    windowed_covariances,
)
from malta.model.parameters import twins_of
from malta.work import is_stopped

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.identification.response import ResponseModel
    from malta.identification.spectra import Spectrum

MAX_ROUNDS = 8  # of the search, each with the curvature and the weights of the one before
SETTLED_STEP = 0.02  # standard deviations
SLOPE_STEP = 1e-2  # of a size: for slopes
MIN_CAUSE_SHARE = 0.02  # of what the parameters leave: a cause that explains less is not named
ALIKE_SHARE = 0.9  # of what the best cause explains: another one that explains as much may be it too
MAX_CAUSES = 6
MAX_CONFLICT = 3.7  # standard deviations between what is known of an imperfection and what the log says of it
MIN_TOLD = 1e-4  # of the variance of an imperfection, that a log takes off: below, it says nothing of it
MIN_PROBABILITY = 1e-6  # of imperfections as large as they were found


class Cause(NamedTuple):
    """An imperfection that explains a part of what the parameters leave of a log.

    name, unit : of it
    value, half : most likely, and half of its 95 % interval, SI
    size : its standard deviation before the log, SI
    share : that it explains beside the causes before it, of the power beyond noise
    alike : others that explain as much: the log cannot tell which of them it is
    """

    name: str
    unit: str
    value: float
    half: float
    size: float
    share: float
    alike: tuple[str, ...]


class KnownEffect(NamedTuple):
    """What a value that was taken as known does to the parameters where it is off by what the log leaves of it.

    name, unit : of it
    value, size : as it was known, and its standard deviation before the log, SI
    left : its standard deviation with the log, SI
    effect : of this, by parameter, as a share of its value
    """

    name: str
    unit: str
    value: float
    size: float
    left: float
    effect: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Explanation:
    """Parameters with everything else uncertain, and what explains the log beside them.

    values : of the parameters that are asked for, SI
    covariance : of these, with everything else uncertain, SI
    alone : the same by noise alone, with everything else as it was found
    chi2 : of the residuals at the lines with all imperfections, over their degrees of freedom
    causes : imperfections that explain what the parameters alone leave, those that explain most first
    effects : of everything else that was taken as known: what it does to the parameters, the largest first
    w : of each line, rad/s
    measured : k x outputs, the outputs at the lines over the rms of each at all lines
    left : of the same, e that nothing explains, with all imperfections
    noise : of the same, standard deviation of e by noise
    share : of the response at the lines that nothing explains, of the worst output
    mistake : why imperfections of usual sizes do not explain the log; "": they do
    names : of the parameters that were asked for, and of everything else of the machine
    bench : imperfections of the bench
    x : the most likely values of `names` and of `bench`, SI
    """

    values: FloatArray
    covariance: FloatArray
    alone: FloatArray
    chi2: float
    causes: tuple[Cause, ...]
    effects: tuple[KnownEffect, ...]
    w: FloatArray
    measured: ComplexArray
    left: ComplexArray
    noise: FloatArray
    share: float
    mistake: str
    names: tuple[str, ...]
    bench: tuple[Imperfection, ...]
    x: FloatArray


class Part(NamedTuple):
    """A log to explain: its machine with all imperfections, its spectrum, and what is added to its first parameters."""

    model: ResponseModel
    spectrum: Spectrum
    added: FloatArray


class _Priors(NamedTuple):
    """rows @ x - right are the imperfections in sizes; `start` and `step` of each parameter."""

    rows: FloatArray
    right: FloatArray
    start: FloatArray
    step: FloatArray
    imperfections: list[Imperfection]


def explain(
    parts: Sequence[tuple[ResponseModel, Spectrum, Mapping[str, float]]],
    begin: FloatArray,
    known: Mapping[str, tuple[float, float]],
    limit: float,
    *,
    refine: bool,
) -> Explanation:
    """Explain logs by parameters and imperfections together, from the parameters `begin` on.

    parts : of each log its machine with the parameters that are asked for, its spectrum, what is added to parameters
    known : values and standard deviations of what is known, by name, SI; others have the usual ones
    limit : of chi2 over its degrees of freedom, below which it is noise
    refine : whether to search; else `begin` is near enough for one step

    Raises CheckError for a log that no machine of this kind makes.
    """
    model, spectrum, _ = parts[0]
    priors = _priors(model, spectrum, known)
    own = tuple(one.name for one in priors.imperfections if one.kind == "parameter")
    bench = tuple(one for one in priors.imperfections if one.kind != "parameter")
    wide = [
        Part(
            replace(m, names=(*m.names, *own), bench=bench),
            s,
            np.array([added.get(n, 0.0) for n in (*m.names, *own)] + [0.0] * len(bench)),
        )
        for m, s, added in parts
    ]
    count, x = len(model.names), priors.start.copy()
    x[:count] = begin
    try:
        for _ in range(MAX_ROUNDS if refine else 1):
            r, J = _linearize(wide, x, priors.step)
            moved, covariance = _step(r, J, priors, x)
            x = x + moved
            settled = np.abs(moved[:count]) < SETTLED_STEP * np.sqrt(np.diag(covariance)[:count])
            if settled.all() or is_stopped():
                break
        return _explanation(wide, priors, x, r + J @ moved, J, limit)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CheckError(f"{spectrum.source}: no machine of this kind makes this log ({error})") from None


def _priors(model: ResponseModel, s: Spectrum, given: Mapping[str, tuple[float, float]]) -> _Priors:
    """The imperfections that are not asked for, with their sizes."""
    sizes = {name: size for name, (_, size) in given.items()}
    imperfections = [
        *_keep_acting(model, own_imperfections(model.plant, model.names, sizes)),
        *(
            i._replace(size=sizes.get(i.name, i.size))
            for i in bench_imperfections(model, s.rate * s.lines)
            if i.name not in model.names and sizes.get(i.name, 1.0) > 0
        ),
    ]
    par, count = model.plant.parameters, len(model.names)
    names = [*model.names, *(one.name for one in imperfections)]
    known = [
        float(getattr(par, one.name, 0.0)) if one.kind == "parameter" else given.get(one.name, (0.0, 0.0))[0]
        for one in imperfections
    ]
    size = np.array([one.size for one in imperfections])
    rows, right = np.zeros((len(imperfections), len(names))), np.array(known) / size
    twins = twins_of(par)
    for k, one in enumerate(imperfections):
        rows[k, count + k] = 1 / size[k]
        if (twin := twins.get(one.name, "")) in names and one.kind == "parameter":
            rows[k, names.index(twin)], right[k] = -1 / size[k], 0.0
    start = np.array([*model.start, *known])
    return _Priors(rows, right, start, np.array([*(STEP * model.scale), *(SLOPE_STEP * size)]), imperfections)


def _keep_acting(model: ResponseModel, found: Sequence[Imperfection]) -> list[Imperfection]:
    """The imperfections of the machine and its sensors that move its matrices where it is."""
    wide = replace(model, names=(*model.names, *(one.name for one in found)))
    same, count = wide.linear(wide.start), len(model.names)
    acting = []
    for k, one in enumerate(found):
        moved = wide.start.copy()
        moved[count + k] += one.size
        if any((a != b).any() for a, b in zip(wide.linear(moved), same, strict=True)):
            acting.append(one)
    return acting


def _linearize(parts: Sequence[Part], x: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of all lines in standard deviations and their slopes, both real, with weights and curvature at x."""
    rows, slopes = [], []
    for model, spectrum, added in parts:
        at, n = x + added, len(model.names)
        s = straighten(replace(model, bench=()), spectrum, at[:n])
        W, w, flowing = weights_of(model, s, at), s.rate * s.lines, s.currents[s.lines]
        e = white_residuals(model, s, at, W)
        own = [
            (model.response(at + h, w) - model.response(at - h, w)) / (2 * h.max()) for h in np.diag(step)[:n]
        ]
        dG = np.concatenate([np.array(own), bench_slopes(model, at, w)])
        J = -np.einsum("kab,nkbm,km->kan", W, dG, flowing, optimize=True).reshape(e.size, -1)
        rows.append(np.concatenate([e.real.ravel(), e.imag.ravel()]))
        slopes.append(np.concatenate([J.real, J.imag]))
    return np.sqrt(2) * np.concatenate(rows), np.sqrt(2) * np.concatenate(slopes)


def _step(r: FloatArray, J: FloatArray, priors: _Priors, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The step to the most likely x, and its covariance."""
    rows = np.vstack([J, priors.rows])
    unit = np.linalg.norm(rows, axis=0)
    Q, R = np.linalg.qr(rows / unit)
    right = np.concatenate([r, priors.rows @ x - priors.right])
    inverse = np.linalg.inv(R) / unit[:, None]
    return -inverse @ (Q.T @ right), inverse @ inverse.T


def _explanation(
    parts: Sequence[Part], priors: _Priors, x: FloatArray, r: FloatArray, J: FloatArray, limit: float
) -> Explanation:
    """What the end of a search says."""
    model = parts[0].model
    count = len(model.names) - sum(one.kind == "parameter" for one in priors.imperfections)
    covariance = _step(r, J, priors, x)[1]
    told = covariance @ J.T  # of the data, and of what was known before
    freedom = len(r) - float(np.einsum("ij,ji->", told, J))
    chi2 = float(r @ r) / freedom
    own = (told * r**2) @ told.T * len(r) / freedom
    data = told @ told.T * max(1.0, chi2)
    grown = np.sqrt(np.maximum(np.diag(own) / np.maximum(np.diag(data), 1e-300), 1.0))
    # What nothing explains is alike at neighbouring lines: so many of them count as one.
    bound = 2 * WINDOW + 1 if chi2 > limit else 1
    known = covariance @ priors.rows.T
    total = known @ known.T + bound * data * np.outer(grown, grown)
    causes = _causes(priors, count, x, r, J)
    lines = [residual_shares(p.model, p.spectrum, x + p.added) for p in parts]
    measured, left, noise = (np.concatenate([one[k] for one in lines]) for k in range(3))
    return Explanation(
        x[:count],
        total[:count, :count],
        np.linalg.pinv(J[:, :count].T @ J[:, :count]),
        chi2,
        causes,
        _effects(priors, model.names[:count], x, J, covariance),
        np.concatenate([p.spectrum.rate * p.spectrum.lines for p in parts]),
        measured,
        left,
        np.abs(noise),
        float(excess_share(left, noise).max()) if chi2 > limit else 0.0,
        _mistake(priors, x, covariance),
        model.names,
        model.bench,
        x,
    )


def _mistake(priors: _Priors, x: FloatArray, covariance: FloatArray) -> str:
    """Why the imperfections that were found are none of usual sizes.

    With its own prior left out, each would be elsewhere: by off / (1 - c), where c is its variance with the prior over
    that without the log. Over the deviation of that difference this is off / sqrt(1 - c), a standard normal number.
    """
    off = priors.rows @ x - priors.right
    told = 1 - np.einsum("ij,jk,ik->i", priors.rows, covariance, priors.rows)
    conflict = np.where(told > MIN_TOLD, np.abs(off) / np.sqrt(np.maximum(told, MIN_TOLD)), 0.0)
    k = int(conflict.argmax())
    if conflict[k] > MAX_CONFLICT:
        one, sizes = priors.imperfections[k], float(off[k] / told[k])
        return (
            f"by the log {one.name} is {sizes * one.size:+.3g} {one.unit} off what is known, {abs(sizes):.2g} times "
            "its usual size"
        )
    told_of = float(told.sum())
    if off @ off > 2 * gammainccinv(max(told_of, 1.0) / 2, MIN_PROBABILITY):
        return f"imperfections would have to be {np.sqrt(off @ off / max(told_of, 1.0)):.2g} times as large as usual"
    return ""


def residual_shares(
    model: ResponseModel, spectrum: Spectrum, theta: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Outputs at the lines, residuals there, and deviations of these by noise, over the rms of each output."""
    s = straighten(replace(model, bench=()), spectrum, theta[: len(model.names)])
    found = residuals_of(model, s, theta)
    size = np.sqrt((np.abs(s.outputs[s.lines]) ** 2).mean(axis=0))
    C, _ = windowed_covariances(found.between)
    noise = np.sqrt(np.einsum("kpp->kp", C).real) / size
    return s.outputs[s.lines] / size, found.lines / size, noise + 0j


def excess_share(left: ComplexArray, noise: ComplexArray) -> FloatArray:
    """By output: the rms of residuals beside what noise leaves, over that of the output; see `residual_shares`."""
    power = (np.abs(left) ** 2).mean(axis=0) - (np.abs(noise) ** 2).mean(axis=0)
    return np.asarray(np.sqrt(np.maximum(power, 0.0)))


def _causes(priors: _Priors, count: int, x: FloatArray, r: FloatArray, J: FloatArray) -> tuple[Cause, ...]:
    """The imperfections that explain what the parameters leave, one after the other: each explains most of the rest.

    To first order, and with the parameters following, as everything moves back to what was known before.
    """
    off = priors.rows @ x - priors.right
    lone = np.array([one.size for one in priors.imperfections])
    start = r - J[:, count:] @ (off * lone)  # everything else as known
    U = J[:, count:] * lone
    chosen: list[int] = []
    Q = np.linalg.qr(J[:, :count])[0]
    first = start - Q @ (Q.T @ start)
    beyond = float(first @ first) - (len(r) - count)
    found: list[tuple[int, float, tuple[str, ...]]] = []
    while beyond > 0 and len(chosen) < MAX_CAUSES:
        basis = np.hstack([J[:, :count], U[:, chosen]])
        Q = np.linalg.qr(basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300))[0]
        rest, free = start - Q @ (Q.T @ start), U - Q @ (Q.T @ U)
        power = np.einsum("ij,ij->j", free, free)
        gain = np.where(power > 1e-9 * np.einsum("ij,ij->j", U, U), (free.T @ rest) ** 2 / (power + 1), 0.0)
        at = priors.start[count:] - (free.T @ rest) / (power + 1) * lone
        gain[chosen] = 0.0
        gain[at < [one.least for one in priors.imperfections]] = 0.0
        best = int(gain.argmax())
        if gain[best] < max(MIN_CAUSE_SHARE * beyond, 10.0):
            break
        alike = [k for k in np.argsort(-gain) if k != best and gain[k] > ALIKE_SHARE * gain[best]]
        found.append((best, float(gain[best]) / beyond, tuple(priors.imperfections[k].name for k in alike)))
        chosen.append(best)
    basis = np.hstack([J[:, :count], U[:, chosen]])
    penalty = np.diag([0.0] * count + [1.0] * len(chosen))
    C = np.linalg.pinv(basis.T @ basis + penalty)
    at = -C @ (basis.T @ start)
    causes = []
    for place, (k, share, others) in enumerate(found):
        one, sizes = priors.imperfections[k], float(at[count + place])
        value = float(priors.start[count + k] + sizes * one.size)
        half = SIGMA * float(np.sqrt(C[count + place, count + place])) * float(one.size)
        causes.append(Cause(one.name, one.unit, value, half, one.size, min(1.0, share), others))
    return tuple(causes)


def _effects(
    priors: _Priors, names: Sequence[str], x: FloatArray, J: FloatArray, covariance: FloatArray
) -> tuple[KnownEffect, ...]:
    """What each imperfection moves the parameters by where no other one follows; that which moves most comes first."""
    count, found = len(names), []
    rows = priors.rows
    left = np.sqrt(np.einsum("ij,jk,ik->i", rows, covariance, rows))
    lone = np.array([one.size for one in priors.imperfections]) * np.minimum(left, 1.0)
    moved = -np.linalg.lstsq(J[:, :count], J[:, count:] * lone, rcond=None)[0] / np.abs(x[:count])[:, None]
    for k in np.argsort(-np.abs(moved).max(axis=0), kind="stable"):
        one, shares = priors.imperfections[k], dict(zip(names, moved[:, k].tolist(), strict=True))
        known = float(priors.start[count + k])
        found.append(KnownEffect(one.name, one.unit, known, one.size, float(lone[k]), shares))
    return tuple(found)

"""Which parameter that was taken as known explains what a model leaves of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from malta.identification.response import STEP, ResponseModel, acting
from malta.identification.spectra import Spectrum, weights_of, white_residuals
from malta.model.parameters import twins_of

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

FARTHEST = 0.5  # of its value: a parameter that would have to change by more explains nothing
ALONE = 1e-6  # of a slope: what is left of it beside those of the estimated parameters, if it acts by itself

Explained = Mapping[str, tuple[float, float]]
"""By parameter: the change that explains most, as a share of its value or of a sensor's gain, and the share that it
explains."""


def sentence_of(explained: Explained) -> str:
    """The parameters that explain most, in words; "" where none was looked at."""
    best = max((share for _, share in explained.values()), default=0.0)
    parts = [f"{n} {100 * c:+.2g} %" for n, (c, share) in explained.items() if share > 0.9 * best]
    if best < 0.5:
        return "; no parameter by itself explains half of it" if explained else ""
    return f"; {' or '.join(parts)} would explain {100 * best:.0f} % of it"


def explained_at_lines(parts: Sequence[tuple[ResponseModel, Spectrum, FloatArray]]) -> Explained:
    """What a change of each parameter that is not estimated would explain of chi2, the estimated ones following it.

    To first order the residuals r move by u a with the change a. Of u and r only what is perpendicular to the slopes of
    the estimated parameters counts: a = -u'r / u'u, which takes (u'r)^2 / u'u off r'r. Shares are of what r'r has
    beyond noise.

    parts : of each log: the machine, the spectrum without curvature, and the parameters that were found, SI
    """
    plant, names = parts[0][0].plant, parts[0][0].names
    gains = (error.name for error in plant.sensor_errors if error.unit == "1")
    alone = ((twin,) for twin in twins_of(plant.parameters))  # a twin among others would not follow its twin
    found = {}
    for group in ((*acting(plant), *gains), *alone):
        others = [name for name in group if name not in names]
        if not others:
            continue
        columns = [_slopes(model, s, theta, others) for model, s, theta in parts]
        r, J = (np.concatenate(stacked) for stacked in zip(*columns, strict=True))
        Q = np.linalg.qr(J[:, : len(names)])[0]
        r = r - Q @ (Q.T @ r)
        beyond = float(r @ r) - (len(r) - len(names)) / 2
        for name, whole in zip(others, J[:, len(names) :].T, strict=True):
            u = whole - Q @ (Q.T @ whole)
            acts = np.linalg.norm(u) > ALONE * np.linalg.norm(whole)
            if acts and beyond > 0 and abs(a := -float(u @ r / (u @ u))) < FARTHEST:
                found[name] = (a, min(1.0, a**2 * float(u @ u) / beyond))
    return found


def _slopes(
    model: ResponseModel, s: Spectrum, theta: FloatArray, others: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Residuals at the lines in standard deviations, and their slopes in shares of all parameters, both real."""
    W = weights_of(model, s, theta)
    par, twins = model.plant.parameters, twins_of(model.plant.parameters)
    own = dict(zip(model.names, theta.tolist(), strict=True))
    taken = [own.get(twins.get(name, ""), float(getattr(par, name, 0.0))) for name in others]
    whole, wide = np.array([*theta, *taken]), replace(model, names=(*model.names, *others))

    def white(at: FloatArray) -> FloatArray:
        e = white_residuals(wide, s, at, W).ravel()
        return np.concatenate([e.real, e.imag])

    steps = STEP * np.diag(np.where(whole == 0, 1.0, whole))
    return white(whole), np.array([(white(whole + h) - white(whole - h)) / (2 * STEP) for h in steps]).T

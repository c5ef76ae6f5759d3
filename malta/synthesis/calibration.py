"""Weights that reproduce given gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from malta.errors import InputError
from malta.model.linearize import LinearModel
from malta.processes import on_one_thread
from malta.synthesis.weighting import Weights


@on_one_thread
def calibrate(
    model: LinearModel,
    weights: Weights,
    stiffness_ratio: float,
    axial_ratio: float = 1.0,
    integral_time: float | Sequence[float] = 1.0,
) -> Weights:
    """Find bases of the weights on which the LQR is a given number of times as stiff as the magnets pull.

    Where the modes decouple, q'' = k q + u with input weight 1/g gives K1 = k + sqrt(k^2 + q g / base^2), so the
    base follows from K1 = stiffness_ratio k. The natural frequency is then w_n = sqrt((stiffness_ratio - 1) k). A
    rate's base is w_n times its position's. k, K1 and g are per unit of mass or inertia (1/s2). Integral action makes
    the exported controller a little stiffer.

    model : the linear model, with decoupled modes
    weights : dimensionless weights, whose bases are replaced
    stiffness_ratio : K1 / k of every unstable mode, more than 2 (which is reached at zero weight)
    axial_ratio : w_n of modes without stiffness over the w_n of the first mode
    integral_time : s, one or one for each output: an error integral's base is this times that of the first position
        (radial) or of its own (modes without stiffness). Free: K1 / k does not depend on it, so fit it on a response

    Returns the weights with the new bases.

    Raises InputError when stiffness_ratio <= 2, axial_ratio or integral_time <= 0, there are more or fewer times than
    outputs, the first mode has no stiffness, or the modes couple.

    >>> import malta
    >>> spec = malta.read_design("design/calibrated.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> K = malta.synthesis.lqr(
    ...     model, malta.synthesis.calibrate(model, spec.weights, stiffness_ratio=4)
    ... )
    >>> stiffness = (model.force_map @ K)[0, 0] / model.stiffness[0, 0]
    >>> f"K1 / k = {stiffness:.3f}"
    'K1 / k = 4.000'
    """
    k, G = model.stiffness, model.force_map
    n = len(k)
    coupling = k - np.diag(np.diag(k))
    if np.abs(coupling).max() > 1e-9 * np.abs(k).max():
        raise InputError("calibrate", "model", "coupled modes", "decoupled ones: z_ss = 0, zero preload")
    if not stiffness_ratio > 2:
        raise InputError("calibrate", "stiffness_ratio", f"{stiffness_ratio:g}", "more than 2")
    times, p = np.asarray(integral_time, dtype=float), len(model.plant.outputs)
    if times.shape not in ((), (p,)):
        raise InputError(
            "calibrate", "integral_time", f"{times.size} times", f"one, or one for each of {p} outputs"
        )
    for name, value in (("axial_ratio", axial_ratio), ("integral_time", float(times.min()))):
        if not value > 0:
            raise InputError("calibrate", name, f"{value:g}", "more than 0")
    stiffness = np.diag(k)
    if not (stiffness[0] > 0 and (stiffness >= 0).all()):
        raise InputError("calibrate", "model", f"stiffness {stiffness[0]:g} 1/s2", "an unstable first mode")
    g = np.diag(G * (weights.r_base**2 / weights.r) @ G.T)
    free = stiffness == 0
    w_n = np.sqrt((stiffness_ratio - 1) * np.where(free, stiffness[0] * axial_ratio**2, stiffness))
    K1 = w_n**2 + stiffness
    base = np.sqrt(weights.q[:n] * g / ((K1 - stiffness) ** 2 - stiffness**2))
    own = {s.name: i for i, s in enumerate(model.plant.design_states[:n])}
    integral_base = times * base[[own.get(s.name, 0) for s in model.plant.outputs]]
    return replace(weights, q_base=np.concatenate([base, base * w_n]), q_i_base=integral_base)

"""Imperfections of the bench of a machine, where a log was made, and what they do to its response."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from malta.identification.imperfections import (
    BETWEEN_SHARE,
    COMMON_GAIN,
    CROSS_TALK,
    DAMPING,
    FORCE,
    FRAME,
    GAIN,
    SKEW,
    STIFFNESS,
    Imperfection,
    turn,
)

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.identification.response import ResponseModel


def bench_imperfections(model: ResponseModel, w: FloatArray) -> list[Imperfection]:
    """Those of any bench: gains, cross talk, forces, stiffness and damping between coordinates, and skews.

    w : excited lines, rad/s
    """
    plant, Ts = model.plant, model.sample_time
    A, B, _, _ = model.matrices(model.start)
    outputs, errors = plant.outputs, [s.name for s in plant.sensors.errors]
    found = [Imperfection("skew", "s", SKEW * Ts, "skew", -1)]
    if plant.has_stroke:
        k = plant.stroke_output
        found.append(Imperfection(f"skew_{plant.stroke.name}", "s", SKEW * Ts, "skew", k))
    found.append(Imperfection("gain_readings", "1", COMMON_GAIN, "readings"))
    found.append(Imperfection("gain_currents", "1", COMMON_GAIN, "currents"))
    found += [Imperfection(f"gain_{n}", "1", GAIN, "current", k, k) for k, n in enumerate(model.currents)]
    for r, to in enumerate(outputs):
        if f"gain_{to.name}" not in errors:
            found.append(Imperfection(f"gain_{to.name}", "1", GAIN, "reading", r, r))
        others = [(c, s) for c, s in enumerate(outputs) if c != r and s.unit == to.unit]
        found += [Imperfection(f"{s.name}_in_{to.name}", "1", CROSS_TALK, "reading", r, c) for c, s in others]
    if not plant.second_order:
        return found
    half, q = len(plant.controlled) // 2, [s.name for s in plant.design_states]
    found += [
        Imperfection(f"frame_{q[a]}_{q[b]}", "rad", FRAME, "frame", a, b)
        for a, b in combinations([k for k in range(half) if plant.design_states[k].unit == "m"], 2)
    ]
    pushed = np.abs(B[half : 2 * half]).max(axis=1)
    natural = np.sqrt(np.maximum(np.abs(np.diag(A[half : 2 * half, :half])), w.min() ** 2))
    middle = np.maximum(natural, np.sqrt(w.min() * w.max()))
    for r in range(half):
        if not pushed[r]:
            continue
        found += [
            Imperfection(
                f"{n}_on_{q[r]}",
                f"{plant.design_states[half + r].unit}/s/A",
                FORCE * pushed[r],
                "force",
                r,
                c,
            )
            for c, n in enumerate(model.currents)
        ]
        for c in range(half):
            if not pushed[c]:
                continue
            unit, ratio = (
                f"{plant.design_states[half + r].unit}/s/({plant.design_states[c].unit})",
                pushed[r] / pushed[c],
            )
            stiff, damp = STIFFNESS * natural[r] * natural[c], DAMPING * np.sqrt(middle[r] * middle[c])
            damp *= 1.0 if r == c else BETWEEN_SHARE
            found.append(Imperfection(f"stiffness_{q[r]}_{q[c]}", unit, stiff * ratio, "stiffness", r, c))
            found.append(Imperfection(f"damping_{q[r]}_{q[c]}", f"{unit}*s", damp * ratio, "damping", r, c))
    return found


def bench_slopes(model: ResponseModel, theta: FloatArray, w: FloatArray) -> ComplexArray:
    """dG of each imperfection of the bench, imperfections x k x p x currents.

    Those inside the machine are C (jw - A)^-1 dA (jw - A)^-1 B and its like, behind the hold of the currents: images
    of a response beyond half of the sampling rate, which hardly move with them, are left out.

    theta : parameters and imperfections, SI
    w : k frequencies, rad/s
    """
    A, B, C, late = model.matrices(theta)
    G, s, half = model.response(theta, w), 1j * w[:, None, None], len(model.plant.controlled) // 2
    R = np.linalg.inv(s * np.eye(len(A)) - A)
    delay = np.exp(-1j * w * late.item())[:, None, None]
    before, held = R @ B, delay * model.hold(w)[:, None, None]
    after = held * (C @ R)
    found = np.zeros((len(model.bench), *G.shape), dtype=complex)
    for dG, one in zip(found, model.bench, strict=True):
        entry = half + one.row
        if one.kind in ("stiffness", "damping"):
            at = one.column + half * (one.kind == "damping")
            dG[:] = after[:, :, entry, None] * before[:, None, at]
        elif one.kind == "force":
            dG[:, :, one.column] = after[:, :, entry]
        elif one.kind == "reading":
            dG[:, one.row] = G[:, one.column]
        elif one.kind == "current":
            dG[:, :, one.column] = G[:, :, one.row]
        elif one.kind == "frame":
            dG[:] = held * (C[:, :half] @ turn(model.plant, one.row, one.column) @ before[:, :half])
        elif one.kind == "skew":
            rows = slice(None) if one.row < 0 else slice(one.row, one.row + 1)
            dG[:, rows] = -s * G[:, rows]
        else:
            dG[:] = G
    return found

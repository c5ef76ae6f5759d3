"""The stroke of 0.1 s as a user of python-control would write it: its documented way.

Plant and controller are discrete `nlsys` systems, joined by `interconnect` and run by `input_output_response`; one
update of the plant is four Runge–Kutta steps of the mover and its current loops. Written twice: as the documentation's
examples are, on numpy arrays; and on plain floats, which python runs faster than numpy's small arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import control
import numpy as np

from malta.machines.tubular.plant import Parameters
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.arrays import FloatArray

SUBSTEPS = 4


def mover(par: Parameters, s: Any, v: Any, sin: Callable[..., Any], cos: Callable[..., Any]) -> list[Any]:
    """Rates of (x y z alpha beta gamma, their rates, five forces): malta's tubular plant, by hand."""
    x, y, z, al, be, ga, vx, vy, vz, da, db, dg, f1x, f1y, f2x, f2y, fd = s
    sa, ca, sb, cb, sg, cg = sin(al), cos(al), sin(be), cos(be), sin(ga), cos(ga)
    n0, n1 = sb, -sa * cb
    l1, l2 = -(par.l_B + z), par.l_B - z
    a1x, a1y = par.K_A * (x + l1 * n0), par.K_A * (y + l1 * n1)
    a2x, a2y = par.K_A * (x + l2 * n0), par.K_A * (y + l2 * n1)
    F1x, F1y, F2x, F2y = f1x + a1x, f1y + a1y, f2x + a2x, f2y + a2y
    cogging = par.F_c * sin(2 * math.pi / par.L_p * z + par.phi_c)
    Fz = fd - (a1x + a2x) * n0 - (a1y + a2y) * n1 + cogging
    mx, my, mz = l1 * F1x + l2 * F2x, l1 * F1y + l2 * F2y, (l1 + l2) * fd / 2
    # The torque n x m, seen in the mover's frame R, is e_z x (R m).
    p = cb * mx + sa * sb * my - ca * sb * mz
    q = ca * my + sa * mz
    Tx, Ty = sg * p - cg * q, cg * p + sg * q
    wx, wy, wz = cg * cb * da + sg * db, -sg * cb * da + cg * db, sb * da + dg
    ex = (Tx - (par.I_zz - par.I_yy) * wy * wz) / par.I_xx
    ey = (Ty - (par.I_xx - par.I_zz) * wx * wz) / par.I_yy
    ez = -(par.I_yy - par.I_xx) * wx * wy / par.I_zz
    # omega' = E q'' + E' q'
    ex -= -sg * dg * cb * da - cg * sb * db * da + cg * dg * db
    ey -= -cg * dg * cb * da + sg * sb * db * da - sg * dg * db
    ez -= cb * db * da
    dda = (cg * ex - sg * ey) / cb
    rates = [vx, vy, vz, da, db, dg, (F1x + F2x) / par.m, (F1y + F2y) / par.m - par.g, Fz / par.m]
    rates += [dda, sg * ex + cg * ey, ez - sb * dda]
    return rates + [par.w_cc * (c - f) for c, f in zip(v, (f1x, f1y, f2x, f2y, fd), strict=True)]


def _documented_update(par: Parameters, Ts: float) -> Callable[..., FloatArray]:
    h = Ts / SUBSTEPS

    def rate(s: FloatArray, v: FloatArray) -> FloatArray:
        return np.array(mover(par, s, v, np.sin, np.cos))

    def update(t: float, s: FloatArray, v: FloatArray, params: Any) -> FloatArray:
        for _ in range(SUBSTEPS):
            k1 = rate(s, v)
            k2 = rate(s + h / 2 * k1, v)
            k3 = rate(s + h / 2 * k2, v)
            k4 = rate(s + h * k3, v)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return s

    return update


def _lean_update(par: Parameters, Ts: float) -> Callable[..., FloatArray]:
    h = Ts / SUBSTEPS

    def moved(s: list[float], k: list[float], step: float) -> list[float]:
        return [p + step * q for p, q in zip(s, k, strict=True)]

    def update(t: float, s: FloatArray, v: FloatArray, params: Any) -> FloatArray:
        a: list[float] = s.tolist()
        u: list[float] = v.tolist()
        for _ in range(SUBSTEPS):
            k1 = mover(par, a, u, math.sin, math.cos)
            k2 = mover(par, moved(a, k1, h / 2), u, math.sin, math.cos)
            k3 = mover(par, moved(a, k2, h / 2), u, math.sin, math.cos)
            k4 = mover(par, moved(a, k3, h), u, math.sin, math.cos)
            a = [
                p + h / 6 * (q1 + 2 * (q2 + q3) + q4)
                for p, q1, q2, q3, q4 in zip(a, k1, k2, k3, k4, strict=True)
            ]
        return np.array(a)

    return update


def closed_loop(par: Parameters, c: Controller, *, lean: bool) -> Any:
    """Mover and control law, interconnected. Inputs r = (p*, xi*, v_ff); outputs y."""
    Ts, ff, limit = c.sample_time, c.feedforward, c.limits.force

    def measured(t: float, s: FloatArray, v: FloatArray, params: Any) -> FloatArray:
        slope = np.array([math.sin(s[4]), -math.sin(s[3]) * math.cos(s[4])]) / (
            math.cos(s[3]) * math.cos(s[4])
        )
        return np.concatenate([s[:2] - (par.l_S + s[2]) * slope, s[:2] + (par.l_S - s[2]) * slope, s[2:3]])

    def act(s: FloatArray, u: FloatArray) -> tuple[FloatArray, ...]:
        y, p_ref, xi_ref, v_ff = u[:5], u[5:10], u[10:20], u[20:25]
        e = s[10:15] + Ts * (1 - s[15:20]) * (p_ref - y)
        xi_hat = s[:10] + c.L @ (y - c.Cd @ s[:10])
        v0 = np.array([np.interp(y[4], ff.z_grid, column) for column in ff.v0.T])
        wanted = c.K @ (xi_ref - xi_hat) + c.Ki @ e + v_ff + v0
        v = np.clip(wanted, -limit, limit)
        return e, xi_hat, v0, v, (v != wanted).astype(float)

    def advance(t: float, s: FloatArray, u: FloatArray, params: Any) -> FloatArray:
        e, xi_hat, v0, v, frozen = act(s, u)
        return np.concatenate([c.Ad @ xi_hat + c.Bd @ (v - v0), e, frozen])

    def command(t: float, s: FloatArray, u: FloatArray, params: Any) -> FloatArray:
        return act(s, u)[3]

    forces, outputs, references = (
        [f"{name}[{i}]" for i in range(size)] for name, size in (("v", 5), ("y", 5), ("r", 20))
    )
    update = (_lean_update if lean else _documented_update)(par, Ts)
    plant = control.nlsys(update, measured, inputs=forces, outputs=outputs, states=17, dt=Ts, name="mover")
    law = control.nlsys(
        advance, command, inputs=outputs + references, outputs=forces, states=20, dt=Ts, name="law"
    )
    return control.interconnect([plant, law], inputs=references, outputs=outputs)


def documented_run(par: Parameters, controller: Controller, inputs: FloatArray, first: FloatArray) -> float:
    """One machine's stroke, built and run: largest output, m. For loops over machines in other processes."""
    t = np.arange(inputs.shape[1]) * controller.sample_time
    found = control.input_output_response(closed_loop(par, controller, lean=False), t, inputs, X0=first)
    return float(np.abs(found.outputs).max())

"""The stroke of 0.1 s as a user of python-control alone would write it: its documented way.

Plant and controller are discrete `nlsys` systems joined by `interconnect` and run by `input_output_response`; one update
of the plant is four Runge–Kutta steps of the mover and its current loops. The mover is written out in plain
floats, which python runs faster than numpy's small arrays: this is the fast way to write it by hand.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import control
import numpy as np

from malta.controller import Controller
from malta.plants.tubular import Parameters

STEPS, SUBSTEPS = 2000, 4


def mover(par: Parameters, s: list[float], v: list[float]) -> list[float]:
    """Rates of (x y z alpha beta gamma, their rates, five forces): malta's tubular plant, written by hand."""
    x, y, z, al, be, ga, vx, vy, vz, da, db, dg, f1x, f1y, f2x, f2y, fd = s
    sa, ca, sb, cb, sg, cg = sin(al), cos(al), sin(be), cos(be), sin(ga), cos(ga)
    n0, n1, n2 = sb, -sa * cb, ca * cb
    l1, l2 = -(par.l_B + z), par.l_B - z
    a1x, a1y = par.K_A * (x + l1 * n0), par.K_A * (y + l1 * n1)
    a2x, a2y = par.K_A * (x + l2 * n0), par.K_A * (y + l2 * n1)
    F1x, F1y, F2x, F2y = f1x + a1x, f1y + a1y, f2x + a2x, f2y + a2y
    Fz = fd - (a1x + a2x) * n0 - (a1y + a2y) * n1 + par.F_c * sin(2 * pi / par.L_p * z + par.phi_c)
    mx, my, mz = l1 * F1x + l2 * F2x, l1 * F1y + l2 * F2y, (l1 + l2) * fd / 2
    # the torque n x m, seen in frame R, is e_z x (R m)
    p = cb * mx + sa * sb * my - ca * sb * mz
    q = ca * my + sa * mz
    Tx, Ty = sg * p - cg * q, cg * p + sg * q
    wx, wy, wz = cg * cb * da + sg * db, -sg * cb * da + cg * db, sb * da + dg
    ax = (Tx - (par.I_zz - par.I_yy) * wy * wz) / par.I_xx
    ay = (Ty - (par.I_xx - par.I_zz) * wx * wz) / par.I_yy
    az = -(par.I_yy - par.I_xx) * wx * wy / par.I_zz
    # omega' = E q'' + E' q'
    ex = ax - (-sg * dg * cb * da - cg * sb * db * da + cg * dg * db)
    ey = ay - (-cg * dg * cb * da + sg * sb * db * da - sg * dg * db)
    ez = az - cb * db * da
    dda = (cg * ex - sg * ey) / cb
    ddb = sg * ex + cg * ey
    ddg = ez - sb * dda
    w = par.w_cc
    return [
        vx, vy, vz, da, db, dg,
        (F1x + F2x) / par.m, (F1y + F2y) / par.m - par.g, Fz / par.m, dda, ddb, ddg,
        w * (v[0] - f1x), w * (v[1] - f1y), w * (v[2] - f2x), w * (v[3] - f2y), w * (v[4] - fd),
    ]  # fmt: skip


def plant_system(par: Parameters, Ts: float) -> Any:
    """Four Runge–Kutta steps a sample as a discrete nonlinear system."""
    h = Ts / SUBSTEPS

    def update(t: float, s: Any, u: Any, params: Any) -> Any:
        a, v = s.tolist(), u.tolist()
        for _ in range(SUBSTEPS):
            k1 = mover(par, a, v)
            k2 = mover(par, [p + h / 2 * q for p, q in zip(a, k1)], v)
            k3 = mover(par, [p + h / 2 * q for p, q in zip(a, k2)], v)
            k4 = mover(par, [p + h * q for p, q in zip(a, k3)], v)
            a = [p + h / 6 * (q + 2 * (r + s_) + t_) for p, q, r, s_, t_ in zip(a, k1, k2, k3, k4)]
        return np.array(a)

    def output(t: float, s: Any, u: Any, params: Any) -> Any:
        slope = np.array([sin(s[4]), -sin(s[3]) * cos(s[4])]) / (cos(s[3]) * cos(s[4]))
        return np.concatenate([s[:2] - (par.l_S + s[2]) * slope, s[:2] + (par.l_S - s[2]) * slope, s[2:3]])

    names = [f"y[{i}]" for i in range(5)]
    return control.nlsys(
        update, output, inputs=[f"v[{i}]" for i in range(5)], outputs=names, states=17, dt=Ts, name="mover"
    )


def controller_system(c: Controller) -> Any:
    """The control law of the gain file as a discrete nonlinear system. u = (y, p*, xi*, v_ff)."""
    ff, limit = c.feedforward, c.limits.force

    def act(s: Any, u: Any) -> tuple[Any, Any, Any, Any, Any]:
        y, p_ref, xi_ref, v_ff = u[:5], u[5:10], u[10:20], u[20:25]
        e = s[10:15] + c.sample_time * (1 - s[15:20]) * (p_ref - y)
        xi_hat = s[:10] + c.L @ (y - c.Cd @ s[:10])
        v0 = np.array([np.interp(y[4], ff.z_grid, column) for column in ff.v0.T])
        wanted = c.K @ (xi_ref - xi_hat) + c.Ki @ e + v_ff + v0
        v = np.clip(wanted, -limit, limit)
        return e, xi_hat, v0, v, (v != wanted).astype(float)

    def update(t: float, s: Any, u: Any, params: Any) -> Any:
        e, xi_hat, v0, v, frozen = act(s, u)
        return np.concatenate([c.Ad @ xi_hat + c.Bd @ (v - v0), e, frozen])

    def output(t: float, s: Any, u: Any, params: Any) -> Any:
        return act(s, u)[3]

    inputs = [f"y[{i}]" for i in range(5)] + [f"r[{i}]" for i in range(20)]
    return control.nlsys(
        update,
        output,
        inputs=inputs,
        outputs=[f"v[{i}]" for i in range(5)],
        states=20,
        dt=c.sample_time,
        name="law",
    )

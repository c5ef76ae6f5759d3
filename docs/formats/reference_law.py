"""The law of a gain file in plain numpy, from its JSON alone; gain.md has the equations, whose names these are."""

from __future__ import annotations

import json
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

Vector = Any
# Beyond these a reading is refused, either way; in the order of the measurements. See gain.md.
REACH = {
    "tubular": [0.0012619146889603474] * 4 + [0.03169786384922092],
    "halbach": [0.10023744672544978],
    "planar": [0.2244036908603816] * 2 + [0.008933671843018923] + [0.01002374467254506] * 2 + [1.0],
}
STROKE = {"tubular": 4, "halbach": 0, "planar": 1}  # the measurement at which v0 is looked up


class Law:
    """One controller with its memory; `start`, then `step` at every sample."""

    def __init__(self, path: str | Path) -> None:
        file = json.loads(Path(path).read_text(encoding="utf-8"))
        self.machine, self.Ts, law = file["plant"]["name"], file["sample_time"], file.get("law", {})
        self.par = {name: entry["value"] for name, entry in file["plant"]["parameters"].items()}
        if law.get("tracks", "states") != "states" or file.get("commutation") or self.machine not in REACH:
            raise ValueError("a machine, law.tracks or commutation that stands in gain.md alone")
        self.Ad, self.Bd, self.Cd = (np.array(file["model"][key]) for key in ("Ad", "Bd", "Cd"))
        self.K, self.Ki, self.L = (np.array(file["gains"][key]) for key in ("K", "Ki", "L"))
        self.ff = {key: np.array(value) for key, value in file["feedforward"].items() if value is not None}
        self.n0, (self.n, self.m) = len(file["model"]["A"]), self.Bd.shape
        self.f_max = np.array(file["limits"]["force"] or [np.inf] * self.m)
        self.pause = np.array(law.get("pause") or [0.0] * self.m)
        self.braking = np.array(law.get("braking") or [0.0] * self.m)
        self.reach, self.stroke = np.array(REACH[self.machine]), STROKE[self.machine]
        later = [signal["name"] for signal in file["signals"]["states"]][self.n0 :: self.m]
        self.lagging = int(any(name.endswith("[i]") for name in later))
        self.d = sum("[k-" in name for name in later)  # samples of delay among the states
        self.start(*np.zeros((3, self.m)))

    def rest(self, p: Vector, dp: Vector) -> Vector:
        """(q*, q*'): the mechanical states at rest at p*, and their rates."""
        if self.machine != "tubular":
            return np.concatenate([p, dp])
        alpha, beta = np.array([p[1] - p[3], p[2] - p[0]]) / (2 * self.par["l_S"])
        alpha_, beta_ = np.array([dp[1] - dp[3], dp[2] - dp[0]]) / (2 * self.par["l_S"])
        q = [(p[0] + p[2]) / 2 + p[4] * beta, (p[1] + p[3]) / 2 - p[4] * alpha, p[4], alpha, beta]
        x_ = (dp[0] + dp[2]) / 2 + dp[4] * beta + p[4] * beta_
        y_ = (dp[1] + dp[3]) / 2 - dp[4] * alpha - p[4] * alpha_
        return np.array([*q, x_, y_, dp[4], alpha_, beta_])

    def forward(self, p: Vector, dp: Vector, ddp: Vector) -> Vector:
        """v_ff."""
        v = self.ff["inertia"] * ddp + self.ff["speed"] @ dp
        return v + self.ff["position"] @ self.rest(p, dp)[: self.n0 // 2] if "position" in self.ff else v

    def stored(self, v_ff: Vector, p: Vector, dp: Vector) -> Vector:
        """The reference of the newest stored force: the rows of Ad in which it is made know the pull of currents."""
        newest = self.n0 + self.m * (self.lagging + self.d - 1)
        return v_ff + self.Ad[newest : newest + self.m, : self.n0] @ self.rest(p, dp)

    def under_way(self) -> Vector:
        """References of the states behind the mechanical ones; those of disturbances are zero."""
        known = np.concatenate([self.lag] * self.lagging + self.under[: self.d] + [np.zeros(0)])
        return np.concatenate([known, np.zeros(self.n - self.n0 - len(known))])

    def start(self, p: Vector, dp: Vector, ddp: Vector) -> None:
        """The memory of a machine that has long followed this reference."""
        self.lag = self.forward(p, dp, ddp)
        self.past, self.under = [self.lag] * self.d, [self.stored(self.lag, p, dp)] * self.d
        self.e, self.frozen = np.zeros(self.m), np.zeros(self.m, dtype=bool)
        self.xi_pred = np.concatenate([self.rest(p, dp), self.under_way()])

    def step(self, y: Vector, valid: Vector, p: Vector, dp: Vector, ddp: Vector) -> dict[str, Vector]:
        """One sample: v, and the flags `refused` of readings and `saturated` of forces."""
        accepted = (valid > 0.5) & (np.abs(y) <= self.reach)  # a NaN is none
        y = np.where(accepted, y, np.clip(self.Cd @ self.xi_pred, -1e3 * self.reach, 1e3 * self.reach))
        xi_hat = self.xi_pred + self.L @ (y - self.Cd @ self.xi_pred)
        v_ff, xi_ref = self.forward(p, dp, ddp), np.concatenate([self.rest(p, dp), self.under_way()])
        if "rate" in self.ff:
            xi_ref[self.n0 - len(self.ff["rate"]) : self.n0] += self.ff["rate"] @ dp
        waits = self.frozen | ((self.pause > 0) & (np.abs(dp) > self.pause))
        waits |= (self.braking > 0) & (np.abs(p - y) > self.braking)
        self.e = self.e + np.where(waits, 0, self.Ts * (p - y))
        v0 = np.array([np.interp(y[self.stroke], self.ff["z_grid"], f) for f in self.ff["v0"].T])
        off = xi_ref - xi_hat
        for k in np.flatnonzero(self.braking):
            b, size = self.braking[k], abs(off[k])
            off[k] *= np.sqrt(b * (2 * size - b)) / size if size > b else 1
        wanted = self.K @ off + self.Ki @ self.e + v_ff + v0
        v = np.clip(wanted, -self.f_max, self.f_max)
        self.frozen = v != wanted
        self.xi_pred = self.Ad @ xi_hat + self.Bd @ (v - v0)
        if self.lagging:
            decay = self.Ad[self.n0, self.n0]
            self.lag = decay * self.lag + (1 - decay) * [*self.past, v_ff][0]
        self.past = [*self.past, v_ff][1:]
        self.under = [*self.under, self.stored(v_ff, p, dp)][1:] if self.d else []
        return {"v": v, "saturated": self.frozen, "refused": ~accepted, "xi_hat": xi_hat}


class Drive:
    """Forces to duty cycles of the tubular machine: 12 axis currents, 18 half-bridges."""

    def __init__(self, path: str | Path) -> None:
        file = json.loads(Path(path).read_text(encoding="utf-8"))
        self.par = {name: entry["value"] for name, entry in file["plant"]["parameters"].items()}
        self.Ts, self.loop, self.limits = file["sample_time"], file["current_loop"], file["limits"]
        self.constants = np.array([self.par["K_B"]] * 4 + [2 * self.par["K_D"]])
        self.constants[:4] *= 1 + self.par.get("dK_B", 0.0) * np.array([-1, -1, 1, 1])
        self.i_max = np.minimum(self.par["I_max"], self.limits["current"])
        self.integral, self.waits = np.zeros(12), np.zeros(12, dtype=bool)
        self.i, self.V = np.zeros(18), self.par["V_dc"]  # last readings that were believed

    def step(self, v: Vector, xi_hat: Vector, i: Vector, valid: Vector, V: float) -> dict[str, Vector]:
        """Currents of the coils, whether one is limited (`met`), and duty cycles. V : of the DC link, as measured"""
        wanted = v / self.constants
        current = np.clip(wanted, -self.i_max, self.i_max)
        most = 4 * max(self.par["I_max"], *self.limits["current"])
        self.i = np.where((valid > 0.5) & (np.abs(i) <= most), i, self.i)
        self.V = V if 0.05 * self.par["V_dc"] <= V <= 4 * self.par["V_dc"] else self.V
        angles = pi * xi_hat[2] / self.par["L_p"] - 2 * pi / 3 * np.arange(3)
        around = np.array(
            [[1 / 3] * 3, *(2 / 3 * np.cos(a - 2 * pi / 3 * np.arange(3)) for a in (0, pi / 2))]
        )
        along = np.array([np.cos(angles), -np.sin(angles)])
        axes = np.kron(np.eye(2), np.kron(around, 2 / 3 * along))  # 12 x 18
        phases = np.kron(np.eye(2), np.kron(around.T * [3, 1.5, 1.5], along.T))  # 18 x 12, its pseudo-inverse
        asked, emf = np.zeros(12), np.zeros(12)
        asked[[2, 4, 8, 10, 1, 7]] = current[[0, 1, 2, 3, 4, 4]]
        emf[[1, 7]] = self.par["K_ind"] * xi_hat[7]
        error = asked - axes @ self.i
        self.integral = self.integral + np.where(self.waits, 0, self.loop["Ki"] * self.Ts * error)
        u = phases @ (self.loop["Kp"] * error + self.integral + emf)
        share = min(0.5, min(self.par["V_max"], *(self.limits["voltage"] or [np.inf])) / self.V)
        duty = np.clip(0.5 + u / self.V, 0.5 - share, 0.5 + share)
        self.waits = np.repeat((duty != 0.5 + u / self.V).reshape(2, 9).any(axis=1), 6)
        return {"current": current, "met": (current != wanted).any(), "command": duty}

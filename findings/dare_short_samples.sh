#!/usr/bin/env bash
# control.dare loses the digits of short samples, in silence; control.care of the bilinear transform keeps them.
#
# System: the unstable pendulum x'' = x + u, exactly sampled, Q = I Ts, R = r Ts: two states in units of one.
# Guess before the run: the sampled regulator tends to the continuous one, whose equation is harmless; so 1e-10 of
#   the gain at 10 us for any r here, or an error that names the conditioning.
# Seen (control 0.10.2, scipy 1.17.1, slycot 0.7.1): r = 1e3: 4e-8 off where 3e-14 can be had; r = 1e9: 0.4 % off by
#   scipy and 1.7 % by slycot, no error and no warning. The same R, Q and poles through z = (1 + s) / (1 - s) and
#   control.care: 6e-8. The exact gain is by doubling in 60 digits (mpmath).
# Why: scipy's and slycot's pencils compare entries of Q Ts with 1 - |z|, both of the size of the sample.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check \
  control==0.10.2 scipy==1.17.1 slycot==0.7.1 mpmath==1.3.0
cat > "$work/seen.py" <<'PY'
import sys
import warnings

import control
import mpmath as mp
import numpy as np
from scipy import linalg

warnings.simplefilter("error")
mp.mp.dps = 60


def exact(A, B, Q, R):
    F, H = mp.matrix(A.tolist()), mp.matrix(Q.tolist())
    B, R = mp.matrix(B.tolist()), mp.matrix(R.tolist())
    A, G = F, B * R**-1 * B.T
    for _ in range(60):
        W = (mp.eye(2) + G * H) ** -1
        step = F.T * H * W * F
        F, G, H = F * W * F, G + F * W * G * F.T, H + step
        if mp.mnorm(step) < mp.mpf(10) ** -50 * mp.mnorm(H):
            break
    return np.array(((R + B.T * H * B) ** -1 * (B.T * H * A)).tolist(), dtype=float)


def bilinear(A, B, Q, R):
    one = np.eye(2)
    V = np.linalg.inv(A + one)
    G = V @ B
    H, N, Bc = R + G.T @ Q @ G, -np.sqrt(2) * V.T @ Q @ G, np.sqrt(2) * G
    Ac, Qc = (A - one) @ V - Bc @ np.linalg.solve(H, N.T), 2 * V.T @ Q @ V - N @ np.linalg.solve(H, N.T)
    rate = np.abs(Ac).max()
    X = control.care(Ac / rate, Bc / rate**0.5, (Qc + Qc.T) / 2 / rate, H, method="scipy")[0]
    return np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)


Ts, off = 1e-5, {}
for r in (1.0, 1e3, 1e6, 1e9):
    held = linalg.expm(np.array([[0.0, 1, 0], [1, 0, 1], [0, 0, 0]]) * Ts)
    A, B, Q, R = held[:2, :2], held[:2, 2:], np.eye(2) * Ts, np.eye(1) * r * Ts
    K = exact(A, B, Q, R)
    ways = {
        "dare, scipy": control.dare(A, B, Q, R, method="scipy")[2],
        "dare, slycot": control.dare(A, B, Q, R, method="slycot")[2],
        "care, bilinear": bilinear(A, B, Q, R),
    }
    off[r] = {way: float(np.abs(found - K).max() / np.abs(K).max()) for way, found in ways.items()}
    print(f"r = {r:7.0e}  " + "  ".join(f"{way}: {value:.1e}" for way, value in off[r].items()))
as_seen = off[1e9]["dare, scipy"] > 1e-3 and off[1e9]["dare, slycot"] > 1e-3 and off[1e9]["care, bilinear"] < 1e-5
as_seen = as_seen and off[1e3]["dare, scipy"] > 1e-9 and off[1e3]["care, bilinear"] < 1e-12
sys.exit(0 if as_seen else 1)
PY
"$work/env/bin/python" "$work/seen.py"

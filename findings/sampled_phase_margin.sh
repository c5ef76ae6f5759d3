#!/usr/bin/env bash
# control.stability_margins: a stable sampled loop of five states has a phase margin of -4.8 degrees, without a warning.
#
# System: 40 / (s + 20) and one or three modes of 1 % damping (30 to 900 rad/s), under a zero-order hold at 1 kHz,
#   unity feedback; every closed-loop pole lies well inside the unit circle.
# Guess before the run: margins of a discrete StateSpace of order 5 to 9 come from polynomials, as those of continuous
#   systems do, good to five digits; where rounding spoils them the function warns and falls back to a grid, as it
#   documents.
# Seen (control 0.10.2, numpy 2.2.6, scipy 1.15.3): order 5: phase margin -4.8 degrees where a dense grid has 118;
#   order 9: gain margin 1.49 and phase margin -4.2 degrees where the grid has 4.02 and 118. No warning: at 10 kHz the
#   same plants do warn and fall back to a grid. The same modes in continuous time: right to three digits.
# Why, as far as seen: crossings are roots of a polynomial in z of twice the order, which lose their digits near z = 1.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check control==0.10.2 numpy==2.2.6 scipy==1.15.3
cat > "$work/seen.py" <<'PY'
import sys
import warnings

import control
import numpy as np

warnings.simplefilter("error")


def plant(modes):
    G = control.ss(control.tf([40.0], [1, 20.0]))
    for k, w in enumerate(np.geomspace(30, 900, modes)):
        row = 0.005 * w * (-1) ** k
        G = G + control.ss([[0, w], [-w, -0.02 * w]], [[0], [1]], [[0, row]], [[0]])
    return G


def grid(G, Ts):
    """Gain and phase margin from 140 000 frequencies, dense about every pole."""
    p = np.log(np.linalg.eigvals(G.A).astype(complex)) / Ts
    near = [q.imag + np.linspace(-60, 60, 20_001) * abs(q.real) for q in p if q.imag > 0]
    w = np.unique(np.concatenate([np.geomspace(1e-2, 0.99999 * np.pi / Ts, 100_001), *near]))
    L = G(np.exp(1j * w[(w > 0) & (w < np.pi / Ts)] * Ts))
    k = np.flatnonzero((np.diff(np.sign(L.imag)) != 0) & (L.real[1:] < 0))
    gains = -1 / L.real[k]
    turns = np.abs(np.angle(-L[np.flatnonzero(np.diff(np.sign(np.abs(L) - 1)))], deg=True))
    return min(gains[gains > 1], default=np.inf), min(turns)


Ts, wrong = 1e-3, []
for modes in (2, 4):
    G = control.c2d(plant(modes), Ts, "zoh")
    radius = np.abs(np.linalg.eigvals(G.A - G.B @ G.C)).max()
    gain, phase, *_ = control.stability_margins(G)
    gain_seen, phase_seen = grid(G, Ts)
    print(f"order {G.nstates}: largest closed-loop |z| {radius:.5f}; stability_margins: gain {gain:.4g}, phase "
          f"{phase:.4g} deg; grid: {gain_seen:.4g}, {phase_seen:.4g} deg")
    wrong.append(radius < 1 and phase < 0 and phase_seen > 100)
sys.exit(0 if all(wrong) else 1)
PY
"$work/env/bin/python" "$work/seen.py"

#!/usr/bin/env bash
# The same number elsewhere: what python-control, scipy and CasADi answer where another answer is meant. docs/elsewhere.md
# has each with its reason.
#
# Guess before the run: a function that takes a sampled system computes with z; a margin of an unstable loop is a NaN or
#   an error; two solvers of one Riccati equation agree to rounding; a schedule is held at the end of its table.
# Seen (control 0.10.2, scipy 1.17.1, slycot 0.7.1, casadi 3.8.2): none of these; each line that is printed is a figure.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check \
  control==0.10.2 scipy==1.17.1 slycot==0.7.1 casadi==3.8.2
cat > "$work/seen.py" <<'PY'
import sys
import warnings

import casadi as ca
import control
import numpy as np
from scipy import signal

warnings.simplefilter("ignore")
seen = {}

# 1. The gain of dlqe is the predictor's, A times the filter's.
A, C, Q, R = np.array([[0.9, 0.1], [0, 0.8]]), np.array([[1.0, 0]]), 0.1 * np.eye(2), np.eye(1)
L, P, _ = control.dlqe(A, np.eye(2), C, Q, R)
filter_gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
print("dlqe", L.ravel(), "filter", filter_gain.ravel())
seen["dlqe"] = np.allclose(L, A @ filter_gain) and not np.allclose(L, filter_gain, rtol=0.05)

# 2. hinfsyn and h2syn read a sampled plant as a continuous one: the same law, and a loop that is unstable in z.
B = np.array([[1.0, 0, 1.0]])
C2, D = np.array([[1.0], [0], [1.0]]), np.array([[0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
sampled, continuous = control.ss([[0.9]], B, C2, D, 0.1), control.ss([[0.9]], B, C2, D)
for synthesize in (control.hinfsyn, control.h2syn):
    laws = [synthesize(plant, 1, 1) for plant in (sampled, continuous)]
    K, same = [law[0] if isinstance(law, tuple) else law for law in laws]
    loop = np.block([[np.array([[0.9]]) + B[:, 2:] @ K.D @ C2[2:], B[:, 2:] @ K.C], [K.B @ C2[2:], K.A]])
    radius = np.abs(np.linalg.eigvals(loop)).max()
    print(synthesize.__name__, "dt", K.dt, "largest |z|", radius)
    seen[synthesize.__name__] = np.allclose(K.A, same.A) and radius > 1

# 3. balred reduces a stable sampled system not at all: 0.9 and 0.5 lie right of the imaginary axis.
reduced = control.balred(control.ss(np.diag([0.9, 0.5]), [[1.0], [1]], [[1.0, 1]], 0, 0.1), 1)
print("balred to 1 state:", reduced.nstates)
seen["balred"] = reduced.nstates == 2

# 4. Margins of a loop that is unstable: s - 1 + 0.5.
margins = control.margin(control.tf([0.5], [1, -1]))
pole = control.poles(control.feedback(control.tf([0.5], [1, -1]), 1)).real.max()
print("margin", margins, "closed-loop pole", pole)
seen["margin"] = pole > 0 and margins[0] == 2 and np.isinf(margins[1])

# 5. The impulse response of a sampled system: of height 1 / Ts, or of height 1.
matrices = [np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]])]
high = control.impulse_response(control.ss(*matrices, 0.1), T=np.arange(4) * 0.1).outputs.ravel()
unit = signal.dimpulse((*matrices, 0.1), n=4)[1][0].ravel()
print("impulse", high, "dimpulse", unit)
seen["impulse"] = np.allclose(high, 10 * unit)

# 6. The slope at a kink: 0 of |x|, a half of max(x, 0).
x = ca.SX.sym("x")
slopes = [float(ca.Function("d", [x], [ca.jacobian(e, x)])(0)) for e in (ca.fabs(x), ca.fmax(x, 0))]
print("slopes at 0 of |x|, max(x, 0):", slopes)
seen["kink"] = slopes == [0.0, 0.5]

# 7. A schedule over two signals: linear inside of its table, the nearest gain outside. It jumps at the edge.
plant = control.ss([[0, 1.0], [1, 0]], [[0], [1.0]], np.eye(2), 0, inputs="u", outputs=["p", "v"], name="m")
points = [[0, 0], [0, 1.0], [1, 0], [1, 1]]
gains = [np.array([[1.0 + p + v, 1]]) for p, v in points]
law, _ = control.create_statefbk_iosystem(
    plant, (gains, points), gainsched_indices=["p", "v"], gainsched_method="linear"
)


def command(p):
    u = np.zeros((law.ninputs, 2))
    u[-2:] = [[p, p], [0.5, 0.5]]
    return float(control.input_output_response(law, [0, 1], u).outputs.ravel()[0])


print("command at p = 0.999, 1.001:", command(0.999), command(1.001))
seen["schedule"] = abs(command(1.001) - command(0.999)) > 0.4

# 8. lqr with slycot and without: two equal axes have unequal gains by slycot, in the seventh digit.
A = np.kron(np.eye(2), [[0, 1.0], [4e4, 0]])
B = np.kron(np.eye(2), [[0], [3.0]])
K = {way: control.lqr(A, B, np.diag([1e10, 1, 1e10, 1]), 1e-2 * np.eye(2), method=way)[0] for way in ("scipy", "slycot")}
apart = {way: abs(k[0, 0] / k[1, 2] - 1) for way, k in K.items()}
print("two equal axes differ by", apart)
seen["lqr"] = apart["scipy"] < 1e-11 < 1e-8 < apart["slycot"]

print({name: bool(value) for name, value in seen.items()})
sys.exit(0 if all(seen.values()) else 1)
PY
"$work/env/bin/python" "$work/seen.py"

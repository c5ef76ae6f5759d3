#!/usr/bin/env bash
# python-flint: whether the real or the complex inverse function encloses a wide ball better depends on the function.
#
# Input: real balls of 20 to 80 % radius, away from every singularity, asked of arb and of acb.
# Guess before the run: on a real ball the real function is at least as tight as the complex one, which has to make its
#   real part and knows less; both are within 10 % of the true range at such radii, as sine, tangent and root are.
# Seen (python-flint 0.9.0 with FLINT 3.6.0), radius over half of the true range: asin of 0.5 +/- 0.4: arb 1.54,
#   acb 1.01, so the complex function is the tighter one; acos the same. atanh of 0.5 +/- 0.4: arb 1.00, acb 5.3.
#   atan, log and square root: 1.00 by both.
# For who encloses with one code for both: the value in the middle plus the slope over the ball is 1.8 to 3.1 times
#   the range here, whichever function it is.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check python-flint==0.9.0
cat > "$work/seen.py" <<'PY'
import math
import sys

import flint
from flint import acb, arb

print(f"python-flint {flint.__version__}, FLINT {flint.__FLINT_VERSION__}")


def widths(name, middle, radius):
    """Radius of the ball that arb and acb give, over half of the true range of an increasing or decreasing function."""
    x, f = arb(middle, radius), getattr(math, name)
    half = abs(f(middle + radius) - f(middle - radius)) / 2
    found = [float(ball.rad()) / half for ball in (getattr(x, name)(), getattr(acb(x), name)().real)]
    print(f"{name}({middle} +/- {radius}): arb {found[0]:.2f}, acb {found[1]:.2f} of the range")
    return found


asin, acos, atanh = (widths(name, 0.5, 0.4) for name in ("asin", "acos", "atanh"))
others = [widths(name, 3.0, 0.6) for name in ("atan", "log", "sqrt")]
slope = {"asin": lambda x: 1 / (1 - x * x).sqrt(), "atanh": lambda x: 1 / (1 - x * x)}
for name, of in slope.items():
    x, f = arb(0.5, 0.4), getattr(math, name)
    whole = arb(f(0.5)) + (x - arb(0.5)) * of(x)
    print(f"{name} by its slope: {float(whole.rad()) / (abs(f(0.9) - f(0.1)) / 2):.2f} of the range")
same = asin[0] > 1.3 > 1.1 > asin[1] and acos[0] > 1.3 > 1.1 > acos[1]
same = same and atanh[0] < 1.1 and atanh[1] > 3 and all(max(one) < 1.1 for one in others)
sys.exit(0 if same else 1)
PY
"$work/env/bin/python" "$work/seen.py"

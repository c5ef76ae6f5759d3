#!/usr/bin/env bash
# CasADi: what becomes of Ctrl-C while a numpy array is converted to a DM.
#
# Input: ca.DM of a 3 x 3 array of doubles, again and again, until a handler of a signal raises KeyboardInterrupt, as
#   Python's own does on Ctrl-C; 1500 times, at other moments each.
# Guess before the run: KeyboardInterrupt is raised by the call or right after it, each time, as of any C extension
#   that returns an error where Python has one; at the worst SystemError with it as its cause.
# Seen (CasADi 3.8.2, numpy 2.4.6): of 1500, some 540 raise KeyboardInterrupt; 340 raise NotImplementedError, "Wrong
#   number or type of arguments for function 'new_DM'", of the very array that was converted a moment before, without a
#   cause; and of 620 nothing is raised at all: the handler has run, and the program goes on. The test by which a
#   conversion is tried takes any error for "not this type" and clears it. Who wants Ctrl-C to end a long work has to
#   note the signal in the handler, and to look at the note.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2 numpy==2.4.6
cat > "$work/seen.py" <<'PY'
import collections
import signal
import sys
import time

import casadi as ca
import numpy as np

print(f"CasADi {ca.__version__}, numpy {np.__version__}")
ran = False


def press(*_):
    global ran
    ran = True
    raise KeyboardInterrupt


signal.signal(signal.SIGALRM, press)
array, seen = np.arange(9.0).reshape(3, 3), collections.Counter()
for k in range(1500):
    ran, ended = False, "nothing was raised"
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.002 + 3e-7 * k)
        while not ran:
            ca.DM(array)
        time.sleep(0.0005)
    except (KeyboardInterrupt, NotImplementedError) as error:
        ended = type(error).__name__
    seen[ended] += 1
for ended, count in seen.most_common():
    print(f"{count:5d}  {ended}")
sys.exit(0 if min(seen["nothing was raised"], seen["NotImplementedError"]) > 30 else 1)
PY
"$work/env/bin/python" "$work/seen.py"

#!/usr/bin/env bash
# CasADi: what expand() and a walk over the instructions see of an SX function that is kept as a call.
#
# Input: a function of sin(x) x + 1 with never_inline, called by another one; and one with two results of two arguments.
# Guess before the run: `expand` is what removes calls, so an expanded function has sines and products only, at the
#   latest with never_inline set to False for it; the work cells of a call's results are others than those of its
#   arguments, as both are needed to read the instruction; equal calls of equal arguments subtract to zero.
# Seen (CasADi 3.8.2): `expand` leaves the call whatever its options, and of the kept function itself makes one whose
#   only operation is a call of it; asking for an inlined call raises "Inconsistent options". Results of a call may take
#   the cells of its arguments, so that who enters them one by one in a table of cells reads a wrong argument for the
#   second. f(y) - f(y) stays a difference of two calls, while cse() turns f(y) + 2 f(y) into 3 f(y).
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
"$work/env/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2
cat > "$work/seen.py" <<'PY'
import sys

import casadi as ca

print(f"CasADi {ca.__version__}")
NAMES = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


def operations(f):
    return [NAMES[f.instruction_id(k)] for k in range(f.n_instructions())]


x, y = ca.SX.sym("x"), ca.SX.sym("y")
kept = ca.Function("kept", [x], [ca.sin(x) * x + 1], {"never_inline": True})
caller = ca.Function("caller", [y], [kept(2 * y)])
seen = []
for options in ({}, {"never_inline": False}, {"always_inline": True}):
    found = [operations(f.expand("flat", options)) for f in (caller, kept)]
    print(f"expand {options}: the caller {found[0]}, the kept function {found[1]}")
    seen += ["OP_CALL" in one and "OP_SIN" not in one for one in found]
try:
    kept.call([y], True, False)
    seen.append(False)
except RuntimeError as error:
    print("an inlined call:", str(error).splitlines()[-1])
    seen.append("Inconsistent options" in str(error))

p = ca.SX.sym("p", 2)
two = ca.Function("two", [p], [ca.vertcat(p[0] * p[1], p[0] + p[1])], {"never_inline": True})
walked = ca.Function("walked", [p], [two(p)])
for k in range(walked.n_instructions()):
    if NAMES[walked.instruction_id(k)] == "OP_CALL":
        read, written = walked.instruction_input(k), walked.instruction_output(k)
        print(f"a call reads the cells {read} and writes the cells {written}")
        seen.append(bool(set(read) & set(written)))

left = kept(y) - kept(y)
merged = operations(ca.Function("merged", [y], [ca.cse(kept(y) + 2 * kept(y))]))
print(f"f(y) - f(y): {left}; operations of cse(f(y) + 2 f(y)): {merged}")
seen += [not left.is_zero(), merged.count("OP_CALL") == 1]
sys.exit(0 if all(seen) else 1)
PY
"$work/env/bin/python" "$work/seen.py"

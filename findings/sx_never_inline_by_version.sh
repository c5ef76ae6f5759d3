#!/usr/bin/env bash
# CasADi: whether an SX function with never_inline is kept as a call depends on the version, without a word.
#
# Input: sin(f(y)) of an SX function f of two symbols that is made with never_inline, in four versions.
# Guess before the run: the option is known to all of them, so a call is kept by all, or the option is refused; and the
#   functions that are called are listed by get_function, as of any function since long ago.
# Seen: 3.6.7 takes the option and inlines f all the same: a product, and no call. 3.7.2 keeps a call, but lists no
#   function, so that a program with a call cannot be read. 3.8.0 lists it, and has_function says that there is none.
#   3.8.2 keeps, lists and has it.
# Exits 0 while this is so, 1 when it has changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/env"
cat > "$work/seen.py" <<'PY'
import sys

import casadi as ca

p, y = ca.SX.sym("p", 2), ca.SX.sym("y", 2)
kept = ca.Function("kept", [p], [p[0] * p[1]], {"never_inline": True})
f = ca.Function("f", [y], [ca.sin(kept(y))])
codes = [f.instruction_id(k) for k in range(f.n_instructions())]
seen = (ca.OP_CALL in codes, "kept" in f.get_function(), f.has_function("kept"))
print(f"CasADi {ca.__version__}: kept as a call {seen[0]}, listed {seen[1]}, had {seen[2]}; f(1, 2) = {float(f([1, 2])):.6f}")
sys.exit(0 if " ".join(str(int(one)) for one in seen) == sys.argv[1] else 1)
PY
changed=0
while read -r version expected; do
  "$work/env/bin/pip" install --quiet --disable-pip-version-check "casadi==$version"
  "$work/env/bin/python" "$work/seen.py" "$expected" || changed=1
done <<'SEEN'
3.6.7 0 0 0
3.7.2 1 0 0
3.8.0 1 1 0
3.8.2 1 1 1
SEEN
exit "$changed"

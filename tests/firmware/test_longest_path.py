"""The longest path of compiled functions: of a listing as objdump writes it, by hand, and of an exported supervisor."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from exported import require, run, target, texts

from malta.firmware.cost import CC_FLAGS as FLAGS, LISTING, PROCESSORS, cost_on, longest_path, passes_of
from malta.firmware.export import folder_files

C = """int f(int x) {
  int sum = 0;
  for (k = 0; k < N; k++) {
    sum += g(x);
  }
  return sum;
}
"""
# A branch with sides of one and three, a loop that is entered at its test, and a call in it.
LOOP = """00000000 <f>:
f():
/tmp/f.c:2
   0:	cmp	r0, #0
   4:	beq	14 <f+0x14>
   8:	mov	r1, #1
   c:	mov	r2, #2
  10:	mov	r3, #3
  14:	mov	r4, #4
/tmp/f.c:3
  18:	b	24 <f+0x24>
/tmp/f.c:4
  1c:	bl	0 <g>
			1c: R_ARM_CALL	g
  20:	add	r5, r5, r0
/tmp/f.c:3
  24:	cmp	r5, #9
  28:	blt	1c <f+0x1c>
/tmp/f.c:6
  2c:	pop	{r4, pc}
  30:	mov	r9, r9
00000034 <g>:
g():
/tmp/f.c:1
  34:	add	r0, r0, #1
  38:	bx	lr
"""


def test_loops_branches_and_calls_are_counted() -> None:
    """Six and the jump to the test; four instructions and the two of g in a loop; the return. Loops by their lines."""
    expected = {passes: 6 + passes * (1 + 2 + 2 + 2) + 1 for passes in (1, 5)}
    for passes, count in expected.items():
        given = {"f.c": C, "f.h": f"#define N {passes}\n"}
        assert longest_path({"f.c": LOOP}, given, "f") == count


def test_a_loop_in_a_loop_and_one_of_unknown_passes() -> None:
    text = "for (k = 0; k < 3; k++) {\n  for (j = 0; j < M; j++) {\n    x();\n  }\n}\nfor (k = 0; k < n; k++) {\n}\n"
    assert passes_of(text, {"M": "2"}) == [3, 6, 6, 6, 3, 1, 1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("p", PROCESSORS, ids=lambda p: p.name)
def test_a_supervised_step_takes_longer_than_the_controllers(p: object, tmp_path: Path) -> None:
    """Of a step alone, nearly a straight line, it is what is counted there, with the longer side of every branch and
    what calls of its blocks cost."""
    (own,) = (one for one in PROCESSORS if one is p)
    require(f"{own.prefix}gcc", f"{own.prefix}objdump")
    files = {f: text for f, text in texts("halbach", "float").items() if f.endswith((".c", ".h"))}
    for file, text in files.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    done = run([f"{own.prefix}gcc", "-O2", *FLAGS, *own.options, "-c", "halbach.c"], tmp_path)
    assert done.returncode == 0, done.stderr
    listing = run([f"{own.prefix}objdump", *LISTING, "halbach.o"], tmp_path).stdout
    step = longest_path({"halbach.c": listing}, files, "halbach_step")
    cost = cost_on(own, files, files, "halbach")
    assert cost is not None
    assert cost.instructions < step < 1.5 * cost.instructions
    assert 2 * step < cost.supervised < 15 * step


@pytest.mark.slow
def test_the_report_says_how_it_is_counted() -> None:
    report = folder_files(target("halbach", "float"), "0" * 64, proof=False)["REPORT.md"]
    assert "It is counted on its longest path: every" in report
    if "this computer |" in report:
        rows = re.findall(r"^\| this computer \| (\d+) \| ([\d.]+) % \|$", report, re.MULTILINE)
        assert len(rows) == 1
        assert int(rows[0][0]) > 1000

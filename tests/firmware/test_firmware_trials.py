"""The exported test reaches every transition, every monitor in each of its states, and nearly all lines."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from exported import EXACT, HERE, of_each_kind, require, run, run_test, target, write_folder

from malta.firmware.program import Precision
from malta.firmware.supervisor import IN_USE, MONITORS, TRANSITIONS, absent_monitors, monitors_of
from malta.firmware.vectors import out_of_reach, watch_table

pytestmark = pytest.mark.first

LINES = 95.0  # % of each file that a run executes


@pytest.mark.parametrize(("name", "precision"), of_each_kind())
def test_it_reaches_what_the_design_has(name: str, precision: Precision, tmp_path: Path) -> None:
    """Lines of the law, the pieces and the supervisor; each monitor by its name, or why it is not there."""
    require("gcc", "gcov")
    folder, t = write_folder(name, precision, tmp_path), target(name, precision)
    files = [f"{name}{of}.c" for of in ("", "_parts", "_supervisor", "_test")]
    done = run(["gcc", *EXACT, "-O0", "--coverage", *files, "-o", "t"], folder)
    assert done.returncode == 0, done.stderr
    done = run(["./t"], folder)
    assert done.returncode == 0, done.stdout
    rows = monitors_of(t)
    cells = sum(len(row.states) for row in rows) - sum(
        (row.key, state) == (one.key, one.state)
        for row in rows
        for state in row.states
        for one in out_of_reach(t)
    )
    keys = " ".join(dict.fromkeys(row.key.lower() for row in rows))
    said = (
        f"supervisor: {len(TRANSITIONS)} of {len(TRANSITIONS)} transitions; in {cells} faults acted: {keys}\n"
    )
    assert done.stdout.startswith(said)
    named = set(keys.upper().split()) | set(absent_monitors(t))
    assert named == set(MONITORS)
    for key, reason in absent_monitors(t).items():
        assert re.search(rf"^without .*\b{key.lower()}\b.*: {reason}$", done.stdout, re.MULTILINE)
    printed = run(["gcov", "-n", *(f"t-{file[:-2]}.gcda" for file in files[:-1])], folder).stdout
    for file in files[:-1]:
        share = re.search(rf"{re.escape(file)}'\nLines executed:([0-9.]+)%", printed)
        assert share, printed
        assert float(share[1]) >= LINES, (file, share[1])


WRONG = (
    (
        "a transition that goes elsewhere",
        "OPERATE, EVENT_HOLD, HALBACH_HOLD",
        "OPERATE, EVENT_HOLD, HALBACH_FAULT",
    ),
    ("a range that is not looked at", "MONITOR_RANGE][k] = size_of(y) /", "MONITOR_RANGE][k] = 0.0 *"),
    ("a stop that is not heard", "(request->stop != 0) ?", "(request->stop == 99) ?"),
    ("gates that stay on in a fault", "sup->enable = is_flying(sup->state);", "sup->enable = 1;"),
    ("a landing without an end", "(sup->times.landing + sup->times.settle)) ||", "100000) ||"),
    ("a count that stays", "sup->count[entry] = count;", "sup->count[entry] = 0;"),
    ("a sensor that is never believed again", "refused[k] ? one_more(sup->unbelieved[k]) : 0", "1"),
    ("a force in a machine that is off", "rest_bridges(in, out);", "rest_bridges(in, out); out->v[0] = 0.1;"),
)


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_it_finds_what_is_wrong(old: str, new: str, tmp_path: Path) -> None:
    folder = write_folder("halbach", "double", tmp_path)
    path = folder / "halbach_supervisor.c"
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    done = run_test(HERE, folder)
    assert done.returncode == 1
    assert done.stdout.startswith("supervisor: ")


@pytest.mark.slow
def test_a_piece_that_computes_something_else_is_named(tmp_path: Path) -> None:
    folder = write_folder("halbach", "double", tmp_path)
    path = folder / "halbach_parts.c"
    text = path.read_text(encoding="utf-8")
    begin = text.index("void halbach_calibrate(")
    path.write_text(text[:begin] + text[begin:].replace(" + ", " - ", 1), encoding="utf-8")
    done = run_test(HERE, folder)
    assert (done.returncode, done.stdout.splitlines()[0]) == (1, "calibrate: differs")


@pytest.mark.parametrize("name", ["halbach", pytest.param("robust", marks=pytest.mark.slow)])
def test_what_is_out_of_reach_is_in_the_table(name: str) -> None:
    """A cell that is left out is one of the table of monitors, with a reason."""
    t = target(name, "double")
    table = watch_table(t)
    assert bool(out_of_reach(t)) == (name == "halbach")
    for one in out_of_reach(t):
        assert one.state in IN_USE
        assert table[one.key][one.state] not in ("", "(gates are off)")
        assert len(one.reason) > 20

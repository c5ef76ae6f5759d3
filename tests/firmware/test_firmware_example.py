"""The exported example lifts a stand-in of the machine off, moves it, lands it, and reads nothing that is not set."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from exported import HERE, build, run, run_test, write_folder

from malta.firmware.program import Precision

STRICT = ("-O1", "-g", "-Wall", "-Wextra", "-Werror", "-Wconversion")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"), [("halbach", "double"), ("robust", "float"), ("planar_pid", "float")]
)
def test_it_moves_and_lands(name: str, precision: Precision, tmp_path: Path) -> None:
    """Its exit code says so: a whole stroke, off again, and no monitor that acted."""
    folder = write_folder(name, precision, tmp_path)
    done = run_test(HERE, folder, *STRICT, *SANITIZERS, main="_example")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_valgrind_finds_nothing_that_is_not_set(tmp_path: Path) -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind not installed")
    program = build(HERE, write_folder("halbach", "double", tmp_path), *STRICT, main="_example")
    done = run(["valgrind", "--error-exitcode=9", "--quiet", str(program)], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"(QUINTIC, .*, )\S+\);", r"\g<1>0.02);"),  # of a sample time of 55 ms
        (r"read_sto\(void\) \{ return 0;", "read_sto(void) { return 1;"),
        (r"(request->stop = )0;", r"\g<1>request->start;"),
        (r"(\*missed = )0;", r"\g<1>1;"),
    ],
    ids=["a stroke that is too fast", "safe torque off", "an emergency stop", "a timer that is always late"],
)
def test_it_says_what_does_not_work(old: str, new: str, tmp_path: Path) -> None:
    folder = write_folder("halbach", "double", tmp_path)
    path = folder / "halbach_example.c"
    text, changes = re.subn(old, new, path.read_text(encoding="utf-8"))
    assert changes == 1
    path.write_text(text, encoding="utf-8")
    assert run_test(HERE, folder, *STRICT, *SANITIZERS, main="_example").returncode == 1

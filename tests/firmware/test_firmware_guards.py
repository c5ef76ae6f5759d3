"""Each generated file forbids what changes its arithmetic, or the self test finds it and the machine stays off."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from exported import HERE, PRECISIONS, require, run, run_test, target, texts, write_folder

from malta.firmware.fmu import unit_of, unit_sources
from malta.firmware.program import Precision

FUSED = re.compile(r"^\s+v(?:fn?m(?:add|sub)|fn?m[as]\.)", re.MULTILINE)  # of x86, and of Arm
M7 = ("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard")
COMPILERS = {"x86": ("gcc", "-mfma"), "Cortex-M7": ("arm-none-eabi-gcc", *M7)}
GNU = ("-std=gnu11", "-O3", "-ffp-contract=fast")
TELLS = """#include "halbach_supervisor.h"
#include <stdio.h>
static halbach_supervisor sup;
static halbach_state s;
static halbach_inputs in;
static halbach_request request;
static halbach_outputs out;
int main(void) {
  const halbach_real rest[5] = {0};
  int32_t state;
  int32_t k;
  halbach_supervisor_take_over(&sup, rest);
  state = sup.state;
  halbach_supervisor_init(&sup);
  halbach_init(&s);
  for (k = 0; k < 3; k++) {
    request.start = (k == 1) ? 1 : 0;
    halbach_supervisor_step(&sup, &s, &in, &request, &out);
  }
  printf("%d %d ", (int)halbach_self_test(), (int)halbach_parts_self_test());
  printf("%d %d %d", (int)sup.fit, (int)state, (int)sup.state);
  return 0;
}
"""
FIT, UNFIT = (
    "1 1 1 5 1",
    "0 0 0 0 0",
)  # both self tests, fit, then the states after taking over and after a start


@cache
def files_of(name: str, precision: Precision) -> dict[str, str]:
    """All that is generated of a design, with the sources of an FMU where those are of this precision."""
    files = texts(name, precision)
    return (
        files
        if precision == "float"
        else files | unit_sources(unit_of(target(name, precision), "loop"), "", "")
    )


def write_files(files: dict[str, str], folder: Path) -> list[Path]:
    """The C files in a folder."""
    paths = [folder / file for file in files if file.endswith((".c", ".h"))]
    for path in paths:
        path.write_text(files[path.name], encoding="utf-8")
    return sorted(path for path in paths if path.suffix == ".c")


@pytest.mark.slow_for("halbach-float")
@pytest.mark.parametrize(
    ("name", "precision"),
    [
        ("halbach", "float"),
        pytest.param("robust", "double", marks=pytest.mark.slow),
        pytest.param("planar_pid", "float", marks=pytest.mark.slow),
    ],
)
def test_no_object_asks_for_a_function_of_libm(name: str, precision: Precision, tmp_path: Path) -> None:
    """Whatever the flags: what compilers themselves add is all that is left, and the names of the files' own."""
    require("gcc", "nm")
    paths = [
        path
        for path in write_files(files_of(name, precision), tmp_path)
        if "int main(" not in path.read_text()
    ]
    assert len(paths) == (7 if precision == "double" else 3)  # those of an FMU too
    for flags in (["-O1"], ["-O0", "-std=c99"], ["-O0", "-fno-math-errno"]):
        done = run(["gcc", *flags, "-r", "-nostdlib", *map(str, paths), "-o", "all.o"], tmp_path)
        assert done.returncode == 0, done.stderr[:2000]
        symbols = set(re.findall(r"U (\S+)", run(["nm", "-u", "all.o"], tmp_path).stdout))
        assert symbols <= {"memcpy", "memmove", "memset", "_GLOBAL_OFFSET_TABLE_"}, flags


@pytest.mark.slow
@pytest.mark.parametrize("cc", COMPILERS)
@pytest.mark.parametrize(("name", "precision"), [("halbach", "double"), ("robust", "float")])
def test_no_file_has_a_fused_instruction(name: str, precision: Precision, cc: str, tmp_path: Path) -> None:
    """As GNU C, which contracts unless told otherwise; without the guards the same files have them."""
    compiler, *options = COMPILERS[cc]
    require(compiler)
    paths = write_files(files_of(name, precision), tmp_path)
    assert len(paths) == (6 if precision == "float" else 10)
    bare = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        assert "__FAST_MATH__" in text
        assert "FLT_EVAL_METHOD" in text
        for guarded in (True, False):
            if not guarded:
                path.write_text(re.sub(r"#pragma GCC.*\n", "", text), encoding="utf-8")
            done = run([compiler, *options, *GNU, "-S", path.name, "-o", "-"], tmp_path)
            assert done.returncode == 0, done.stderr[:2000]
            fused = len(FUSED.findall(done.stdout))
            assert not (guarded and fused), path.name
            bare += fused
    assert bare > 50


@pytest.mark.slow_for(
    "-std=c99 -O0-1 1 1 5 1-double",
    "-std=c99 -O2-1 1 1 5 1-double",
    "-std=c99 -O2-1 1 1 5 1-float",
    "-std=c99 -O3-1 1 1 5 1-double",
    "-std=c99 -O3-1 1 1 5 1-float",
    "-O2 -ffp-contract=fast -mfma-1 1 1 5 1-double",
    "-O2 -ffp-contract=fast -mfma-1 1 1 5 1-float",
    "-O2 -frounding-math -fno-trapping-math-1 1 1 5 1-double",
    "-O2 -frounding-math -fno-trapping-math-1 1 1 5 1-float",
    "-O2 -funsafe-math-optimizations-0 0 0 0 0-double",
    "-O2 -funsafe-math-optimizations-0 0 0 0 0-float",
    "-O2 -fassociative-math -fno-signed-zeros -fno-trapping-math-0 0 0 0 0-double",
    "-O2 -fassociative-math -fno-signed-zeros -fno-trapping-math-0 0 0 0 0-float",
    "-O2 -freciprocal-math-0 0 0 0 0-double",
    "-O2 -freciprocal-math-0 0 0 0 0-float",
    "-O2 -fno-signed-zeros-0 0 0 0 0-double",
    "-O2 -fno-signed-zeros-0 0 0 0 0-float",
)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("flags", "found"),
    [
        *((f"-std=c99 {level}", FIT) for level in ("-O0", "-O2", "-O3")),
        *(
            pytest.param(f"-std=gnu11 {level}", FIT, marks=pytest.mark.slow)
            for level in ("-O0", "-O2", "-O3")
        ),
        ("-O2 -ffp-contract=fast -mfma", FIT),
        ("-O2 -frounding-math -fno-trapping-math", FIT),
        ("-O2 -funsafe-math-optimizations", UNFIT),
        ("-O2 -fassociative-math -fno-signed-zeros -fno-trapping-math", UNFIT),
        ("-O2 -freciprocal-math", UNFIT),
        ("-O2 -fno-signed-zeros", UNFIT),
        ("-O2 -ffinite-math-only", "without fast mathematics"),
        ("-Ofast", "without fast mathematics"),
        ("-O2 -mfpmath=387", "in the precision of its numbers"),
    ],
)
def test_a_machine_stays_off_where_the_arithmetic_is_another(
    flags: str, found: str, precision: Precision, tmp_path: Path
) -> None:
    """Refused by the compiler where a macro tells, else by the supervisor."""
    require("gcc")
    assert found in started(tmp_path, precision, "gcc", *flags.split())


@pytest.mark.slow
def test_the_test_says_why(tmp_path: Path) -> None:
    """Where vectors differ, or would, for the options of the compiler."""
    done = run_test(HERE, write_folder("halbach", "double", tmp_path), "-O2", "-funsafe-math-optimizations")
    assert done.returncode == 1
    assert "halbach_parts.c is not that of their text: look at the compiler's options\n" in done.stdout


@pytest.mark.parametrize("flags", ["-O2", "-O3 -ffp-contract=fast -mfma", "-O2 -funsafe-math-optimizations"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_clang_is_told_or_found_out(flags: str, precision: Precision, tmp_path: Path) -> None:
    require("clang")
    found = started(tmp_path, precision, "clang", *flags.split())
    assert found in ({FIT} if flags == "-O2" else {UNFIT} if "unsafe" in flags else {FIT, UNFIT})


@pytest.mark.slow
@pytest.mark.parametrize("of", ["", "_parts", "_supervisor"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_each_file_is_tried_by_itself(of: str, precision: Precision, tmp_path: Path) -> None:
    """One file that contracts is enough."""
    require("gcc")
    found = started(tmp_path, precision, "gcc", "-std=gnu11", "-O2", "-mfma", contracts=f"halbach{of}.c")
    assert found == {"": "0 1 0 0 0", "_parts": UNFIT, "_supervisor": "1 1 0 0 0"}[of]


def started(folder: Path, precision: Precision, cc: str, *flags: str, contracts: str = "") -> str:
    """What a program tells of its arithmetic and of a start, or the compiler; contracts: a file without its guard."""
    files = files_of("halbach", precision)
    names = [f"halbach{of}.c" for of in ("", "_parts", "_supervisor")]
    write_files({key: files[key] for key in (*names, "halbach.h", "halbach_supervisor.h")}, folder)
    if contracts:
        text = files[contracts].replace('#pragma GCC optimize("fp-contract=off")\n', "")
        assert text != files[contracts]
        (folder / contracts).write_text(text, encoding="utf-8")
    (folder / "tells.c").write_text(TELLS, encoding="utf-8")
    command = [cc, *flags, "-Wall", "-Wextra", "-Werror", "tells.c", *names, "-o", "tells"]
    done = run(command, folder)
    return done.stderr if done.returncode else run(["./tells"], folder).stdout

"""The exported folder on other processors: one checksum everywhere, no library, no finding of sanitizers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from exported import (
    EXACT,
    HERE,
    PRECISIONS,
    PROCESSORS,
    build,
    c_files,
    require,
    root_text,
    run,
    run_test,
    write_folder,
)

from malta.firmware.cost import FLAGS
from malta.firmware.program import Precision

SOME = ["float", *(pytest.param(p, marks=pytest.mark.slow) for p in PRECISIONS if p != "float")]
TRIED = [("halbach", "double"), ("robust", "float"), ("planar_pid", "double")]
DIFFERS = r"stroke: sample (\d+) differs\n  \w+\[\d+\] is \S+, expected \S+\n"
SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")


def checksum(printed: str) -> str:
    found = re.search(r"^pass: 4 vectors of 60 samples, checksum ([0-9a-f]{8})\n\Z", printed, re.MULTILINE)
    assert found, printed
    return found[1]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), TRIED)
def test_every_processor_computes_the_same_bits(name: str, precision: Precision, tmp_path: Path) -> None:
    folder = write_folder(name, precision, tmp_path)
    expected = checksum(run_test(HERE, folder, "-O2").stdout)
    for processor in PROCESSORS.values():
        require(processor.compiler, *processor.runner[:1])
        assert checksum(run_test(processor, folder, "-O2").stdout) == expected, processor


@pytest.mark.slow_for("float--O0", "float--O1", "float--Os")
@pytest.mark.parametrize("level", ["-O0", "-O1", "-Os", pytest.param("-O3", marks=pytest.mark.slow)])
@pytest.mark.parametrize("precision", SOME)
def test_optimization_changes_no_bit(level: str, precision: Precision, tmp_path: Path) -> None:
    folder = write_folder("halbach", precision, tmp_path)
    assert checksum(run_test(HERE, folder, level).stdout) == checksum(run_test(HERE, folder, "-O2").stdout)


@pytest.mark.slow
@pytest.mark.parametrize("precision", SOME)
def test_contraction_is_noticed(precision: Precision, tmp_path: Path) -> None:
    """A multiplication and an addition in one instruction round once. The files forbid it, whatever the flags."""
    folder = write_folder("halbach", precision, tmp_path)
    flags = ("-O2", "-ffp-contract=fast")
    assert run_test(PROCESSORS["Cortex-M7"], folder, *flags).returncode == 0
    for path in folder.glob("*.c"):
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace('#pragma GCC optimize("fp-contract=off")\n', ""), encoding="utf-8")
    done = run_test(PROCESSORS["Cortex-M7"], folder, *flags)
    assert done.returncode == 1
    assert re.match(DIFFERS, done.stdout)


@pytest.mark.slow
def test_a_changed_vector_is_named(tmp_path: Path) -> None:
    """A reading of the first vector's fifth sample, a little larger: the test names vector, sample and signal."""
    folder = write_folder("halbach", "double", tmp_path)
    path = folder / "halbach_test.c"
    lines = path.read_text(encoding="utf-8").splitlines()
    first = next(k for k, line in enumerate(lines) if '{ "stroke"' in line) + 1
    row = lines[first + 4].strip("{},").split(", ")
    row[3] = repr(float(row[3]) + 1e-9)
    lines[first + 4] = "{" + ", ".join(row) + "},"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    done = run_test(HERE, folder)
    assert done.returncode == 1
    found = re.match(DIFFERS, done.stdout)
    assert found, done.stdout
    assert found[1] == "4"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), TRIED)
def test_no_library_is_called(name: str, precision: Precision, tmp_path: Path) -> None:
    """A float build has no arithmetic of double precision, and no build has a function of libm."""
    p = PROCESSORS["Cortex-M4F"]
    require(p.compiler, "arm-none-eabi-nm")
    folder = write_folder(name, precision, tmp_path)
    for path in c_files(folder, "none"):
        done = run([p.compiler, *p.options, *FLAGS, "-c", str(path), "-o", "part.o"], folder)
        assert done.returncode == 0, done.stderr[:2000]
        undefined = re.findall(r" U (\S+)", run(["arm-none-eabi-nm", "-u", "part.o"], folder).stdout)
        arithmetic = {symbol for symbol in undefined if symbol.startswith("__aeabi_d")}
        assert bool(arithmetic) == (precision == "double")
        assert not [s for s in undefined if not s.startswith(("__aeabi_", f"{name}_"))]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), TRIED)
def test_sanitizers_find_nothing(name: str, precision: Precision, tmp_path: Path) -> None:
    """Addresses and undefined behaviour, over the vectors and the example."""
    folder = write_folder(name, precision, tmp_path)
    for main in sorted(path.stem for path in folder.glob("*.c")):
        if "int main(" in (folder / f"{main}.c").read_text(encoding="utf-8"):
            done = run_test(HERE, folder, "-O1", *SANITIZERS, main=main)
            assert done.returncode == 0, (main, done.stdout, done.stderr[:2000])
            assert done.stderr == ""


@pytest.mark.slow
def test_the_analyzer_finds_nothing(tmp_path: Path) -> None:
    require("gcc")
    folder = write_folder("halbach", "float", tmp_path)
    for path in sorted(folder.glob("*.c")):
        done = run(["gcc", *EXACT, "-O1", "-fanalyzer", "-Werror", "-c", str(path), "-o", "part.o"], folder)
        assert done.returncode == 0, done.stderr[:2000]


@pytest.mark.parametrize("precision", SOME)
def test_roots_bit_by_bit_are_those_of_the_processor(precision: Precision, tmp_path: Path) -> None:
    """Also of the smallest and the largest number, and 0 of what is not positive; infinity is its own root."""
    require("gcc")
    real = np.float64 if precision == "double" else np.float32
    limits = np.finfo(real)
    loop = 'while (scanf("%la", &x) == 1) printf("%a\\n", (double)own_root((own_real)x));'
    main = f"int main(void) {{ double x; {loop} }}\n"
    text = "#include <stdio.h>\n" + root_text(precision) + main
    (tmp_path / "root.c").write_text(text, encoding="utf-8")
    rng = np.random.default_rng(5)
    given = (10.0 ** rng.uniform(np.log10(limits.tiny), np.log10(limits.max), 500)).astype(real)
    given = np.concatenate([given, [limits.smallest_subnormal, limits.tiny, limits.max, 1, 4, 2, np.inf]])
    given = np.concatenate([given, [0, -1, -np.inf, np.nan]]).astype(real)
    program = build(HERE, tmp_path, "-O1", main="root")
    (tmp_path / "given").write_text("\n".join(float(x).hex() for x in given), encoding="utf-8")
    printed = run(["sh", "-c", f"{program} < given"], tmp_path).stdout.split()
    expected = np.sqrt(np.where(np.greater(given, 0), given, 0))
    assert np.array_equal([float.fromhex(x) for x in printed], expected.astype(float))

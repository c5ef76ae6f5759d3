"""Exports of fused multiply-adds: rounded once in Python, in the library and in the instruction of each processor."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import pytest
from exported import HERE, PROCESSORS, controller, require, run, run_test

import malta
from malta.firmware.cost import operations
from malta.firmware.program import TYPES, multiply_add
from malta.firmware.signals import Target, fidelity_of

if TYPE_CHECKING:
    from pathlib import Path

    from malta.firmware.program import Precision

SLOW = (
    "-DHALBACH_SLOW_FMA",
    "-Wl,--no-as-needed",
    "-lm",
)  # the library's, on a computer whose compiler has no such instruction


def _export(precision: Precision, folder: Path, *, fma: bool = True) -> Path:
    files = malta.export_c("design/gains/halbach.json", folder, precision=precision, proof=False, fma=fma)
    return files[0].parent


def _checksum(printed: str) -> str:
    found = re.search(r"^pass: 4 vectors of 60 samples, checksum ([0-9a-f]{8})\n", printed, re.MULTILINE)
    assert found, printed
    return found[1]


@pytest.mark.parametrize("precision", ["float", "double"])
@np.errstate(over="ignore", invalid="ignore")
def test_a_product_and_a_sum_round_once(precision: Precision) -> None:
    """Beside exact rationals: no number of the precision is nearer. Zeros keep their signs, and infinity is one."""
    real, rng = TYPES[precision], np.random.default_rng(3)
    limits = np.finfo(real)
    for scale in (1.0, float(limits.tiny) ** 0.5, float(limits.eps) ** 0.5):
        a, b, c = (rng.normal(size=(3, 300)) * [[1.0], [1.0], [scale]]).astype(real)
        c[::3] = -a[::3] * b[::3]  # what is left is the rounding of the product
        for x, y, z in zip(a, b, c, strict=True):
            exact = Fraction(float(x)) * Fraction(float(y)) + Fraction(float(z))
            found = real(multiply_add(x, y, z))
            off = abs(Fraction(float(found)) - exact)
            for other in (np.nextafter(found, real(np.inf)), np.nextafter(found, real(-np.inf))):
                assert off <= abs(Fraction(float(other)) - exact)
    assert np.signbit(multiply_add(real(-0.0), real(1.0), real(-0.0)))
    assert real(multiply_add(limits.max, real(2.0), real(0.0))) == np.inf
    assert np.isnan(multiply_add(real(np.inf), real(0.0), real(1.0)))


def test_the_option_changes_products_and_sums_alone() -> None:
    c = controller("halbach")
    plain, fused = (
        Target(c, "float", fidelity_of(malta.plant_of(c.parameters)), fused=on) for on in (False, True)
    )
    before, after = operations(plain), operations(fused)
    count = after.pop("fused multiply-adds")
    assert count > 20
    assert before["additions"] - after["additions"] == count
    assert before["multiplications"] - after["multiplications"] == count
    assert before["divisions"] == after["divisions"]


def test_the_library_has_the_bits_of_the_vectors(tmp_path: Path) -> None:
    """And other ones than without; a target that cannot fuse is refused."""
    require("gcc")
    folder = _export("float", tmp_path / "fused")
    fused = _checksum(run_test(HERE, folder, "-O2", *SLOW).stdout)
    plain = _checksum(run_test(HERE, _export("float", tmp_path / "plain", fma=False), "-O2").stdout)
    assert fused != plain
    refused = run(["gcc", "-O2", "-mno-fma", "-c", "halbach.c", "-o", "part.o"], folder)
    assert refused.returncode != 0
    assert "no fused multiply-add" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"), [("Cortex-M4F", "float"), ("Cortex-M7", "float"), ("Cortex-M7", "double")]
)
def test_processors_have_the_bits_of_the_vectors(name: str, precision: Precision, tmp_path: Path) -> None:
    """By their own instruction, without a call of the library; in single precision the text is shorter than without."""
    p = PROCESSORS[name]
    require(p.compiler, *p.runner[:1], "arm-none-eabi-objdump")
    sizes = []
    for fma in (True, False):
        folder = _export(precision, tmp_path / f"{fma}", fma=fma)
        done = run_test(p, folder, "-O2")
        assert done.returncode == 0, done.stdout
        compiled = run([p.compiler, *p.options, "-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-c",
                        "halbach.c", "-o", "one.o"], folder)  # fmt: skip
        assert compiled.returncode == 0, compiled.stderr[:2000]
        listing = run(["arm-none-eabi-objdump", "-d", "one.o"], folder).stdout
        assert ("vfma" in listing) == fma
        assert "<fma" not in listing
        sizes.append(len(re.findall(r"^ +[0-9a-f]+:", listing, re.MULTILINE)))
    assert sizes[0] < sizes[1] or precision == "double"

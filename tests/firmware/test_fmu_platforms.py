"""FMUs with binaries of several platforms: what they are, and that each computes the bits of this computer's."""

from __future__ import annotations

import importlib.util
import io
import platform
import shutil
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from exported import START, require, run
from test_fmu import SHA256, Unit, content, target

import malta
from malta.errors import InputError
from malta.firmware import fmu as platforms
from malta.firmware.fmu import PLATFORMS, build_fmu, platforms_named

fmpy: Any = pytest.importorskip("fmpy")
with_zig = pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="ziglang not installed")
SAMPLES = 200
KINDS = {  # of a binary by its first bytes: format and processor
    "x86_64-linux": ("ELF", 62),
    "aarch64-linux": ("ELF", 183),
    "x86_64-windows": ("PE", 0x8664),
    "x86_64-darwin": ("Mach-O", 0x01000007),
    "aarch64-darwin": ("Mach-O", 0x0100000C),
}


def kind_of(binary: bytes) -> tuple[str, int]:
    """The format of a shared library and the number of its processor."""
    if binary[:4] == b"\x7fELF":
        return "ELF", struct.unpack_from("<H", binary, 18)[0]
    if binary[:2] == b"MZ":
        head = struct.unpack_from("<I", binary, 0x3C)[0]
        assert binary[head : head + 4] == b"PE\0\0"
        return "PE", struct.unpack_from("<H", binary, head + 4)[0]
    magic, cpu = struct.unpack_from("<II", binary)
    assert magic == 0xFEEDFACF
    return "Mach-O", cpu


def slices_of(fat: bytes) -> list[bytes]:
    """The libraries in a Mach-O file of several processors, each on a page of its own."""
    magic, count = struct.unpack_from(">II", fat)
    assert magic == 0xCAFEBABE
    found = []
    for k in range(count):
        cpu, _, at, size, alignment = struct.unpack_from(">5I", fat, 8 + 20 * k)
        assert (at % (1 << alignment), kind_of(fat[at : at + size])[1]) == (0, cpu)
        found.append(fat[at : at + size])
    return found


@pytest.fixture(scope="module")
def everywhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The loop of a machine with binaries of all platforms, as a folder."""
    folder = tmp_path_factory.mktemp("everywhere")
    fmu = build_fmu(target("halbach"), SHA256, part="loop", platforms=["all"])
    assert fmu.note == ""
    with zipfile.ZipFile(io.BytesIO(fmu.content)) as archive:
        archive.extractall(folder)
    return folder


def flight(unit: Unit, value: float) -> Any:
    """All variables of a loop after each sample."""
    everything = [reference for group in unit.groups.values() for reference in group]
    unit.begin()
    unit.start()
    found = []
    for _ in range(SAMPLES):
        unit.set("p_ref", [value])
        unit.advance()
        found.append(unit.fmu.getReal(sorted(everything)))
    unit.fmu.freeInstance()
    return np.array(found)


@pytest.fixture
def own(tmp_path: Path) -> Any:
    """The bits of the binary that this computer's compiler makes."""
    with zipfile.ZipFile(io.BytesIO(content(target("halbach"), "loop", 2))) as archive:
        archive.extractall(tmp_path / "own")
    return flight(Unit(tmp_path / "own"), 1e-4)


@pytest.mark.slow
@with_zig
def test_all_platforms_have_a_binary_of_their_kind(everywhere: Path) -> None:
    """On a Mac, importers of FMI 2 look into darwin64, whatever its processor is."""
    found = {path.parent.name: path.read_bytes() for path in everywhere.glob("binaries/*/halbach_loop.*")}
    assert set(found) == {p.second for p in PLATFORMS}
    for p in PLATFORMS:
        if p.second != "darwin64":
            assert kind_of(found[p.second]) == KINDS[p.name]
    both = slices_of(found["darwin64"])
    assert [kind_of(one) for one in both] == [KINDS["x86_64-darwin"], KINDS["aarch64-darwin"]]
    assert both[1] == found["aarch64-darwin"]


@pytest.mark.slow
@with_zig
def test_the_same_gain_file_gives_the_same_bytes_also_across(tmp_path: Path) -> None:
    """From two folders; the folders of FMI 3 have its names."""
    chosen = ["linux64", "aarch64-linux", "win64"]
    made = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TMPDIR", str(tmp_path / name))
            patch.setattr("tempfile.tempdir", None)
            made.append(build_fmu(target("halbach"), SHA256, fmi=3, platforms=chosen).content)
    assert made[0] == made[1]
    with zipfile.ZipFile(io.BytesIO(made[0])) as archive:
        folders = {name.split("/")[1] for name in archive.namelist() if name.startswith("binaries/")}
    assert folders == {"x86_64-linux", "aarch64-linux", "x86_64-windows"}


@pytest.mark.slow
@with_zig
@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64",
    reason="another computer than x86_64 with Linux",
)
def test_the_cross_compiled_binary_flies_as_the_own_one(everywhere: Path, own: Any) -> None:
    found = flight(Unit(everywhere), 1e-4)
    assert np.abs(own[:, 1:]).max() > 1e-5
    assert np.array_equal(found, own)


def _with_qemu() -> tuple[str, ...]:
    require("qemu-aarch64")
    libraries = Path("/usr/aarch64-linux-gnu")  # of Debian's libc6-arm64-cross
    if not (libraries / "lib" / "libc.so.6").exists():
        pytest.skip("no C library of aarch64")
    return "qemu-aarch64", "-L", str(libraries)


def _with_wine() -> tuple[str, ...]:
    wine = shutil.which("wine64") or shutil.which("wine")
    if wine is None:
        pytest.skip("wine not installed")
    return (wine,)


@pytest.mark.slow
@with_zig
@pytest.mark.parametrize(("name", "runner"), [("aarch64-linux", _with_qemu), ("x86_64-windows", _with_wine)])
def test_another_computer_computes_the_same_bits(
    name: str,
    runner: Callable[[], tuple[str, ...]],
    everywhere: Path,
    own: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A program of zig's loads the binary, emulated, and steps it as fmpy does this computer's."""
    command = runner()
    (p,) = platforms_named([name])
    program = tmp_path / ("host.exe" if p.ending == ".dll" else "host")
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", p.target, "-I", str(everywhere / "sources")]
    done = run([*zig, str(START / "fmu_host.c"), "-o", str(program)], tmp_path, seconds=1800)
    assert done.returncode == 0, done.stderr[:2000]
    monkeypatch.setenv("WINEPREFIX", str(tmp_path / "wine"))
    monkeypatch.setenv("WINEDEBUG", "-all")
    (library,) = (everywhere / "binaries" / p.second).glob("*.*")
    d = fmpy.read_model_description(everywhere, validate=False)
    (reference,) = (v.valueReference for v in d.modelVariables if v.name.startswith("p_ref."))
    step = repr(float(d.defaultExperiment.stepSize))
    given = [str(library), d.guid, str(own.shape[1]), step, str(SAMPLES), str(reference), "1e-4"]
    done = run([*command, str(program), *given], tmp_path)
    assert done.returncode == 0, done.stderr[:2000]
    bits = np.array([int(line, 16) for line in done.stdout.split()], dtype=np.uint64)
    assert np.array_equal(bits.reshape(SAMPLES, -1), own.view(np.uint64))


def test_platforms_have_the_names_of_both_versions() -> None:
    assert platforms_named(["all"]) == PLATFORMS
    assert [p.name for p in platforms_named(["win64", "x86_64-linux", "linux64"])] == [
        "x86_64-linux",
        "x86_64-windows",
    ]
    with pytest.raises(
        InputError, match="platforms: found 'win95', expected all, or some of x86_64-linux, linu"
    ):
        platforms_named(["all", "win95"])


def test_a_missing_ziglang_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(platforms, "find_spec", lambda _: None)
    gains, out = ROOT / "design" / "gains" / "halbach.json", tmp_path / "a.fmu"
    with pytest.raises(
        InputError, match="found no cross compiler, expected ziglang: pip install ziglang, or malta"
    ):
        malta.export_fmu(gains, out, platforms=["win64"])
    assert not out.exists()


def test_a_compiler_that_fails_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(platforms, "find_spec", lambda _: object())
    monkeypatch.setattr(platforms, "shared_library", lambda *_: None)
    gains, out = ROOT / "design" / "gains" / "halbach.json", tmp_path / "a.fmu"
    with pytest.raises(
        malta.CheckError, match="ziglang compiled nothing for x86_64-windows: try -m ziglang cc -targ"
    ):
        malta.export_fmu(gains, out, platforms=["win64"])
    assert not out.exists()

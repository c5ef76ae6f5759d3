"""The ring buffer of exported C: its dump is read as a log, its commands are computed again to the bit."""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run
from exported import PRECISIONS, controller, require, target

import malta
from malta.firmware.cost import costs, log_costs
from malta.firmware.flight import Native, compile_controller, compile_files, engine_of_c, new_state, view
from malta.firmware.sources import HEAD, ring_of, ring_sources, sources
from malta.identification.dump import read_dump, replay_dump
from malta.simulation.engine.compiled import library

SHA = "0" * 64
SECONDS = 4.0  # 72 samples of the Halbach motor: 8 blocks of 10, and one


@cache
def require_compiler() -> None:
    if library("int one(void) { return 1; }", 1) is None:
        pytest.skip("no C compiler works")


class Ring:
    """A ring and the controller that writes into it, in C of this computer."""

    def __init__(self, native: Native, state: Any, seconds: float, after: int = 0) -> None:
        self.native, self.state, self.name = native, state, native.name
        t = replace(native.target, logged=seconds)
        files = sources(t, SHA, self.name) | ring_sources(t, SHA, self.name)
        ends = (".h", ".c", "_parts.c", "_log.h", "_log.c")
        self.lib = compile_files([files[f"{self.name}{end}"] for end in ends])
        self.ring = ring_of(t, SHA)
        self.memory = ctypes.create_string_buffer(self.ring.memory)
        self.call("log_init", self.memory, ctypes.byref(state), after)

    def call(self, function: str, *arguments: Any) -> Any:
        found = getattr(self.lib, f"{self.name}_{function}")
        found.restype = ctypes.c_void_p
        return found(*arguments)

    def step(self, inputs: Any, outputs: Any, flown: int = 1, fault: int = 0) -> None:
        now = self.call("log_sample", self.memory)
        read = now + ctypes.sizeof(self.native.Reference)
        commanded = read + ctypes.sizeof(inputs)
        ctypes.memmove(read, ctypes.byref(inputs), ctypes.sizeof(inputs))
        if flown:
            self.call("step", ctypes.byref(self.state), ctypes.c_void_p(read), ctypes.c_void_p(commanded))
        ctypes.memmove(ctypes.byref(outputs), commanded, ctypes.sizeof(outputs))
        self.call("log_keep", self.memory, ctypes.byref(self.state), flown, fault)


@pytest.fixture
def ring() -> Ring:
    require_compiler()
    native = compile_controller(target("halbach", "float"))
    return Ring(native, new_state(native), SECONDS, after=5)


def random_readings(ring: Ring, count: int, seed: int = 0) -> Callable[[int], Any]:
    """Readings of 0.1 mm, one in 20 invalid, and a reference that moves."""
    random = np.random.default_rng(seed)
    y, valid = 1e-4 * random.standard_normal(count), random.random(count) > 0.05

    def inputs(k: int) -> Any:
        found = ring.native.Inputs()
        view(found, "y")[:] = y[k]
        view(found, "y_valid")[:] = valid[k]
        view(ring.state.reference, "p")[:] = 1e-4 * np.sin(0.1 * k)
        return found

    return inputs


def fly(ring: Ring, count: int, *, fault: int | None = None, off: range = range(0)) -> list[float]:
    """Steps with random readings: the forces that were commanded."""
    inputs, outputs, forces = random_readings(ring, count), ring.native.Outputs(), []
    for k in range(count):
        ring.step(inputs(k), outputs, flown=int(k not in off), fault=int(k == fault))
        forces.append(float(outputs.v[0]))
    return forces


def dumped(ring: Ring, folder: Path) -> Path:
    path = folder / "ring.dump"
    path.write_bytes(ring.memory.raw)
    return path


@pytest.mark.parametrize("count", [7, 73, 90, 300, 305])
def test_a_dump_is_the_flight_and_is_computed_again_to_the_bit(
    ring: Ring, count: int, tmp_path: Path
) -> None:
    forces = fly(ring, count)
    path = dumped(ring, tmp_path)
    found = replay_dump(controller("halbach"), path)
    assert (found.first, found.same, found.restarts) == (None, found.samples, 0)
    assert max(found.difference.values()) == 0.0
    log = malta.identification.read_log(path)
    rows, block = ring.ring.rows, ring.ring.block
    assert (rows, block) == (90, 10)
    kept = (
        count if count < rows else 8 * block + count % block
    )  # the block that is being written has newer rows
    assert (log.samples, found.samples) == (kept, kept)
    assert log.columns["v"][:, 0].tolist() == forces[-kept:]
    assert log.columns["reference"][-1, 0] == np.float32(1e-4 * np.sin(0.1 * (count - 1)))
    assert log.survey.missing["x"] == np.isnan(log.columns["y"]).sum() > 0 or count == 7
    assert (log.machine, log.controller, log.sample_time) == ("halbach", "halbach", 0.055)


@pytest.mark.parametrize("cause", ["call", "fault", "threshold"])
def test_it_stops_so_many_samples_after_a_trigger(ring: Ring, cause: str, tmp_path: Path) -> None:
    """At a call before sample 200, a fault in it, or the first reading beyond 0.25 mm: 5 samples follow."""
    if cause == "threshold":
        assert not ring.call("log_watch", ring.memory, 1, ctypes.c_float(1e-4))  # there is one output
        assert ring.call("log_watch", ring.memory, 0, ctypes.c_float(2.5e-4)) == 1
    inputs, outputs, beyond = random_readings(ring, 600, seed=3), ring.native.Outputs(), []
    for k in range(600):
        if cause == "call" and k == 200:
            ring.call("log_trigger", ring.memory)
        ring.step(inputs(k), outputs, fault=int(cause == "fault" and k == 200))
        if abs(outputs.y_used[0]) > np.float32(2.5e-4):
            beyond.append(k)
    at = beyond[0] if cause == "threshold" else 200
    dump = read_dump(ring.memory.raw, tmp_path / "ring.dump")
    assert dump.cause == cause
    assert dump.trigger == len(dump.rows) - 6
    assert dump.rows["reference.p"][dump.trigger, 0] == np.float32(1e-4 * np.sin(0.1 * at))
    log = malta.identification.read_log(dumped(ring, tmp_path))
    assert np.flatnonzero(log.columns["flags"][:, log.names("flags").index("trigger")]) == [dump.trigger]
    assert replay_dump(controller("halbach"), tmp_path / "ring.dump").first is None


def test_a_ring_that_stops_at_the_end_of_a_block_has_all_its_rows(ring: Ring, tmp_path: Path) -> None:
    fly(ring, 200, fault=184)  # and 5 more: 190
    found = replay_dump(controller("halbach"), dumped(ring, tmp_path))
    assert (found.samples, found.same) == (90, 90)


def test_samples_with_gates_off_are_not_computed_again(ring: Ring, tmp_path: Path) -> None:
    """Off from 33 to 47, so that the state of samples 48 and 49 is not known; a supervisor would start the law anew."""
    fly(ring, 80, off=range(33, 48))
    path = dumped(ring, tmp_path)
    found = replay_dump(controller("halbach"), path)
    assert (found.samples, found.same) == (80 - 15 - 2, 63)
    log = malta.identification.read_log(path)
    off = log.columns["flags"][:, log.names("flags").index("off")]
    assert np.flatnonzero(off).tolist() == list(range(33, 48))
    assert not log.columns["v"][off == 1].any()


def test_one_other_bit_is_seen(ring: Ring, tmp_path: Path, run: Run) -> None:
    fly(ring, 60)
    bytes_of = ring.ring.real_bytes
    row = HEAD + bytes_of + ring.ring.text_bytes + bytes_of * ring.ring.blocks * ring.ring.remembered
    names = [name for name, _ in ring.ring.sample]
    before = sum(f.size for _, f in ring.ring.sample[: names.index("out.v")])
    damaged = bytearray(ring.memory.raw)
    damaged[row + bytes_of * (41 * ring.ring.numbers + before)] ^= 1
    path = tmp_path / "ring.dump"
    path.write_bytes(damaged)
    found = replay_dump(controller("halbach"), path)
    assert (found.samples, found.same) == (60, 59)
    assert found.first == pytest.approx(41 * 0.055)
    assert 0 < found.difference["F_x"] < 1e-6
    said = run("replay", "design/gains/halbach.json", path)
    assert said.code == 1
    assert "from 2.255 s on the exported C commands other bits" in " ".join(said.err.split()), said.err


def test_a_dump_of_a_processor_with_the_other_order_of_bytes(ring: Ring, tmp_path: Path) -> None:
    fly(ring, 120)
    content = ring.memory.raw
    text = HEAD + ring.ring.real_bytes
    parts = (
        content[8:text],
        content[text : text + ring.ring.text_bytes],
        content[text + ring.ring.text_bytes :],
    )
    swapped = [np.frombuffer(part, "u4").byteswap().tobytes() for part in (parts[0], parts[2])]
    other = tmp_path / "other.dump"
    other.write_bytes(content[:8] + swapped[0] + parts[1] + swapped[1])
    found = replay_dump(controller("halbach"), other)
    assert (found.samples, found.first) == (80, None)
    log, own = malta.identification.read_log(other), malta.identification.read_log(dumped(ring, tmp_path))
    assert (log.columns["v"] == own.columns["v"]).all()


def test_what_is_no_dump_is_refused_with_one_sentence(ring: Ring, tmp_path: Path, run: Run) -> None:
    fly(ring, 60)
    good, path = ring.memory.raw, tmp_path / "bad.dump"
    place = {name: 20 + 4 * k for k, name in enumerate(("period", "watched", "next", "wrapped"))}
    cases = {
        "magic: found b'NOLOG": b"NOLOG" + good,
        "order: found bytes": good[:8] + b"\1\1\1\1" + good[12:],
        "version: found 2": good[:12] + b"\2\0\0\0" + good[16:],
        "text_bytes: found 0": good[:16] + bytes(4) + good[20:],
        r"found 1000 bytes, expected \d+": good[:1000],
        "text: found no names": good.replace(b"machine\t", b"machina\t"),
        "text: found bytes that are not ASCII": good.replace(b"controller\t", b"c\xffntroller\t", 1),
        "sample_time: found 'nothing'": good.replace(b"sample_time\t", b"sample_tame\t"),
        "block: found '1x'": good.replace(b"block\t10", b"block\t1x"),
        "precision: found double": good.replace(b"precision\tfloat", b"precision\tdouble")[: len(good)],
        "in.y: found no such signals": good.replace(b"in.y\t", b"in.x\t"),
        "next: found 90": good[: place["next"]] + b"\x5a\0\0\0" + good[place["next"] + 4 :],
        "next: found 0 samples": good[: place["next"]] + bytes(4) + good[place["next"] + 4 :],
    }
    for says, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(malta.InputError, match=says) as error:
            malta.identification.read_log(path)
        assert "\n" not in str(error.value)
    said = run("log", path)
    assert (said.code, "Traceback" in said.err) == (2, False)
    path.write_bytes(good)
    with pytest.raises(malta.InputError, match="those of the gain file's export"):
        replay_dump(controller("halbach_pid"), path)


def test_a_ring_that_no_memory_holds_is_refused(tmp_path: Path, run: Run) -> None:
    for time, says in (("1e9s", "bytes in all"), ("0s", "above zero"), ("5 kg", "kg")):
        said = run(
            "export", "design/gains/halbach.json", "--log", time, "--out", tmp_path / "c", "--no-proof"
        )
        assert (said.code, says in said.err, (tmp_path / "c").exists()) == (2, True, False)
    said = run("export", "design/gains/halbach.json", "--log", "1s", "--to", "fmu")
    assert (said.code, "--log: found an FMU" in said.err) == (2, True)


@pytest.mark.slow
def test_a_ring_takes_less_than_5_percent_of_a_step() -> None:
    """Of `robust` on each processor whose compiler is here, in either precision; the memory is that of the record."""
    require("gcc", "objdump")
    for precision in PRECISIONS:
        t = replace(target("robust", precision), logged=0.1)
        steps = {c.processor: c.instructions for c in costs(t)}
        found = log_costs(t)
        assert len(found) == len(steps) > 0
        for c in found:
            mean = c.each + (c.most - c.each) / ring_of(t, SHA).block
            assert 30 < c.each < mean < 0.05 * steps[c.processor], c


@pytest.mark.slow
def test_a_minute_with_the_simulated_machine_is_computed_again() -> None:
    require_compiler()
    rings = []

    def stepped(native: Native, state: Any) -> Callable[[Any, Any, int, int], None]:
        rings.append(Ring(native, state, 60.0))
        return lambda inputs, outputs, _, __: rings[-1].step(inputs, outputs)

    c = controller("halbach")
    scenario = malta.Scenario("hold", 66.0, malta.references.hold, noise=1.0, fidelity="phase")
    run = malta.simulate(malta.plant_of(c.parameters), c, scenario, engine=engine_of_c("double", stepped))
    path = Path("build/minute.dump")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(rings[-1].memory.raw)
    found, log = replay_dump(c, path), malta.identification.read_log(path)
    assert found.samples * c.sample_time >= 60
    assert (found.first, found.difference) == (None, {"F_x": 0.0})
    assert (log.columns["v"] == run.v[-log.samples :]).all()
    assert (log.columns["y"] == run.y[-log.samples :]).all()


@pytest.mark.slow
def test_a_minute_at_20_kHz_under_the_supervisor_is_computed_again(tmp_path: Path) -> None:
    """The exported example with its stand-in for a machine, strokes there and back: 1.25 million samples."""
    require("gcc", "make")
    malta.export_c(
        "design/gains/robust.json", tmp_path / "c", precision="float", until="currents", log=60.0, proof=False
    )
    example = tmp_path / "c" / "robust_example.c"
    text = example.read_text()
    changes = {
        r"\{ \(void\)log; \}": '{ FILE *f = fopen("robust.dump", "wb"); (void)fwrite(log, sizeof *log, 1, f); '
        "(void)fclose(f); }",
        r"#include <stdbool.h>": "#include <stdbool.h>\n#include <stdio.h>",
        r"samples_left = \d+;": "samples_left = 1400000;",
        r"request.land = 1 - follow\(&stroke, &request\);": "if (follow(&stroke, &request) == 0) {"
        " (void)robust_start_stroke(&stroke, ROBUST_QUINTIC, stroke.end, stroke.start, stroke.rise); }",
    }
    for old, new in changes.items():
        text, count = re.subn(old, new.replace("\\", "\\\\"), text)
        assert count == 1
    example.write_text(text)
    for command in (["make", "robust_example"], ["./robust_example"]):
        subprocess.run(command, cwd=tmp_path / "c", check=False, capture_output=True, timeout=300)
    dump = tmp_path / "c" / "robust.dump"
    found = replay_dump(controller("robust"), dump)
    dump.unlink()
    assert found.samples * 50e-6 >= 60
    assert (found.same, found.first, found.restarts) == (found.samples, None, 0)
    assert set(found.difference.values()) == {0.0}

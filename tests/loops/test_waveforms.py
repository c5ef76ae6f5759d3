"""The worst waveform of a bounded signal: no other one moves further, and the simulated machine moves as far."""

from __future__ import annotations

import math
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import ROOT
from flight import default_of

import malta
from malta.linear.impulses import impulses, l1_bounds, sign_changes
from malta.loops.linear_loops import linear_loop
from malta.loops.loop import Loop
from malta.loops.sampled_loops import states_within
from malta.loops.waveforms import largest_load
from malta.tuning.outcomes import judge_controller

if TYPE_CHECKING:
    from pathlib import Path

    from malta.arrays import FloatArray

EXAMPLE = ROOT / "examples" / "ball"
GAINS = ROOT / "design" / "gains"
EXAMPLES = {"ball": "ball", "ball_pid": "ball", "magnet": "magnet", "plate": "plate", "rotor": "rotor"}
FLOWN = (
    ("structured", "F_x", "x1", 1.0),
    ("tubular_pid", "T_y", "x1", 0.01),
    ("planar_pid", "F_z", "z", 1.0),
    ("ball", "w", "y", 1e-3),
)


def loop_of(name: str) -> Loop:
    if name in EXAMPLES:
        spec = malta.read_design(ROOT / "examples" / EXAMPLES[name] / "design" / f"{name}.toml")
        point = spec.plant.at()
        return malta.loop(spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, point)))
    controller = malta.gains.read(GAINS / f"{name}.json")
    return malta.loop(malta.plant_of(controller.parameters), controller)


def fly(loop: Loop, output: str, load: FloatArray) -> FloatArray:
    """What a load that is held for each sample (k x disturbances) does to an output of the simulated machine."""
    k, T = [s.name for s in loop.plant.outputs].index(output), loop.sample_time

    def held(t: FloatArray) -> FloatArray:
        rows: FloatArray = np.zeros((len(t), load.shape[1]))
        inside = np.rint(t / T).astype(int)
        rows[inside < len(load)] = load[inside[inside < len(load)]]
        return rows

    motion = []
    for disturbance in (held, None):
        scenario = malta.Scenario(
            "load", (len(load) + 1) * T, malta.references.hold,
            disturbance=disturbance, fidelity=default_of(loop.plant),
        )  # fmt: skip
        motion.append(malta.simulate(loop.plant, loop.controller, scenario).p[:, k])
    return np.asarray(motion[0] - motion[1])


@pytest.mark.slow_for("planar_pid-F_z-z-1.0", "ball-w-y-0.001")
@pytest.mark.parametrize(("name", "load", "output", "limit"), FLOWN)
def test_a_load_found_by_flights_alone_reaches_the_bound(
    name: str, load: str, output: str, limit: float
) -> None:
    """A pulse of one sample gives the impulse response of the simulated machine, and its signs the adversary's load."""
    loop = loop_of(name)
    found = malta.worst_waveform(loop, load, output, limit)
    samples = math.ceil(found.peak_time / loop.sample_time)
    j = [s.name for s in loop.plant.disturbances].index(load)
    pulse = np.zeros((samples, len(loop.plant.disturbances)))
    pulse[0, j] = limit
    g = fly(loop, output, pulse)[1 : samples + 1]
    bang = np.zeros_like(pulse)
    bang[:, j] = limit * np.sign(g)[::-1]
    reached = np.abs(fly(loop, output, bang)).max()
    assert 0.97 * found.value < reached < 1.001 * (found.value + found.error)


@pytest.mark.slow_for("planar", "plate")
@pytest.mark.parametrize("name", ["robust", "planar", "plate"])
def test_the_signal_of_the_record_does_in_flight_what_it_says(name: str) -> None:
    loop = loop_of(name)
    load, output = loop.plant.disturbances[0], loop.plant.outputs[0]
    found = max(
        (
            malta.worst_waveform(loop, load.name, s.name, 1e-2)
            for s in loop.plant.outputs
            if s.unit == output.unit
        ),
        key=lambda one: one.value,
    )
    samples = math.ceil(found.peak_time / loop.sample_time)
    moved = fly(loop, found.output, found.load(loop.sample_time * np.arange(samples)))
    assert np.abs(moved).max() == pytest.approx(found.value, rel=0.02)
    assert np.abs(found.response[1]).max() == pytest.approx(found.value, rel=1e-3)


@pytest.mark.parametrize("name", ["calibrated", "halbach_pid", "planar_pid", "magnet"])
def test_it_lies_above_every_other_load(name: str) -> None:
    """Above loads of random signs, sines and steps, of which other functions know the answer."""
    loop = loop_of(name)
    load = loop.plant.disturbances[0].name
    (recovered,) = (one for one in malta.loops.recovery(loop) if one.name == load)
    s, k = loop.sampled, len(loop.sampled.control.A)
    assert s.pushed is not None
    M, e = s.closed, np.append(s.pushed[:, 0], np.zeros(k))
    C, rng = np.hstack([s.outputs, np.zeros((len(s.outputs), k))]), np.random.default_rng(1)
    for i, one in enumerate(recovered.outputs):
        if one.largest < 1e-12:
            continue
        found = malta.worst_waveform(loop, load, one.output)
        assert found.value > one.largest * (1 - 1e-3)
        assert found.value > one.compliance * (1 - 1e-3)
        x, most = np.zeros((len(M), 200)), 0.0
        for _ in range(300):
            x = M @ x + e[:, None] * np.where(rng.random(200) < 0.5, -1.0, 1.0)
            most = max(most, float(np.abs(C[i] @ x).max()))
        assert 0 < most < found.value + found.error


@pytest.mark.parametrize("gap", [0.5, 1e-2, 1e-5, 1e-8])
def test_the_bound_of_a_slow_response_is_its_sum(gap: float) -> None:
    """Of x+ = (1 - gap) x + w and y = x: 1 / gap, however many samples that takes."""
    one = np.ones((1, 1))
    (found,) = l1_bounds((1 - gap) * one, one, one, 0 * one)
    assert 1 - 1e-9 <= found * gap < 1 + 1e-4
    with pytest.raises(malta.CheckError, match="moves without limit"):
        l1_bounds(one, one, one, 0 * one)


@pytest.mark.parametrize("damping", [0.3, 1e-3, 1e-4])
@pytest.mark.parametrize("turn", [0.003, 0.1, 2.9])
def test_bounds_are_those_of_every_sample(turn: float, damping: float) -> None:
    """A mode that rings at `turn` rad a sample beside a slow one, to two outputs, with two parts in a sample."""
    c, s = (1 - damping * turn) * math.cos(turn), (1 - damping * turn) * math.sin(turn)
    M = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1 - 1e-4]])
    C, E = np.array([[1, 0, 0.01], [0, 1, -0.3]]), np.array([[1, 0.9], [0.1, 0.2], [0.01, 0.01]])
    D = np.array([[0.5, 0], [0, 0.1]])
    every = impulses(M, C, E, D)
    found = l1_bounds(M, C, E, D)
    sums = np.abs(every.values).sum(axis=1)
    assert np.all(found >= sums * (1 - 1e-9))
    turned = np.array([sign_changes(h) for h in every.values])
    assert np.all(found <= (sums + turned + every.tail) * (1 + 3e-4))


def test_it_is_the_sum_of_an_impulse_response() -> None:
    """Of x+ = 0.5 x + w, y = x: 1 + 1/2 + 1/4 + ... = 2; of alternating signs likewise."""
    for pole in (0.5, -0.5):
        one = np.ones((1, 1))
        found = impulses(pole * one, one, one, 0 * one)
        assert found.norms[0] == pytest.approx(2, rel=1e-6)
        assert found.norms[0] + found.tail[0] >= 2
        assert found.values[0, 1:4].tolist() == [1, pole, pole**2]


def test_its_size_follows_its_limit_and_its_direction() -> None:
    loop = loop_of("tubular_pid")
    one, ten = (malta.worst_waveform(loop, "F_x", "x1", limit) for limit in (1.0, 10.0))
    assert ten.value == pytest.approx(10 * one.value)
    half = malta.worst_waveform(loop, {"F_x": -0.5}, "x1", 2.0)
    assert half.value == pytest.approx(one.value)
    assert half.load(np.zeros(1))[0, 0] == pytest.approx(one.load(np.zeros(1))[0, 0])  # both move it up
    # A load at a point is no more than its force and its torque apart.
    both = malta.worst_waveform(loop, {"F_x": 1.0, "T_y": -0.045}, "x1")
    turned = malta.worst_waveform(loop, "T_y", "x1", 0.045)
    assert both.value < one.value + turned.value + one.error + turned.error


@pytest.mark.parametrize("name", ["structured", "planar", "halbach", "magnet"])
def test_states_at_the_end_of_a_sample_are_those_of_the_next(name: str) -> None:
    loop = loop_of(name)
    n, T = len(loop.model.A), loop.sample_time
    within = [
        states_within(loop.model, loop.controller, loop.sampled, loop.current_loops, time)
        for time in (0.0, 1e-9 * T, T)
    ]
    size = np.abs(within[2]).max(axis=1, keepdims=True)
    assert np.allclose(within[2] / size, loop.matrix[:n] / size, rtol=1e-6, atol=1e-6)
    assert np.allclose(within[1] / size, within[0] / size, rtol=1e-5, atol=1e-5)


def test_noise_moves_outputs_and_forces_by_no_less_than_their_peaks_over_frequency() -> None:
    loop = loop_of("planar_pid")
    _, T, _, FS = loop.classical.gang["x"]
    assert malta.worst_waveform(loop, "noise x", "x").value > T
    forces = math.hypot(*(malta.worst_waveform(loop, "noise x", name).value for name in ("F_x", "T_y")))
    assert forces > FS


def test_a_ramp_is_behind_by_less_than_the_worst_reference_of_its_rate() -> None:
    loop, rate = loop_of("halbach_pid"), 0.1
    closed = linear_loop(loop).closed_loop()
    T = loop.sample_time
    x, behind = np.zeros(len(closed.A)), [0.0]
    for k in range(400):
        r = np.array([rate * T * k, 0.0])
        behind.append(abs(float((closed.C @ x + closed.D @ r)[0]) - r[0]))
        x = x + T * (closed.A @ x + closed.B @ r)
    found = malta.worst_waveform(loop, "rate x", "error x", rate)
    assert found.limit_unit == "m/s"
    assert max(behind) <= found.value + found.error
    assert found.value < 3 * max(behind)


def test_a_clearance_is_touched_by_the_largest_load_and_by_none_below() -> None:
    loop = loop_of("tubular_pid")
    size, contact = largest_load(loop, "F_x")
    assert malta.worst_waveform(loop, "F_x", contact, size).value == pytest.approx(1, abs=1e-5)
    x1, par = malta.worst_waveform(loop, "F_x", "x1", size), vars(loop.plant.parameters)
    assert x1.value == pytest.approx(par["r_max"], rel=1e-3)
    assert math.isinf(largest_load(loop, "T_z")[0])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("F_q", "x1"), "worst_waveform: disturbance: found 'F_q'"),
        (("noise q", "x1"), "worst_waveform: disturbance: found 'q'"),
        (("F_x", "q"), "worst_waveform: output: found 'q'"),
        (("F_x", 4), "worst_waveform: output: found 4"),
        (({"F_x": 0.0}, "x1"), "worst_waveform: disturbance: found shares of 0"),
        (({}, "x1"), "worst_waveform: disturbance"),
        (({"F_x": math.nan}, "x1"), "worst_waveform: disturbance.F_x"),
        ((None, "x1"), "worst_waveform: disturbance"),
        (("F_x", "x1", 0.0), "worst_waveform: limit: found 0.0"),
        (("F_x", "x1", math.inf), "worst_waveform: limit: found inf"),
        (("rate z", "z"), "worst_waveform: output: found 'z' of a reference, expected 'error z'"),
        (("rate z", "f_D"), "worst_waveform: output"),
        (("noise z", "axial end stop"), "worst_waveform: disturbance: found 'noise z', expected a load"),
        (("noise z", "error z"), "worst_waveform: output"),
        (
            ("F_x", "axial end stop"),
            "worst_waveform: output: found 'axial end stop', expected a contact that F_x",
        ),
    ],
)
def test_bad_input_is_one_sentence(arguments: tuple[object, ...], says: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        malta.worst_waveform(loop_of("tubular_pid"), *arguments)  # type: ignore[arg-type]
    assert str(caught.value).startswith(says)


def test_an_unstable_loop_and_a_machine_without_contacts_are_refused() -> None:
    loop = loop_of("tubular_pid")
    unstable = malta.loop(loop.plant, loop.controller, parameters={"K_A": 1e6})
    with pytest.raises(malta.CheckError, match="unstable loop"):
        malta.worst_waveform(unstable, "F_x", "x1")


@pytest.mark.parametrize(("asked", "verdict"), [("0.5 N", "holds"), ("50 N", "fails")])
def test_a_design_file_asks_for_loads_that_touch_nothing(tmp_path: Path, asked: str, verdict: str) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "ball")
    file, (value, unit) = tmp_path / "ball" / "design" / "ball.toml", asked.split()
    wanted = f'margin = 3\nnever_touches = {{ w = {{ value = {value}, unit = "{unit}" }} }}\n'
    file.write_text(file.read_text(encoding="utf-8").replace("margin = 3\n", wanted), encoding="utf-8")
    spec = malta.read_design(file)
    assert spec.specification["never_touches w"] == float(value)
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    (found,) = judge_controller(spec, controller, ["never_touches w"])
    assert (found.verdict, found.unit, found.how) == (verdict, "N", "linear loop, to stop")
    size, _ = largest_load(malta.loop(spec.plant, controller), "w")
    assert found.found == pytest.approx(size)


def test_a_requirement_of_a_load_that_the_machine_has_not_is_one_sentence(tmp_path: Path) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "ball")
    file = tmp_path / "ball" / "design" / "ball.toml"
    wanted = 'margin = 3\nnever_touches = { F_q = { value = 1, unit = "N" } }\n'
    file.write_text(file.read_text(encoding="utf-8").replace("margin = 3\n", wanted), encoding="utf-8")
    with pytest.raises(malta.InputError, match=r"specification\.never_touches\.F_q"):
        malta.read_design(file)


def test_the_recovery_table_holds_what_any_load_does() -> None:
    loop = loop_of("tubular_pid")
    for recovered in malta.loops.recovery(loop):
        for one in recovered.outputs:
            if one.largest > 1e-9:
                alone = malta.worst_waveform(loop, recovered.name, one.output)
                assert one.any_waveform == pytest.approx(alone.value, rel=2e-3)
                assert one.any_waveform >= one.largest

"""Single precision over many samples, and numbers that are none: sums move on, and nothing poisons the state."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from exported import PRECISIONS, controller, target
from hypothesis import given, settings, strategies as st

import malta
from malta.firmware.flight import Native, call, compile_controller, engine_of_c, new_state, view, write
from malta.firmware.program import TYPES, Precision
from malta.firmware.signals import Target
from malta.firmware.sources import sources
from malta.simulation import references
from malta.simulation.engine.compiled import compiler

ERROR = 1e-8  # m, which does not move a float of 1e-4 in a sample of 50 us
BAD = (math.nan, math.inf, -math.inf, 1e30, -1e30)
BEGIN, LENGTH = 5, 20  # samples of a burst
DAMAGES = st.lists(
    st.tuples(st.integers(0, LENGTH - 1), st.integers(0, 99), st.sampled_from(BAD)), min_size=1, max_size=40
)
PRESENT = ("y", "i", "link")  # readings, each with or without a flag of its own


@pytest.fixture(autouse=True)
def _with_compiler() -> None:
    if compiler() is None:
        pytest.skip("no C compiler")


class Run:
    """A controller that takes sample after sample; it starts with a machine that follows a reference of zero."""

    def __init__(self, t: Target) -> None:
        self.native: Native = compile_controller(t)
        self.state, self.inputs, self.outputs = (
            new_state(self.native),
            self.native.Inputs(),
            self.native.Outputs(),
        )
        self.width = sum(f.size for f in t.state_fields)
        call(self.native, "start", self.state)

    def step(self, readings: dict[str, Any]) -> None:
        write(self.inputs, readings)
        call(self.native, "step", self.state, self.inputs, self.outputs)

    def numbers(self) -> Any:
        """All outputs but the flags of refused readings, then the state, in a row."""
        real = TYPES[self.native.target.precision]
        outputs, state = np.frombuffer(self.outputs, real).copy(), np.frombuffer(self.state, real, self.width)
        entries = len(self.outputs.refused)
        outputs[entries : 2 * entries] = 0  # after y_used
        return np.concatenate([outputs, state])


def at_rest(r: Run) -> dict[str, Any]:
    """Readings of a machine where the reference is, without noise."""
    t = r.native.target
    readings: dict[str, Any] = {f.name: np.ones(f.size) for f in t.input_fields}
    readings["y"] = np.zeros(len(t.controller.measurements))
    if t.driven:
        readings |= {"i": view(r.state, "i_last").copy(), "link": view(r.state, "link_last").copy()}
    return readings


def damaged(readings: dict[str, Any], damages: list[tuple[int, int, float]], sample: int) -> dict[str, Any]:
    """Readings of one sample of a burst with its damages."""
    after = {name: np.array(value, dtype=float) for name, value in readings.items()}
    names = [name for name in PRESENT if name in readings]
    places = [(name, k) for name in names for k in range(len(readings[name]))]
    for _, where, value in (d for d in damages if d[0] == sample):
        name, k = places[where % len(places)]
        after[name][k] = value
    return after


def moved(precision: Precision, samples: int) -> Any:
    """How far the sums of errors move from 1e-4 m s, with an error of 10 nm in all readings and no sum that waits."""
    r = Run(target("robust", precision))
    readings = at_rest(r) | {"y": np.full(5, -ERROR)}
    view(r.state, "e")[:] = 1e-4
    begin = view(r.state, "e").astype(float)
    for _ in range(samples):
        view(r.state, "frozen")[:] = 0
        r.step(readings)
    return view(r.state, "e").astype(float) - begin


@pytest.mark.slow
def test_sums_of_single_precision_do_not_stand_still() -> None:
    """Over 1 s they follow those of double precision within 1e-3; a plain sum would not move at all."""
    Ts = controller("robust").sample_time
    samples = round(1 / Ts)
    double = moved("double", samples)
    assert double == pytest.approx(np.full(5, ERROR), rel=1e-9)
    assert moved("float", samples) == pytest.approx(double, rel=1e-3)
    plain = np.float32(1e-4)
    for _ in range(samples):
        plain = plain + np.float32(Ts * ERROR)
    assert plain == np.float32(1e-4)


@pytest.mark.slow
def test_two_seconds_of_single_precision() -> None:
    """A hold with noise: positions agree within 10 pm, 2e-6 of their range, and drift nowhere."""
    c = controller("robust")
    plant = malta.plant_of(c.parameters)
    scenario = malta.Scenario("hold", 2.0, references.hold, noise=1.0, fidelity="phase")
    double, single = (malta.simulate(plant, c, scenario, engine=engine_of_c(p)) for p in PRECISIONS)
    assert double.verdict.completed
    apart = np.abs(single.p - double.p)
    assert 1e-14 < apart.max() < 1e-11
    tenths = np.array([part.max() for part in np.array_split(apart, 10)])
    assert tenths[-1] < 2 * tenths[0]


@pytest.mark.slow_for("robust-float", "tubular_pid-double", "tubular_pid-float")
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["halbach", "robust", "tubular_pid"])
@settings(max_examples=40, deadline=None)
@given(damages=DAMAGES)
def test_refused_readings_leave_no_trace_at_rest(
    name: str, precision: Precision, damages: list[tuple[int, int, float]]
) -> None:
    """Where the machine does what the filter expects, a burst changes no bit of outputs and state, then or later."""
    t = target(name, precision)
    calm, disturbed = Run(t), Run(t)
    readings = at_rest(calm)
    for k in range(BEGIN + LENGTH + 10):
        calm.step(readings)
        disturbed.step(damaged(readings, damages, k - BEGIN))
        assert disturbed.numbers().tobytes() == calm.numbers().tobytes(), k
        refused = any(d[0] == k - BEGIN and d[1] % count(readings) < len(readings["y"]) for d in damages)
        assert bool(view(disturbed.outputs, "refused").any()) == refused


def count(readings: dict[str, Any]) -> int:
    return sum(len(readings[name]) for name in PRESENT if name in readings)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["halbach", "robust"])
@settings(max_examples=40, deadline=None)
@given(damages=DAMAGES)
def test_after_a_burst_sums_lack_what_was_refused(
    name: str, precision: Precision, damages: list[tuple[int, int, float]]
) -> None:
    """With noise: the state stays finite, and sums of errors lack the refused errors times Ts."""
    t = target(name, precision)
    calm, disturbed = Run(t), Run(t)
    rows = noisy_rows(calm)
    missed = np.zeros(len(t.controller.measurements))
    for k in range(BEGIN + LENGTH + 60):
        readings = rows[k % len(rows)]
        calm.step(readings)
        disturbed.step(damaged(readings, damages, k - BEGIN))
        assert np.isfinite(disturbed.numbers()).all()
        missed += view(calm.outputs, "y_used") - view(disturbed.outputs, "y_used")
    one, other = (view(r.state, "e").astype(float) for r in (calm, disturbed))
    rounding = {"double": 1e-12, "float": 1e-4}[precision] * np.abs(one).max()
    assert np.abs(other - one - t.controller.sample_time * missed).max() <= rounding


def noisy_rows(r: Run) -> list[dict[str, Any]]:
    """Readings of a machine at rest with noise, for 60 samples."""
    rng, rest = np.random.default_rng(7), at_rest(r)
    sizes = {name: size for name, size in (("y", 1e-7), ("i", 1e-2)) if name in rest}
    return [
        rest | {k: rest[k] + size * rng.normal(size=len(rest[k])) for k, size in sizes.items()}
        for _ in range(60)
    ]


def test_a_filter_that_is_left_alone_finds_back() -> None:
    """Forces at their limits, then a second without any reading: the unstable model would leave single precision."""
    r = Run(target("robust", "float"))
    readings = at_rest(r)
    for k in range(3):
        r.step(readings | {"y": 1e-3 * (-1.0) ** (k + np.arange(5))})
    write(r.inputs, readings | {"y": np.full(5, math.nan)})
    for _ in range(20_000):
        call(r.native, "step", r.state, r.inputs, r.outputs)
    assert np.isfinite(r.numbers()).all()
    write(r.inputs, readings)
    for _ in range(20_000):
        call(r.native, "step", r.state, r.inputs, r.outputs)
    assert np.abs(view(r.state, "xi_pred")[:5]).max() < 1e-6
    assert not view(r.outputs, "saturated").any()


def test_a_motor_turns_on_beyond_one_radian() -> None:
    """Nothing bounds readings of a machine without contacts; under a load a blind controller would lose it."""
    A = [[0, 1, 0], [0, -1, 2], [0, 0, -30]]
    plant = malta.linear_machine(
        A, [[0], [0], [30]], [[1, 0, 0]], limit=50.0, noise=1e-4, outputs=["phi [rad]"]
    )
    w = malta.synthesis.weights([10, 1, 0], [1], [1], [1e-6], q_i=[10])
    c = malta.lqg(malta.linearize(plant, plant.at()), w, 1e-3, name="motor")

    def turned(_: Any) -> Any:
        return lambda t: references.Motion(*(np.full((len(t), 1), value) for value in (3.0, 0.0, 0.0)))

    def load(t: Any) -> Any:
        return np.full((len(t), 1), -0.5)

    run = malta.Scenario("turned", 0.5, turned, fidelity="force", noise=1.0, disturbance=load)
    own, flown = malta.simulate(plant, c, run), malta.simulate(plant, c, run, engine=engine_of_c("double"))
    assert own.p[0, 0] > 2
    np.testing.assert_allclose(flown.p, own.p, rtol=1e-12)


@pytest.mark.slow_for("1e+38-True")
@pytest.mark.parametrize(("gain", "fits"), [(1e38, True), (1e39, False)])
def test_single_precision_refuses_what_it_does_not_hold(gain: float, fits: bool) -> None:
    c = controller("tubular_pid")
    t = Target(replace(c, K=np.where(np.abs(c.K).max() == c.K, gain, c.K)), "float")
    if fits:
        assert "1e+38f" in sources(t, "")["tubular_pid.c"]
    else:
        with pytest.raises(malta.InputError, match=r"precision: found float for a number of 1e\+39"):
            sources(t, "")


@pytest.mark.slow
def test_the_samples_of_a_stroke_are_counted_at_any_rate() -> None:
    """At 1 MHz the longest rise is shorter than a thousand seconds: 2^31 half samples are all."""
    c = controller("tubular_pid")
    for period, longest in ((c.sample_time, 1000.0), (1e-6, 1e9 * 1e-6 / 6)):
        text = sources(Target(replace(c, sample_time=period)), "")["tubular_pid.c"]
        (limit,) = re.findall(r"_real limit = (\S+);", text)
        assert float(limit) == pytest.approx(longest)
        assert 2 * 6 * float(limit) / period < 2**31


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("bad", [*BAD, 2.0])
def test_a_reference_out_of_reach_changes_nothing(bad: float, precision: Precision) -> None:
    """NaN, infinity, or far beyond the travel, in any entry: refused, and the state keeps every byte."""
    r = Run(target("robust", precision))
    before = bytes(r.state)
    for name in ("p", "dp", "ddp") if abs(bad) != 2 else ("p",):
        for k in range(5):
            reference = r.native.Reference()
            view(reference, name)[k] = bad
            assert call(r.native, "set_reference", r.state, reference) == 0
    assert bytes(r.state) == before
    reference = r.native.Reference()
    view(reference, "p")[4] = 1e-3
    assert call(r.native, "set_reference", r.state, reference) == 1
    assert view(r.state.reference, "p")[4] == TYPES[precision](1e-3)

"""Requests within limits: bang-bang adversaries from flown impulses reach the bound, and no request exceeds it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import Run
from exported import require
from jsonschema import Draft202012Validator

import malta
from malta.cli.documents.published import schema_of
from malta.loops.loop import Loop
from malta.simulation.references import Motion


@cache
def loop_of(name: str) -> Loop:
    controller = malta.gains.read(f"design/gains/{name}.json")
    return malta.loop(malta.plant_of(controller.parameters), controller)


def motion_of(loop: Loop, axis: int, a: np.ndarray, start: float = 0.0) -> Any:
    """A reference of accelerations that change at samples, from rest: p' their sum, p that of mean speeds."""
    T, p = loop.sample_time, len(loop.plant.outputs)
    a = np.concatenate([[0.0], a])
    dp = np.cumsum(T * a)
    place = start + np.concatenate([[0.0], np.cumsum(T * (dp[1:] + dp[:-1]) / 2)])

    def motion(t: np.ndarray) -> Motion:
        k = np.clip(np.round(t / T).astype(int), 0, len(a) - 1)
        rows = np.zeros((3, len(t), p))
        for row, values in zip(rows, (place, dp, a), strict=True):
            row[:, axis] = values[k]
        return Motion(*rows)

    return motion


def fly(loop: Loop, reference: Any, samples: int) -> Any:
    """Fly a reference with the nonlinear machine without noise: the run, up to the last sample of the reference."""
    fidelity: Any = (
        "dq" if "tubular" in loop.plant.name else "force"
    )  # with current loops where there are any
    lasts = (samples + 1) * loop.sample_time
    scenario = malta.Scenario("request", lasts, lambda _: reference, fidelity=fidelity)
    return malta.simulate(loop.plant, loop.controller, scenario)


def errors(run: Any, reference: Any, axis: int) -> np.ndarray:
    return np.asarray(run.p[:, axis] - reference(run.t).p[:, axis])


def flown_impulse(loop: Loop, axis: int, samples: int, size: float) -> np.ndarray:
    """The error after an acceleration of one sample, flown by the nonlinear machine, newest first, per unit."""
    a = np.zeros(samples)
    a[0] = size
    reference = motion_of(loop, axis, a)
    return errors(fly(loop, reference, samples), reference, axis)[1 : samples + 1] / size


# An adversary that knows nothing of matrices: it flies an impulse, and takes its signs backwards.
@pytest.mark.parametrize(
    ("name", "axis", "samples", "size"),
    [
        ("tubular_pid", 4, 2400, 10.0),
        pytest.param("robust", 0, 8000, 0.001, marks=pytest.mark.slow),
        pytest.param("planar", 2, 120, 0.01, marks=pytest.mark.slow),
    ],
)
def test_a_bang_bang_adversary_from_a_flown_impulse_reaches_the_bound(
    name: str, axis: int, samples: int, size: float
) -> None:
    loop = loop_of(name)
    h = flown_impulse(loop, axis, samples, size)
    reference = motion_of(loop, axis, size * np.sign(h[::-1]))
    t = loop.sample_time * np.arange(samples + 1)
    place, speed = (float(np.abs(x[:, axis]).max()) for x in reference(t)[:2])
    signal = loop.plant.outputs[axis].name
    found = malta.worst_request(loop, signal, f"error {signal}", (place, speed, size))
    reached = np.abs(errors(fly(loop, reference, samples), reference, axis)).max()
    assert 0.95 * found.upper < reached <= found.upper * (1 + 1e-5)  # the machine is not linear
    assert 0.95 * found.upper < found.value <= found.upper


@pytest.mark.parametrize(
    ("name", "signal", "output", "limits"),
    [
        ("tubular_pid", "z", "error z", (0.01, 0.5, 20.0)),
        ("tubular_pid", "z", "f_D", (0.001, 0.1, 5.0)),
        ("robust", "z", "error z", (0.01, 0.019, 20.0)),
        pytest.param("robust", "x1", "error x1", (2e-5, 0.01, 20.0), marks=pytest.mark.slow),
        ("planar", "z", "error z", (1e-4, 0.02, 5.0)),
    ],
)
def test_the_request_that_is_found_obeys_its_limits_and_flies_as_far_as_it_says(
    name: str, signal: str, output: str, limits: tuple[float, float, float]
) -> None:
    loop = loop_of(name)
    found = malta.worst_request(loop, signal, output, limits)
    assert 0.95 * found.upper < found.value <= found.upper
    p, dp, ddp = found.motion
    for row, limit in zip(found.motion, limits, strict=True):
        assert np.abs(row).max() <= limit * (1 + 1e-9)
    assert dp[0] == 0
    assert np.diff(dp) == pytest.approx(loop.sample_time * ddp[1:], abs=1e-12)
    axis = [s.name for s in loop.plant.outputs].index(signal)
    reference = motion_of(loop, axis, ddp[1:], p[0])
    run = fly(loop, reference, len(found.t) - 1)
    k = len(found.t) - 1
    flown = errors(run, reference, axis)[k]
    if output == "f_D":
        flown = run.v[k, -1]  # of which 0 hold it at the middle of its travel
    assert abs(flown) == pytest.approx(found.value, rel=0.02)


def random_requests(
    rng: np.random.Generator, samples: int, limits: tuple[float, float, float], T: float
) -> Any:
    """Accelerations at random signs and times, turned where speed or position would leave their limits."""
    P, V, A = limits
    a, p, v, wanted = np.zeros(samples), 0.0, 0.0, 0.0
    for k in range(samples):
        if rng.random() < 0.01:
            wanted = A * rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)])
        now = wanted
        ahead, stop = v + T * now, 0.0
        stop = p + T * ahead + math.copysign(ahead**2 / (2 * A), ahead) + T * ahead
        if abs(ahead) > V or abs(stop) > P:
            now = -math.copysign(min(A, abs(v) / T), v)
        p, v = p + T * (v + v + T * now) / 2, v + T * now
        a[k] = now
    return a


def test_random_requests_do_not_exceed_the_bounds() -> None:
    """A thousand requests in all: a run of many requests has a request for each of its samples."""
    loop, limits, rng = loop_of("tubular_pid"), (0.01, 0.5, 20.0), np.random.default_rng(7)
    error = malta.worst_request(loop, "z", "error z", limits)
    force = malta.worst_request(loop, "z", "f_D", limits)
    a = random_requests(rng, 20_000, limits, loop.sample_time)  # it turns some 200 times
    reference = motion_of(loop, 4, a)
    for row, limit in zip(reference(loop.sample_time * np.arange(len(a) + 1)), limits, strict=True):
        assert np.abs(row).max() <= limit * (1 + 1e-9)
    run = fly(loop, reference, len(a))
    reached = np.abs(errors(run, reference, 4)).max()
    assert 0.2 * error.upper < reached < error.upper
    assert np.abs(run.v[:, -1]).max() < force.upper


@pytest.mark.slow
def test_what_the_exported_supervisor_makes_of_any_request_stays_within_the_bound() -> None:
    require("gcc")
    gentle, rng = loop_of("tubular_pid"), np.random.default_rng(3)
    limits = np.zeros((3, 5))
    limits[:, 4] = 13e-3, 0.5, 20.0
    loop = malta.loop(gentle.plant, replace(gentle.controller, references=limits))
    places = rng.uniform(-13e-3, 13e-3, 12)

    def jumps(t: np.ndarray) -> Motion:
        rows = np.zeros((3, len(t), 5))
        rows[0, :, 4] = places[np.minimum((t / 0.06).astype(int), 11)] * (t > 0.01)
        return Motion(*rows)

    limited = malta.firmware.limit_reference(loop.controller, jumps)
    t = loop.sample_time * np.arange(14000)
    for row, limit in zip(limited(t), limits[:, 4], strict=True):
        assert 0.7 * limit < np.abs(row[:, 4]).max() <= limit
    found = malta.worst_request(loop, "z", "error z", limits[:, 4].tolist())
    run = fly(loop, limited, len(t) - 2)
    reached = np.abs(errors(run, limited, 4)).max()
    assert 0.2 * found.upper < reached < found.upper


@pytest.mark.slow
def test_bounds_grow_with_limits_and_scale_with_them() -> None:
    loop = loop_of("tubular_pid")
    small = malta.worst_request(loop, "z", "error z", (0.01, 0.5, 20.0))
    twice = malta.worst_request(loop, "z", "error z", (0.02, 1.0, 40.0))
    assert twice.upper == pytest.approx(2 * small.upper, rel=1e-3)
    slower = malta.worst_request(loop, "z", "error z", (0.01, 0.05, 20.0))
    nearer = malta.worst_request(loop, "z", "error z", (0.0005, 0.5, 20.0))
    assert max(slower.upper, nearer.upper) < 0.95 * small.upper


def test_small_limits_of_a_slow_loop_are_bounded_too() -> None:
    """The program is in shares of the limits: in SI its positions would be below the tolerances of its solver."""
    spec = malta.read_design("examples/ball/design/ball_pid.toml")
    loop = malta.loop(spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())))
    for size in (1.0, 1e-4):
        found = malta.worst_request(loop, "y", "error y", (1e-4 * size, 0.01 * size, size))
        assert found.upper == pytest.approx(6.0477e-5 * size, rel=1e-3)
        assert 0.95 * found.upper < found.value <= found.upper


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("q", "error z", (1, 1, 1)), "worst_request: reference: found 'q'"),
        (("z", "z", (1, 1, 1)), "worst_request: output: found 'z'"),
        (("z", "error z", (1, 1)), "worst_request: limits: found"),
        (("z", "error z", 1.0), "worst_request: limits: found 1.0"),
        (("z", "error z", (0.0, 1, 1)), "worst_request: limits[0]: found 0"),
        (("z", "error z", (1, 1, math.nan)), "worst_request: limits[2]: found nan"),
        (
            ("z", "error z", (0.01, 0.5, 20)),
            "worst_request: limits[1]: found 0.5, expected at most 0.02, where sums",
        ),
    ],
)
def test_bad_input_is_one_sentence(arguments: tuple[Any, ...], says: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        malta.worst_request(loop_of("robust"), *arguments)
    assert str(caught.value).startswith(says)


def test_an_unstable_loop_is_refused() -> None:
    loop = loop_of("tubular_pid")
    with pytest.raises(malta.CheckError, match="unstable loop"):
        malta.worst_request(
            malta.loop(loop.plant, loop.controller, parameters={"K_A": 1e6}), "z", "f_D", (1, 1, 1)
        )
    errors_of = loop_of("structured")  # whose current loops forecast voltages by the reference's speed
    with pytest.raises(malta.InputError, match="loop: found currents that follow the reference's speed"):
        malta.worst_request(errors_of, "z", "f_D", (1, 1, 1))
    with pytest.raises(malta.InputError, match="a Loop, from"):
        malta.worst_request(loop.plant, "z", "f_D", (1, 1, 1))  # type: ignore[arg-type]


def test_the_command_lists_what_the_supervisor_accepts(run: Run) -> None:
    code, out, _ = run("loads", "design/gains/halbach.json", "--requests")
    assert (code, "error x" in out, "while no command reaches its limit" in out) == (0, True, True)
    code, out, _ = run("loads", "design/gains/halbach.json", "--requests", "--json")
    document = json.loads(out)
    Draft202012Validator(schema_of("loads-output")).validate(document)
    assert [one["signal"] for one in document["linear"]] == ["error x", "F_x"]
    assert document["loads"] == []

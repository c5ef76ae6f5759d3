"""python-control behind the gains of a design file, and filterpy's filter beside its observer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.linear.sampling import sample
from malta.processes import environment
from malta.synthesis.filter_check import ALLOWED_ERROR, check_filter

DESIGNS = sorted(p for p in ROOT.glob("design/*.toml"))
EXAMPLES = [ROOT / "examples" / name for name in ("magnet/design/scheduled.toml", "rotor/design/rotor.toml")]


def designed(path: Path, **changes: Any) -> tuple[malta.Spec, Any, malta.Controller]:
    """A design file's LQG, with some of its fields changed."""
    spec = replace(malta.read_design(path), **changes)
    model = malta.linearize(spec.plant, spec.plant.at(**spec.operating_point))
    return spec, model, malta.synthesize(spec, model)


def lqgs() -> list[Path]:
    return [path for path in (*DESIGNS, *EXAMPLES) if malta.read_design(path).kind == "LQG"]


@pytest.mark.parametrize("path", lqgs(), ids=lambda path: path.stem)
def test_filterpy_has_the_gain_of_every_shipped_observer(path: Path) -> None:
    found = check_filter(*designed(path))
    assert 10 < found.samples < 20_000
    assert found.apart < 1e-9


@pytest.mark.parametrize("way", ["backward-euler", "zoh", "sampled-data"])
@pytest.mark.parametrize("rho", [-0.5, 0.9])
def test_noise_that_comes_with_the_reading(way: Any, rho: float) -> None:
    """Correlated by `rho`, in the coordinates of the positions."""
    weights = malta.read_design("design/robust.toml").weights
    noisy = replace(weights, correlation=np.full(5, rho))
    found = check_filter(
        *designed(ROOT / "design/robust.toml", law=noisy, discretization=way, current_lag=False)
    )
    assert found.apart < 1e-8


@pytest.mark.parametrize("name", ["table2", "calibrated", "planar"])
def test_an_observer_that_is_off_is_refused(name: str) -> None:
    spec, model, controller = designed(ROOT / f"design/{name}.toml")
    off = np.array(controller.L)
    off[np.unravel_index(np.abs(off).argmax(), off.shape)] *= 1 + 1e-4
    with pytest.raises(malta.CheckError, match=rf"{name}\.toml: Kalman filter: after \d+ samples filterpy's"):
        check_filter(spec, model, replace(controller, L=off))


def test_a_filter_too_slow_to_wait_for_is_compared_as_far_as_it_came() -> None:
    """A mass on the ground whose sensor is poor: 20 000 samples, and what is left is allowed."""
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    model = malta.linearize(cart, cart.at())
    spec, _, _ = designed(ROOT / "design/table2.toml", discretization="zoh")
    weights = malta.synthesis.weights([1, 1], [1], [1e-12], [1.0])
    slow = replace(spec, law=weights, sample_time=1e-4)
    found = check_filter(slow, model, malta.lqg(model, weights, 1e-4, "zoh"))
    assert (found.samples, found.apart < found.allowed) == (20_000, True)
    assert found.allowed > 100 * ALLOWED_ERROR


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(25))
def test_no_sound_observer_is_refused(seed: int) -> None:
    """Drawn machines, weights over ten decades, samples of 10 us to 10 ms: what filterpy leaves is foreseen."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    way: Any = ["backward-euler", "zoh", "sampled-data"][seed % 3]
    stiffness = rng.normal(size=(n, n)) * 10 ** rng.uniform(0, 5)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [stiffness, -np.diag(rng.uniform(0, 5, n))]])
    B = np.vstack([np.zeros((n, n)), rng.normal(size=(n, n)) * 10 ** rng.uniform(-2, 2)])
    cart = malta.linear_machine(A, B, np.hstack([rng.normal(size=(n, n)), np.zeros((n, n))]))
    model = malta.linearize(cart, cart.at())
    weights = malta.synthesis.weights(
        10 ** rng.uniform(-2, 6, 2 * n), 10 ** rng.uniform(-3, 3, n),
        10 ** rng.uniform(-8, 0, n), 10 ** rng.uniform(-14, -4, n),
    )  # fmt: skip
    Ts = 10 ** rng.uniform(-5, -2)
    base = malta.read_design("design/table2.toml")
    spec = replace(base, law=weights, sample_time=Ts, discretization=way)
    try:
        controller = malta.lqg(model, weights, Ts, spec.discretization)
    except malta.CheckError as error:
        pytest.skip(f"no sound design: {error}")
    found = check_filter(spec, model, controller)
    assert found.apart < found.allowed / 2
    assert found.samples == 20_000 or found.allowed < 1e-2


PROGRAM = """
import sys
from collections import Counter
import control, filterpy.kalman
calls = Counter()
def count(owner, name):
    first = getattr(owner, name)
    def counted(*args, **kwargs):
        calls[name] += 1
        if owner is control:
            assert kwargs["method"] == "scipy"
        return first(*args, **kwargs)
    setattr(owner, name, counted)
count(control, "care"), count(control, "dare"), count(filterpy.kalman.KalmanFilter, "predict")
from malta.cli.main import main
try:
    main()
except SystemExit as ended:
    print(ended.code, *(calls[name] for name in ("care", "dare", "predict")))
"""


@pytest.mark.slow_for("examples/ball/design/ball_pid.toml-expected1")
@pytest.mark.parametrize(
    ("design", "expected"),
    [
        ("examples/ball/design/ball.toml", [0, 4, 114]),
        ("examples/ball/design/ball_pid.toml", [0, 0, 0]),
        pytest.param("design/table2.toml", [12, 0, 21], marks=pytest.mark.slow),
    ],
)
def test_a_design_calls_python_control_and_filterpy(design: str, expected: list[int], tmp_path: Path) -> None:
    """Regulator and filter, on two scales: MALTA's have three parts that nothing joins and that differ."""
    path = ROOT / design
    command = [sys.executable, "-c", PROGRAM, "design", str(path)]
    command += ["--out", str(tmp_path), "--figures", str(tmp_path)]
    folder = path.parents[1]
    done = subprocess.run(command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=600)
    code, *calls = done.stdout.splitlines()[-1].split()
    assert (code, [int(number) for number in calls]) == ("0", expected), done.stderr


SLYCOT = """
import json, sys
if sys.argv[1] == "no":
    sys.modules["slycot"] = None
import control, malta
spec = malta.read_design("design/{name}.toml")
model = malta.linearize(spec.plant, spec.plant.at(**spec.operating_point))
controller = malta.synthesize(spec, model)
document = malta.gains.document(controller, malta.verify(model, controller, proof=False))
print(document["sha256"], control.slycot_check())
"""


@pytest.mark.slow_for("table2")
@pytest.mark.parametrize("name", ["table2", pytest.param("robust", marks=pytest.mark.slow)])
def test_a_gain_file_is_the_same_with_and_without_slycot(name: str) -> None:
    pytest.importorskip("slycot", reason="slycot is not installed")
    said = []
    for slycot in ("yes", "no"):
        command = [sys.executable, "-c", SLYCOT.replace("{name}", name), slycot]
        done = subprocess.run(
            command, cwd=ROOT, env=environment(), capture_output=True, text=True, check=True
        )
        said.append(done.stdout.split())
    (with_it, has), (without, has_not) = said
    assert (has, has_not) == ("True", "False")
    assert with_it == without


@pytest.mark.parametrize("solver", ["python-control", "scipy"])
def test_both_solvers_give_the_same_bits(solver: Any) -> None:
    """Of every matrix that synthesis returns; what looks at a machine alone asks scipy."""
    for name in ("table2", "calibrated", "halbach", "planar"):
        spec, model, controller = designed(ROOT / f"design/{name}.toml")
        again = malta.synthesize(spec, model, solver=solver)
        for field in ("Ad", "Bd", "K", "Ki", "L"):
            assert np.array_equal(getattr(again, field), getattr(controller, field)), (name, field)


def test_a_short_sample_and_weak_weights_keep_their_digits() -> None:
    """Where control.dare loses them: the double integrator at 1 us, against the continuous regulator."""
    A, B = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])
    for Ts in (1e-3, 1e-6):
        cart = malta.linear_machine(A, B, [[1, 0]])
        model = malta.linearize(cart, cart.at())
        weights = malta.synthesis.weights([16, 0], [1], [1], [1])
        K = malta.lqg(model, weights, Ts, "sampled-data").K
        # The sampled regulator is the continuous one, [4, sqrt(8)], up to terms of w_n Ts.
        assert K[0] == pytest.approx([4, 8**0.5], rel=4 * Ts)
    assert sample(A, B, 1e-6)[1][1, 0] == pytest.approx(1e-6)

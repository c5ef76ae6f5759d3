"""Learning from strokes: the force constant, what the next stroke is sent, and the proof that errors shrink."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import Run
from scipy.linalg import toeplitz

import malta
from malta.identification.excite import cut_loop
from malta.identification.log import sample_excitation
from malta.identification.log_files import write_log
from malta.identification.measure import machines_of
from malta.identification.strokes import ThrustPatterns, correction, thrust_patterns
from malta.loops.loop import Loop
from malta.synthesis.feedforward import static_feedforward

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant

CONTROLLER = malta.gains.read("design/gains/robust.json")


def changed(values: dict[str, float]) -> Plant:
    par: Any = CONTROLLER.parameters
    return malta.plant_of(replace(par, **values))


@pytest.mark.slow
@pytest.mark.parametrize("K_D", [4.68, 5.72])
def test_one_stroke_teaches_the_thrust(K_D: float) -> None:
    stroke = malta.Scenario.stroke(10e-3, noise=1.0, quantize=True)
    machine = changed({"K_D": K_D, "F_c": 0.6})
    before = malta.simulate(machine, CONTROLLER, stroke)
    found = malta.learn(CONTROLLER, malta.identification.log_of(before))
    assert found.parameter == "K_D"
    assert found.after == pytest.approx(K_D, rel=0.01)
    # The machine has 0.1 N more cogging than v0: noise alone would miss it.
    assert abs(found.after / K_D - 1) < found.half / found.factor < 0.02
    assert found.limits == ""
    # The limit is that of the current: 5 A in both modules.
    assert found.controller.limits.force[4] == pytest.approx(10 * found.after)
    limits = found.controller.limits.force / CONTROLLER.limits.force
    assert limits == pytest.approx([1, 1, 1, 1, found.after / found.before])  # the currents keep theirs
    after = malta.simulate(machine, found.controller, stroke)
    errors = [malta.simulation.stroke_figures(run).axial_error for run in (before, after)]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_the_constant_has_a_total_interval() -> None:
    """A mass of 1.4 % more goes into the constant: the interval of the factor misses it, the total one does not."""
    stroke = malta.Scenario.stroke(10e-3, noise=1.0, quantize=True)
    machine = changed({"K_D": 4.68, "m": 1.014 * 0.36})
    log = malta.identification.log_of(malta.simulate(machine, CONTROLLER, stroke))
    found = malta.learn(CONTROLLER, log)
    off = abs(found.after / 4.68 - 1)
    assert found.half / found.factor < off < found.half_after / found.after < 0.03
    # Friction, of 1 N and 1 N s/m, takes thrust and moves the factor by less than noise does.
    plain = {name: table for name, table in log.columns.items() if name != "i"}
    log = replace(log, columns=plain, signals={name: s for name, s in log.signals.items() if name != "i"})
    speed = np.gradient(np.asarray(log.columns["reference"])[:, 4], log.sample_time)
    rubbed = np.array(log.columns["v"])
    rubbed[:, 4] += np.tanh(speed / 1e-3) + speed
    smooth, rough = (
        malta.learn(CONTROLLER, one) for one in (log, replace(log, columns={**plain, "v": rubbed}))
    )
    assert abs(rough.factor - smooth.factor) < 2 * smooth.deviation


def test_a_stroke_at_the_limit_of_its_thrust_is_told() -> None:
    log = malta.identification.log_of(
        malta.simulate(changed({}), CONTROLLER, malta.Scenario.stroke(10e-3, noise=1.0))
    )
    limit = CONTROLLER.limits.force[4]
    v = np.array(log.columns["v"])
    v[:, 4] = np.clip(v[:, 4] * 1.2 * limit / np.abs(v[:, 4]).max(), -limit, limit)
    found = malta.learn(CONTROLLER, replace(log, columns={**log.columns, "v": v}))
    assert found.at_limit == pytest.approx(float((np.abs(v[:, 4]) >= 0.999 * limit).mean()))
    assert "at its limit" in found.limits


@pytest.mark.slow
def test_strokes_teach_the_next_one_what_is_missing() -> None:
    """A machine with other mass, thrust and cogging: in five noisy strokes from 0.4 mm to what the noise moves."""
    machine = changed({"m": 0.3, "K_D": 6.2, "F_c": 0.8})
    found = malta.identification.learn_strokes(machine, CONTROLLER, strokes=5)
    first, second, *taught = 1e6 * np.array(found.axial_error)
    assert (first > 300, 20 < second < 60, taught[0] < 0.4 * second, taught[-1] < 10) == (True,) * 4
    assert found.patterns[0] == 0
    assert found.patterns[1] > 2 * found.patterns[4]
    # Flown again without noise: what repeats falls to what the noise moves, 5 um.
    assert found.without_noise[0] == pytest.approx(found.axial_error[0], rel=0.01)
    assert max(found.without_noise[2:]) < 7e-6
    # Without noise no stroke is worse than the one before.
    still = malta.identification.learn_strokes(machine, CONTROLLER, strokes=5, noise=0.0)
    assert (np.diff(still.axial_error) < 1e-9).all()
    assert still.without_noise[:5] == still.axial_error
    assert still.axial_error[4] < 1.5e-6
    with pytest.raises(malta.InputError, match="expected 1 or more"):
        malta.identification.learn_strokes(machine, CONTROLLER, strokes=0)


@pytest.mark.slow
def test_what_the_model_misses_is_sent_first() -> None:
    """The gain file's own machine lags by 46 um behind delay and current loops; of that nothing is left to teach."""
    found = malta.identification.learn_strokes(changed({}), CONTROLLER, strokes=2)
    assert found.axial_error[0] > 40e-6
    assert found.without_noise[1] < 3e-6  # the force constant was learned from a noisy stroke
    assert found.axial_error[1] < 10e-6


@pytest.mark.slow
def test_no_stroke_is_expected_to_be_worse_than_the_one_before() -> None:
    """300 times six strokes of the model's own machine, with noise: the mean error falls, whatever was missing."""
    patterns, _ = stroke_patterns()
    noise, random = (15.6e-6) ** 2 * patterns.noise, np.random.default_rng(2)
    size = np.exp(-np.arange(len(noise)) / 4)
    for missing in (1e-3, 1e-4, 2e-5):
        errors = np.zeros((300, 6))
        for row in errors:
            x, left, most = missing * size * random.normal(size=len(noise)), 0 * noise, 0 * noise + 0.8
            for k in range(6):
                seen = x + np.sqrt(noise) * random.normal(size=len(noise))
                gains, left = correction(seen, noise, left, most)
                assert (gains <= most).all()
                most = gains if gains.any() else most
                row[k] = x @ x
                x = x - gains * seen
        fell = errors[:, :-1] - errors[:, 1:]
        assert (fell.mean(axis=0) > -2 * fell.std(axis=0) / np.sqrt(len(fell))).all()
        assert errors[:, 5].mean() < 0.7 * errors[:, 1].mean()


@pytest.mark.slow
def test_logs_of_a_bench_teach_as_the_simulated_strokes_do(run: Run, tmp_path: Path) -> None:
    """learn --out --next, a stroke, and learn --before --next: the errors of learn_strokes, from files."""
    machine = changed({"m": 0.3, "K_D": 6.2, "F_c": 0.8})
    gains, law = Path("design/gains/robust.json"), CONTROLLER
    scenario, files = malta.Scenario.stroke(10e-3, noise=1.0, quantize=True, settle=0.3), [tmp_path / "1.npz"]
    flown = malta.simulate(machine, law, scenario)
    sent, errors = tmp_path / "d.csv", [malta.simulation.stroke_figures(flown).axial_error]
    malta.identification.write_log(malta.identification.log_of(flown), files[0])
    assert run("learn", gains, files[0], "--out", tmp_path, "--next", sent).code == 0
    gains, law = tmp_path / "robust_learned.json", malta.gains.read(tmp_path / "robust_learned.json")
    for k in (2, 3):
        thrust = np.loadtxt(sent, delimiter=",", skiprows=1)[:, 1]
        excitation = sample_excitation(law.sample_time, machine, thrust)
        flown = malta.simulate(machine, law, scenario.replace(seed=k, excitation=excitation))
        errors.append(malta.simulation.stroke_figures(flown).axial_error)
        log = malta.identification.write_log(malta.identification.log_of(flown), tmp_path / f"{k}.npz")
        before = [text for file in files[1:] for text in ("--before", file)]
        assert run("learn", gains, log, *before, "--next", sent).code == 0
        files.append(log)
    assert errors[0] > 300e-6
    assert 20e-6 < errors[1] < 70e-6  # cogging alone: what the model knows was sent
    assert errors[2] < 11e-6
    assert run("learn", gains, log, "--before", files[1]).code == 2


@pytest.mark.slow
def test_gains_of_patterns_keep_the_contraction_that_is_proven() -> None:
    """The sum of a_k x_k^2 does not grow for machines whose error contracts under a gain of 0.8."""
    patterns, believed = stroke_patterns()
    random = np.random.default_rng(3)
    norms = []
    for one in machines_of(believed, {"K_D": 0.3, "m": 0.2}, 0, samples=0):
        M = moved_patterns(patterns, one)
        c = np.linalg.norm(np.eye(len(M)) - 0.8 * M, 2)
        for _ in range(2):
            D = np.diag(np.sqrt(random.uniform(0.001, 0.8, len(M))))
            norms.append((c, np.linalg.norm(np.eye(len(M)) - D @ M @ D, 2)))
    below = [left for c, left in norms if c < 1]
    assert len(below) >= 6
    assert max(below) <= 1
    assert max(c for c, _ in norms) > 1


@pytest.mark.slow
def test_a_slow_stroke_teaches_the_table_that_holds_the_machine() -> None:
    """Another cogging: the gain file's table becomes the machine's, within its deviations, and the stroke gains."""
    machine = changed({"F_c": 0.9, "phi_c": 0.5})
    slow = malta.Scenario.stroke(10e-3, rise=0.15, noise=1.0, settle=0.3)
    log = malta.identification.log_of(malta.simulate(machine, CONTROLLER, slow))
    found = malta.identification.learn_v0(CONTROLLER, log)
    k, true = machine.thrust_input, static_feedforward(machine)
    table = found.controller.feedforward
    missed = table.v0[:, k] - np.interp(table.z_grid, true.z_grid, true.v0[:, k])
    inside = np.isin(table.z_grid, found.z)
    assert found.z[[0, -1]] == pytest.approx([-5e-3, 5e-3], abs=0.26e-3)
    assert abs(missed[inside]).max() < 4 * found.deviation.max() < 0.05
    assert abs(found.change).max() > 0.4
    others = np.delete(table.v0, k, axis=1)
    assert np.array_equal(others, np.delete(CONTROLLER.feedforward.v0, k, axis=1))
    outside = table.v0[:, k] - CONTROLLER.feedforward.v0[:, k]
    assert outside[0] == pytest.approx(found.change[0], abs=0.05)  # it goes on as at the last place
    errors = [
        malta.simulation.stroke_figures(malta.simulate(machine, law, slow.replace(noise=0.0))).axial_error
        for law in (CONTROLLER, found.controller)
    ]
    assert errors[1] < 0.05 * errors[0]


def test_v0_needs_a_slow_stroke_that_moves() -> None:
    for stroke, says in (
        (malta.Scenario.stroke(10e-3), "accelerates the mover by 25"),
        (malta.Scenario.stroke(0.5e-3, rise=0.15), "a stroke of 0.5 mm"),
    ):
        log = malta.identification.log_of(malta.simulate(changed({}), CONTROLLER, stroke))
        with pytest.raises(malta.InputError, match=says):
            malta.identification.learn_v0(CONTROLLER, log)


@pytest.mark.slow
def test_errors_are_proven_to_shrink_over_the_box() -> None:
    """The bound holds the lifted operator of a stroke's log at every machine tried, and is near the largest of them."""
    box = {"K_D": 0.2}
    proven = malta.identification.contraction(CONTROLLER, box)
    assert proven.upper is not None
    assert proven.lower <= proven.upper < 1.011 * proven.lower
    patterns, believed = stroke_patterns()
    lifted = [lifted_norm(patterns, one) for one in machines_of(believed, box, 0, samples=0)]
    assert 0.2 < lifted[0] < 0.21  # of the gain file's own machine: 1 - 0.8, and the slope of cogging
    assert max(lifted) == pytest.approx(proven.upper, rel=0.03)
    assert max(lifted) < proven.upper + 0.01  # the slope of cogging away from the middle is not in the proof


@pytest.mark.slow
def test_parameters_that_do_not_move_the_stroke_do_not_count() -> None:
    proven = malta.identification.contraction(CONTROLLER, {"K_A": 0.2, "K_B": 0.2})
    assert proven.upper == pytest.approx(0.2, rel=0.02)


def test_what_is_not_proven_says_why() -> None:
    with pytest.raises(malta.InputError, match="unknown parameter"):
        malta.identification.contraction(CONTROLLER, {"k": 0.1})
    with pytest.raises(malta.InputError, match="no parameter"):
        malta.identification.contraction(CONTROLLER, {})
    table2 = malta.identification.contraction(malta.gains.read("design/gains/table2.json"), {"K_D": 0.1})
    assert (table2.upper, "near enough" in table2.reason) == (None, True)


@pytest.mark.slow
def test_errors_shrink_over_the_whole_box_but_not_beyond() -> None:
    """K_D / m is nearly one entry of the matrices: the proof of four parameters is one of an interval of that.

    The slope of cogging by m is the other entry that moves; the gain at the witness is that of its machine.
    """
    names = ("m", "K_A", "K_B", "K_D")
    proven = malta.identification.contraction(CONTROLLER, dict.fromkeys(names, 0.2))
    assert proven.upper is not None
    assert proven.lower == pytest.approx(0.8614, abs=1e-3)
    assert proven.lower < proven.upper < 0.875
    assert [proven.witness[name] for name in ("m", "K_D")] == pytest.approx([0.288, 6.24])
    ratio = malta.identification.contraction(CONTROLLER, {"K_D": (5.2 * 0.8 / 1.2, 5.2 * 1.2 / 0.8)})  # type: ignore[dict-item]
    assert ratio.lower == pytest.approx(
        proven.lower, rel=2e-3
    )  # the same machines, on the route of one parameter
    patterns, believed = stroke_patterns()
    lifted = [
        lifted_norm(patterns, one)
        for one in machines_of(believed, dict.fromkeys(("m", "K_D"), 0.2), 0, samples=4)
    ]
    assert 0.8 < max(lifted) < 0.868
    # A machine with 2.6 times the thrust on mass is moved too far by what is learned.
    assert malta.identification.contraction(CONTROLLER, {"m": 0.45, "K_D": 0.45}).lower > 1


def stroke_patterns() -> tuple[ThrustPatterns, Loop]:
    believed = malta.loop(malta.plant_of(CONTROLLER.parameters), CONTROLLER)
    scenario = malta.Scenario.stroke(10e-3)
    t = believed.sample_time * np.arange(scenario.samples(believed.sample_time))
    reference = scenario.reference(believed.plant)(t).p[:, believed.plant.stroke_output]
    return thrust_patterns(believed, reference), believed


def lifted_norm(patterns: ThrustPatterns, machine: Loop) -> float:
    """The 2-norm of U' (1 - 0.8 H B (H_0 B)^+) U: on the samples of one log."""
    return float(np.linalg.norm(np.eye(len(patterns.s)) - 0.8 * moved_patterns(patterns, machine), 2))


def moved_patterns(patterns: ThrustPatterns, machine: Loop) -> FloatArray:
    """U' H B (H_0 B)^+ U: how a machine moves in the patterns that move the gain file's machine by one each."""
    cut = machine.plant.stroke_output, machine.plant.thrust_input
    N, Ts = len(patterns.B), machine.sample_time
    w = 2 * np.pi * np.fft.rfftfreq(2 * N, Ts)
    G = np.zeros(len(w), dtype=complex)
    G[1:-1] = cut_loop(machine, w[1:-1]).G[:, *cut]
    H = toeplitz(np.fft.irfft(G, 2 * N)[:N], np.zeros(N))
    return np.asarray(patterns.U.T @ H @ patterns.B @ (patterns.V / patterns.s))


@pytest.mark.slow
def test_a_law_whose_strokes_do_not_converge_is_refused() -> None:
    """The integrals of table2 are too slow for an inverse within one stroke."""
    table2 = malta.gains.read("design/gains/table2.json")
    with pytest.raises(malta.CheckError, match="its own machine grows from"):
        malta.identification.learn_strokes(malta.plant_of(table2.parameters), table2, strokes=2)


def test_what_the_next_stroke_is_sent_needs_a_stroke_of_this_law() -> None:
    run = malta.simulate(changed({}), CONTROLLER, malta.Scenario.stroke(10e-3, noise=1.0))
    log = malta.identification.log_of(run)
    found = malta.identification.next_stroke(CONTROLLER, log)
    assert found.thrust[[0, -1]] == pytest.approx([0, 0], abs=0.2)
    assert found.noise == pytest.approx(np.hypot(15e-6, 15e-6 / np.sqrt(12)), rel=0.05)
    holes = np.array(log.columns["y"])
    holes[7] = np.nan
    with pytest.raises(malta.CheckError, match="samples are missing"):
        malta.identification.next_stroke(
            CONTROLLER, replace(log, columns={**log.columns, "y": holes}, sha256="")
        )
    with pytest.raises(malta.CheckError, match="a log of machine rotor"):
        malta.identification.next_stroke(CONTROLLER, replace(log, machine="rotor"))


def test_a_law_that_learned_no_constant_is_not_written(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy of the gain file would pass for a learned one, from a log and from strokes."""
    log = malta.identification.log_of(
        malta.simulate(malta.plant_of(CONTROLLER.parameters), CONTROLLER, malta.Scenario.stroke(10e-3))
    )
    monkeypatch.setattr("malta.identification.learn.thrust_constant", lambda _: "")
    file = write_log(log, tmp_path / "log.npz")
    for given in ((file,), ("--strokes", "1")):
        refused = run("learn", "design/gains/robust.json", *given, "--out", tmp_path / "out")
        assert refused.code == 2
        assert "no parameter that scales the thrust alone" in refused.err
        assert not (tmp_path / "out").exists()

"""The exported controller: the same bits as its expressions, and the same flight as the simulation's law."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import PRECISIONS, call_piece, controller, of_each_kind, target

import malta
from malta.firmware.export import folder_files
from malta.firmware.flight import call, compile_controller, differences, engine_of_c, new_state, view, write
from malta.firmware.fmu import build_fmu
from malta.firmware.program import Precision, evaluate
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.sources import sources
from malta.firmware.step import look_up, programs_of, started_state, step_function, zero_reference
from malta.simulation.engine.compiled import compiler

WARNINGS = (
    *("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-Werror", "-Wall", "-Wextra", "-Wpedantic"),
    *("-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Wstrict-prototypes", "-Wmissing-prototypes"),
    *("-Wfloat-conversion", "-Wcast-qual", "-Wundef", "-Wswitch-default"),
)


@pytest.fixture(autouse=True)
def _with_compiler() -> None:
    if compiler() is None:
        pytest.skip("no C compiler")


@pytest.mark.slow_for("robust-double")
@pytest.mark.parametrize(("name", "precision"), of_each_kind("robust", "halbach_late"))
def test_every_piece_computes_the_bits_of_its_expressions(name: str, precision: Precision) -> None:
    t = target(name, precision)
    native, rng = compile_controller(t), np.random.default_rng(3)
    pieces = {key: p for key, p in programs_of(t).items() if key not in ("sense", "decide", "state_at")}
    assert len(pieces) >= 8
    for key, p in pieces.items():
        for _ in range(4):
            given = {of: rng.normal(size=size) * 1e-3 for of, size in p.arguments}
            given |= {of: np.array([0.02]) for of in ("rise", "pole") if of in given}
            expected = evaluate(p, given, precision)
            found = call_piece(native, key, given, dict(p.results))
            for of, values in expected.items():
                assert np.array_equal(found[of], values), (key, of)


@pytest.mark.parametrize(("name", "precision"), of_each_kind("robust", "halbach_late"))
def test_steps_compute_the_bits_of_their_expressions(name: str, precision: Precision) -> None:
    """The whole state and all outputs, sample after sample, with readings that are none among them."""
    t = target(name, precision)
    native, rng, reach = compile_controller(t), np.random.default_rng(4), reading_ranges(t.believed)
    model = step_function(t)
    state, given, out = new_state(native), native.Inputs(), native.Outputs()
    reference = {f.name: np.zeros(f.size) for f in t.reference_fields}
    for k in range(12):
        before = {f.name: view(state, f.name).copy() for f in t.state_fields if f.size}
        read: dict[str, Any] = {"y": rng.normal(size=len(reach)) * reach / 10, "y_valid": np.ones(len(reach))}
        if k == 5:
            read["y"][0] = np.nan
        if t.driven:
            read |= {"i": rng.normal(size=18), "i_valid": np.ones(18), "link": np.array([45.0 - k])}
        write(given, read)
        call(native, "step", state, given, out)
        after, sensed = model(before, reference, read)
        for record, values in ((state, after), (out, sensed)):
            for of, expected in values.items():
                assert np.array_equal(view(record, of), expected), (k, of)
        assert bool(sensed["refused"].any()) == (k == 5)


@pytest.mark.slow_for("tubular_pid")
@pytest.mark.parametrize("name", ["table2", "tubular_pid"])
def test_the_pieces_make_the_step(name: str) -> None:
    """Called one after the other as a firmware may do, in double precision: the bits of a step."""
    t = target(name, "double")
    c, rng, step = t.controller, np.random.default_rng(5), step_function(t)
    programs = programs_of(t)

    def piece(of: str, **given: Any) -> dict[str, Any]:
        return evaluate(programs[of], given, "double")

    reference = zero_reference(t)
    state = started_state(t, reference)
    for k in range(4):
        read: dict[str, Any] = {"y": 1e-5 * rng.normal(size=5), "y_valid": np.ones(5), "link": [44.0]}
        read |= {"i": rng.normal(size=18), "i_valid": np.ones(18)}
        p, dp, y = reference["p"], reference["dp"], read["y"]
        xi_hat = piece("filter", xi_pred=state["xi_pred"], y=y, p=p)["xi_hat"]
        e = piece("sum_errors", e=state["e"], frozen=state["frozen"], y=y, p=p, dp=dp)["e_next"]
        v_ff = piece("feedforward", **reference)["v_ff"]
        xi_ref = np.zeros(len(c.states))
        xi_ref[: len(c.A)] = piece("reference_states", p=p, dp=dp)["states"]
        v0 = look_up(t, y[t.believed.stroke_output])
        law = piece("law", xi_hat=xi_hat, e=e, xi_ref=xi_ref, v_ff=v_ff, v0=v0)
        current = piece("currents", y=y, v=law["v"])["current"]
        loops = {name: state[name] for name in ("u_integral", "u_limited", "i_last", "link_last")}
        drive = piece("current_control", current=current, states=xi_hat[: len(c.A)], **loops, **read)
        state, out = step(state, reference, read)
        for mine, theirs in (
            (xi_hat, out["xi_hat"]),
            (e, state["e"]),
            (law["v"], out["v"]),
            (law["xi_pred_next"], state["xi_pred"]),
            (current, out["current"]),
            (drive["command"], out["command"]),
            (drive["u_integral_next"], state["u_integral"]),
        ):
            assert np.array_equal(mine, theirs), k


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["force", "dq"])
def test_it_flies_to_the_bit_where_nothing_is_contracted(fidelity: Any) -> None:
    """A noisy stroke: CasADi's virtual machine and the C compute the same numbers, in double precision."""
    c = controller("robust")
    plant, scenario = malta.plant_of(c.parameters), malta.Scenario.stroke(10e-3, fidelity=fidelity, noise=1.0)
    own = malta.simulate(plant, c, scenario, engine="virtual machine")
    flown = malta.simulate(plant, c, scenario, engine=engine_of_c())
    assert flown.verdict.completed
    assert {d.name: d.largest for d in differences(own, flown)} == dict.fromkeys(
        [d.name for d in differences(own, flown)], 0.0
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "distance"),
    [
        *(("robust", 10e-3), ("tubular_pid", 10e-3)),
        *(
            pytest.param(*given, marks=pytest.mark.slow)
            for given in (("robust_observer", 10e-3), ("planar", 1e-3))
        ),
    ],
)
def test_it_flies_as_the_simulation_does(name: str, distance: float) -> None:
    """With phase currents and duty cycles where the machine has them: every signal within 1e-12 of its range."""
    c = controller(name)
    plant = malta.plant_of(c.parameters)
    fidelity: Any = "force" if plant.actuator.windings is None else "phase"
    scenario = malta.Scenario.stroke(distance, fidelity=fidelity, noise=1.0, duration=0.05)
    own = malta.simulate(plant, c, scenario)
    flown = malta.simulate(plant, c, scenario, engine=engine_of_c())
    single = malta.simulate(plant, c, scenario, engine=engine_of_c("float"))
    assert max(d.share for d in differences(own, flown)) < 1e-12
    assert 1e-9 < max(d.share for d in differences(own, single)) < 3e-4


@pytest.mark.slow
def test_a_table_of_currents_is_exported(tmp_path: Path) -> None:
    """The planar motor commutates by the paper's bilinear table; recorded vectors pass, and the C flies as the law."""
    c = controller("planar")
    c = replace(c, parameters=replace(c.parameters, cells=35.0))
    t = Target(c, "float", "force")
    assert [len(t.look_ups), *t.look_ups[0].nodes.shape] == [16, 36, 36, 6]
    for file, text in folder_files(t, "0" * 64, proof=False).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    done = subprocess.run(
        ["make", "-s", "-C", str(tmp_path), "test"], check=False, capture_output=True, text=True
    )
    assert "\npass: 4 vectors" in done.stdout, done.stdout + done.stderr
    plant = malta.plant_of(c.parameters)
    scenario = malta.Scenario("hold", 60 * c.sample_time, malta.references.hold, noise=1.0, fidelity="force")
    own = malta.simulate(plant, c, scenario)
    flown = malta.simulate(plant, c, scenario, engine=engine_of_c("float"))
    assert max(d.share for d in differences(own, flown)) < 1e-4
    assert build_fmu(t, "0" * 64).content
    with pytest.raises(
        malta.InputError, match="whose currents come from a table, expected the controller alone"
    ):
        build_fmu(t, "0" * 64, part="loop")


@pytest.mark.slow_for("robust-double", "robust-float", "halbach-float")
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["robust", "halbach", pytest.param("planar_pid", marks=pytest.mark.slow)])
def test_no_compiler_warns(name: str, precision: Precision, tmp_path: Path) -> None:
    for file, text in sources(target(name, precision), "0" * 64).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    cc = compiler()
    assert cc is not None
    for path in sorted(tmp_path.glob("*.c")):
        done = subprocess.run(
            [*cc, *WARNINGS, "-c", str(path), "-o", str(path.with_suffix(".o"))],
            check=False,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[:2000]

"""The chain of margins, the classical ones, their figure, and `malta verify` that prints them."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import matplotlib.text
import numpy as np
import pytest
from conftest import ROOT, Run, numbers
from matplotlib.patches import Rectangle
from typer.testing import CliRunner

import malta
from malta import gains
from malta.cli.main import app, main
from malta.errors import InputError
from malta.linear.closed_loops import closed_loop, instability
from malta.linear.open_loops import responses
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.classical import Nominal, balanced_norm, classical_margins, delay_margins, disk_margins_alone
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_laws import machine_law
from malta.loops.sampled_loops import loaded_loop
from malta.loops.uncertain_models import uncertain
from malta.loops.windings import LAST_STAGE
from malta.margins.loop_report import LoopReport
from malta.margins.travel import place_margin
from malta.margins.verify import (
    MACHINE_STAGE,
    SAMPLED_STAGE,
    compensators,
    linear_report,
    nominal_loop,
    staged_report,
)
from malta.model.linearize import linearize
from malta.model.plants import plant_of
from malta.proof.blocks.gain import Gain
from malta.proof.robust import UNSTABLE_TEXT, robust_margin
from malta.report.figures.margins import chain_figure

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.figure import Figure

    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]


BOX = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)
STAGES = ["LQR", "LQI", "LQG", "LQGI", "+ current loops", "sampled", "machine"]
DESIGNS = ("table2", "calibrated")


SLOW = pytest.mark.slow
CHAINED = [pytest.param(name, marks=SLOW) for name in DESIGNS]


def robustness(plant: Plant, c: Controller, box: Mapping[str, float], **options: Any) -> LoopReport:
    """The margins of all stages, without what else `malta.verify` computes."""
    model = linearize(plant, plant.point(c.operating_point[0]))
    return staged_report(
        linear_report(model, c, None, options.pop("current_loops", LAST_STAGE)), box, **options
    )


@cache
def chain_of(name: str) -> LoopReport:
    c = gains.read(f"design/gains/{name}.json")
    steps: list[float] = []
    found = robustness(plant_of(c.parameters), c, BOX, progress=steps.append)
    assert steps == sorted(steps)
    assert 0 < steps[0] < 0.2
    assert 0.9 < steps[-1] <= 1
    return found


SENSORS = ["x1", "y1", "x2", "y2", "z"]


def _sampled(name: str, z: float = 0.0) -> tuple[UncertainSystem, Compensator]:
    c = gains.read(f"design/gains/{name}.json")
    plant = plant_of(c.parameters)
    return uncertain(plant, list(BOX), at={"z": z}, loaded=False), machine_law(plant, c, "lag")


@pytest.mark.parametrize("name", CHAINED)
def test_margins_go_where_the_chain_says(name: str) -> None:
    found = chain_of(name)
    assert [link.name for link in found.chain] == STAGES
    assert STAGES[-2:] == [SAMPLED_STAGE, MACHINE_STAGE]
    assert [link.broken_at for link in found.chain] == ["forces"] * 2 + ["sensors"] * 5
    by_name = {link.name: link for link in found.chain}
    for state_feedback in ("LQR", "LQI"):  # Kalman's inequality; R is diagonal
        assert by_name[state_feedback].peak <= 1 + 1e-6
    assert by_name["LQR"].margin.upper > by_name["LQG"].margin.upper
    assert by_name["LQG"].peak < by_name["+ current loops"].peak + 1e-3
    for link in found.chain:
        assert link.margin.lower is not None
        assert link.margin.lower <= link.margin.upper <= 1.0011 * link.margin.lower
    if name == "table2":  # its integrals do not hold it against the slope of the cogging at 10 mm
        assert (found.travel.lower, found.travel.upper, found.travel.reason) == (0.0, 0.0, UNSTABLE_TEXT)
    else:
        assert found.travel.lower is not None
        assert found.travel.lower <= min(place.margin.upper for place in found.places)
    expected = {"table2": (5 / 3, 0.1414), "calibrated": (3.0, 1.62)}[name]
    assert (by_name["LQR"].margin.upper, by_name["sampled"].margin.upper) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", CHAINED)
def test_places_stand_for_both_sides_of_the_travel(name: str) -> None:
    c = gains.read(f"design/gains/{name}.json")
    plant = plant_of(c.parameters)
    places = chain_of(name).places
    assert [place.position for place in places] == pytest.approx([0, 5e-3, 10e-3, 15e-3])
    for z in (15e-3, -15e-3):
        there = robust_margin(*machine_system(plant, c, list(BOX), {"z": z}), BOX)
        assert there.upper >= places[-1].margin.upper * (1 - 1e-9)
    assert places[-1].margin.upper >= (chain_of(name).travel.lower or 0)


@pytest.mark.slow
def test_what_is_proven_over_the_travel_is_proven_at_its_places() -> None:
    """The loss that is found beside the travel's witness is that of a search at the place alone."""
    c = gains.read("design/gains/calibrated.json")
    plant, travel = plant_of(c.parameters), chain_of("calibrated").travel
    alone = place_margin(plant, c, BOX, -10e-3)
    near = (1 - 5e-4) * alone.upper
    beside = place_margin(plant, c, BOX, -10e-3, travel=replace(travel, lower=near))
    assert beside.certificate == ()  # no search of its own
    assert beside.lower == near
    assert beside.upper == pytest.approx(alone.upper, rel=1e-6)
    assert beside.witness == pytest.approx(alone.witness, rel=1e-3)
    wrong = place_margin(plant, c, BOX, -10e-3, travel=replace(travel, lower=1.5 * (travel.lower or 0)))
    assert wrong.lower == pytest.approx(alone.lower, rel=1e-3)


@pytest.mark.parametrize("name", DESIGNS)
def test_gang_of_four_by_its_definition(name: str) -> None:
    system, law = _sampled(name)
    w = np.geomspace(1e-2, np.pi / 50e-6, 12_000)
    P, _, _, F = responses(system, law, system.nominal, w)
    S = np.linalg.inv(np.eye(5) - P @ F)
    T = -P @ F @ S
    assert np.abs(S + T - np.eye(5)).max() < 1e-7
    for i, figures in enumerate(classical_margins(nominal_loop(system, law), SENSORS).gang.values()):
        expected = (
            np.abs(S[:, i, i]).max(),
            np.abs(T[:, i, i]).max(),
            np.abs(S @ P)[:, i].max(),
            np.abs(F @ S)[:, :, i].max(),
        )
        assert figures == pytest.approx(expected, rel=1e-5)
        assert all(found >= (1 - 1e-7) * seen for found, seen in zip(figures, expected, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
def test_disks_are_stood_and_the_one_channel_disk_is_exact(name: str) -> None:
    """Real factors within the disk, in all channels at once, leave it stable; one channel's is reached by a factor."""
    system, law = _sampled(name)
    disks = {d.channels: d for d in classical_margins(nominal_loop(system, law), SENSORS).disks}
    assert list(disks)[:3] == ["forces", "sensors", "forces and sensors"]
    assert disks["forces and sensors"].size <= min(disks["forces"].size, disks["sensors"].size)
    rng = np.random.default_rng(0)
    for kind in ("forces", "sensors", "forces and sensors"):
        d = disks[kind].size
        for _ in range(10):
            # real gains of the same size, by eigenvalues
            sign = rng.choice((-1, 1), size=(2, 5)) * 0.999 * d / 2
            g = (1 + sign) / (1 - sign)
            real = replace(
                law,
                B=law.B @ (np.diag(g[1]) if "sensors" in kind else np.eye(5)),
                C=(np.diag(g[0]) if "forces" in kind else np.eye(5)) @ law.C,
            )
            through = law.D @ (np.diag(g[1]) if "sensors" in kind else np.eye(5))
            real = replace(real, D=(np.diag(g[0]) if "forces" in kind else np.eye(5)) @ through)
            assert instability(system, real, system.nominal)[0] < 0
    for i, sensor in enumerate(SENSORS):
        disk = disks[f"{sensor} alone"]
        w = np.array([disk.frequency])
        P, _, _, F = responses(system, law, system.nominal, w)
        S = np.linalg.inv(np.eye(5) - P @ F)[0, i, i]
        assert 1 / abs(S - 0.5) == pytest.approx(disk.size, rel=1e-6)
        smallest = []
        for angle in np.linspace(0, 2 * np.pi, 7201):
            d = disk.size * np.exp(1j * angle)
            f = np.ones(5, dtype=complex)
            f[i] = (1 + d / 2) / (1 - d / 2)
            smallest.append(abs(np.linalg.det(np.eye(5) - np.diag(f) @ P[0] @ F[0])))
        size = abs(np.linalg.det(np.eye(5) - P[0] @ F[0]))
        assert min(smallest) < 2e-3 * size
        assert np.median(smallest) > 2e-2 * size
        assert disk.gain == pytest.approx((1 + disk.size / 2) / (1 - disk.size / 2))
        assert disk.phase == pytest.approx(2 * math.atan(disk.size / 2))


def test_a_single_loop_has_the_disk_of_its_peak() -> None:
    """One channel: 1 / max |S - 1/2|, on a grid thirty times as dense."""
    system, law = _sampled("calibrated")
    P, _, _, F = responses(system, law, system.nominal, np.geomspace(1e-2, np.pi / 50e-6, 12_000))
    S = np.linalg.inv(np.eye(5) - P @ F)
    expected = 1 / np.abs(np.einsum("kii->ki", S) - 0.5).max(axis=0)
    found = disk_margins_alone(nominal_loop(system, law), [f"s{i}" for i in range(5)])
    assert [disk.size for disk in found] == pytest.approx(expected.tolist(), rel=1e-4)


def test_a_balanced_matrix_bounds_mu() -> None:
    """From above; random unit factors bound it from below: mu >= rho(U M). Exact for rank one."""
    rng = np.random.default_rng(0)
    M = rng.normal(size=(20, 4, 4)) + 1j * rng.normal(size=(20, 4, 4))
    M *= 10.0 ** rng.uniform(-3, 3, (20, 4, 1)) * 10.0 ** rng.uniform(-3, 3, (20, 1, 4))
    U = np.exp(2j * np.pi * rng.uniform(size=(500, 1, 4, 1)))
    below = np.abs(np.linalg.eigvals(U * M)).max(axis=(0, 2))
    above = balanced_norm(M)
    assert (below <= above * (1 + 1e-9)).all()
    assert np.median(above / below) < 1.3
    a, b = rng.normal(size=(5, 4)) + 1j, rng.normal(size=(5, 4)) - 1j
    assert balanced_norm(a[:, :, None] * b[:, None, :]) == pytest.approx(np.abs(a * b).sum(axis=1), rel=1e-3)


def test_blocks_beside_the_diagonal_do_not_count() -> None:
    """mu of [[a, 0], [b, c]] is max(|a|, |c|), whatever b: a machine with no response at half of the sample rate."""
    M = np.diag([0.5, 0.5, 0.3, 0.4]).astype(complex)
    M[2:, :2] = 1e8 * np.array([[1.0, 2.0], [-3.0, 1.0]])
    assert balanced_norm(M[None])[0] == pytest.approx(0.5, rel=1e-6)
    M[0, 2] = 1e-16  # what rounding leaves of the other block
    assert balanced_norm(M[None])[0] == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("name", DESIGNS)
def test_delay_margins_in_whole_samples(name: str) -> None:
    """One sensor late by whole samples: stable up to the margin, unstable beyond."""
    system, law = _sampled(name)
    T, n = 50e-6, len(law.A)
    for i, (_, margin) in enumerate(classical_margins(nominal_loop(system, law), SENSORS).delay.items()):
        if margin > 200 * T:  # as many states more
            continue
        stable = {}
        for k in (math.floor(0.999 * margin / T), math.floor(1.001 * margin / T) + 1):
            late = np.zeros((n + k, n + k))
            late[:n, :n], B, D = law.A, np.zeros((n + k, 5)), law.D.copy()
            B[:n] = law.B
            C = np.hstack([law.C, np.zeros((5, k))])
            if k:  # a chain of k samples in place of the sensor
                late[:n, n], C[:, n], B[:n, i], D[:, i] = law.B[:, i], law.D[:, i], 0, 0
                late[n : n + k - 1, n + 1 :] = np.eye(k - 1)
                B[-1, i] = 1
            slow = replace(law, A=late, B=B, C=C, D=D, integrals=0)
            stable[k] = float(instability(system, slow, system.nominal)[0]) < 0
        assert list(stable.values()) == [True, False], (i, margin)


def test_delay_margin_of_an_integrator() -> None:
    """L = 10 / s crosses over at 10 rad/s with 90 degrees to go: pi / 20 s."""
    one, none = np.eye(1), np.zeros((1, 1))
    integrator = System(none, one, one, none)
    law = System(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), -10 * one)
    assert delay_margins(Nominal(integrator, law, True, None)) == pytest.approx([np.pi / 20], rel=1e-12)
    half = System(law.A, law.B, law.C, 0.05 * one)
    assert delay_margins(Nominal(half, law, True, None)) == [np.inf]


@pytest.mark.parametrize("name", CHAINED)
def test_each_parameter_alone(name: str) -> None:
    """Tolerances against poles on a dense line."""
    c = gains.read(f"design/gains/{name}.json")
    plant = plant_of(c.parameters)
    system, law = machine_system(plant, c, list(BOX), {"z": -15e-3})
    if name == "table2":  # unstable at 10 mm whatever its parameters
        assert all(side.upper == 0.0 for sides in chain_of(name).tolerance.values() for side in sides)
        return
    for i, (key, sides) in enumerate(chain_of(name).tolerance.items()):
        for sign, margin in zip((-1, 1), sides, strict=True):
            assert margin.lower is not None
            p = np.tile(system.nominal, (60, 1))
            p[:, i] *= 1 + sign * 0.2 * np.linspace(0, 1, 60) * margin.lower * (1 - 1e-9)
            assert (instability(system, law, p) < 0).all(), key
            if not margin.exhausted:
                beyond = system.nominal.copy()
                beyond[i] *= 1 + sign * 0.2 * margin.upper
                there, along = machine_system(plant, c, [*BOX, "z"], {"z": 0.0})
                assert margin.witness is not None
                assert there.derived is not None
                z = margin.witness["z"]
                beyond = np.r_[beyond, z, there.derived.values(z)]
                assert instability(there, along, beyond)[0] > -1e-6
    heavier = chain_of(name).mass
    assert heavier is not None
    assert heavier.lower is not None
    assert instability(system, law, system.nominal + np.array([heavier.lower, 0, 0, 0]))[0] < 0
    assert heavier.lower / 0.072 == pytest.approx(chain_of(name).tolerance["m"][1].lower, rel=1e-3)


SHIPPED = sorted(path.stem for path in (ROOT / "design" / "gains").glob("*.json"))


@pytest.mark.slow_for("table2")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("table2", "halbach") else [pytest.mark.slow])
        for name in SHIPPED
    ],
)
def test_the_last_stage_is_the_machine_of_verify(name: str) -> None:
    """With its loads, for every shipped design: the figure of the chain and the table beside it show one number."""
    c = gains.read(f"design/gains/{name}.json")
    plant = plant_of(c.parameters)
    margins = malta.verify(malta.linearize(plant, plant.point(c.operating_point[0])), c)
    largest = max(v for k, v in margins.peak_sensitivity.items() if k != "sigma_max")
    found = robustness(plant, c, malta.read_design(f"design/{name}.toml").uncertainty, proof=False)
    assert found.chain[-1].peak == pytest.approx(largest, rel=1e-6)
    loaded = 2 if plant.actuator.windings is not None else 1
    assert [link.loaded for link in found.chain] == [False] * (len(found.chain) - loaded) + [True] * loaded
    assert found.places[0].peak == pytest.approx(largest, rel=1e-6)  # the middle


@pytest.mark.slow
def test_cogging_that_is_stiffer_than_the_axial_loop_shows() -> None:
    """table2: |S| of z is 1.3 without its loads and 36 with them; the places where v0(z) misfits are unstable."""
    c = gains.read("design/gains/table2.json")
    plant = plant_of(c.parameters)
    found = robustness(plant, c, BOX, proof=False)
    by_name = {link.name: link.peak for link in found.chain}
    assert by_name["+ current loops"] == pytest.approx(6.93, abs=0.01)
    assert by_name[SAMPLED_STAGE] == pytest.approx(36.0, abs=0.1)
    assert [math.isnan(place.peak) for place in found.places] == [False, False, True, False]
    quiet = plant_of(replace(c.parameters, F_c=0.0))
    smooth = replace(c, feedforward=replace(c.feedforward, v0=c.feedforward.v0 * [1, 1, 1, 1, 0]))
    assert robustness(quiet, smooth, BOX, proof=False).chain[-1].peak == pytest.approx(6.93, abs=0.02)


@pytest.mark.slow
def test_force_constants_that_the_controller_does_not_know() -> None:
    """--set K_B: the last stage peaks as verify's machine, which has the slope of its loads too."""
    c = gains.read("design/gains/calibrated.json")
    weak = plant_of(replace(c.parameters, K_B=4.0))
    found = robustness(weak, c, {"K_A": 0.2}, proof=False)
    margins = malta.verify(malta.linearize(weak, weak.at()), c)
    largest = max(v for k, v in margins.peak_sensitivity.items() if k != "sigma_max")
    assert found.chain[-1].peak == pytest.approx(largest, rel=1e-5)
    law = compensators(weak, c)[SAMPLED_STAGE][0]
    loops = [
        closed_loop(uncertain(weak, ["m"], believed=b), law, np.array([0.36]))[0]
        for b in (plant_of(c.parameters), None)
    ]
    assert np.abs(loops[0] - loops[1]).max() > 1


@pytest.mark.slow
def test_an_unstable_machine_is_reported() -> None:
    c = gains.read("design/gains/calibrated.json")
    found = robustness(plant_of(replace(c.parameters, K_A=3e4)), c, BOX)
    assert [link.margin.upper > 0 for link in found.chain] == [True, True, False, False, False, False, False]
    assert math.isnan(found.chain[-1].peak)
    assert not found.disks
    assert not found.gang
    assert all(math.isnan(v) for v in found.delay.values())
    assert all(math.isnan(p.disk) and math.isnan(p.delay) and p.margin.lower == 0 for p in found.places)


def test_no_parameters_and_unknown_current_loops_are_refused() -> None:
    c = gains.read("design/gains/calibrated.json")
    with pytest.raises(InputError, match="no parameters"):
        robustness(plant_of(c.parameters), c, {})
    with pytest.raises(InputError, match="expected lag or pi"):
        robustness(plant_of(c.parameters), c, BOX, current_loops="dq")


# The figure


def _texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


@pytest.mark.slow
def test_the_figure_names_what_it_shows() -> None:
    found = chain_of("calibrated")
    worst = {"x1": Gain(2.4, 2.41, 500.0, {}, 1, 0.0), "z": Gain(1.9, 1.91, 90.0, {}, 1, 0.0)}
    figure = chain_figure(replace(found, worst=worst))
    figure.draw_without_rendering()
    texts = _texts(figure)
    assert "calibrated: where the margin goes" in texts
    assert "100 %: m K_A K_D K_B ±20 %, all at once" in texts
    left, right = figure.axes[:2]
    names = [tick.get_text() for tick in left.get_yticklabels()]
    assert names == [*(link.name for link in found.chain), "all of the travel"]
    widths = [bar.get_bbox().width for bar in left.patches[: len(names)] if isinstance(bar, Rectangle)]
    assert widths == pytest.approx(
        [100 * (m.lower or 0) for m in (*(k.margin for k in found.chain), found.travel)]
    )
    assert [bar.get_bbox().width for bar in right.patches if isinstance(bar, Rectangle)] == pytest.approx(
        [*(link.peak for link in found.chain), max(place.peak for place in found.places)]
    )
    assert [2.41, 2.41] in [np.asarray(line.get_ydata()).tolist() for line in figure.axes[3].lines]
    assert "upper bound over the box, proven" in texts
    assert {"A | B", "B | C", "C | D"} <= set(texts)
    along = figure.axes[2].lines[0]
    assert along.get_xdata().tolist() == pytest.approx([-15, -10, -5, 0, 5, 10, 15])  # type: ignore[union-attr]
    # bars stay below the right edge, no text beyond the picture
    assert max(widths) < left.get_xlim()[1]


@pytest.mark.slow
def test_unstable_loops_and_unproven_margins_are_drawn() -> None:
    found = chain_of("calibrated")
    c = gains.read("design/gains/calibrated.json")
    unstable = robustness(plant_of(replace(c.parameters, K_A=3e4)), c, BOX)
    chain_figure(unstable).draw_without_rendering()
    nothing = replace(found.travel, lower=None, upper=float("inf"), reason="not settled")
    figure = chain_figure(replace(found, robust=nothing))
    figure.draw_without_rendering()
    assert "none" in _texts(figure)


# malta verify


def _strict(text: str) -> Any:
    def refuse(token: str) -> Any:
        raise AssertionError(token)

    return json.loads(text, parse_constant=refuse)


ANALYSES: list[Any] = []


@pytest.fixture
def analysed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands print one analysis of `calibrated`, whatever the form."""
    module = importlib.import_module("malta.tuning.verify")
    verify = module.verify

    def once(*arguments: Any, **options: Any) -> Any:
        if not ANALYSES:
            ANALYSES.append(verify(*arguments, **options))
        return ANALYSES[0]

    monkeypatch.setattr(module, "verify", once)


@pytest.mark.slow
@pytest.mark.usefixtures("analysed_once")
def test_verify_prints_tables_within_a_hundred_columns(tmp_path: Path) -> None:
    out = CliRunner().invoke(app, ["verify", "design/gains/calibrated.json", "--out", str(tmp_path)])
    assert out.exit_code == 0
    lines = out.stdout.replace(str(tmp_path), "T").splitlines()
    assert max(map(len, lines)) <= 100
    for text in (
        "Where the margin goes",
        "all of the travel",
        "Gang of four",
        "One at a time",
        "payload",
        "Along the",
    ):
        assert text in out.stdout
    assert (tmp_path / "calibrated_margins.png").stat().st_size > 20_000


@pytest.mark.slow
@pytest.mark.usefixtures("analysed_once")
def test_verify_as_json_holds_finite_numbers(run: Run) -> None:
    code, out, err = run("verify", "design/gains/calibrated.json", "--json")
    assert (code, err) == (0, "")
    result = json.loads(out)
    robust = result.pop("robust")  # null where no witness exists
    assert robust["travel"]["lower"] == pytest.approx(1.6278, abs=1e-3)
    found = numbers(result)
    assert len(found) > 60
    assert all(map(math.isfinite, found))
    assert (result["design"], result["stable"]) == ("calibrated", True)
    assert max(result["poles_rad_per_s"]["open_loop"])[0] == pytest.approx(218.92, abs=0.005)


@pytest.mark.slow
def test_verify_prints_one_json_document() -> None:
    arguments = [
        "verify",
        "design/gains/calibrated.json",
        "--json",
        "--uncertain",
        "m=10%",
        "--current-loops",
        "pi",
        "--set",
        "m=0.56",
    ]
    out = CliRunner().invoke(app, arguments)
    assert out.exit_code == 0
    found = _strict(out.stdout)
    assert found["robust"]["uncertainty"] == {"m": 0.1}
    assert [stage["stage"] for stage in found["robust"]["chain"]] == STAGES
    assert found["robust"]["chain"][-1]["lower"] > 1
    assert "nan" not in out.stdout.lower()


@pytest.mark.slow
def test_verify_of_an_unstable_machine_prints_and_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for more in ([], ["--json"]):
        arguments = ["malta", "verify", "design/gains/calibrated.json", "--set", "K_A=3e4", *more]
        monkeypatch.setattr("sys.argv", arguments)
        with pytest.raises(SystemExit) as caught:
            main()
        assert caught.value.code == 1
        printed = capsys.readouterr()
        assert printed.err.startswith("malta: design/gains/calibrated.json: the loop (sampled) is unstable")
        assert len(printed.err.splitlines()) == 1
        if more:
            assert _strict(printed.out)["stable"] is False
        else:
            assert max(map(len, printed.out.splitlines())) <= 100


@pytest.mark.parametrize(
    ("more", "part"),
    [
        (["--current-loops", "dq"], "expected lag or pi"),
        (["--uncertain", "K_X=10%"], "K_X"),
        (["--uncertain", "m=0%"], "expected a share above 0"),
        (["--uncertain", "m=-5%"], "expected a share above 0"),
        (["--uncertain", "m=much"], "--uncertain"),
        (["--set", "m=-1"], "m"),
    ],
)
def test_bad_input_gets_one_sentence(
    more: list[str], part: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["malta", "verify", "design/gains/table2.json", *more])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert part in printed.err
    assert len(printed.err.splitlines()) == 1


@pytest.mark.parametrize("name", CHAINED)
def test_margins_without_parameters_are_the_smallest_along_the_travel(name: str) -> None:
    c = gains.read(f"design/gains/{name}.json")
    loops = [
        loaded_loop(plant_of(c.parameters), c, {"z": z})
        for z in (-15e-3, -10e-3, -5e-3, 0.0, 5e-3, 10e-3, 15e-3)
    ]
    found = chain_of(name)
    if name == "table2":  # unstable at 10 mm under its cogging
        assert [loop.stable for loop in loops[3:]] == [True, True, False, True]
        assert (found.disks, found.gang) == ((), {})
        return
    places = [classical_margins(loop, SENSORS) for loop in loops]
    assert found.delay == pytest.approx({key: min(p.delay[key] for p in places) for key in SENSORS})
    for k, disk in enumerate(found.disks):
        assert disk.size == pytest.approx(min(p.disks[k].size for p in places))
    for key, figures in found.gang.items():
        assert figures == pytest.approx(np.max([p.gang[key] for p in places], axis=0))

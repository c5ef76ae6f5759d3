"""The rotor of examples/: a machine that malta knows by its file alone, with margins proven for every speed."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT, printed

import malta
from malta import report
from malta.campaigns.result import figures_of
from malta.linear.closed_loops import instability
from malta.margins.loop_report import LoopReport, zone
from malta.margins.travel import NO_EXTENT, Extent, extent_of, positions_of, travel_loops, travel_margin
from malta.model import machines
from malta.model.checks import check_numbers, check_symbols
from malta.model.machines import machine
from malta.model.plant import Plant
from malta.proof.blocks.gain import Gain
from malta.proof.margin import Margin
from malta.simulation.experiments.catalogue import cases_of

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller

pytestmark = pytest.mark.usefixtures("proven_once")

FOLDER = ROOT / "examples" / "rotor"
DESIGNS = ("rotor", "rotor_pid")


@pytest.fixture(scope="module")
def rotor() -> Any:
    """The machine's module."""
    return machine(FOLDER / "rotor.py")


@pytest.fixture(scope="module")
def par(rotor: Any) -> Any:
    found = malta.read(FOLDER / "rotor.toml")
    assert isinstance(found, rotor.Parameters)
    return found


@pytest.fixture(scope="module")
def plant(par: Any) -> Plant:
    return malta.plant_of(par)


@pytest.fixture(scope="module")
def controllers(plant: Plant) -> dict[str, Controller]:
    model = malta.linearize(plant, plant.at())
    return {
        name: malta.synthesize(malta.read_design(FOLDER / "design" / f"{name}.toml"), model)
        for name in DESIGNS
    }


@pytest.fixture(params=DESIGNS)
def controller(request: pytest.FixtureRequest, controllers: dict[str, Controller]) -> Controller:
    """Each design in turn."""
    return controllers[request.param]


def poles_of(plant: Plant) -> Any:
    return np.linalg.eigvals(malta.linearize(plant, plant.at()).A)


def test_malta_does_not_know_the_rotor() -> None:
    for source in (ROOT / "malta").rglob("*.py"):
        text = source.read_text(encoding="utf-8")
        assert not [word for word in ("414286", "examples/rotor", "Omega_max", "retainer") if word in text], (
            source
        )
    assert "rotor" not in machines._installed_machines()


def test_the_gains_of_the_coils_are_the_printed_ones(rotor: Any, par: Any) -> None:
    """k_s / k_i = i_0 / g_0 fixes the bias and k_i the turns; both are rounded in the file."""
    k_s, k_i = rotor.gains_of_coils(par)
    assert k_s == pytest.approx(142_866, abs=1)
    assert (k_s / par.k_s, k_i / par.k_i) == pytest.approx((1, 1), abs=0.01)
    assert par.i_0 == pytest.approx(par.k_s * par.g_0 / par.k_i, rel=0.003)
    assert par.I_max < par.i_0


def test_the_force_of_a_bearing_is_that_of_two_opposite_magnets(rotor: Any, par: Any) -> None:
    """F = mu_0 N^2 A cos(theta_p / 2) / 4 ((i_0 + i)^2 / (g_0 - q)^2 - (i_0 - i)^2 / (g_0 + q)^2)."""
    scale = rotor.MU_0 * par.N**2 * par.A_g * math.cos(par.theta_p / 2) / 4
    k_s, k_i = rotor.gains_of_coils(par)
    own = replace(par, k_s=k_s, k_i=k_i)
    for q, i in ((0.0, 1.0), (60e-6, 0.3), (-130e-6, 1.4)):
        expected = scale * (((par.i_0 + i) / (par.g_0 - q)) ** 2 - ((par.i_0 - i) / (par.g_0 + q)) ** 2)
        assert float(rotor.magnets(own, q, i)) == pytest.approx(expected)
    x, u = ca.SX.sym("q"), ca.SX.sym("i")
    force = rotor.magnets(par, x, u)
    slopes = ca.Function("slopes", [x, u], [ca.jacobian(force, x), ca.jacobian(force, u)])(0, 0)
    assert [float(slope) for slope in slopes] == pytest.approx([par.k_s, par.k_i])


def test_open_loop_poles_are_those_of_two_beams_on_negative_springs(plant: Plant, par: Any) -> None:
    still = plant.variant(replace(par, Omega=0.0))
    l_A, l_B, k = par.l_A, par.l_B, par.k_s
    K = np.array([[2 * k, k * (l_A - l_B)], [k * (l_A - l_B), k * (l_A**2 + l_B**2)]])
    rates = np.sqrt(np.linalg.eigvals(np.diag([1 / par.m, 1 / par.I_t]) @ K))
    expected = sorted(sign * rate for rate in rates for sign in (1, -1) for _ in "xy")
    found = poles_of(still)
    assert np.abs(found.imag).max() < 1e-3 * rates.max()  # pairs of equal poles
    assert np.sort(found.real) == pytest.approx(expected, rel=1e-6)


def test_the_gyroscopic_effect_turns_the_tilting_poles(plant: Plant, par: Any) -> None:
    """With bearings alike: I_t s^2 - j I_p Omega s - 2 k l^2 = 0 for beta - j alpha, and its conjugate."""
    even = plant.variant(replace(par, l_B=par.l_A, I_p=par.I_t, Omega=1500.0))
    half, k = 1500.0 / 2, 2 * par.k_s * par.l_A**2 / par.I_t
    found = poles_of(even)
    tilting = sorted(found[np.abs(found.imag) > 1].tolist(), key=lambda s: (s.imag, s.real))
    assert k < half**2  # a top that does not fall: poles on the axis
    fast, slow = half + math.sqrt(half**2 - k), half - math.sqrt(half**2 - k)
    assert [s.imag for s in tilting] == pytest.approx([-fast, -slow, slow, fast])
    assert np.abs([s.real for s in tilting]).max() < 1e-6
    slender = poles_of(plant)
    assert np.abs(slender.imag).max() == pytest.approx(5.614, abs=1e-3)
    assert np.sort(slender.real)[-1] == pytest.approx(452.98, abs=0.01)


def test_peak_sensitivities_are_in_zone_A(plant: Plant, controllers: dict[str, Controller]) -> None:
    model = malta.linearize(plant, plant.at())
    found = {name: malta.verify(model, c) for name, c in controllers.items()}
    peaks = {name: [m.peak_sensitivity[s.name] for s in plant.outputs] for name, m in found.items()}
    assert peaks["rotor"] == pytest.approx([1.75, 1.75, 1.79, 1.79], abs=0.01)
    assert peaks["rotor_pid"] == pytest.approx([1.21, 1.21, 1.92, 1.92], abs=0.01)
    assert {zone(peak) for both in peaks.values() for peak in both} == {"A"}
    assert found["rotor"].bandwidth["sigma_max_T"] > found["rotor_pid"].bandwidth["sigma_max_T"]


def test_flown_unbalance_is_that_of_the_linear_loop(plant: Plant, controllers: dict[str, Controller]) -> None:
    e = malta.experiment("unbalance", plant, controllers["rotor"], speeds=(500.0, 2094.0))
    flown = np.array([[merit.value for merit in case.merits[:4]] for case in e.cases])
    assert flown == pytest.approx(e.curves["linear"], rel=1e-3)
    assert flown[1, 0] == pytest.approx(3.18e-6, abs=1e-8)
    assert flown[:, 0] == pytest.approx(flown[:, 1], rel=1e-3)  # a circle
    with pytest.raises(malta.InputError, match="unbalance: speeds: found 0 rad/s"):
        malta.experiment("unbalance", plant, controllers["rotor"], speeds=(0.0,))


def test_a_rotor_that_fell_is_caught(plant: Plant, controllers: dict[str, Controller], par: Any) -> None:
    """Without power it falls for sqrt(2 c_r / g) = 6.2 ms; the magnets can lift it from its bearings."""
    found = malta.experiment("drop", plant, controllers["rotor"], off=0.03)
    run = found.run
    assert not found.failed
    assert run.verdict.name.startswith("retainer bearing")
    assert run.verdict.time - 0.02 == pytest.approx(math.sqrt(2 * par.c_r / par.g), abs=2e-4)
    assert 1 < run.contact.max() < 1.5
    assert np.abs(run.p[-1]).max() < 2e-6
    lifted = malta.experiment("lift-off", plant, controllers["rotor"], noise=0.0)
    assert lifted.run.verdict.completed
    assert lifted.run.contact[0].min() > 1
    assert np.abs(lifted.run.p[-1]).max() < 1e-7
    with pytest.raises(malta.InputError, match=r"drop: off: found 0\.3 s"):
        malta.experiment("drop", plant, controllers["rotor"], off=0.3)


@pytest.mark.slow
def test_one_proof_covers_every_speed(plant: Plant, controllers: dict[str, Controller], par: Any) -> None:
    c, box = controllers["rotor_pid"], {"k_i": 0.1}
    places, over = travel_loops(plant, c, ("k_i",))
    assert over == {"Omega": (0.0, par.Omega_max)}
    margin = travel_margin(plant, c, box)
    assert margin.lower is not None
    assert margin.witness is not None
    assert margin.lower == pytest.approx(4.2799, abs=0.01)
    assert margin.lower <= margin.upper <= 1.001 * margin.lower
    agree(places[0], margin, {"k_i": par.k_i}, box, np.linspace(0, par.Omega_max, 21))
    alone = malta.robust_margin(*places[0], box)  # at the rotor's own speed
    assert alone.upper >= margin.lower
    same = malta.robust_margin(*places[0], box, over={"Omega": (0.0, par.Omega_max)})
    assert same.lower == pytest.approx(margin.lower, rel=1e-3)


def test_an_uncertain_speed_is_no_interval(
    plant: Plant, controllers: dict[str, Controller], par: Any
) -> None:
    assert travel_loops(plant, controllers["rotor_pid"], ("Omega",))[1] == {}
    assert str(extent_of(plant, ("Omega",))) == ""
    assert positions_of(plant, extent_of(plant), ()) == ((0.0,), (par.Omega,), (par.Omega_max,))


def agree(
    loop: Any, margin: malta.proof.Margin, nominal: dict[str, float], box: dict[str, float], speeds: Any
) -> None:
    """Eigenvalues at the corners of the proven box, speed by speed: all stable; at the witness just not."""
    system, law = loop
    assert margin.lower is not None
    assert margin.witness is not None
    corners = [
        [nominal[name] * (1 + sign * margin.lower * box[name]) for name, sign in zip(box, signs, strict=True)]
        for signs in product((-1, 1), repeat=len(box))
    ]
    points = np.array([[*corner, speed] for corner in corners for speed in speeds])
    assert instability(system, law, points).max() < 0
    witness = np.array([margin.witness[name] for name in system.names])
    stretched = system.nominal + 1.01 * (witness - system.nominal)
    stretched[-1] = witness[-1]
    assert instability(system, law, stretched)[0] > 0


@pytest.mark.slow
def test_words_say_what_a_proof_covers(plant: Plant, controllers: dict[str, Controller]) -> None:
    speed = "for all Omega in 0 .. 2094 rad/s"
    assert str(extent_of(plant)) == speed
    assert str(NO_EXTENT) == ""
    assert str(Extent("z", 0.01)) == "over the travel"
    assert str(Extent("z", 0.01, {"a": (0, 1)}, {"a": "1"})) == "over the travel and for all a in 0 .. 1"
    found = malta.verify(malta.linearize(plant, plant.at()), controllers["rotor_pid"], {"k_i": 0.1})
    assert f"robust {speed}: proven 427." in str(found)
    nowhere: LoopReport = replace(found, extent=NO_EXTENT)
    assert "robust: proven 427." in str(nowhere)


@pytest.mark.slow
def test_tables_of_a_machine_without_a_travel(
    plant: Plant, controllers: dict[str, Controller], par: Any, tmp_path: Path
) -> None:
    box = {"k_i": 0.1}
    found = malta.verify(plant, controllers["rotor_pid"], box, stages=True, proof=False)
    assert [place.position for place in found.places] == [0, par.Omega, par.Omega_max]
    tables = (
        report.chain_table(found),
        report.disk_table(found),
        report.gang_table(found),
        report.tolerance_table(found),
        report.places_table(found),
    )
    text = " ".join(" ".join(map(printed, tables)).split())
    for words in (
        "all Omega in 0 .. 2094 rad/s",
        "the smallest of 3 values of",
        "Along Omega",
        "at [rad/s]",
        "1047",
    ):
        assert words in text
    assert "travel" not in text
    assert not report.open_bounds(found)  # nothing was asked
    lost = Margin(None, 2.0, None, None, {}, {}, (), 0.0, "time was up")
    ends = Margin(4.0, math.inf, None, None, {}, {}, (), 0.0)
    unproven = replace(
        found,
        chain=(replace(found.chain[0], margin=lost), replace(found.chain[0], name="end", margin=ends)),
        places=tuple(replace(place, margin=lost) for place in found.places),
        tolerance={"k_i": (lost, ends)},
        worst={"x": Gain(1.0, None, 2.0, {}, 3, 4.0, "why")},
    )
    assert report.open_bounds(unproven) == [
        f"{found.chain[0].name}, at 0, at 1047, at 2094: nothing proven (time was up), lost at 200.00 %",
        "end: proven 400.00 %; no unstable machine found",
        "k_i down: nothing proven (time was up)",
        "|S| of x: 1 at 2 rad/s, nothing proven (why)",
    ]
    report.chain_figure(found, tmp_path / "margins.png")
    assert (tmp_path / "margins.png").stat().st_size > 10_000
    point = replace(found, extent=NO_EXTENT, places=found.places[1:2])
    text = "\n".join(printed(table) for table in (report.chain_table(point), report.places_table(point)))
    assert "Omega" not in text
    assert "travel" not in text
    report.chain_figure(point).draw_without_rendering()


def test_intervals_have_to_be_some(plant: Plant, par: Any) -> None:
    for over, found in (
        ({"Psi": (0.0, 1.0)}, "'Psi'"),
        ({"T_d": (0.0, 1.0)}, "'T_d'"),
        ({"Omega": (0.0, 1.0)}, r"\(0.0, 1.0\), expected \(low, high\) about its value, 1047.2"),
        ({"Omega": (0.0, math.inf)}, r"\(0.0, inf\)"),
    ):
        with pytest.raises(malta.InputError, match=f"rotor: over.*: found {found}"):
            check_numbers(replace(plant, over=over))
    with pytest.raises(
        malta.InputError, match=r"Omega: found 3000 rad/s, expected at most Omega_max, 2094\.4 rad/s"
    ):
        replace(par, Omega=3000.0)


def test_a_parameter_taken_for_a_number_is_named(plant: Plant, par: Any) -> None:
    """CasADi makes NaN of math.cos(symbol), and says nothing."""

    def build(p: Any) -> Plant:
        pull = -p.m * p.g * math.cos(p.slope)
        return replace(plant, parameters=p, variant=build, load=lambda _: ca.vertcat(pull, 0, 0, 0))

    with pytest.raises(malta.InputError, match=r"rotor: load: found slope, taken for a number.*ca.sin"):
        check_symbols(build(par))

    def refusing(p: Any) -> Plant:
        return replace(
            plant, parameters=p, variant=refusing, stroke=malta.model.Stroke(mass=1.0 if p.e_u > 1 else 2.0)
        )

    with pytest.raises(malta.InputError, match=r"rotor: plant: found e_u, taken for a number"):
        check_symbols(refusing(par))


def test_rotors_that_differ_are_flown_and_listed(
    plant: Plant, controllers: dict[str, Controller], tmp_path: Path
) -> None:
    """Without a stroke, and with nothing to touch but what carries it."""
    plan = malta.campaigns.Plan(controllers["rotor"], "lift-off", {"m": 0.1, "k_s": 0.1}, samples=8)
    found = malta.campaign(plan, tmp_path / "campaign")
    assert found.completed.tolist() == [True] * 8
    labels = [listed.label for listed in figures_of(found)]
    assert labels[:4] == [f"deviation {s.name}" for s in plant.outputs]
    assert "largest bearing force" in labels
    with pytest.raises(malta.InputError, match="'drop', which changes the machine"):
        cases_of("drop", plant, controllers["rotor"])


def test_every_case_has_its_figures(plant: Plant, controllers: dict[str, Controller]) -> None:
    text = printed(report.experiment_table(malta.experiment("step", plant, controllers["rotor"])))
    assert [s.name for s in plant.outputs if s.name in text] == ["s_Ax", "s_Ay", "s_Bx", "s_By"]


@pytest.mark.slow
def test_the_margin_of_all_parameters_agrees_with_eigenvalues(
    plant: Plant, controller: Controller, par: Any
) -> None:
    box = {"m": 0.1, "k_s": 0.1, "k_i": 0.1}
    margin = travel_margin(plant, controller, box)
    expected = {"rotor": 5.0797, "rotor_pid": 2.9599}[controller.name]
    assert margin.lower == pytest.approx(expected, abs=0.01)
    assert margin.upper == pytest.approx(expected, rel=2e-3)
    nominal = {name: getattr(par, name) for name in box}
    places, _ = travel_loops(plant, controller, tuple(box))
    agree(places[0], margin, nominal, box, np.linspace(0, par.Omega_max, 21))


@pytest.mark.slow
def test_designs_are_made_from_a_folder_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`malta design`, as a user calls it, in a process that knows no other rotor."""
    shutil.copytree(
        FOLDER, tmp_path / "rotor", ignore=shutil.ignore_patterns("build", "gains", "__pycache__")
    )
    monkeypatch.chdir(tmp_path / "rotor")
    command = [
        sys.executable,
        "-c",
        "from malta.cli.main import main; main()",
        "design",
        "design/rotor_pid.toml",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "Parametric margin for all Omega in 0 .. 2094 rad/s" in done.stdout
    assert (tmp_path / "rotor" / "design" / "gains" / "rotor_pid.json").stat().st_size > 1000

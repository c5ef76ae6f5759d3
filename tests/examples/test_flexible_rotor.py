"""The flexible rotor of examples/: matrices beside published frequencies, its loop, and proofs for every speed."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.margins.travel import travel_loops

if TYPE_CHECKING:
    pass

FOLDER = ROOT / "examples" / "flexible_rotor"


@pytest.fixture(scope="module")
def example() -> Any:
    """Its modules by name."""
    rotor = malta.machine(FOLDER / "flexible_rotor.py")
    return lambda part: rotor if part == "flexible_rotor" else import_module(f"{rotor.__name__}.{part}")


@pytest.fixture(scope="module")
def plant(example: Any) -> malta.model.Plant:
    assert example
    return malta.plant_of(malta.read(FOLDER / "flexible_rotor.toml"))


def test_frequencies_are_the_published_ones(example: Any) -> None:
    beam = example("beam")
    known = beam.published()
    for case in known["case"]:
        found = beam.whirl(beam.assemble(known["element"]), case["speed"] * np.pi / 30, known["stiffness"])
        assert np.abs(found[:6]) == pytest.approx(case["frequencies"], rel=1e-7)


def test_a_slender_shaft_bends_as_the_beam_of_textbooks(example: Any) -> None:
    """w_1 = 4.7300^2 sqrt(E I / (rho A L^4)) of a free beam, 40 times as long as thick."""
    beam, steel, n, L = example("beam"), {"E": 211e9, "G": 81.2e9, "rho": 7810.0}, 16, 2.0
    one = beam.element(L / n, 0.05, steel)
    M, K = np.zeros((2, 2 * n + 2, 2 * n + 2))
    for k in range(n):
        at = slice(2 * k, 2 * k + 4)
        M[at, at] += one.M
        K[at, at] += one.K
    w = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)[2])
    assert w == pytest.approx(4.73004**2 * np.sqrt(211e9 * 0.05**2 / 16 / (7810 * L**4)), rel=5e-3)


def test_the_file_has_the_matrices_of_the_dimensions(example: Any) -> None:
    beam, rotor = example("beam"), example("flexible_rotor")
    for own, made in zip(rotor.read_matrices(), beam.assemble(beam.FINE), strict=True):
        assert own == pytest.approx(made, rel=1e-12, abs=1e-12 * np.abs(made).max())


def test_modes_have_mass_one_and_the_rotors_mass(example: Any) -> None:
    rotor, beam = example("flexible_rotor"), example("beam")
    m, (M, _, K) = rotor.modes(4), rotor.read_matrices()
    assert m.shapes.T @ M @ m.shapes == pytest.approx(np.eye(6), abs=1e-9)
    assert m.shapes.T @ K @ m.shapes == pytest.approx(np.diag(m.w**2), abs=1e-3)
    shaft = 7810 * np.pi / 4 * 0.05**2 * 1.5
    discs = sum(beam.disc(d, 0.05, 0.07, 7810.0)[0] for d in (0.28, 0.35))
    assert m.shapes[0, 0] ** -2 == pytest.approx(shaft + discs, rel=1e-9)
    assert (m.w[2:] / (2 * np.pi)).round(1).tolist() == pytest.approx([76.3, 141.3, 256.1, 372.5], abs=0.1)


def test_amplification_and_separation_margins_are_those_of_API_617(example: Any) -> None:
    """AF of a damping of 0.1 is about 1/(2 zeta) = 5; it asks 17 % (1 - 1/3.5) below the range, 10 % more above.

    Nothing is asked up to 2.5, and at most 16 % and 26 % of any peak.
    """
    analysis = example("analysis")
    speeds = np.linspace(1.0, 300.0, 3000)
    a = 1 / np.abs(100.0**2 - speeds**2 + 20j * speeds)
    response = analysis.Response(speeds, a[:, None], a[:, None], a[:, None])
    (below,), (above,) = (analysis.criticals(response, at) for at in ((150.0, 250.0), (50.0, 90.0)))
    assert below.speed == pytest.approx(99, abs=0.2)
    assert below.amplification == pytest.approx(5, rel=0.04)
    assert below.required == pytest.approx(0.17 * (1 - 1 / (below.amplification - 1.5)))
    assert above.required == pytest.approx(below.required + 0.1)
    assert below.margin == pytest.approx(0.34, abs=0.01)
    asked = analysis.required_margin
    assert [asked(AF, side) for AF in (2.5, 2.51, 1e9) for side in ("below", "above")] == pytest.approx(
        [0, 0, 0.17 / 101, 0.1 + 0.17 / 101, 0.16, 0.26]
    )
    assert [analysis.zone(share) for share in (0.2, 0.35, 0.45, 0.6)] == ["A", "B", "C", "D"]


def test_the_law_levitates_in_zone_A(example: Any, plant: malta.model.Plant) -> None:
    law, analysis = example("law"), example("analysis")
    par: Any = plant.parameters
    controller, w = law.controller(plant), np.geomspace(10, 3e4, 200)
    for speed in (1.0, par.Omega_max):
        loop = malta.loop(analysis.at_speed(plant, speed), controller)
        assert loop.poles.real.max() == pytest.approx(-27.8, abs=1.3)
        assert 2 < np.abs(np.einsum("kii->ki", loop.sensitivity(w))).max() < 2.75
    found = analysis.unbalance_response(plant, controller, np.array([98.0, par.Omega_max]))
    assert found.sensors[0] == pytest.approx([4.4e-6, 4.8e-6], rel=0.05)
    assert found.magnets.max() / par.c_r < 0.3


@pytest.mark.slow
def test_the_flown_unbalance_is_that_of_the_linear_loop(example: Any, plant: malta.model.Plant) -> None:
    """The nonlinear magnets at full speed; the figure of the experiment has the points beside the curves."""
    found = malta.experiment("unbalance", plant, example("law").controller(plant), speeds=(418.0,))
    flown, linear = (
        np.array([one.value for one in found.cases[0].merits[at]]) for at in (np.s_[:2], np.s_[2:4])
    )
    assert flown == pytest.approx(linear, rel=1e-3)
    assert (
        not found.run.saturated.any()
    )  # 34 N of 570, though the compiler could round the same force in two ways
    figure = malta.report.experiment_figure(found)
    assert len(figure.axes) == 4
    assert figure.axes[2].get_lines()[-1].get_label() == "sensor B, flown"


@pytest.mark.slow
def test_the_design_file_holds_its_goals_at_rest_and_at_full_speed(example: Any) -> None:
    """What `malta design` keeps; the soft goal is what `malta tune` made small."""
    spec = example("law").design()
    found = malta.structured.tune_design(spec, keep=True)
    assert found.spec is spec
    assert found.tuned.models == ("Omega = 0", "Omega = 418.9")
    assert found.tuned.order == 16
    assert found.tuned.reached["sensitivity 2.7"] == pytest.approx(0.995, abs=5e-3)
    assert found.tuned.reached["rest"] <= 1
    assert found.tuned.reached["compliance"] == pytest.approx(0.955, rel=0.01)


@pytest.mark.slow
def test_every_course_of_the_speed_is_proven(example: Any, plant: malta.model.Plant) -> None:
    law = example("law")
    par: Any = plant.parameters
    ((system, compensator),), _ = travel_loops(plant, law.controller(plant), ("Omega",))
    found = malta.proof.prove_rate(system, compensator, "Omega", (0.0, par.Omega_max), time=300)
    assert found.rate is not None
    assert 2000 < found.rate < 1e4
    assert found.decay == pytest.approx(16, rel=0.1)


@pytest.mark.slow
def test_the_rest_is_below_its_weight_at_every_frequency_and_speed(
    example: Any, plant: malta.model.Plant
) -> None:
    law, analysis, rotor = example("law"), example("analysis"), example("flexible_rotor")
    par: Any = plant.parameters
    assert analysis.bound_rest(par, law.rest_weight()).share < 1
    m, w = rotor.modes(30), 5698.4
    Z = np.diag(m.w[6:] ** 2 - w**2 + 2j * w * par.zeta * m.w[6:])
    R = np.linalg.norm(m.sensors[:, 6:] @ np.linalg.solve(Z, m.magnets[:, 6:].T), 2)
    assert pytest.approx(8.9e-8, rel=0.01) == R
    assert abs(complex(law.rest_weight()(1j * w))) > R


@pytest.mark.slow
def test_force_constants_may_be_off_at_every_speed(example: Any, plant: malta.model.Plant) -> None:
    par: Any = plant.parameters
    whole = example("law").continuous(plant)
    law = malta.proof.Compensator(whole.A, -whole.B, whole.C, -whole.D, lag=1 / par.T_d)
    system = malta.uncertain(plant, ["k_i", "Omega"])
    found = malta.robust_margin(
        system, law, {"k_i": 0.1}, over={"Omega": (0.0, par.Omega_max)}, budget=malta.proof.Budget(300)
    )
    assert found.lower == pytest.approx(2.2905, rel=2e-3)
    assert found.upper == pytest.approx(found.lower, rel=2e-3)


@pytest.mark.slow
def test_the_sampled_loop_of_44_states_is_proven_at_every_speed(
    example: Any, plant: malta.model.Plant
) -> None:
    """Force constants within a box, in the machine's own loop: lost where the continuous one is, at zero frequency."""
    controller = example("law").controller(plant)
    par: Any = plant.parameters
    over = {"Omega": (0.0, par.Omega_max)}
    found = malta.robust_margin(malta.loop(plant, controller), {"k_i": 0.1}, over=over)
    assert found.lower is not None
    assert 0.99 * found.upper < found.lower <= found.upper == pytest.approx(2.29056, rel=1e-4)

"""What the compiled engine leaves out is proven to be left out rightly; where nothing is proven, it computes it all."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta import references
from malta.machines.tubular import plant as tubular
from malta.simulation import simulate as prepared
from malta.simulation.engine import compiled
from malta.simulation.engine.batch import simulate_many
from malta.simulation.engine.digest import cruise_functions, digest_function
from malta.simulation.engine.engines import (
    EngineChoice,
    compiled_period,
    engine_of,
    shape_of,
    source,
    translate,
)
from malta.simulation.engine.instructions import Counts
from malta.simulation.engine.integration_state import Identities, find_conserved, linear_parts
from malta.simulation.layout import ending_columns, numbers_of, with_symbols
from malta.simulation.period import Period, columns_of
from malta.simulation.scenario import Scenario, setup_of

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

needs_compiler = pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")
SPIN = 11  # the state gamma'
_ENGINES: tuple[EngineChoice, ...] = ("compiled", "virtual machine")


def _stroke(**options: Any) -> Scenario:
    return Scenario.stroke(4e-3, rise=6e-3, duration=0.02, fidelity="force", **options)


def _torque(about_z: float) -> Any:
    return lambda t: np.tile([0.0, 0.5, 0.0, 1e-4, 0.0, about_z], (len(t), 1))


def _period(design: Design, scenario: Scenario, plant: Plant | None = None) -> Period:
    plant = plant or design.plant
    return compiled_period(shape_of(plant, design.controller, setup_of(plant, design.controller, scenario)))


def _spin_is_integrated(p: Period) -> bool:
    """Whether the working state has a rate for every position of the tubular machine, rather than a constant."""
    assert p.enter is not None
    machine, held, theta = p.enter.sx_in()
    slopes = ca.jacobian(p.enter(machine, held, theta), machine)
    return not ca.depends_on(ca.vec(slopes), machine)  # sin(beta) alpha' + gamma' is not linear in the states


def _agreement(design: Design, scenario: Scenario, plant: Plant | None = None) -> tuple[Any, float]:
    """The compiled run, and its largest difference from that of CasADi's virtual machine, as a share of each state.

    A state that no force moves is rounding: shares are of 1e-7 m, rad/s, ... at least.
    """
    plant = plant or design.plant
    found, expected = (
        malta.simulate(plant, design.controller, scenario, engine=engine) for engine in _ENGINES
    )
    assert found.verdict == expected.verdict
    size = np.abs(expected.x).max(axis=0, initial=1e-7)
    return found, float((np.abs(found.x - expected.x) / size).max())


def _symbolic(design: Design) -> tuple[Any, Any, Any, Any]:
    """The machine's rates, its states, its currents and the symbols of its numbers."""
    plant, _, theta = with_symbols(design.plant, numbers_of(design.plant, design.controller, 4))
    x, i = ca.SX.sym("x", 12), ca.SX.sym("i", 5)
    return ca.densify(plant.f(x, plant.actuator.forces(x, i), plant.load(x))), x, i, theta


# What expressions prove of themselves


def test_spin_of_a_round_mover_is_conserved(designs: dict[str, Design]) -> None:
    """gamma' + sin(beta) alpha' is what no force of the machine changes; a torque about the axis does."""
    rate, x, _, _ = _symbolic(designs["table2"])
    ((k, j, s),) = find_conserved(x, rate)
    assert (k, j) == (SPIN, 9)
    assert ca.is_equal(s, ca.sin(x[4]), 2)
    torque = ca.SX.sym("torque")
    assert find_conserved(x, rate + torque * ca.DM([0] * 11 + [1])) == []
    assert find_conserved(x, rate + 1e-30 * x[11] * ca.DM([0] * 11 + [1])) == []


def test_what_is_almost_conserved_is_not() -> None:
    """x_k' = -s x_j' - s' x_j holds as an identity or not at all."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    wave = ca.sin(x[0])
    for last, count in (
        (ca.cos(x[0]) * x[2], 1),
        (ca.cos(2 * x[0]) * x[2], 0),
        (0.999 * ca.cos(x[0]) * x[2], 0),
    ):
        push = u * ca.cosh(x[1])
        rate = ca.vertcat(x[2], x[3], push, -wave * push - last * x[2])
        assert len(find_conserved(x, rate)) == count
    # s may depend on positions only
    rate = ca.vertcat(x[2], x[3], u, -x[3] * u)
    assert find_conserved(x, rate) == []


def test_polynomials_are_compared_exactly() -> None:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    same = Identities()
    assert same.is_zero((a + b) ** 2 - a * a - 2 * a * b - b * b)
    assert same.is_zero(ca.sin(a * b) - ca.sin(b * a))
    assert not same.is_zero((a + b) ** 2 - a * a - 2 * a * b)
    assert not same.is_zero(ca.sin(2 * a) - 2 * ca.sin(a) * ca.cos(a))  # zero, but not as a polynomial
    assert not same.is_zero(0.1 * a + 0.2 * a - 0.3 * a)  # 0.1 + 0.2 is not 0.3 in binary
    long = [ca.SX(1), ca.SX(1)]
    for k in range(12):
        long = [e * (a + ca.sin(k * b + 1)) for e in long]
    assert not same.is_zero(long[0] - long[1])  # too long to tell


def test_currents_enter_as_sums(designs: dict[str, Design]) -> None:
    """Five sums of currents and moments; in their terms the motion is the same."""
    rate, x, i, theta = _symbolic(designs["table2"])
    parts, names, rewritten = linear_parts(rate, i, theta)
    assert parts.numel() == 5
    assert not any(ca.depends_on(rewritten, i[k]) for k in range(5))
    f = ca.Function("f", [x, i, theta], [rate, ca.substitute(rewritten, names, parts)])
    rng = np.random.default_rng(0)
    one, other = f(rng.normal(size=12), rng.normal(size=5), rng.uniform(1, 2, theta.numel()))
    np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-12)
    # a coefficient that moves is no coefficient
    parts, _, _ = linear_parts(x[0] * (i[0] + i[1]) + i[0] * i[1], i, theta)
    assert sorted(str(parts[k]) for k in range(parts.numel())) == ["(i_0+i_1)", "i_0", "i_1"]


# Spin, torque, and machines that are not round


@needs_compiler
@pytest.mark.parametrize("spin", [0.0, 80.0])
def test_spin_may_begin_anywhere(designs: dict[str, Design], spin: float) -> None:
    """What is conserved is no assumption about the start: a mover that turns 13 times a second keeps doing so."""
    start = {"gamma_dot": spin, "beta_dot": 0.1}
    design, scenario = designs["table2"], _stroke(start=start, noise=1.0, substeps=4)
    assert not _spin_is_integrated(_period(design, scenario))
    run, difference = _agreement(design, scenario)
    assert difference < 1e-9
    kept = run.x[:, SPIN] + np.sin(run.x[:, 4]) * run.x[:, 9]
    assert np.abs(kept - kept[0]).max() < 1e-13 * max(abs(spin), 1)
    assert np.ptp(run.x[:, SPIN]) > 1e-12  # gamma' itself is not constant


@needs_compiler
def test_a_torque_about_the_axis_is_integrated(designs: dict[str, Design]) -> None:
    design, scenario = designs["table2"], _stroke(disturbance=_torque(1e-5))
    assert _spin_is_integrated(_period(design, scenario))
    run, difference = _agreement(design, scenario)
    assert difference < 1e-9
    inertia = design.spec.parameters.I_zz  # type: ignore[attr-defined]
    assert run.x[-1, SPIN] == pytest.approx(1e-5 / inertia * run.t[-1], rel=1e-3)


@needs_compiler
@pytest.mark.parametrize("options", [{"bearing": True}, {"delay": 2}, {"substeps": 9}, {"quantize": True}])
def test_other_setups_agree_with_the_virtual_machine(
    designs: dict[str, Design], options: dict[str, Any]
) -> None:
    assert _agreement(designs["table2"], _stroke(noise=1.0, **options))[1] < 1e-9


@needs_compiler
def test_long_steps_differ_in_the_spin_alone(designs: dict[str, Design]) -> None:
    """One step a sample: a spin that is integrated has the error of the steps, and a conserved one has none."""
    run, difference = _agreement(designs["table2"], _stroke(noise=1.0, substeps=1))
    assert difference < 1e-8
    expected = malta.simulate(run.plant, run.controller, run.scenario, engine="virtual machine")
    assert np.abs(run.p - expected.p).max() < 1e-9 * np.abs(run.p).max()
    kept, integrated = (r.x[:, SPIN] + np.sin(r.x[:, 4]) * r.x[:, 9] for r in (run, expected))
    assert np.abs(kept).max() < 1e-20 < np.abs(integrated).max()


@needs_compiler
def test_a_mover_that_is_not_round_is_integrated(designs: dict[str, Design]) -> None:
    """With two different inertias the axis of symmetry is gone, and so is what was conserved."""
    design = designs["table2"]
    par: Any = design.spec.parameters
    plant = tubular.plant(replace(par, I_yy=1.01 * par.I_xx))
    scenario = _stroke(start={"gamma_dot": 20.0, "beta_dot": 0.1})
    assert _spin_is_integrated(_period(design, scenario, plant))
    assert _agreement(design, scenario, plant)[1] < 1e-9


@needs_compiler
def test_a_spinning_campaign_is_what_simulate_makes_of_it(designs: dict[str, Design]) -> None:
    """Every machine with another torque-free spin dynamics: deviations to the last bits of one and many."""
    design, scenario = designs["calibrated"], _stroke(start={"gamma_dot": 50.0}, noise=1.0, seed=3)
    par: Any = design.spec.parameters
    changes = {"m": par.m * np.linspace(0.9, 1.1, 8), "I_zz": par.I_zz * np.linspace(0.8, 1.2, 8)}
    batch = simulate_many(design.plant, design.controller, scenario, changes)
    for k in (0, 7):
        machine = tubular.plant(replace(par, m=changes["m"][k], I_zz=changes["I_zz"][k]))
        run = malta.simulate(machine, design.controller, replace(scenario, run=k))
        expected = np.abs(run.p - run.reference).max(axis=0)
        np.testing.assert_allclose(batch.deviation[k], expected, rtol=1e-12)


# Once a run, once a sample


def test_the_reference_is_computed_once_for_all_lanes(designs: dict[str, Design]) -> None:
    """K xi* + v_ff depends on nothing but the sample and the controller: five numbers, and no lane reads p*'."""
    design = designs["table2"]
    p = _period(design, _stroke())
    given = p.decide.size1_in(1)
    shared = [k for k, name in enumerate(p.theta) if not name.startswith(("machine.", "errors"))]
    found = translate(p.decide, [1], Counts(g=7), shared)
    assert 5 <= found.counts.g <= 7
    assert "K(g[7])" in found.function
    assert found.foresee.count("given[") > 20
    outputs = len(design.plant.outputs)
    assert not any(f"a1[{k}]" in found.function for k in range(2 * outputs, given))
    assert translate(p.decide, [1]).counts.d < found.counts.d - 100  # where every lane has its own gains


def test_zero_forces_drop_out_by_their_controller(designs: dict[str, Design]) -> None:
    """Gravity acts along y: v0(z) of the x axes is 1e-31 N, which is nothing beside 26 N."""
    controller = designs["table2"].controller
    assert columns_of(controller) == (1, 3, 4)
    text = source(_period(designs["table2"], _stroke()), None)
    assert "#define COLUMN 1, 3, 4" in text
    assert "a3[0]" not in text
    v0 = np.array(controller.feedforward.v0)
    v0[3, 0] = 1e-9
    other = replace(controller, feedforward=replace(controller.feedforward, v0=v0))
    assert columns_of(other) == (0, 1, 3, 4)
    setup = setup_of(designs["table2"].plant, controller, _stroke())
    shapes = {shape_of(designs["table2"].plant, c, setup) for c in (controller, other)}
    assert len(shapes) == 2


def test_a_quiet_sample_updates_a_digest_as_any_other(designs: dict[str, Design]) -> None:
    """The short update equals the general one to the bit wherever its premise holds, and the premise fails at every
    event: a contact, a limit, a level of the stroke, a run that is over."""
    design, scenario = designs["calibrated"], _stroke()
    shape = shape_of(design.plant, design.controller, setup_of(design.plant, design.controller, scenario))
    general, (premise, short) = digest_function(shape), cruise_functions(shape)
    sizes = [general.size1_in(i) for i in range(4)]
    names = [*_names(shape)]
    rng, held = np.random.default_rng(1), 0
    for _ in range(300):
        kept, row, given, theta = (rng.uniform(-1, 1, size) for size in sizes)
        kept[names.index("alive")] = rng.random() < 0.9
        kept[[i for i, name in enumerate(names) if name == "reached"]] = rng.choice([-1.0, 5.0], 2)
        contact, saturated = _columns(shape, "contact"), _columns(shape, "saturated")
        row[contact] = rng.uniform(0, 1.1, len(row[contact]))
        row[saturated] = rng.random(len(row[saturated])) < 0.02
        arguments = kept, row, given, theta
        if float(premise(*arguments)):
            held += 1
            assert np.array_equal(np.array(short(*arguments)), np.array(general(*arguments)))
            assert kept[names.index("alive")] == 1
            assert row[contact].max() < 1
            assert not row[saturated].any()
    assert 20 < held < 250
    bearing = setup_of(design.plant, design.controller, _stroke(bearing=True))
    assert cruise_functions(shape_of(design.plant, design.controller, bearing)) == ()


def _names(shape: Any) -> list[str]:
    from malta.simulation.engine.digest import digest_sizes

    return [name for name, size in digest_sizes(shape.plant).items() for _ in range(size)]


def _columns(shape: Any, name: str) -> slice:
    from malta.simulation.layout import layout_of

    row = layout_of(shape.plant, shape.controller, shape.setup).row
    first = sum(size for key, size in list(row.items())[: list(row).index(name)])
    return slice(first, first + row[name])


# What a simulation begins with


def _ready(design: Design, scenario: Scenario) -> prepared.Prepared:
    return prepared.prepare(design.plant, design.controller, scenario)


def test_what_can_only_repeat_is_prepared_once(designs: dict[str, Design]) -> None:
    design, scenario = designs["table2"], _stroke()
    first = _ready(design, scenario)
    assert _ready(design, scenario) is first
    assert _ready(design, _stroke()) is not first
    assert _ready(designs["calibrated"], scenario) is not first


def test_what_may_change_is_prepared_anew(designs: dict[str, Design]) -> None:
    """A function of the caller may look at anything, and a dictionary may be written into."""
    design, size = designs["table2"], [1e-3]

    def moved(plant: Plant) -> Any:
        return references.hold(plant, z=size[0])

    scenario = Scenario("hold", 0.005, moved, fidelity="force")
    runs: list[FloatArray] = []
    for size[0] in (1e-3, 2e-3):
        runs.append(malta.simulate(design.plant, design.controller, scenario).reference)
    assert np.ptp([run[0, 4] for run in runs]) == pytest.approx(1e-3)
    own, array = partial(references.hold, z=1e-3), np.array(1e-3)
    assert prepared.is_repeatable(Scenario("hold", 0.005, own))
    for touched in (
        {"start": {"z": 1e-3}},
        {"disturbance": _torque(0.0)},
        {"reference": partial(references.hold, z=array)},  # type: ignore[arg-type]
        {"reference": moved},
    ):
        options: Any = {"reference": own} | touched
        assert not prepared.is_repeatable(Scenario("hold", 0.005, **options))


# Where a run ends


@needs_compiler
def test_the_compiled_engine_ends_with_the_contact(designs: dict[str, Design]) -> None:
    """Its last row is the first of a contact, and the virtual machine's run ends there too."""
    design = designs["table2"]
    par = design.plant.parameters
    assert isinstance(par, tubular.Parameters)
    plant = design.plant.variant(replace(par, m=2 * par.m))
    scenario = Scenario.stroke(10e-3, fidelity="force")
    ready = prepared.prepare(plant, design.controller, scenario)
    setup = ready.simulation.setup
    engine = engine_of(plant, design.controller, setup, ready.substeps, choice="compiled")
    _, rows = engine.run(0, ready.state, ready.inputs.given, ready.noise, ready.fast_noise)
    contact = rows[:, ending_columns(plant, design.controller, setup)]
    assert len(rows) < len(ready.inputs.t)
    assert contact[-1].max() >= 1
    assert contact[:-1].max() < 1
    one, other = (malta.simulate(plant, design.controller, scenario, engine=choice) for choice in _ENGINES)
    assert len(one.t) == len(other.t) == len(rows)
    assert one.verdict == other.verdict


def test_a_contact_that_a_bearing_cushions_ends_nothing(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    setups = [
        setup_of(design.plant, design.controller, Scenario.stroke(10e-3, fidelity="force", bearing=bearing))
        for bearing in (False, True)
    ]
    apart, cushioned = (ending_columns(design.plant, design.controller, setup) for setup in setups)
    assert len(apart) == len(design.plant.contacts.names)
    assert cushioned == apart[2:]

"""What a machine declares and its linear model does not have: refused, or nothing is proven, with the place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT, Run

import malta
from malta.loops.parametric_plants import of_plant
from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si
from malta.model.equilibrium import balance
from malta.model.soundness import unproven


@dataclass(frozen=True)
class Parameters:
    m: float = si("kg", above=0)
    k: float = si("N/m")
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "one_axis.Parameters")


PAR = Parameters(m=0.1, k=1e3)


def plant(
    par: Any = PAR,
    *,
    force: Callable[[Any, Any, Any], Any] = lambda par, q, i: i + par.k * q,
    read: Callable[[Any, Any], Any] = lambda x, _: x[0],
    **fields: Any,
) -> Plant:
    """A mass of 0.1 kg on one axis, pushed away by a spring of 1 N/mm."""
    own: dict[str, Any] = {
        "name": "one_axis",
        "states": (Signal("q", "m"), Signal("q_dot", "m/s")),
        "inputs": (Signal("f", "N"),),
        "outputs": (Signal("y", "m"),),
        "disturbances": (Signal("w", "N"),),
        "f": lambda x, u, w: ca.vertcat(x[1], (u + w) / par.m),
        "h": read,
        "sensors": Sensors(noise=(1e-6,)),
        "contacts": Contacts(("stop",), lambda x: ca.fabs(x[0]) / 1e-3),
    }
    actuator = Actuator(
        (Signal("i", "A"),),
        (1.0,),
        current_limit=40.0,
        dead_time=1e-4,
        forces=lambda x, i: force(par, x[0], i),
    )
    variant = lambda other: plant(other, force=force, read=read, **fields)  # noqa: E731
    return Plant(parameters=par, variant=variant, actuator=actuator, **own | fields)


WEIGHTS = malta.synthesis.weights(q=[1e8, 1], r=[1], w=[1e-2], v=[1e-12])
PLAIN = plant()
LAW = malta.lqg(malta.linearize(PLAIN, PLAIN.at()), WEIGHTS, Ts=1e-4, delay=1)


def refused(machine: Plant) -> str:
    """The sentence with which everything refuses a machine."""
    sentences = set()
    hold = malta.Scenario("hold", 1e-3, malta.references.hold, fidelity="force")
    for ask in (
        lambda: malta.linearize(machine, machine.at()),
        lambda: malta.verify(machine, LAW, {"m": 0.2}),
        lambda: malta.loop(machine, LAW).stable,
        lambda: malta.simulate(machine, LAW, hold),
    ):
        with pytest.raises(malta.InputError) as error:
            ask()
        sentences.add(str(error.value))
    assert len(sentences) == 1
    assert not malta.inspect(machine).proves
    return sentences.pop()


def nothing_proven(machine: Plant) -> str:
    """The reason for which nothing is proven of a machine, and `verify` ends."""
    with pytest.raises(malta.CheckError) as error:
        malta.verify(machine, LAW, {"m": 0.2})
    found = malta.robust_margin(malta.loop(machine, LAW), {"m": 0.2})
    assert not found.lower
    assert found.lower == 0 or found.reason in str(error.value)  # 0: the slope of one side is unstable
    assert not malta.inspect(machine).proves
    return str(error.value).partition("machine's: ")[2]


def test_a_plain_machine_is_proven() -> None:
    found = malta.inspect(PLAIN)
    assert found.proves
    assert [row.part for row in found.rows] == ["actuator.currents"]  # which leave k q
    assert malta.robust_margin(malta.loop(PLAIN, LAW), {"m": 0.2}).lower == pytest.approx(3.7953, rel=1e-3)


@pytest.mark.parametrize("h", [5e-5, -5e-5, -1e-4])
def test_a_sensor_that_sees_its_coil_is_refused(h: float) -> None:
    """y = q + h f: with h = -50 um/N the loop is unstable, and was proven stable."""
    assert "y follows u at once" in refused(plant(read=lambda x, u: x[0] + h * u))


@pytest.mark.parametrize(
    ("gain", "offset", "inverse", "words"),
    [
        (600.0, 0.0, False, "position_of"),
        (-1.0, 0.0, False, "position_of"),
        (600.0, -16.0, True, "h(0) is -16 m of y"),
        (1.0, 1e-4, False, "h(0) is 0.0001 m of y"),
    ],
)
def test_readings_that_are_no_positions_are_refused(
    gain: float, offset: float, inverse: bool, words: str
) -> None:
    own: dict[str, Any] = {"position_of": lambda y: (y - offset) / gain} if inverse else {}
    assert words in refused(plant(read=lambda x, _: gain * x[0] + offset, **own))


def test_a_sensor_in_volts_with_its_inverse_is_one() -> None:
    """y = 600 q in volts."""
    volts = plant(
        read=lambda x, _: 600 * x[0],
        position_of=lambda y: y / 600,
        outputs=(Signal("y", "V"),),
        sensors=Sensors(noise=(6e-4,)),
    )
    assert malta.inspect(volts).proves
    assert malta.linearize(volts, volts.at()).C.tolist() == [[600, 0]]


KINKS: dict[str, Callable[[Any, Any, Any], Any]] = {
    "if_else": lambda par, q, i: i + ca.if_else(q > 0, 12 * par.k * q, par.k * q),
    "the other side": lambda par, q, i: i + ca.if_else(q < 0, par.k * q, 12 * par.k * q),
    "fmax": lambda par, q, i: i + par.k * q + 11 * par.k * ca.fmax(q, 0),
    "fmin": lambda par, q, i: i + 12 * par.k * q - 11 * par.k * ca.fmin(q, 0),
    "fabs": lambda par, q, i: i + 12 * par.k * ca.fabs(q),
    "root of a square": lambda par, q, i: i + 12 * par.k * ca.sqrt(q**2),
    "sign": lambda par, q, i: i + par.k * q + 1e-2 * ca.sign(q),
    "floor": lambda par, q, i: i + par.k * q + 1e-2 * ca.floor(q / 1e-6),
    "of the current": lambda par, q, i: ca.fmax(i, 0.5 * i) + par.k * q,
}


@pytest.mark.parametrize("name", KINKS)
def test_nothing_is_proven_at_a_kink(name: str) -> None:
    """One function in many spellings has one answer, with the place."""
    reason = nothing_proven(plant(force=KINKS[name]))
    assert reason.startswith("f: a kink at rest, slope of q_dot' along ")
    if name in ("if_else", "the other side", "fmax", "fmin"):
        assert "along q is 1e+04 to the left and 1.2e+05 to the right" in reason


def test_gains_and_blocks_have_the_same_reason() -> None:
    machine = plant(force=KINKS["fabs"])
    system, law = malta.loop(machine, LAW).uncertain(["m"])
    gain = malta.worst_case_gain(system, law, {"m": 0.2}, time=0.1)
    block = malta.dynamic_margin(system, law, {"m": 0.2}, malta.proof.Dynamic(0.1), time=0.1)
    assert (gain.upper, block.lower) == (None, None)
    assert gain.reason == block.reason == system.approximate


def test_an_endless_slope_is_a_kink() -> None:
    """A root that begins at rest, and one of both signs."""
    for force in (
        lambda par, q, i: i + par.k * q + ca.sqrt(ca.fmax(q, 0)),
        lambda par, q, i: i + par.k * q + ca.sign(q) * ca.sqrt(ca.fabs(q)),
    ):
        assert "a kink at rest" in unproven(plant(force=force), (0.0, 0.0))


def test_a_load_that_is_a_number_is_a_column() -> None:
    """f takes w[0], and the load is a number or a list, as that of the sphere that `malta new` writes."""
    for load in (-0.981, [-0.981], np.array([-0.981])):
        heavy = plant(f=lambda x, u, w: ca.vertcat(x[1], (u + w[0]) / PAR.m), load=lambda _, load=load: load)
        assert balance(heavy, np.zeros(2)).u == pytest.approx([0.981])


def test_rounding_beside_a_large_number_is_no_kink() -> None:
    """A pressure that counts from 1 bar: a step of 1e-8 Pa is lost in it; a kink of the pressure is still one."""

    def cushion(bend: float) -> Plant:
        def rate(p: Any) -> Any:
            return ((1.2e5 + p) - 1.01325e5) / 2000 - (1.2e5 - 1.01325e5) / 2000 + bend * ca.fabs(p)

        return plant(
            states=(Signal("p", "Pa"), Signal("v", "m/s")),
            outputs=(Signal("y", "Pa"), Signal("y_v", "m/s")),
            f=lambda x, u, w: ca.vertcat(u - 10 * x[0], rate(x[0]) - x[1] + w),
            read=lambda x, _: x,
            position_of=lambda y: y,
            sensors=Sensors(noise=(1.0, 1e-3)),
            contacts=Contacts(),
        )

    assert unproven(cushion(0.0), (0.0, 0.0)) == ""
    assert "slope of v' along p" in unproven(cushion(1e-4), (0.0, 0.0))


def test_a_kink_in_the_speed_is_one() -> None:
    """Coulomb friction of a tenth of a newton."""
    rubbing = plant(f=lambda x, u, w: ca.vertcat(x[1], (u + w - 0.1 * ca.sign(x[1])) / PAR.m))
    assert "along q_dot" in nothing_proven(rubbing)


@pytest.mark.parametrize(
    "force",
    [
        lambda par, q, i: i + ca.if_else(q > 0, par.k * q, par.k * q),
        lambda par, q, i: i + par.k * q + ca.if_else(q > 0, 1e6 * q**2, 0),
        lambda par, q, i: i + par.k * q + par.k * ca.fmax(q - 5e-4, 0),
        lambda par, q, i: i + par.k * q + 1e5 * q**2 + 1e9 * q**3,
        lambda par, q, i: i + 100 * par.k * q * ca.sqrt(1e-4 + q**2),
    ],
)
def test_smooth_at_rest_is_proven(force: Callable[[Any, Any, Any], Any]) -> None:
    """Switches whose sides agree in value and slope, and one half a millimetre away."""
    assert unproven(plant(force=force), (0.0, 0.0)) == ""


def test_the_nearest_switch_is_named() -> None:
    away = plant(force=lambda par, q, i: i + par.k * q + 12 * par.k * ca.fmax(q - 4e-4, 0))
    (text,) = malta.inspect(away).switches
    assert text.startswith("q: at 0.0004 m")
    assert malta.inspect(PLAIN).switches == ("q: none from -0.001 to 0.001 m",)


def test_a_kink_is_one_at_its_place_alone() -> None:
    """Nothing is proven of the machine at the switch, and of that beside it as much as before."""
    away = plant(force=lambda par, q, i: i + par.k * q + 12 * par.k * ca.fmax(q - 4e-4, 0))
    assert of_plant(away, ["m"]).approximate == ""
    assert "a kink at q = 0.0004" in of_plant(away, ["m"], at={"q": 4e-4}).approximate


@pytest.mark.parametrize(("there", "back", "proven"), [(1.0, 1.0, False), (0.0, 1.0, True), (1.0, 0.0, True)])
def test_states_that_were_left_out_and_close_a_loop(there: float, back: float, proven: bool) -> None:
    """A second mass, which the first one drives and which pushes it."""
    machine = plant(
        states=tuple(Signal(n, u) for n, u in (("q", "m"), ("s", "m"), ("q_dot", "m/s"), ("s_dot", "m/s"))),
        uncontrolled=("s", "s_dot"),
        f=lambda x, u, w: ca.vertcat(
            x[2], x[3], (u + w + 500 * back * x[1]) / PAR.m, (500 * there * x[0] - x[1] - x[3]) / PAR.m
        ),
    )
    if proven:
        assert malta.robust_margin(malta.loop(machine, LAW), {"k": 0.2}).lower is not None
    else:
        assert "s is moved by what is controlled and acts back" in nothing_proven(machine)


def test_what_acts_on_nothing_is_named() -> None:
    idle = plant(
        disturbances=(Signal("w", "N"), Signal("v", "N")),
        f=lambda x, u, w: ca.vertcat(x[1], (u + w[0]) / PAR.m),
        states=(Signal("q", "m"), Signal("q_dot", "mm")),
        outputs=(Signal("y", "rad"),),
        force=lambda _, q, i: i + 1e3 * q,
    )
    found = {str(row).partition(": leave")[0] for row in malta.inspect(idle).rows}
    assert "disturbances: nothing depends on v" in found
    assert "parameters: k changes nothing of the machine" in found
    assert any(text.startswith("states: q_dot in mm, the rate of q in m") for text in found)
    assert any(text.startswith("outputs: y in rad shows q in m") for text in found)
    assert malta.inspect(idle).proves


@pytest.mark.slow
def test_a_parameter_without_effect_is_named_in_the_answer() -> None:
    """Alone it proves nothing; beside another the answer says that it says nothing of it."""
    loop = malta.loop(plant(force=lambda _, q, i: i + 1e3 * q), LAW)
    alone = malta.robust_margin(loop, {"k": 0.5})
    assert (alone.lower, alone.reason) == (None, "the loop does not depend on k")
    both = malta.robust_margin(loop, {"k": 0.5, "m": 0.2})
    assert both.idle == ("k",)
    assert both.lower == pytest.approx(malta.robust_margin(loop, {"m": 0.2}).lower, rel=1e-3)
    assert str(both).endswith("; does not depend on k")


SHIPPED = sorted(ROOT.glob("design/*.toml")) + sorted(ROOT.glob("examples/*/design/*.toml"))


@pytest.mark.slow_for("planar")
@pytest.mark.parametrize("file", SHIPPED, ids=lambda path: path.stem)
def test_proofs_of_shipped_machines_are_of_these_machines(file: Path) -> None:
    machine = malta.read_design(file).plant
    assert unproven(machine, tuple(machine.at().x.tolist())) == ""


KINKED = "    return 4e4 * ca.fmax(q, 0) + par.C *"


def _ball(tmp_path: Path, old: str = "", new: str = "") -> Path:
    for name in ("ball.py", "ball.toml"):
        text = (ROOT / "examples" / "ball" / name).read_text(encoding="utf-8")
        assert name == "ball.toml" or old in text
        (tmp_path / name).write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return tmp_path / "ball.py"


@pytest.mark.slow
def test_the_command_says_it_in_a_line(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("inspect", _ball(tmp_path, "    return par.C *", KINKED))
    assert code == 1
    text = " ".join(out.split())
    assert (
        "a kink at rest, slope of q_dot' along q is 1.44e+04 to the left and 4.144e+05 to the right" in text
    )
    assert text.endswith("ball: nothing is proven of it")


@pytest.mark.slow
def test_the_command_says_that_proofs_hold(run: Run, tmp_path: Path) -> None:
    file = _ball(tmp_path)
    for what in (file, file.with_suffix(".toml")):
        code, out, err = run("inspect", what)
        assert (code, err) == (0, "")
        assert out.endswith("ball: proofs hold of it\n")
    (tmp_path / "ball.toml").unlink()
    code, _, err = run("inspect", file)
    assert code == 2
    assert "no such file" in err


def test_numbers_of_the_machine_do_not_matter() -> None:
    """The answer is the same for machines a thousand times as heavy, large or strong."""
    for scale in (1e-3, 1e3):
        heavy = plant(replace(PAR, m=PAR.m * scale, k=PAR.k * scale))
        kinked = plant(replace(PAR, m=PAR.m * scale, k=PAR.k * scale), force=KINKS["fabs"])
        assert unproven(heavy, (0.0, 0.0)) == ""
        assert unproven(kinked, (0.0, 0.0))
    assert np.isfinite(scale)

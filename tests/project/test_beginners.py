"""Mistakes that a newcomer makes with a machine and a design of his own: each is answered by what to change."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from typer.testing import CliRunner

import malta
from malta.cli import main as cli
from malta.files import shipped_path
from malta.model import machines
from malta.synthesis.reachability import lost_modes

F = "f=lambda x, u, w: ca.vertcat(x[1], (u + w) / par.m)"
FORCES = "forces=lambda x, i: pull(par, x[0], i)"
H = "h=lambda x, _: x[0]"
SAMPLE = '{ value = 200, unit = "us" }'

_folders = iter(range(10**6))


@pytest.fixture
def ball(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Copy the sphere of the examples under a name of its own, texts replaced: the design file."""

    def copied(*changes: tuple[str, str]) -> Path:
        name = f"sphere{next(_folders)}"
        left = dict(changes)
        for source, target in (
            ("ball.py", f"{name}.py"),
            ("ball.toml", f"{name}.toml"),
            ("design/ball.toml", "design/b.toml"),
        ):
            text = shipped_path("examples", "ball", *source.split("/")).read_text(encoding="utf-8")
            for old in [old for old in left if old in text]:
                text = text.replace(old, left.pop(old))
            text = text.replace("../ball.toml", f"../{name}.toml").replace('"ball.py"', f'"{name}.py"')
            text = text.replace('name="ball"', f'name="{name}"')
            (tmp_path / target).parent.mkdir(exist_ok=True)
            (tmp_path / target).write_text(text, encoding="utf-8")
        assert not left
        return tmp_path / "design" / "b.toml"

    yield copied
    for name in [name for name in machines._files if name.startswith("sphere")]:
        del machines._files[name]


FUNCTIONS = {
    "math for casadi": (
        [
            (F, F.replace("par.m)", "par.m + math.sin(x[0]))")),
            ("import casadi", "import math\nimport casadi"),
        ],
        "NaN in its expression, expected CasADi's functions, as ca.sin",
    ),
    "max": (
        [(F, F.replace("(u + w)", "max(u + w, 0)"))],
        "expected ca.fmax, ca.fmin or ca.if_else in place of max",
    ),
    "a symbol of one's own": ([(F, F.replace("par.m", "ca.SX.sym('m')"))], "symbols of its own (m)"),
    "the rate's sign": ([(F, F.replace("x[1]", "-x[1]"))], "expected f = (q', q'') for states (q, q')"),
    "an array": (
        [
            (F, F.replace("ca.vertcat(", "np.array([").replace("par.m)", "par.m])")),
            ("import casadi", "import numpy as np\nimport casadi"),
        ],
        "an array of numpy, expected a vector of CasADi",
    ),
    "an unknown name": ([("k_i = 4", "k_i = four")], "NameError: name 'four' is not defined, at sphere"),
    "an unknown field": ([("disturbances=", "disturbance=")], "unexpected keyword argument 'disturbance'"),
    "nothing returned": (
        [("    return Plant(", "    Plant(")],
        "a function that returns None, expected one that returns a Plant",
    ),
}


@pytest.mark.parametrize("mistake", FUNCTIONS)
def test_a_wrong_function_of_a_machine_is_one_sentence(ball: Any, mistake: str) -> None:
    changes, says = FUNCTIONS[mistake]
    with pytest.raises(malta.InputError) as caught:
        malta.read_design(ball(*changes))
    assert says in str(caught.value)


DESIGNS = {
    "no force": (
        [
            (F, F.replace("(u + w)", "500 * par.m * x[0] + w")),
            (FORCES, FORCES.replace("pull(par, x[0], i)", "0 * i")),
        ],
        "no force moves the mode with the pole 7.071 rad/s of q q_dot",
    ),
    "a rate for a position": (
        [(H, "h=lambda x, _: x[1]")],
        "a zero at s = 0): weights.integral needs to be 0",
    ),
    "a long sample": (
        [(SAMPLE, '{ value = 200, unit = "ms" }')],
        "is too long for the unstable pole at 120 rad/s",
    ),
}


@pytest.mark.parametrize("mistake", DESIGNS)
def test_a_design_that_cannot_be_says_why(ball: Any, mistake: str) -> None:
    changes, says = DESIGNS[mistake]
    spec = malta.read_design(ball(*changes))
    with pytest.raises(malta.CheckError) as caught:
        malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    assert says in str(caught.value)


@settings(max_examples=30)
@given(st.integers(2, 6), st.integers(0, 10**6), st.floats(-6, 6))
def test_modes_out_of_reach_are_those_of_the_part_that_inputs_do_not_enter(
    n: int, seed: int, decades: float
) -> None:
    """Blocks [A1 0; 0 A2], B on the first alone, states mixed and scaled: the unstable poles of A2 are lost."""
    rng = np.random.default_rng(seed)
    A1, A2 = rng.normal(size=(n, n)), np.diag([1.5, -1.0])
    scale = 10 ** np.linspace(-decades / 2, decades / 2, n + 2)
    A = np.block([[A1, np.zeros((n, 2))], [np.zeros((2, n)), A2]])
    A, B = A * scale[:, None] / scale, np.vstack([rng.normal(size=(n, 1)), np.zeros((2, 1))]) * scale[:, None]
    found = lost_modes(A, B)
    assert [mode.pole.real for mode in found] == pytest.approx([1.5])
    assert found[0].states == (n,)
    assert not lost_modes(A1, np.eye(n))


def test_names_that_are_typed_wrong_are_asked_for() -> None:
    with pytest.raises(malta.InputError, match=r"\(did you mean 'table4'\?\)"):
        malta.read("data/tubular.toml", preset="tabel4")
    assert "did you mean" not in str(malta.InputError("f", "qqqqq", "an unknown key", "one of a b c"))
    assert str(malta.InputError("f", "K_b", "an unknown parameter", "one of K_B m")).endswith(
        "(did you mean 'K_B'?)"
    )
    assert str(malta.InputError("--to", "", "'fmuu'", "c or fmu")).endswith("(did you mean 'fmu'?)")
    with pytest.raises(malta.InputError, match=r"no such file.*\(did you mean data/tubular\.toml\?\)"):
        malta.read("data/tubuler.toml")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[weights]", "[weight]"), "(did you mean 'weights'?)"),
        (("[uncertainty]", "[uncertainy]"), "(did you mean 'uncertainty'?)"),
        ((SAMPLE, "200e-6"), 'expected a table with its unit, as { value = 200, unit = "us" }'),
        (("\nC = 0.2", "\nc = 0.2"), "(did you mean 'C'?)"),
    ],
)
def test_a_mistake_in_a_design_file_shows_the_right_way(
    ball: Any, change: tuple[str, str], says: str
) -> None:
    with pytest.raises(malta.InputError) as caught:
        malta.read_design(ball(change))
    assert says in str(caught.value)


def test_a_design_without_specification_is_not_judged(ball: Any) -> None:
    file = ball()
    text = file.read_text(encoding="utf-8")
    file.write_text(text[: text.index("[specification]")], encoding="utf-8")
    result = CliRunner().invoke(cli.app, ["tune", str(file), "--check"])
    assert isinstance(result.exception, malta.InputError)
    assert "specification: found nothing, expected this table: what the design has to reach" in str(
        result.exception
    )


def test_a_pid_with_the_wrong_sign_is_told_so(tmp_path: Path) -> None:
    for name in ("ball.py", "ball.toml", "design/ball_pid.toml"):
        source = shipped_path("examples", "ball", *name.split("/"))
        (tmp_path / name).parent.mkdir(exist_ok=True)
        text = source.read_text(encoding="utf-8")
        for gain in ("8, unit", "100, unit", "25, unit"):
            text = text.replace(f"value = {gain}", f"value = -{gain}")
        (tmp_path / name).write_text(text, encoding="utf-8")
    result = CliRunner().invoke(cli.app, ["design", str(tmp_path / "design" / "ball_pid.toml")])
    assert result.exit_code == 1
    assert "is unstable" in result.stderr
    assert "with the other sign of Kp, Ki and Kd it is stable" in result.stderr


def test_a_range_of_no_width_and_arguments_with_defaults_are_fine() -> None:
    """k held fast beside m, as without it; `extra` keeps its value."""

    def cart(m: Any, k: Any, extra: float = 1.0) -> Any:
        return [[0, 1], [-k / m, -0.2 / m]], [[0], [extra / m]], [[1, 0]]

    spring = malta.uncertain(cart, {"m": 1, "k": 4})
    pull = [[2.0]]
    alone = malta.robust_margin(spring, pull, {"k": 0.1})
    for width in (0, (1, 1)):
        assert malta.robust_margin(spring, pull, {"k": 0.1, "m": width}).lower == pytest.approx(
            alone.lower, rel=1e-3
        )

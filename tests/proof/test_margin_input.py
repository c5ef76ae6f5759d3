"""What margins are asked of: systems that overflow are answered, input that is none is one clear sentence."""

# ruff: noqa: ARG005  (functions of parameters that do not use them)

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest

import malta
from malta import gains
from malta.errors import InputError
from malta.linear.expressions import program
from malta.linear.uncertain import UncertainSystem
from malta.model.plants import plant_of
from malta.proof.box import box_of
from malta.proof.problem import CoefficientPolynomial
from malta.proof.robust import common_margin

PLANT = plant_of(gains.read("design/gains/table2.json").parameters)
LAG = control.ss([[-1.0]], [[1.0]], [[-1.0]], [[0.0]])


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def motor(**options: Any) -> UncertainSystem:
    """k / (s + 1)."""
    return malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0}, **options)


@pytest.mark.slow_for("-1-exp", "-1-cosh", "1-exp", "1-cosh")
@pytest.mark.parametrize("f", [ca.exp, ca.sin, ca.cosh])
@pytest.mark.parametrize("sign", [-1, 1])
def test_functions_that_overflow_far_from_the_axis_are_enclosed_on_smaller_discs(f: Any, sign: int) -> None:
    """-1 - f(k) / 2 < 0 as far as is looked: each of them stays above -2."""
    system = malta.uncertain(lambda k: ([[-1.0]], [[f(sign * k)]], [[1.0]]), {"k": 1.0})
    m = malta.robust_margin(system, [[-0.5]], {"k": 0.3}, budget=malta.proof.Budget(10))
    assert m.lower is not None
    assert m.lower > 1  # how far it comes takes time


def test_an_exponential_in_the_input_loses_stability_where_it_does() -> None:
    """-1 + e^-k / 2 = 0 at k = -ln 2: 1 + ln 2 below the nominal value."""
    system = malta.uncertain(lambda k: ([[-1.0]], [[ca.exp(-k)]], [[1.0]]), {"k": 1.0})
    m = malta.robust_margin(system, [[0.5]], {"k": 0.3})
    assert m.lower is not None
    assert m.lower <= (1 + math.log(2)) / 0.3 <= m.upper * (1 + 1e-12)
    assert m.lower == pytest.approx(m.upper, rel=1e-3)


@pytest.mark.slow_for("sin-a law with states", "sin-a gain", "exp-a gain")
@pytest.mark.parametrize("law", [LAG, [[-1.0]]], ids=["a law with states", "a gain"])
@pytest.mark.parametrize("f", [ca.sin, ca.exp])
def test_functions_in_the_direct_feedthrough_are_enclosed(f: Any, law: Any) -> None:
    system = malta.uncertain(lambda k: ([[-1.0]], [[1.0]], [[1.0]], [[0.1 * f(k)]]), {"k": 1.0})
    m = malta.robust_margin(system, law, {"k": 0.3})
    assert m.lower is not None
    assert m.lower > 1


def test_a_loop_without_states_is_no_loop() -> None:
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
    static = malta.uncertain(lambda k: (*none, [[k]]), {"k": 1})
    algebraic = malta.uncertain(lambda k: ([[-k]], [[1.0]], [[1.0]], [[0.0]], [[0.0]]), {"k": 1})
    for system in (static, algebraic):
        with pytest.raises(InputError, match="uncertain: A: found no states but algebraic ones"):
            malta.robust_margin(system, [[-0.5]], {"k": 0.1})
    # x' = -x + k u, u = -x
    assert malta.robust_margin(static, LAG, {"k": 0.1}).lower == pytest.approx(20, rel=1e-3)


@pytest.mark.parametrize("value", [1e308, (-1e308, 1e308), (1.0, 1e308), (-1e308, 1.7e308), 1e151])
def test_ranges_that_overflow_are_refused(value: Any) -> None:
    says = r"k: found .*, expected values between -1e\+150 and 1e\+150"
    with pytest.raises(InputError, match=says):
        malta.robust_margin(motor(), [[-2.0]], {"k": value})
    with pytest.raises(InputError, match=says):
        malta.proof.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": value}, {"k": 1})


@pytest.mark.slow_for("20-3", "20-5", "100-2", "100-3", "100-5", "150-1", "150-2", "150-3", "150-5")
@pytest.mark.parametrize("power", [1, 2, 3, 5])
@pytest.mark.parametrize("decades", [20, 100, 150])
def test_numbers_that_overflow_prove_nothing(decades: int, power: int) -> None:
    """(s + 1)^3 + k^n is unstable beyond k^n = 8."""
    R = 10.0**decades
    m = malta.proof.margin_of_polynomial(
        lambda k: [1, 3, 3, 1 + k**power], {"k": (-R, R)}, {"k": 0.0}, time=0.4
    )
    assert m.lower is None or m.lower * R <= 8 ** (1 / power) * (1 + 1e-9)
    system = malta.uncertain(lambda k: ([[-1.0, 0], [0, -2]], [[k**power], [1]], [[1.0, 1]]), {"k": 0.0})
    m = malta.robust_margin(system, [[-2.0]], {"k": (-R, R)}, budget=malta.proof.Budget(0.4))
    # s^2 + (5 + 2 k^n) s + 4 + 4 k^n: an even power leaves it stable for every k, an odd one until k = -1.
    assert power == 2 or m.lower is None or m.lower * R <= 1 + 1e-9


def test_what_overflows_at_the_ends_of_an_interval_is_not_proven() -> None:
    system = malta.uncertain(lambda k, c: ([[-1.0 - c**3]], [[k]], [[1.0]]), {"k": 1.0, "c": 1.0})
    assert (
        malta.robust_margin(
            system, [[-2.0]], {"k": 0.1}, {"c": (0.5, 1e120)}, budget=malta.proof.Budget(0.4)
        ).upper
        > 0
    )


def test_roots_of_coefficients_beyond_floating_point() -> None:
    p = ca.SX.sym("p")
    f = ca.Function("f", [p], [ca.vertcat(p**3, p**3, p**3)])
    problem = CoefficientPolynomial(program(f), ("p",), False)
    assert problem.instability(np.array([[1e120]]))[0] == pytest.approx(-0.5)
    assert problem.instability(np.array([[0.0]]))[0] > 0  # nothing is left of it


LETTER: Any = "a"
TWO = ([[-1.0]], [[1.0]], [[1.0]])
NO_RANGE: dict[str, Any] = {
    "a string": "a",
    "None": None,
    "an array": np.array([0.5, 1.5]),
    "strings": ("a", "b"),
    "half of one": (None, 2),
    "complex": 1j,
    "a truth value": True,
    "NaN": math.nan,
    "three": (1, 2, 3),
    "reversed": [1.5, 0.5],
}


@pytest.mark.parametrize("value", NO_RANGE.values(), ids=NO_RANGE.keys())
def test_what_is_no_range_is_said(value: Any) -> None:
    says = r"k: found .+, expected a share of 0 or more, or \(low, high\) about the nominal 1"
    with pytest.raises(InputError, match=r"^robust_margin: " + says):
        malta.robust_margin(motor(), [[-2.0]], {"k": value})
    with pytest.raises(InputError, match=r"^margin: " + says):
        common_margin([(motor(), [[-2.0]])], {"k": value})
    with pytest.raises(InputError, match=r"^margin_of_polynomial: " + says):
        malta.proof.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": value}, {"k": 1})
    two = malta.uncertain(lambda k, c: ([[-c]], [[k]], [[1.0]]), {"k": 1.0, "c": 1.0})
    with pytest.raises(InputError, match=r"^robust_margin: " + says):
        malta.robust_margin(two, [[-2.0]], {"c": 0.1}, {"k": value})


@pytest.mark.parametrize("ranges", [[("k", 0.1)], None, 0.1, {1: 0.1}])
def test_ranges_are_given_by_name(ranges: Any) -> None:
    with pytest.raises(InputError, match=r"^robust_margin: ranges: found .* as {"):
        malta.robust_margin(motor(), [[-2.0]], ranges)
    with pytest.raises(InputError, match=r"^margin: ranges: found .* as {"):
        common_margin([(motor(), [[-2.0]])], ranges)
    with pytest.raises(InputError, match=r"^margin_of_polynomial: box: found .* as {"):
        malta.proof.margin_of_polynomial(lambda k: [1, 1 + k], ranges)
    if ranges is not None:
        with pytest.raises(InputError, match=r"^robust_margin: over: found .* as {"):
            malta.robust_margin(motor(), [[-2.0]], {"k": 0.1}, ranges)


def test_an_interval_may_be_a_list() -> None:
    one, two = (malta.robust_margin(motor(), [[-2.0]], {"k": sides}) for sides in ([0.5, 1.5], (0.5, 1.5)))
    assert one.lower == pytest.approx(two.lower, rel=1e-3)
    m = malta.proof.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": [0, 2]})
    assert m.upper == pytest.approx(2, rel=1e-6)


@pytest.mark.parametrize("value", ["a", np.array([1.0, 2.0]), math.nan, 0, -1, True, 1j])
@pytest.mark.parametrize("name", ["tolerance", "time"])
def test_tolerance_and_time_are_numbers_above_zero(name: str, value: Any) -> None:
    says = f": {name}: found .*, expected a number above zero"
    with pytest.raises(InputError, match=r"^robust_margin" + says):
        malta.robust_margin(motor(), [[-2.0]], {"k": 0.1}, **{name: value})
    if name == "tolerance":
        with pytest.raises(InputError, match=r"^margin" + says):
            common_margin([(motor(), [[-2.0]])], {"k": 0.1}, **{name: value})
    with pytest.raises(InputError, match=r"^margin_of_polynomial" + says):
        malta.proof.margin_of_polynomial(lambda k: [1, 1 + k], {"k": (1, 2)}, **{name: value})


def test_time_may_be_infinite() -> None:
    assert malta.robust_margin(motor(), [[-2.0]], {"k": 0.1}, time=math.inf).upper == pytest.approx(15)


@pytest.mark.parametrize("system", [None, "a", 1, LAG, {}], ids=str)
def test_a_system_is_an_uncertain_one(system: Any) -> None:
    with pytest.raises(InputError, match=r"^robust_margin: system: .* expected a malta.uncertain system"):
        malta.robust_margin(system, [[-2.0]], {"k": 0.1})
    with pytest.raises(InputError, match=r"^margin: system: .* expected a malta.uncertain system"):
        common_margin([(system, [[-2.0]])], {"k": 0.1})


LAWS: dict[str, tuple[Any, str]] = {
    "improper": (control.tf([1, 0], [1]), "law: found a TransferFunction with more zeros than poles"),
    "a response": (control.frd([-2 + 1j], [1.0]), "law: found a FrequencyResponseData"),
    "None": (None, "law: found None, expected a Compensator"),
    "a string": ("a", "law: found 'a', expected a Compensator"),
    "complex": ([[1j]], r"law: found complex numbers, as 0\+1j, expected real numbers"),
    "three dimensions": (np.zeros((1, 1, 1)), "law: found a value of type ndarray"),
    "NaN": ([[math.nan]], "law: found NaN or infinity"),
    "a function": (len, "law: found a value of type builtin_function_or_method"),
    "another shape": ([-2.0, 1.0], r"D: found shape \(1, 2\), .*: 1 input u from 1 output y"),
}


@pytest.mark.parametrize(("law", "says"), LAWS.values(), ids=LAWS.keys())
def test_what_is_no_law_is_said(law: Any, says: str) -> None:
    with pytest.raises(InputError, match=r"^compensator: " + says):
        malta.robust_margin(motor(), law, {"k": 0.1})


@pytest.mark.parametrize("places", [[], None, "ab", (motor(), [[-2.0]]), [(motor(), [[-2.0]], 1)]])
def test_places_are_pairs(places: Any) -> None:
    with pytest.raises(InputError, match=r"^margin: places: found .*, expected pairs"):
        common_margin(places, {"k": 0.1})


def test_places_take_gains_as_a_single_loop_does() -> None:
    m = common_margin([(motor(), [[-2.0]]), (motor(), [[-4.0]])], {"k": 0.5})
    assert m.upper == pytest.approx(2.5, rel=1e-6)


def _of(k: Any) -> Any:
    return [[-1.0]], [[k]], [[1.0]]


SYSTEMS: dict[str, tuple[Callable[[], Any], str]] = {
    "nominal None": (lambda: malta.uncertain(_of, None), "nominal: found None"),
    "nominal list": (lambda: malta.uncertain(_of, ["k"]), r"nominal: found \['k'\]"),
    "nominal string": (lambda: malta.uncertain(_of, "k"), "nominal: found 'k'"),
    "nominal value": (lambda: malta.uncertain(_of, {"k": "1"}), "k: found '1', expected a finite number"),
    "ZeroDivisionError": (lambda: malta.uncertain(lambda k: 1 / 0, {"k": 1}), "source: .*ZeroDivisionError"),
    "KeyError": (lambda: malta.uncertain(lambda k: dict[str, int]()["a"], {"k": 1}), "source: .*KeyError: 'a'"),
    "AttributeError": (lambda: malta.uncertain(lambda k: k.foo, {"k": 1}), "source: .*AttributeError"),
    "IndexError": (lambda: malta.uncertain(lambda k: [][1], {"k": 1}), "source: .*IndexError"),
    "returns strings": (lambda: malta.uncertain(lambda k: ("a", "b", "c"), {"k": 1}), "A: found 'a'"),
    "returns digits": (lambda: malta.uncertain(lambda k: ("1", "2", "3"), {"k": 1}), "A: found '1'"),
    "returns None": (lambda: malta.uncertain(lambda k: None, {"k": 1}), "source: .* returns None"),
    "returns complex": (
        lambda: malta.uncertain(lambda k: ([[-1j]], [[k]], [[1]]), {"k": 1}),
        "A: found .*1j.*, expected finite numbers",
    ),
    "returns None inside": (lambda: malta.uncertain(lambda k: ([[None]], 1, 1), {"k": 1}), "A: found None"),
    "ragged": (
        lambda: malta.uncertain(lambda k: ([[1, 2], [3]], [[1]], [[1]]), {"k": 1}),
        "A: found rows of different lengths",
    ),
    "NaN beside k": (
        lambda: malta.uncertain(lambda k: ([[math.nan, k], [k, 1]], [[1], [1]], [[1, 1]]), {"k": 1}),
        "A: found nan",
    ),
    "infinite expression": (
        lambda: malta.uncertain(lambda k: (ca.vertcat(ca.SX(math.inf)), k, 1), {"k": 1}),
        "A: found NaN or infinity",
    ),
    "two matrices": (lambda: malta.uncertain(lambda k: (k, k), {"k": 1}), "source: found 2 matrices"),
    "one matrix": (lambda: malta.uncertain(lambda k: k, {"k": 1}), "source: found 1 matrix,"),
    "terms number": (lambda: malta.uncertain(TWO, {"k": 1}, terms={"k": 1}), "terms.k: found 1"),
    "terms string": (lambda: malta.uncertain(TWO, {"k": 1}, terms={"k": "abc"}), "terms.k: found 'abc'"),
    "terms list": (lambda: malta.uncertain(TWO, {"k": 1}, terms=[1]), r"terms: found \[1\]"),
    "terms strings": (lambda: malta.uncertain(TWO, {"k": 1}, terms={"k": ("a",)}), "terms.k: found 'a'"),
    "sample_time string": (lambda: motor(sample_time="a"), "sample_time: found 'a'"),
    "sample_time True": (lambda: motor(sample_time=True), "sample_time: found True"),
    "sample_time zero": (lambda: motor(sample_time=0), "sample_time: found 0, expected a number above zero"),
    "unknown option": (lambda: motor(foo=1), "foo: found an unknown option, expected one of terms"),
    "builtin": (lambda: malta.uncertain(max, {"k": 1}), "source: .*parameters cannot be read"),
    "no parameters": (lambda: malta.uncertain(lambda *a: 1, {"k": 1}), "source: .*without named parameters"),
    "no source": (lambda: malta.uncertain(None, {"k": 1}), "source: found None"),
    "limits number": (lambda: motor(limits={"k": 1}), "limits.k: found 1"),
    "limits strings": (lambda: motor(limits={"k": ("a", "b")}), "limits.k: found "),
    "limits of one": (lambda: motor(limits={"k": (0,)}), "limits.k: found "),
    "limits reversed": (lambda: motor(limits={"k": (2, 0)}), "limits.k: found .* the lower one first"),
    "limits NaN": (lambda: motor(limits={"k": (math.nan, 2)}), "limits.k: found "),
    "limits list": (lambda: motor(limits=[(0, 1)]), "limits: found "),
    "one row": (
        lambda: malta.uncertain(lambda k: ([[-1, 0], [0, 1]], [[k], [0]], [[1, 0]], 0, [[1, 1], [0, 0]]), {"k": 1}),
        "E: found 1 row and 0 columns of zeros",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("made", "says"), SYSTEMS.values(), ids=SYSTEMS.keys())
def test_what_is_no_system_is_said(made: Callable[[], Any], says: str) -> None:
    with pytest.raises(InputError, match=r"^uncertain: " + says):
        made()


POLYNOMIALS: dict[str, tuple[Callable[[], Any], str]] = {
    "None": (lambda: malta.proof.margin_of_polynomial(None, {"k": (1, 2)}), "coefficients: found None"),
    "a string": (lambda: malta.proof.margin_of_polynomial("abc", {"k": (1, 2)}), "coefficients: found 'abc'"),
    "NaN": (
        lambda: malta.proof.margin_of_polynomial(lambda k: [1, math.nan, k], {"k": (1, 2)}),
        "coefficients: found nan, expected finite numbers",
    ),
    "a string inside": (
        lambda: malta.proof.margin_of_polynomial(lambda k: ["a", k], {"k": (1, 2)}),
        "coefficients: found 'a', expected finite numbers",
    ),
    "degree zero": (
        lambda: malta.proof.margin_of_polynomial(lambda k: [k], {"k": (1, 2)}),
        "coefficients: found 1 coefficient,",
    ),
    "raises": (
        lambda: malta.proof.margin_of_polynomial(lambda k: 1 / 0, {"k": (1, 2)}),
        "source: .*ZeroDivision",
    ),
    "nominal": (
        lambda: malta.proof.margin_of_polynomial(lambda k: [1, k], {"k": (1, 2)}, {"k": LETTER}),
        "k: found 'a', expected a finite number",
    ),
    "box": (
        lambda: malta.proof.margin_of_polynomial(lambda k: [1, k], {"k": (LETTER, LETTER)}),
        r"k: found \('a', 'a'\)",
    ),
    "empty": (lambda: malta.proof.margin_of_polynomial(lambda k: [1, k], {}), "box: found no parameters"),
}


@pytest.mark.parametrize(("asked", "says"), POLYNOMIALS.values(), ids=POLYNOMIALS.keys())
def test_what_is_no_polynomial_is_said(asked: Callable[[], Any], says: str) -> None:
    with pytest.raises(InputError, match=r"^margin_of_polynomial: " + says):
        asked()


def test_a_box_is_refused_in_the_name_of_the_function_that_was_called() -> None:
    with pytest.raises(InputError, match=r"^worst_case_gain: k: found 'a'"):
        box_of(("k",), np.ones(1), (), {"k": LETTER}, {}, caller="worst_case_gain")


@pytest.mark.parametrize("names", [None, "m", {"m": 1.0}])
def test_parameters_of_a_plant_are_given_as_names(names: Any) -> None:
    with pytest.raises(InputError, match=r"^uncertain: names: found .*, expected names of parameters"):
        malta.uncertain(PLANT, names)


def test_parameters_of_a_plant_are_known() -> None:
    with pytest.raises(InputError, match=r"^uncertain: K_X: found an unknown parameter"):
        malta.uncertain(PLANT, ["K_X"])
    with pytest.raises(InputError, match=r"^uncertain: foo: found an unknown option, expected one of at"):
        malta.uncertain(PLANT, ["m"], foo=1)


def test_a_loss_where_a_mass_is_zero_has_an_answer() -> None:
    """Stable for every mass above zero: what is lost beyond has no poles at zero itself."""
    s = malta.uncertain(lambda m: ([[0, 1], [-1 / m, -1 / m]], [[0], [1 / m]], [[1, 0]]), {"m": 1.0})
    for time in (0.05, 2.0):
        m = malta.robust_margin(s, [[-0.5]], {"m": 0.1}, time=time)
        assert m.lower is None or m.lower <= 10 <= m.upper * (1 + 1e-9)


def test_a_settled_margin_gives_no_reason() -> None:
    system = malta.uncertain(lambda k: ([[0, 1], [-k, -1]], [[0], [1]], [[1, 0]]), {"k": 4.0})
    found = malta.robust_margin(system, [[-5.0]], {"k": 0.2})
    assert found.lower is not None
    assert found.lower > 0
    assert found.reason == ""


def test_a_law_of_the_other_sign_is_told() -> None:
    """K of control.lqr is of u = -K x."""
    cart = malta.uncertain(lambda k: ([[0, 1], [k, 0]], [[0], [2]], [[1, 0], [0, 1]]), {"k": 400.0})
    K = control.lqr([[0, 1], [400, 0]], [[0], [2]], np.diag([1e6, 1.0]), [[1.0]])[0]
    found = malta.robust_margin(cart, K, {"k": 0.2})
    assert found.reason == "the nominal loop is unstable, and stable with -F: u = F y is positive feedback"
    assert (malta.robust_margin(cart, -K, {"k": 0.2}).lower or 0.0) > 20
    assert malta.robust_margin(cart, 0 * K, {"k": 0.2}).reason == "the nominal loop is unstable"

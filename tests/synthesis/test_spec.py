"""Design files: what the shipped ones ask for, and what a wrong one is told."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import refusal

import malta

if TYPE_CHECKING:
    from conftest import Design

DATA = Path(__file__).parents[2] / "data" / "tubular.toml"

TS = "sample_time = { value = 50,"
TS_UNIT = 'sample_time = { value = 50, unit = "us" }'
STATE = 'state = { published = "table_II.state" }'
INPUT = 'input = { published = "table_II.input" }'
INTEGRAL = 'integral = { published = "table_II.integral" }'
PROCESS = 'process = { published = "table_II.process_noise" }'
SENSOR = 'sensor = { published = "table_III.std" }'
UNCERTAINTY = 'uncertainty = { published = "position_controller.uncertainty" }'
BASE_X = 'x         = { value = 52.2441, unit = "um" }'
OPERATING_POINT = 'z = { value = 0, unit = "mm" }'
SAMPLED = '"sampled-data" '
DELAY = "delay = 0 "
INPUT_WEIGHTS = "input = { fx_B1 = 1, fy_B1 = 1, fx_B2 = 1.0, fy_B2 = 1, f_D = 0.1 }"  # those of Table II
FORCES = ("fx_B1", "fy_B1", "fx_B2", "fy_B2", "f_D")


def edited(folder: Path, *changes: tuple[str, str], base: str = "calibrated") -> Path:
    """A copy of a shipped design with texts replaced (each must stand there once), read from anywhere."""
    text = Path(f"design/{base}.toml").read_text(encoding="utf-8")
    for old, new in (('"../data/tubular.toml"', f'"{DATA.as_posix()}"'), *changes):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "design.toml"
    path.write_text(text, encoding="utf-8")
    return path


def quantities(values: dict[str, float], unit: str) -> str:
    """An inline table of quantities."""
    return "{ " + ", ".join(f'{k} = {{ value = {v!r}, unit = "{unit}" }}' for k, v in values.items()) + " }"


# --- what is shipped ---


def test_shipped_design_is_read(design: Design) -> None:
    spec = design.spec
    assert spec.path.resolve() == Path(f"design/{spec.name}.toml").resolve()
    assert spec.machine_file.resolve() == DATA.resolve()
    assert spec.parameters == malta.read(DATA, "table1")
    assert (spec.sample_time, spec.delay, dict(spec.operating_point)) == (50e-6, 0, {"z": 0.0})
    assert spec.plant.name == "tubular"


def test_shipped_designs_differ_in_discretization_and_current_loops(designs: dict[str, Design]) -> None:
    asked = {k: (d.spec.discretization, d.spec.current_loop_delay) for k, d in designs.items()}
    assert asked == {"table2": ("backward-euler", False), "calibrated": ("sampled-data", True)}


def test_published_references_are_the_numbers_of_table_II(design: Design, published: dict[str, Any]) -> None:
    weights, plant, table = design.spec.weights, design.plant, published["table_II"]
    assert weights.q.tolist() == [table["state"][s.name] for s in plant.design_states]
    assert weights.r.tolist() == [table["input"][s.name] for s in plant.inputs]
    assert weights.q_i.tolist() == [table["integral"][s.name] for s in plant.outputs]
    process = [table["process_noise"][s.name]["value"] for s in plant.inputs]
    assert weights.process_variance.tolist() == process
    assert weights.q[:3].tolist() == [3.25, 3.25, 0.3]
    assert weights.r.tolist() == [1.0, 1.0, 1.0, 1.0, 0.1]
    assert dict(design.spec.uncertainty) == published["position_controller"]["uncertainty"]


def test_table2_is_plain_SI_with_the_noise_of_table_II(
    designs: dict[str, Design], published: dict[str, Any]
) -> None:
    weights = designs["table2"].spec.weights
    assert (weights.q_base == 1).all()
    assert (weights.r_base == 1).all()
    assert (weights.q_i_base == 1).all()
    assert (np.diag(weights.Q) == weights.q).all()
    sensor = published["table_II"]["sensor_noise"]
    assert weights.sensor_variance.tolist() == [sensor[k]["value"] for k in ("x1", "y1", "x2", "y2", "z")]


def test_calibrated_stands_on_bases_with_the_noise_of_table_III(
    designs: dict[str, Design], published: dict[str, Any]
) -> None:
    weights = designs["calibrated"].spec.weights
    assert weights.q_base[[0, 2, 3, 7]] == pytest.approx([52.2441e-6, 33.463e-6, 2.51881e-3, 12.6885e-3])
    assert weights.q_i_base == pytest.approx([5.22441e-6] * 4 + [33.463e-6])
    assert (weights.r_base == 1).all()
    std = published["table_III"]["std"]
    expected = [(std[k]["value"] * 1e-6) ** 2 for k in ("x1", "y1", "x2", "y2", "z")]
    assert weights.sensor_variance == pytest.approx(expected, rel=1e-14)


def test_weights_are_bryson_scaled(designs: dict[str, Design]) -> None:
    weights = designs["calibrated"].spec.weights
    assert weights.Q[0, 0] == pytest.approx(3.25 / 52.2441e-6**2, rel=1e-14)
    assert weights.Q_i[4, 4] == pytest.approx(30 / 33.463e-6**2, rel=1e-14)
    assert weights.R[4, 4] == 0.1
    assert np.count_nonzero(weights.Q) == 10


# --- the fingerprint of a design ---


def test_sha256_is_of_the_content_not_of_the_text(tmp_path: Path) -> None:
    sha256 = malta.read_design(edited(tmp_path)).sha256
    assert len(bytes.fromhex(sha256)) == 32
    commented = edited(
        tmp_path, (DELAY, "# a comment\n\n  delay   =   0 "), (TS, "sample_time = {value=50.0,")
    )
    assert malta.read_design(commented).sha256 == sha256


def test_sha256_takes_published_references_for_their_numbers(tmp_path: Path) -> None:
    sha256 = malta.read_design(edited(tmp_path)).sha256
    assert malta.read_design(edited(tmp_path, (INPUT, INPUT_WEIGHTS))).sha256 == sha256


def test_sha256_does_not_change_with_words_and_the_spelling_of_paths(tmp_path: Path) -> None:
    plain = malta.read_design(edited(tmp_path))
    reworded = malta.read_design(edited(tmp_path, ('summary = "', 'summary = "other words: ')))
    assert reworded.summary == f"other words: {plain.summary}"
    assert reworded.sha256 == plain.sha256
    for spelling in (os.path.relpath(DATA, tmp_path), f"{DATA.parent.as_posix()}/../data/./tubular.toml"):
        spec = malta.read_design(edited(tmp_path, (f'"{DATA.as_posix()}"', f'"{spelling}"')))
        assert (spec.sha256, spec.parameters) == (plain.sha256, plain.parameters)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (INPUT, INPUT_WEIGHTS.replace("0.1", "0.2")),
        (BASE_X, BASE_X.replace("52.2441", "52.2442")),
        (TS, "sample_time = { value = 51,"),
        (DELAY, "delay = 1 "),
        (SAMPLED, '"zoh"'),
        ("= true", "= false"),
        (SENSOR, 'sensor = { published = "table_II.sensor_noise" }'),
        ('"table1"', '"table4"'),
        (OPERATING_POINT, 'z = { value = 1, unit = "mm" }'),
        (UNCERTAINTY, "uncertainty = { m = 0.2 }"),
    ],
)
def test_sha256_changes_with_what_shapes_the_design(tmp_path: Path, old: str, new: str) -> None:
    sha256 = malta.read_design(edited(tmp_path)).sha256
    assert malta.read_design(edited(tmp_path, (old, new))).sha256 != sha256


# --- what a file may say in more than one way ---


def test_order_of_entries_does_not_matter(tmp_path: Path) -> None:
    turned = "input = { f_D = 0.1, fy_B2 = 1, fx_B2 = 1, fy_B1 = 1, fx_B1 = 1 }"
    weights = malta.read_design(edited(tmp_path, (INPUT, turned))).weights
    assert weights.r.tolist() == [1.0, 1.0, 1.0, 1.0, 0.1]


def test_noise_as_standard_deviation_or_as_variance_is_the_same(tmp_path: Path) -> None:
    std = {"fx_B1": 0.05, "fy_B1": 0.05, "fx_B2": 0.05, "fy_B2": 0.05, "f_D": 0.07}
    variance = {name: value**2 for name, value in std.items()}
    found = [
        malta.read_design(edited(tmp_path, (PROCESS, "process = " + quantities(values, unit)))).weights
        for values, unit in ((std, "N"), (variance, "N^2"))
    ]
    assert found[0].process_variance.tolist() == found[1].process_variance.tolist()
    assert found[0].process_variance[4] == 0.07**2


def test_units_of_bases_and_operating_point_convert(tmp_path: Path) -> None:
    path = edited(
        tmp_path,
        (BASE_X, 'x         = { value = 0.0522441, unit = "mm" }'),
        (OPERATING_POINT, 'z = { value = -0.5, unit = "cm" }'),
        (TS_UNIT, 'sample_time = { value = 0.1, unit = "ms" }'),
    )
    spec = malta.read_design(path)
    assert spec.weights.q_base[0] == pytest.approx(52.2441e-6, rel=1e-15)
    assert dict(spec.operating_point) == {"z": -0.005}
    assert spec.sample_time == 1e-4


def test_delay_and_preset_are_taken(tmp_path: Path) -> None:
    spec = malta.read_design(edited(tmp_path, (DELAY, "delay = 2 "), ('"table1"', '"table4"')))
    assert (spec.delay, spec.parameters.preset) == (2, "table4")
    assert spec.parameters == malta.read(DATA, "table4")


def test_state_weight_may_be_zero(tmp_path: Path) -> None:
    names = ("x", "y", "z", "alpha", "beta")
    numbers = ", ".join(f"{name} = 0" for name in names)
    rates = ", ".join(f"{name}_dot = 1" for name in names)
    weights = malta.read_design(edited(tmp_path, (STATE, f"state = {{ {numbers}, {rates} }}"))).weights
    assert weights.q.tolist() == [0.0] * 5 + [1.0] * 5


# --- files that are wrong ---

FAULTS = {  # old text, new text; field, found, expected
    "no name": ('name = "calibrated"', "", "name", "nothing", "key"),
    "name that leaves the folder": ('"calibrated"', '"../up"', "name", "'../up'", ""),
    "empty name": ('"calibrated"', '""', "name", "''", ""),
    "number for a name": ('"calibrated"', "7", "name", "7", "string"),
    "no preset": ('preset = "table1"', "", "preset", "nothing", "key"),
    "no sample time": (TS_UNIT, "", "sample_time", "nothing", "key"),
    "unknown key": (DELAY, "delay = 0\nspeed = 3 ", "speed", "unknown", "one of name summary machine"),
    "no input weights": (INPUT, "", "weights.input", "nothing", "key"),
    "unknown table of weights": (INPUT, f"{INPUT}\noutput = 3", "weights.output", "unknown", "one of state"),
    "too few weights": (
        INPUT, "input = { fx_B1 = 1, f_D = 1 }", "weights.input", "2 entries (fx_B1 f_D)",
        "each of the 5 inputs (fx_B1 fy_B1 fx_B2 fy_B2 f_D)",
    ),
    "too many weights": (
        INPUT, INPUT_WEIGHTS.replace(" }", ", f_E = 1 }"), "weights.input.f_E",
        "none of the 5 inputs", "one of fx_B1 fy_B1 fx_B2 fy_B2 f_D",
    ),
    "weights of other signals": (
        STATE, 'state = { published = "table_II.input" }', "weights.state.fx_B1", "none of the 10 states",
        "one of x y z alpha beta x_dot y_dot z_dot alpha_dot beta_dot",
    ),
    "integral weights of other signals": (
        INTEGRAL, 'integral = { published = "table_II.input" }', "weights.integral.fx_B1",
        "none of the 5 measured signals", "one of x1 y1 x2 y2 z",
    ),
    "negative": (INPUT, INPUT_WEIGHTS.replace("0.1", "-0.1"), "weights.input.f_D", "-0.1", "above 0"),
    "zero input weight": (INPUT, INPUT_WEIGHTS.replace("0.1", "0"), "weights.input.f_D", "0", "above 0"),
    "NaN weight": (INPUT, INPUT_WEIGHTS.replace("0.1", "nan"), "weights.input.f_D", "nan", "finite"),
    "infinite weight": (INPUT, INPUT_WEIGHTS.replace("0.1", "inf"), "weights.input.f_D", "inf", "finite"),
    "text weight": (INPUT, INPUT_WEIGHTS.replace("0.1", '"a"'), "weights.input.f_D", "'a'", "number"),
    "bool weight": (INPUT, INPUT_WEIGHTS.replace("0.1", "true"), "weights.input.f_D", "True", "number"),
    "zero base": (BASE_X, BASE_X.replace("52.2441", "0"), "bases.state.x", "0 m", "a finite number above 0 m"),
    "negative base": (
        BASE_X, BASE_X.replace("52.2441", "-1"), "bases.state.x", "-1e-06 m", "a finite number above 0 m",
    ),
    "unit of a base": (BASE_X, BASE_X.replace("um", "um/s"), "bases.state.x.unit", "'um/s'", "unit of m"),
    "kg of a base": (BASE_X, BASE_X.replace("um", "kg"), "bases.state.x.unit", "'kg'", "unit of m"),
    "NaN base": (BASE_X, BASE_X.replace("52.2441", "nan"), "bases.state.x.value", "nan", "finite"),
    "base left out": (BASE_X, "", "bases.state", "9 entries (y", "10 states (x y z"),
    "bases of no kind": ('input = "SI"', 'input = "metric"', "bases.input", "'metric'", '"SI"'),
    "no bases": ('input = "SI"', "", "bases.input", "nothing", "key"),
    "noise of other signals": (
        SENSOR, 'sensor = { published = "table_II.process_noise" }', "noise.sensor.fx_B1",
        "none of the 5 measured signals", "one of x1 y1 x2 y2 z",
    ),
    "unit of a noise": (
        PROCESS, "process = " + quantities(dict.fromkeys(FORCES, 1.0), "m"),
        "noise.process.fx_B1.unit", "'m'", "N (standard deviation) or N^2 (variance)",
    ),
    "no noise": (
        PROCESS, "process = " + quantities(dict.fromkeys(FORCES, 0.0), "N"),
        "noise.process.fx_B1", "0 N", "a finite number above 0 N",
    ),
    "negative variance": (
        PROCESS, "process = " + quantities(dict.fromkeys(FORCES, -1.0), "N^2"),
        "noise.process.fx_B1", "-1", "a finite number above 0",
    ),
    "noise whose square is infinite": (
        PROCESS, "process = " + quantities(dict.fromkeys(FORCES, 1e200), "N"),
        "noise.process.fx_B1", "inf (N)^2", "a finite number above 0",
    ),
    "noise whose square is 0": (
        PROCESS, "process = " + quantities(dict.fromkeys(FORCES, 1e-200), "N"),
        "noise.process.fx_B1", "0 (N)^2", "a finite number above 0",
    ),
    "base whose square is infinite": (
        BASE_X, BASE_X.replace("52.2441", "1e206"), "bases", "[1e+200, 5.22441", "square is a number",
    ),
    "base whose square is 0": (
        BASE_X, BASE_X.replace("52.2441", "1e-194"), "bases", "[1e-200, 5.22441", "square is a number",
    ),
    "key of two lines": (DELAY, 'delay = 0\n"a\\nb" = 3 ', "a\nb", "an unknown key", "one of name summary machine"),
    "discretization": (SAMPLED, '"tustin" ', "discretization", "'tustin'", "'backward-euler', 'zoh'"),
    "delay of -1": (DELAY, "delay = -1 ", "delay", "-1", "greater than or equal to 0"),
    "delay of 11": (DELAY, "delay = 11 ", "delay", "11", "less than or equal to 10"),
    "delay in words": (DELAY, 'delay = "1" ', "delay", "'1'", "number"),
    "word for a switch": ("= true", '= "yes"', "current_loop_delay", "'yes'", "boolean"),
    "sample time of 0": (TS, "sample_time = { value = 0,", "sample_time", "0 s", "more than 0 s"),
    "backwards": (TS, "sample_time = { value = -50,", "sample_time", "-5e-05 s", "more than 0 s"),
    "infinite sample time": (TS, "sample_time = { value = inf,", "sample_time.value", "inf", "finite"),
    "sample time in m": (TS_UNIT, TS_UNIT.replace("us", "m"), "sample_time.unit", "'m'", "unit of s"),
    "sample time in Hz": (TS_UNIT, TS_UNIT.replace("us", "kHz"), "sample_time.unit", "'kHz'", "unit of s"),
    "sample time without unit": (TS_UNIT, "sample_time = 50e-6", "sample_time", "5e-05", ""),
    "an unknown state": (
        OPERATING_POINT, 'gamma = { value = 0, unit = "rad" }', "operating_point.gamma", "an unknown state",
        "one of x y z alpha beta",
    ),
    "unit of the operating point": (
        OPERATING_POINT, OPERATING_POINT.replace("mm", "rad"), "operating_point.z.unit", "'rad'",
        "unit of m",
    ),
    "unknown published table": (
        STATE, 'state = { published = "table_V.state" }', "weights.state", "'table_V.state'", "published",
    ),
    "number for a published table": (STATE, "state = { published = 3 }", "weights.state", "3", "published"),
    "unknown published entry": (
        UNCERTAINTY, 'uncertainty = { published = "position_controller.margins" }', "uncertainty",
        "'position_controller.margins'", "published",
    ),
    "unknown parameter": (UNCERTAINTY, "uncertainty = { mass = 0.2 }", "uncertainty.mass", "unknown", "I_xx"),
    "wholly uncertain": (UNCERTAINTY, "uncertainty = { m = 1 }", "uncertainty.m", "1", "less than 1"),
    "not uncertain": (UNCERTAINTY, "uncertainty = { m = 0 }", "uncertainty.m", "0", "greater than 0"),
    "bare uncertainty": (UNCERTAINTY, "uncertainty = 0.2", "uncertainty", "0.2", ""),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "field", "found", "expected"), FAULTS.values(), ids=FAULTS)
def test_wrong_design_file_is_refused(
    tmp_path: Path, old: str, new: str, field: str, found: str, expected: str
) -> None:
    path = edited(tmp_path, (old, new))
    error = refusal(lambda: malta.read_design(path), path)
    assert error.field == field
    assert found in error.found
    assert expected in error.expected


def test_delay_does_not_go_with_backward_euler(tmp_path: Path) -> None:
    path = edited(tmp_path, (DELAY, "delay = 1 "), base="table2")
    error = refusal(lambda: malta.read_design(path), path)
    assert (error.field, error.found) == ("delay", "1 with backward-euler, which has none")


def test_unknown_preset_names_the_machine_file(tmp_path: Path) -> None:
    path = edited(tmp_path, ('"table1"', '"table9"'))
    error = refusal(lambda: malta.read_design(path), DATA)
    assert (error.found, error.expected) == ("no preset 'table9'", "one of table1, table4, table1_currents")


def test_missing_machine_file_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path, (DATA.as_posix(), "nowhere/tubular.toml"))
    with pytest.raises(
        malta.InputError, match=r"tubular\.toml: found no such file, expected a TOML file$"
    ) as caught:
        malta.read_design(path)
    assert caught.value.where.startswith(str(tmp_path / "nowhere"))


@pytest.mark.parametrize("machine", ["3", "[1]", '{ path = "x" }'])
def test_machine_is_a_path(tmp_path: Path, machine: str) -> None:
    path = edited(tmp_path, (f'"{DATA.as_posix()}"', machine))
    error = refusal(lambda: malta.read_design(path), path)
    assert (error.field, error.expected) == ("machine", "the path of the machine's data file")


def test_missing_empty_and_malformed_design_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "nothing.toml"
    assert refusal(lambda: malta.read_design(path), path).found == "no such file"
    path.write_bytes(b"")
    assert refusal(lambda: malta.read_design(path), path).field == "machine"
    path.write_text("name = ")
    assert "TOML error" in refusal(lambda: malta.read_design(path), path).found
    assert refusal(lambda: malta.read_design(tmp_path), tmp_path).found == "Is a directory"


def test_truncated_design_file_is_refused(tmp_path: Path) -> None:
    path = edited(tmp_path)
    content = path.read_bytes()
    complete = content.rindex(b"}") + 1
    for length in range(0, complete, 11):
        path.write_bytes(content[:length])
        with pytest.raises(malta.InputError):
            malta.read_design(path)
    path.write_bytes(content[:complete])
    assert malta.read_design(path).name == "calibrated"


# --- weights made in code ---


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("q", [-1.0] + [1.0] * 9, "not negative"),
        ("q", [math.nan] + [1.0] * 9, "finite"),
        ("q", [[1.0] * 10], "vector"),
        ("r", [0.0] * 5, "above 0"),
        ("q_i", [-1.0] * 5, "not negative"),
        ("q_base", [0.0] * 10, "above 0"),
        ("q_base", [1.0] * 9, "one base for each weight"),
        ("r_base", [1.0] * 6, "one base for each weight"),
        ("process_variance", [0.0] * 5, "above 0"),
        ("sensor_variance", [math.inf] * 5, "finite"),
    ],
)
def test_weights_refuse_what_is_no_weight(
    designs: dict[str, Design], name: str, value: list[Any], expected: str
) -> None:
    weights = designs["table2"].spec.weights
    given = {k: getattr(weights, k) for k in weights.__dataclass_fields__} | {name: np.array(value)}
    error = refusal(lambda: malta.synthesis.Weights(**given), Path("Weights"))
    assert expected in error.expected


def test_weights_cannot_be_written_to(designs: dict[str, Design]) -> None:
    with pytest.raises(ValueError, match="read-only"):
        designs["table2"].spec.weights.q[0] = 1.0

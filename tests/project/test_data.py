"""Machine data: what the shipped file holds, how units convert, and what a wrong file is told."""

from __future__ import annotations

import math
import tomllib
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from conftest import refusal

import malta
from malta import units
from malta.machines.tubular import plant as tubular
from malta.model.parameters import units_of
from malta.model.printed import read_published
from malta.tables import load_toml
from malta.units import to_si, unit_factor

if TYPE_CHECKING:
    pass

DATA = Path("data/tubular.toml")
ASSUMED = {"l_S", "g", "F_c", "phi_c", "V_max", "I_max", "T_d", "s_z"} | {  # where the paper is silent
    "k_t", "d_t", "R_dc", "f_clk", "t_dead",
    "dK_A", "dK_B", "kappa", "e_x", "e_y", "c_x", "c_y",
    "s_i", "d_i", "q_i", "tau_s", "T_s",
}  # fmt: skip
TRUNCATION_STEP = 7  # bytes

L_S = '{ value = 93.75,     unit = "mm", '
M = 'm      = { value = 0.360,     unit = "kg",      tag = "printed",  source = "Table IV" }'
W_CC = 'value = 3000,      unit = "rad/s"'
I_XX = "I_xx   ="
K_A4 = "K_A    = { value = 8330,"


def file_values() -> dict[str, Any]:
    return tomllib.loads(DATA.read_text(encoding="utf-8"))


def edited(folder: Path, *changes: tuple[str, str]) -> Path:
    """A copy of the machine's file with texts replaced; each must stand there once."""
    text = DATA.read_text(encoding="utf-8")
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return path


# --- what is shipped ---


def test_default_preset_is_table1() -> None:
    assert malta.read(DATA) == malta.read(DATA, preset="table1")
    assert malta.read(DATA).preset == "table1"


def test_presets_differ_in_attraction_bearing_distance_and_noise_of_currents_only() -> None:
    table1: Any = malta.read(DATA, "table1")
    table4: Any = malta.read(DATA, "table4")
    assert (table4.K_A, table4.l_B, table4.preset) == (8330.0, 45.347e-3, "table4")
    assert replace(table4, K_A=8626.7, l_B=44.560e-3, preset="table1") == table1
    noisy: Any = malta.read(DATA, "table1_currents")
    assert replace(noisy, s_i=0.0, preset="table1") == table1


def test_every_value_has_unit_tag_and_source() -> None:
    content = file_values()
    tables = [content["parameters"], *content["presets"].values()]
    for table in tables:
        for name, entry in table.items():
            assert set(entry) == {"value", "unit", "tag", "source"}, name
            assert entry["tag"] in ("printed", "computed", "assumed"), name
            assert entry["unit"], name
            assert len(entry["source"]) >= len("Table IV"), name
    names = {name for table in tables for name in table}
    assert names == set(units_of(tubular.Parameters))


def test_assumptions_are_tagged_assumed() -> None:
    content = file_values()
    tables = [content["parameters"], *content["presets"].values()]
    assumed = {name for table in tables for name, entry in table.items() if entry["tag"] == "assumed"}
    assert assumed == ASSUMED


def test_shipped_values_in_SI(par: tubular.Parameters) -> None:
    expected = {"l_S": 0.09375, "L_p": 0.015, "L": 2.8e-3, "Psi": 8.3e-3, "C_dc": 0.088, "f_pwm": 1e5}
    expected |= {
        "T_cc": 5e-5,
        "T_d": 7.5e-5,
        "r_max": 6e-4,
        "s_r": 4.1e-7,
        "n_y1": 1.137,
        "dp": 1e-6,
        "l_B": 0.04456,
    }
    assert {name: getattr(par, name) for name in expected} == expected
    assert par.pm_cc == pytest.approx(math.pi / 3, rel=1e-15)


def test_every_physical_field_is_a_float(par: tubular.Parameters) -> None:
    assert {type(getattr(par, f.name)) for f in fields(par) if f.name != "preset"} == {float}


# --- what the paper prints, and what follows from it ---


def test_preset_table1_meets_the_poles_of_table_I(par: tubular.Parameters, published: dict[str, Any]) -> None:
    poles, digits = published["table_I"]["poles"], published["table_I"]["digits"]
    assert round(math.sqrt(2 * par.K_A / par.m), digits) == poles["x"] == 218.92
    assert round(par.l_B * math.sqrt(2 * par.K_A / par.I_xx), digits) == poles["alpha"] == 157.53
    assert round(poles["x"] ** 2 * par.m / 2, 1) == par.K_A
    assert par.l_B == pytest.approx(poles["alpha"] * math.sqrt(par.I_xx / (2 * par.K_A)), abs=0.5e-6)


def test_preset_table4_keeps_the_tilt_poles_only() -> None:
    par: Any = malta.read(DATA, "table4")
    assert round(math.sqrt(2 * par.K_A / par.m), 2) == 215.12
    assert round(par.l_B * math.sqrt(2 * par.K_A / par.I_xx), 2) == 157.53


def test_induced_voltage_constant_is_pi_psi_over_pole_size(par: tubular.Parameters) -> None:
    assert round(math.pi * par.Psi / par.L_p, 2) == par.K_ind


def test_kinetic_energy_raises_the_dc_link_as_published(
    par: tubular.Parameters, published: dict[str, Any]
) -> None:
    speed, rise = published["dc_link"]["speed"], published["dc_link"]["rise"]
    assert (speed["unit"], rise["unit"]) == ("m/s", "V")
    fed_back = math.sqrt(par.V_dc**2 + par.m * speed["value"] ** 2 / par.C_dc) - par.V_dc
    assert round(fed_back, 2) == rise["value"]


def test_table_IV_is_printed_and_whole_in_preset_table4(published: dict[str, Any]) -> None:
    content, table = file_values(), published["table_IV"]
    entries = content["parameters"] | content["presets"][table["preset"]]
    assert table["preset"] == "table4"
    assert {name: entries[name]["tag"] for name in table["parameters"]} == dict.fromkeys(
        table["parameters"], "printed"
    )
    assert {name for name, e in entries.items() if e["source"].startswith("Table IV")} == set(
        table["parameters"]
    )


def test_current_controller_as_published(par: tubular.Parameters, published: dict[str, Any]) -> None:
    table = published["current_controller"]
    crossover, margin = table["crossover"], table["phase_margin"]
    assert to_si(crossover["value"], crossover["unit"], "rad/s", "published", "crossover") == par.w_cc
    assert to_si(margin["value"], margin["unit"], "rad", "published", "phase_margin") == par.pm_cc


def test_travel_and_resolution_as_published(par: tubular.Parameters, published: dict[str, Any]) -> None:
    assert to_si(**published["travel"]["z_ss"], si_unit="m", where="published", name="z_ss") == par.z_max
    assert published["figure_14"]["resolution"]["value"] * 1e-6 == par.dp


# --- units ---


@pytest.mark.parametrize(
    ("value", "unit", "si_unit", "expected"),
    [
        (93.75, "mm", "m", 0.09375),
        (360.0, "g", "kg", 0.36),
        (180.0, "deg", "rad", math.pi),
        (100.0, "kHz", "Hz", 1e5),
        (50.0, "us", "s", 5e-5),
        (75.0, "\u00b5s", "s", 7.5e-5),  # the micro sign
        (75.0, "\u03bcs", "s", 7.5e-5),  # the Greek letter
        (2.8, "mH", "H", 2.8e-3),
        (8.3, "mWb", "Wb", 8.3e-3),
        (88.0, "mF", "F", 0.088),
        (1.7, "V / (m/s)", "V s/m", 1.7),
        (3.0, "J", "N m", 3.0),
        (1.3805, "g m^2", "kg m^2", 1.3805e-3),
        (687.259, "mrad/s", "rad/s", 0.687259),
        (7.06, "um^2", "m^2", 7.06e-12),
        (2.0, "inch", "m", 0.0508),
        (1.0, "turn/s", "rad/s", 2 * math.pi),
        (3000.0, "rpm", "rad/s", 100 * math.pi),
        (-4.0, "mm", "m", -4e-3),
        (0.0, "mm", "m", 0.0),
    ],
)
def test_units_convert(value: float, unit: str, si_unit: str, expected: float) -> None:
    assert to_si(value, unit, si_unit, "file", "name") == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("value", [93.75, 52.2441, 0.6, 15.0, 44.56, 0.1, 1e-9])
def test_decimal_prefixes_convert_exactly(value: float) -> None:
    assert to_si(value, "mm", "m", "file", "name") == value / 1000
    assert to_si(value, "um", "m", "file", "name") == value / 1000000
    assert to_si(value, "m", "m", "file", "name") == value
    assert to_si(value, "km", "m", "file", "name") == value * 1000


@pytest.mark.parametrize(
    ("unit", "si_unit"),
    [
        ("kg", "m"),
        ("Hz", "rad/s"),
        ("1/s", "rad/s"),
        ("rad/s", "Hz"),
        ("rad", "percent"),
        ("", "m"),
        ("mmm", "m"),
        ("furlongs per fortnight", "m/s"),
        ("3 mm", "m"),
        ("mm*", "m"),
        ("(m", "m"),
        ("N", "N m"),
        ("N/m", "N"),
        ("__import__('os')", "m"),
    ],
)
def test_unit_of_another_kind_is_refused(unit: str, si_unit: str) -> None:
    error = refusal(lambda: to_si(1.0, unit, si_unit, "file.toml", "name"), Path("file.toml"))
    turns = ", as turn/s" if (unit, si_unit) == ("Hz", "rad/s") else ""
    expected = f"a unit of {si_unit}{turns}"
    assert (error.field, error.found, error.expected) == ("name.unit", repr(unit), expected)


@pytest.mark.slow_for("unit13")
@pytest.mark.parametrize(
    "unit",
    [
        "10**10**10 us",
        "1 9**9**9**9",
        "us^9^9",
        "s^10",
        "s**(2)",
        "m^0.5",
        "(((min^9)^9)^9)^9",
        "((((min^9)^9)^9)^9)^9",
        "(nm^9)^9",
        "min^9 " * 33,
        "g^9 " * 40,
        "(" * 150,
        "m " * 99 + "!",
        "m " * 100_000,
        "m_s",
    ],
)
def test_text_that_is_no_product_of_units_is_refused_at_once(unit: str) -> None:
    with pytest.raises(
        malta.InputError,
        match=r"^file.toml: name.unit: found '.{1,50}, expected a unit of s( \(did you mean 's'\?\))?$",
    ):
        to_si(1.0, unit, "s", "file.toml", "name")
    with pytest.raises(malta.InputError, match=r"^data: unit: found '.{1,50}, expected a unit$"):
        malta.model.in_unit(1.0, unit)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("(m/s^2)^2", 1),
        ("(N) s / (m)", 1),
        ("N m / (m)", 1),
        ("kg*mm/s**2", 1e-3),
        ("m s^-2", 1),
        ("((mm))", 1e-3),
        ("1/ms", 1e3),
        ("µm", 1e-6),
        ("mW/(g K)", 1),
        ("mbar", 100),
        ("l/min", 1e-3 / 60),
        ("pC/N", 1e-12),
        ("%", 0.01),
        ("1", 1),
    ],
)
def test_units_are_products_with_powers(unit: str, factor: float) -> None:
    assert unit_factor(unit, "name") == pytest.approx(factor, rel=1e-12)


@pytest.mark.slow
def test_known_symbols_are_the_units_of_pint() -> None:
    """Each with each prefix, bit by bit; in products, whose factors round by their order, nearly so."""
    single = [prefix + symbol for prefix in ("", *units._PREFIXES) for symbol in units._SYMBOLS]
    tails = ("/s^2", "/(V)^2", " m / (rad/ms)", "/(kg m)", "^2/V", "*s**-1", " / m / rad", "(m)")
    for unit in [*single, *units._UNPREFIXED_SYMBOLS, *(one + tail for one in single for tail in tails)]:
        found, (factor, root) = units._plain_root_units(unit), units._pint_root_units(unit)
        assert found is not None, unit
        assert found[1] == root, unit
        assert found[0] == (factor if unit in single else pytest.approx(factor, rel=1e-15, abs=0)), unit
    for unit in ("min", "inch", "meter", "Nm", "m/((s/A))", "(m s)^2", "newtons"):
        assert units._plain_root_units(unit) is None, unit


# --- files that are wrong ---


FAULTS = {  # old text, new text; field, found, expected
    "kg for m": (L_S, L_S.replace("mm", "kg"), "parameters.l_S.unit", "'kg'", "unit of m"),
    "Hz": (W_CC, W_CC.replace("rad/s", "Hz"), "parameters.w_cc.unit", "'Hz'", "rad/s"),
    "no unit": (L_S, L_S.replace("mm", "xx"), "parameters.l_S.unit", "'xx'", "unit of m"),
    "unit left out": (L_S, "{ value = 93.75, ", "parameters.l_S.unit", "nothing", "key"),
    "missing parameter": (M, "", "parameters.m", "nothing", "kg"),
    "unknown parameter": (
        M, f"{M}\nq = {{ value = 1, unit = 'kg', tag = 'assumed', source = 'x' }}", "parameters.q",
        "unknown", "I_xx",
    ),
    "unknown key": (M, M.replace("unit", "colour = 3, unit"), "parameters.m.colour", "unknown", "keys"),
    "unknown tag": (M, M.replace("printed", "guess"), "parameters.m.tag", "'guess'", "printed"),
    "bare number": (M, "m = 0.36", "parameters.m", "0.36", ""),
    "NaN": (L_S, L_S.replace("93.75", "nan"), "parameters.l_S.value", "nan", "finite"),
    "-inf": (L_S, L_S.replace("93.75", "-inf"), "parameters.l_S.value", "-inf", "finite"),
    "1e999": (L_S, L_S.replace("93.75", "1e999"), "parameters.l_S.value", "inf", "finite"),
    "text": (L_S, L_S.replace("93.75", '"93.75"'), "parameters.l_S.value", "'93.75'", "number"),
    "bool": (L_S, L_S.replace("93.75", "true"), "parameters.l_S.value", "True", "number"),
    "list": (L_S, L_S.replace("93.75", "[1]"), "parameters.l_S.value", "[1]", "number"),
    "unknown in preset": (K_A4, K_A4.replace("K_A", "K_Z"), "presets.table4.K_Z", "unknown", "K_A"),
    "unknown machine": ('"tubular"', '"planar9"', "machine", "'planar9'", "'tubular'"),
    "no machine": ('machine = "tubular"', "", "machine", "nothing", "key"),
    "unknown default": ('= "table1"', '= "table9"', "presets", "'table9'", "table1, table4"),
    "no default": ('default_preset = "table1"', "", "default_preset", "nothing", "key"),
    "doubled key": (I_XX, "m =", "", "TOML error", "TOML file"),
    "malformed number": ("0.360,", "0.360.1,", "", "TOML error", "TOML file"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "field", "found", "expected"), FAULTS.values(), ids=FAULTS)
def test_wrong_machine_file_is_refused(
    tmp_path: Path, old: str, new: str, field: str, found: str, expected: str
) -> None:
    path = edited(tmp_path, (old, new))
    error = refusal(lambda: malta.read(path), path)
    assert error.field == field
    assert found in error.found
    assert expected in error.expected


@pytest.mark.parametrize(
    ("old", "new", "name", "found", "expected"),
    [
        (M, M.replace("0.360", "-0.360"), "parameters.m", -0.36, "a finite number above 0 in kg"),
        (M, M.replace("0.360", "0"), "parameters.m", 0.0, "a finite number above 0 in kg"),
        (L_S, '{ value = 1e308, unit = "km", ', "parameters.l_S", math.inf, "a finite number above 0 in m"),
        (
            K_A4,
            K_A4.replace("8330", "-1"),
            "presets.table4.K_A",
            -1.0,
            "a finite number of at least 0 in N/m",
        ),
    ],
    ids=["negative", "zero", "infinite in SI", "negative in the other preset"],
)
def test_value_that_no_machine_has_is_refused(
    tmp_path: Path, old: str, new: str, name: str, found: float, expected: str
) -> None:
    path = edited(tmp_path, (old, new))
    error = refusal(lambda: malta.read(path), path)
    assert error.field == name
    assert float(error.found.split()[0]) == found
    assert error.expected == expected


def test_malformed_file_says_the_line(tmp_path: Path) -> None:
    path = edited(tmp_path, (I_XX, "m ="))
    assert "at line 12" in refusal(lambda: malta.read(path), path).found


def test_unknown_preset_lists_the_known_ones() -> None:
    error = refusal(lambda: malta.read(DATA, preset="table9"), DATA)
    assert (error.field, error.found) == ("presets", "no preset 'table9'")
    assert error.expected == "one of table1, table4, table1_currents"


def test_preset_that_leaves_a_value_open_is_refused(tmp_path: Path) -> None:
    (own,) = [
        line
        for line in DATA.read_text(encoding="utf-8").splitlines()
        if line.startswith("K_A    = { value = 86")
    ]
    path = edited(
        tmp_path,
        (own + "\n", ""),
        ("[presets.table4]", f"{own}\n[presets.table4]"),  # at the end of table1
        ("K_A    = { value = 8330,", "K_D    = { value = 8330,"),
        ('"N/m", tag = "p', '"N/A", tag = "p'),
    )
    assert malta.read(path) == malta.read(DATA)
    error = refusal(lambda: malta.read(path, preset="table4"), path)
    assert (error.field, error.expected) == ("parameters.K_A", "a value in N/m")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "nothing"),
        (b"\n# only a comment\n", "nothing"),
        (b"\xff\xfe\x00m", "not UTF-8"),
        (b"\x00", "TOML error"),
        (b"a = " + b"[" * 5000, "TOML error"),
        (b"a = " + b"1" * 5000, "TOML error"),
        (b'machine = "a\\u0000b"', "'a\\x00b'"),
    ],
)
def test_empty_or_foreign_file_is_refused(tmp_path: Path, content: bytes, found: str) -> None:
    path = tmp_path / "machine.toml"
    path.write_bytes(content)
    assert found in refusal(lambda: malta.read(path), path).found


def test_missing_file_folder_and_path_through_a_file_are_refused(tmp_path: Path) -> None:
    missing, through = tmp_path / "nothing.toml", DATA / "machine.toml"
    assert refusal(lambda: malta.read(missing), missing).found == "no such file"
    assert refusal(lambda: malta.read(tmp_path), tmp_path).found == "Is a directory"
    assert refusal(lambda: malta.read(through), through).found == "Not a directory"


def test_name_with_a_null_byte_is_refused(tmp_path: Path) -> None:
    expected = r"found a null byte in its name, expected a readable TOML file$"
    for read in (malta.read, malta.read_design):
        with pytest.raises(malta.InputError, match=expected):
            read("a\0b")
    design = tmp_path / "design.toml"
    text = Path("design/table2.toml").read_text(encoding="utf-8")
    design.write_text(text.replace("../data/tubular.toml", "a\\u0000b"), encoding="utf-8")
    with pytest.raises(malta.InputError):
        malta.read_design(design)


@pytest.mark.slow
def test_truncated_file_is_refused_or_complete(tmp_path: Path) -> None:
    content, path, whole = DATA.read_bytes(), tmp_path / "machine.toml", malta.read(DATA)
    accepted = []
    for length in range(0, len(content), TRUNCATION_STEP):
        path.write_bytes(content[:length])
        with suppress(malta.InputError):
            assert malta.read(path) == whole
            accepted.append(length)
    complete = content.index(b'"', content.index(b"2 K_A l_B^2 / I_xx")) + len('" }')  # all that table1 needs
    assert complete <= min(accepted)


def test_missing_published_data_is_refused(tmp_path: Path) -> None:
    path = edited(tmp_path)
    beside = tmp_path / "published" / "machine.toml"
    assert refusal(lambda: read_published(path), beside).found == "no such file"
    assert load_toml("data/published/tubular.toml") == read_published(DATA)

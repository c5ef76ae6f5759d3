"""Controllers whose target may change gains, limits, references and monitors: the same bits, and what is refused."""

from __future__ import annotations

import ctypes
import re
import struct
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import EXACT, HERE, controller, require, run, run_test, target

import malta
from malta.firmware.calibration import (
    checksum_of,
    counts_of,
    gain_lines,
    is_tunable,
    parameters_of,
    proven_share,
)
from malta.firmware.export import a2l_text, folder_files
from malta.firmware.flight import Native, compile_controller, view
from malta.firmware.period_functions import decide
from malta.firmware.program import Precision
from malta.firmware.signals import Target
from malta.firmware.sources import sources
from malta.firmware.supervised_flight import compile_supervised
from malta.firmware.supervisor_text import NUMBERS
from malta.firmware.vectors import record_vectors
from malta.margins.tuned_gains import GainBox
from malta.simulation.engine.compiled import compiler
from malta.synthesis.law import gains_of

pytestmark = pytest.mark.usefixtures("proven_once")


@cache
def tunable(name: str, precision: Precision = "double") -> Target:
    return replace(target(name, precision), tunable=True)


@pytest.mark.slow_for("halbach-float")
@pytest.mark.parametrize(
    ("name", "precision"),
    [
        *(("halbach", "double"), ("halbach", "float")),
        pytest.param("robust", "double", marks=pytest.mark.slow),
        pytest.param("tubular_pid", "float", marks=pytest.mark.slow),
        pytest.param("robust_observer", "float", marks=pytest.mark.slow),
    ],
)
def test_default_parameters_compute_the_bits_of_constants(name: str, precision: Precision) -> None:
    """The recorded vectors of both have the same checksums of all outputs and of the whole state."""
    plain, with_record = record_vectors(target(name, precision)), record_vectors(tunable(name, precision))
    assert [v.checksums for v in with_record] == [v.checksums for v in plain]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), [("halbach", "double"), ("robust", "float")])
def test_the_folder_compiles_without_a_warning_and_passes(
    name: str, precision: Precision, tmp_path: Path
) -> None:
    require("gcc")
    for file, text in folder_files(tunable(name, precision), "0" * 64, proof=False).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    warnings = ("-Werror", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Wundef")
    done = run_test(HERE, tmp_path, *EXACT, *warnings)
    assert (done.returncode, done.stderr) == (0, "")
    assert "pass: 4 vectors" in done.stdout
    report = (tmp_path / "REPORT.md").read_text(encoding="utf-8")
    assert "No margin is proven for other gains than the default ones (it was not asked for)" in report
    (more,) = re.findall(r"this computer \d+ in place of \d+ \(([+-][\d.]+) %\)", report)
    assert -10 < float(more) < 8


@pytest.mark.slow
def test_names_of_the_machine_s_own_equations_are_no_gains() -> None:
    """K is a gain and, of the planar motor's coils, the matrix of their wrenches."""
    names = [name for block in decide(tunable("planar_pid")).blocks for name in block.results]
    assert "wrench_matrix_K" in names
    assert "K" not in names


@cache
def compiled() -> Native:
    if compiler() is None:
        pytest.skip("no C compiler")
    return compile_controller(tunable("halbach"))


def record(native: Native) -> Any:
    """A record of parameters as its C has it: the members of the default one."""
    t = native.target
    members: list[Any] = [(p.field.name, ctypes.c_double * p.field.size) for p in parameters_of(t)]
    members += [("samples", ctypes.c_int32 * len(counts_of(t))), ("checksum", ctypes.c_uint32)]
    kind: Any = type("Parameters", (ctypes.Structure,), {"_fields_": members})
    return kind.in_dll(native.lib, f"{native.name}_default_parameters")


def copy(native: Native) -> Any:
    default = record(native)
    return type(default).from_buffer_copy(default)


def seal(native: Native, p: Any) -> None:
    call = getattr(native.lib, f"{native.name}_checksum")
    call.restype = ctypes.c_uint32
    p.checksum = call(ctypes.byref(p))


def begun(native: Native) -> Any:
    state = native.State()
    getattr(native.lib, f"{native.name}_init")(ctypes.byref(state))
    return state


def test_the_default_record_has_the_checksum_that_the_target_computes() -> None:
    native = compiled()
    default, own = record(native), copy(native)
    assert default.checksum == checksum_of(native.target)
    seal(native, own)
    assert own.checksum == default.checksum
    assert list(own.K) == [v for v in gains_of(controller("halbach"))["K"].nonzeros() if abs(v) != 1]


def test_another_record_counts_from_the_next_step_on() -> None:
    """K larger by 5 %: the force is that of the estimate by these gains, beside the observed disturbance by 1."""
    native = compiled()
    forces = []
    for factor in (1.0, 1.05):
        state, p = begun(native), copy(native)
        p.K[:] = [factor * value for value in p.K]
        seal(native, p)
        assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 1
        inputs, outputs = native.Inputs(), native.Outputs()
        view(inputs, "y")[:], view(inputs, "y_valid")[:] = 1e-4, 1
        getattr(native.lib, f"{native.name}_step")(*(ctypes.byref(r) for r in (state, inputs, outputs)))
        forces.append(float(view(outputs, "v")[0]))
        x, rate, disturbance = view(outputs, "xi_hat")
        assert forces[-1] == pytest.approx(-(p.K[0] * x + p.K[1] * rate + disturbance), rel=1e-12)
    assert abs(forces[1]) > 1.02 * abs(forces[0])


@pytest.mark.parametrize(
    ("member", "entry", "change"),
    [
        ("K", 0, lambda v: 1.101 * v),
        ("K", 1, lambda v: 0.899 * v),
        ("L", 0, lambda v: np.nan * v),
        ("force_limit", 0, lambda v: np.nextafter(v, np.inf)),
        ("current_limit", 2, lambda v: -v),
        ("position", 0, lambda v: 1.001 * v),
        ("speed", 0, lambda v: np.inf * v),
        ("threshold", 3, lambda v: 1.001 * v),
        ("samples", 3, lambda v: v + 1),
        ("samples", 0, lambda v: 0 * v),
    ],
)
def test_a_number_out_of_its_range_changes_nothing(member: str, entry: int, change: Any) -> None:
    native = compiled()
    state, p = begun(native), copy(native)
    before = state.parameters
    getattr(p, member)[entry] = change(getattr(p, member)[entry])
    seal(native, p)
    assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 0
    assert state.parameters == before == ctypes.addressof(record(native))


@pytest.mark.parametrize(
    ("K", "L", "accepted"),
    [
        ((1.19, 1.19), 1.0, 1),
        ((0.81, 0.81), 1.0, 1),
        ((1.01, 1.0), 1.0, 0),
        ((1.21, 1.21), 1.0, 0),
        ((1.0, 1.0), 1.001, 0),
    ],
)
def test_gains_within_a_proven_box_share_a_factor(K: tuple[float, float], L: float, accepted: int) -> None:
    """What is proven is a factor of each axis on K and Ki: one entry alone, or another filter, is refused."""
    if compiler() is None:
        pytest.skip("no C compiler")
    native = compile_controller(proven())
    state, p = begun(native), copy(native)
    p.K[:] = [factor * value for factor, value in zip(K, p.K, strict=True)]
    p.L[0] *= L
    seal(native, p)
    call = getattr(native.lib, f"{native.name}_set_parameters")
    assert call(ctypes.byref(state), ctypes.byref(p)) == accepted


@cache
def proven() -> Target:
    return replace(tunable("halbach"), gains=GainBox(0.2, ((0,),)))


def test_the_record_of_proven_gains_compiles_without_a_warning(tmp_path: Path) -> None:
    require("gcc")
    for file, text in sources(proven(), "0" * 64).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    warnings = ("-Werror", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Wundef")
    done = run(["gcc", *EXACT, *warnings, "-c", "halbach_parameters.c"], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_is_proven_of_gains_is_said() -> None:
    assert gain_lines(proven())[1:] == [
        "Ki for the forces (F_x) are those of the gain file times a factor for each of these",
        "axes within 20 % of 1; L and the gains of the current loops stay.",
    ]
    asked = replace(tunable("halbach"), gains=GainBox(None, (), "time was up"))
    assert gain_lines(asked)[0].endswith("(time was up); they may differ by")
    assert proven_share(replace(proven(), gains=GainBox(0.12345, ((0,),)))) == 0.123


def test_a_checksum_that_does_not_fit_is_refused() -> None:
    native = compiled()
    state, p = begun(native), copy(native)
    p.K[0] *= 1.01
    assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 0
    seal(native, p)
    assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 1


def test_a_lower_limit_of_references_refuses_what_is_beyond_it() -> None:
    native = compiled()
    state, p = begun(native), copy(native)
    p.position[0] *= 0.5
    seal(native, p)
    assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 1
    for share, accepted in ((0.99, 1), (1.01, 0)):
        reference = native.Reference()
        view(reference, "p")[0] = share * p.position[0]
        call = getattr(native.lib, f"{native.name}_set_reference")
        assert call(ctypes.byref(state), ctypes.byref(reference)) == accepted


def test_parameters_that_change_in_their_memory_keep_the_supervisor_off() -> None:
    """A record that was accepted and written into afterwards: its checksum fits no more when the start is asked for."""
    if compiler() is None:
        pytest.skip("no C compiler")
    s = compile_supervised(tunable("halbach"))
    native = s.native
    for touched in (False, True):
        state, p, supervisor, request = begun(native), copy(native), s.Supervisor(), s.Request()
        inputs, outputs = native.Inputs(), native.Outputs()
        assert getattr(native.lib, f"{native.name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 1
        p.K[0] *= 1.01 if touched else 1.0
        getattr(native.lib, f"{native.name}_supervisor_init")(ctypes.byref(supervisor))
        view(inputs, "y_valid")[:] = 1
        for start in (0, 1):
            request.start = start
            records = (supervisor, state, inputs, request, outputs)
            getattr(native.lib, f"{native.name}_supervisor_step")(*(ctypes.byref(r) for r in records))
        assert supervisor.state == NUMBERS["OFF" if touched else "OFFSETS"]


@pytest.mark.slow
def test_the_description_names_every_number_of_the_record_at_its_place() -> None:
    t = tunable("robust", "float")
    text = a2l_text(t, "robust")
    assert text.startswith("ASAP2_VERSION 1 70\n")
    entries = re.findall(
        r"/begin CHARACTERISTIC (\S+) .*\n      VALUE 0x0 (\S+) 0 (\S+) (\S+) (\S+)\n"
        r'      SYMBOL_LINK "robust_default_parameters" (\d+)',
        text,
    )
    reals = [v for p in parameters_of(t) for v in p.values]
    assert len(entries) == len(reals) + len(counts_of(t)) + 1
    assert [int(at) for *_, at in entries] == [4 * k for k in range(len(entries))]
    assert len({name for name, *_ in entries}) == len(entries)
    for value, (name, layout, method, low, high, _) in zip(reals, entries, strict=False):
        assert layout == "layout_REAL"
        (factor,) = re.findall(rf"COMPU_METHOD {method} .*\n.*\n      COEFFS_LINEAR (\S+) 0", text)
        assert float(low) <= value * float(factor) * (1 + 1e-12), name
        assert value * float(factor) <= float(high) * (1 + 1e-12), name
    loop = controller("robust").current_loop
    assert loop is not None
    (high,) = (float(entry[4]) for entry in entries if entry[0] == "Ki_current")
    assert high == pytest.approx(1.1 * loop.Ki)
    assert '"V / (A s)"' in text
    assert '5 "OPERATE"' in text
    assert text.count("/begin ") == text.count("/end ")


@pytest.mark.slow
def test_gains_of_one_take_a_signal_as_it_is() -> None:
    """A PID's filter takes positions as measured: no number of that is tuned, as its multiplication is none."""
    L = gains_of(controller("tubular_pid"))["L"]
    kept = is_tunable(L)
    assert kept.count(False) == 1
    (of_filter,) = (p for p in parameters_of(tunable("tubular_pid")) if p.field.name == "L")
    assert of_filter.field.size == sum(kept)


def test_single_precision_is_summed_as_it_is_stored() -> None:
    t = tunable("halbach", "float")
    data = b"".join(struct.pack("<f", v) for p in parameters_of(t) for v in p.values.astype(np.float32))
    data += b"".join(struct.pack("<i", n) for n in counts_of(t))
    found = 0x811C9DC5
    for byte in data:
        found = (found ^ byte) * 0x01000193 % 2**32
    assert checksum_of(t) == found


@pytest.mark.slow
def test_the_command_writes_the_files(tmp_path: Path) -> None:
    gains = Path(malta.__file__).parents[1] / "design" / "gains" / "halbach.json"
    files = malta.export_c(gains, tmp_path / "c", proof=False, tunable=True)
    names = {file.name for file in files}
    assert {"halbach.a2l", "halbach_parameters.c"} <= names


@cache
def supervised() -> Any:
    if compiler() is None:
        pytest.skip("no C compiler")
    return compile_supervised(tunable("halbach"))


def calibration(native: Native) -> Any:
    kind = type(record(native))
    ints = [(name, ctypes.c_int32) for name in ("ready", "used", "reason", "entry", "commits")]
    page: Any = type(
        "Calibration", (ctypes.Structure,), {"_fields_": [("working", kind), ("pages", kind * 2), *ints]}
    )
    return page()


def test_a_commit_is_checked_beside_the_law_and_taken_by_a_sample() -> None:
    """Three records: what a tool writes is never what a step reads; what is refused changes nothing."""
    s = supervised()
    lib, own = s.native.lib, calibration(s.native)
    name = s.native.name
    state, supervisor, request = begun(s.native), s.Supervisor(), s.Request()
    inputs, outputs = s.native.Inputs(), s.native.Outputs()
    getattr(lib, f"{name}_supervisor_init")(ctypes.byref(supervisor))
    getattr(lib, f"{name}_calibration_init")(ctypes.byref(own))
    supervisor.calibration = ctypes.addressof(own)

    def commit(p: Any) -> int:
        return int(getattr(lib, f"{name}_calibration_commit")(ctypes.byref(own), p and ctypes.byref(p)))

    def step() -> None:
        getattr(lib, f"{name}_supervisor_step")(
            *(ctypes.byref(r) for r in (supervisor, state, inputs, request, outputs))
        )

    before = state.parameters
    own.working.force_limit[0] *= 0.5
    assert (commit(own.working), own.commits, state.parameters) == (0, 0, before)
    assert commit(own.working) == 5  # the one before waits
    step()
    assert (own.commits, own.used) == (1, 1)
    assert state.parameters == ctypes.addressof(own) + type(own).pages.offset + ctypes.sizeof(
        type(own.working)
    )
    taken = state.parameters
    for wrong in (0.0, np.nan, 1e30):
        own.working.K[1] = wrong
        assert (commit(own.working), own.entry) == (3, 1)
        step()
        assert (own.commits, state.parameters) == (1, taken)
    assert commit(None) == 0  # that of the gain file
    step()
    assert own.commits == 2


def test_a_start_that_is_refused_says_why() -> None:
    s = supervised()
    lib, name = s.native.lib, s.native.name
    p = copy(s.native)
    state, supervisor, request = begun(s.native), s.Supervisor(), s.Request()
    inputs, outputs = s.native.Inputs(), s.native.Outputs()
    getattr(lib, f"{name}_supervisor_init")(ctypes.byref(supervisor))
    assert getattr(lib, f"{name}_set_parameters")(ctypes.byref(state), None) == 0
    assert getattr(lib, f"{name}_set_parameters")(ctypes.byref(state), ctypes.byref(p)) == 1

    def start() -> tuple[int, int, int]:
        for asked in (0, 1):
            request.start = asked
            getattr(lib, f"{name}_supervisor_step")(
                *(ctypes.byref(r) for r in (supervisor, state, inputs, request, outputs))
            )
        return supervisor.refused, supervisor.refused_entry, supervisor.state

    p.K[0] *= 3.0  # in use, as a tool would that knows no better
    assert start() == (3, 0, NUMBERS["OFF"])
    p.K[0] = record(s.native).K[0] * (1 + 1e-3)
    assert start() == (2, -1, NUMBERS["OFF"])
    request.sto = 1
    assert start() == (11, -1, NUMBERS["OFF"])
    request.sto = 0
    seal(s.native, p)
    assert start() == (0, -1, NUMBERS["OFFSETS"])

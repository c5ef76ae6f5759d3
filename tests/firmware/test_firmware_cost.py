"""A step of the export has fewer instructions than other ways to write it, and CasADi's own C computes the same."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from exported import PRECISIONS, require, run, target
from firmware import A9, M4F, RUNNERS, agree, can_count, cases, instructions, whole_step

from malta.firmware.cost import CLOCK
from malta.firmware.flight import call, compile_controller, new_state, view, write
from malta.firmware.period_functions import decide
from malta.firmware.program import Precision
from malta.firmware.step import look_up
from malta.firmware.vectors import record_vectors


@pytest.mark.slow
@pytest.mark.parametrize(("p", "precision"), [(A9, "double"), (M4F, "float")], ids=["A9-double", "M4F-float"])
def test_no_other_way_has_fewer_instructions(p: Any, precision: Precision) -> None:
    """The law beside loops over matrices, both beside what CasADi generates: instructions that are executed."""
    require(f"{p.prefix}gcc", RUNNERS[p.name][0])
    if not can_count(p):
        pytest.skip("another version of QEMU")
    for case in cases(target("robust", precision)):
        agree(case)
        counts = {way: instructions(p, case.ways[way], case.main(way)) for way in case.ways}
        assert min(counts, key=counts.__getitem__) == "malta", counts


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_step_takes_a_tenth_of_the_period(precision: Precision) -> None:
    """50 us at 667 MHz, one instruction a clock, on the processor of the paper."""
    require(f"{A9.prefix}gcc")
    t = target("robust", precision)
    count = whole_step(t)
    assert count is not None
    assert 0.05 < count / (t.controller.sample_time * CLOCK) < 0.10


@pytest.mark.slow_for("halbach")
@pytest.mark.parametrize("name", ["halbach", pytest.param("robust", marks=pytest.mark.slow)])
def test_casadi_generates_the_same_step(name: str, tmp_path: Path) -> None:
    """CasADi's C of the expressions before they are lowered, over the recorded vectors: within 1e-12 of each range."""
    require("gcc")
    t = target(name, "double")
    native, theirs = compile_controller(t), generated(decide(t).plain, tmp_path)
    names = [f.name for f in (*t.reference_fields, *t.input_fields)]
    ends = np.cumsum([f.size for f in (*t.reference_fields, *t.input_fields)])[:-1]
    largest: dict[str, float] = {}
    apart: dict[str, float] = {}
    for vector in record_vectors(t):
        state, given, out = new_state(native), native.Inputs(), native.Outputs()
        for row in vector.readings:
            known = dict(zip(names, np.split(row, ends), strict=True))
            write(state.reference, {f.name: known[f.name] for f in t.reference_fields})
            write(given, {f.name: known[f.name] for f in t.input_fields})
            known |= {f.name: view(state, f.name).copy() if f.size else np.zeros(0) for f in t.state_fields}
            call(native, "step", state, given, out)
            known["y_used"] = view(out, "y_used")
            z = known["y_used"][t.believed.stroke_output]
            expected = theirs({**known, "v0": look_up(t, z)})
            found = {f"{f.name}_next": view(state, f.name) for f in t.state_fields if f.size}
            found |= {f.name: view(out, f.name) for f in t.output_fields if f.name in expected}
            for key, values in found.items():
                apart[key] = max(apart.get(key, 0.0), float(np.abs(values - expected[key]).max()))
                largest[key] = max(largest.get(key, 0.0), float(np.abs(values).max()))
    assert len(apart) > 8
    assert not {key: value for key, value in apart.items() if value > 1e-12 * largest[key]}


def generated(f: ca.Function, folder: Path) -> Any:
    """The C that CasADi generates of a function, compiled: named vectors in, named vectors out."""
    code = ca.CodeGenerator("generated.c", {"with_export": True})
    code.add(f)
    (folder / "generated.c").write_text(code.dump(), encoding="utf-8")
    flags = ["-O1", "-ffp-contract=off", "-fPIC", "-shared"]
    done = run(["gcc", *flags, "generated.c", "-lm", "-o", "generated.so"], folder)
    assert done.returncode == 0, done.stderr[:2000]
    function = getattr(ctypes.CDLL(str(folder / "generated.so")), f.name())
    real = ctypes.POINTER(ctypes.c_double)

    def compute(given: dict[str, Any]) -> dict[str, Any]:
        vectors = [np.array(given[f.name_in(k)], dtype=float) for k in range(f.n_in())]
        results = [np.zeros(f.size1_out(k)) for k in range(f.n_out())]
        a = (real * f.sz_arg())(*(v.ctypes.data_as(real) for v in vectors))
        r = (real * f.sz_res())(*(v.ctypes.data_as(real) for v in results))
        scratch = (ctypes.c_longlong * (f.sz_iw() + 1))(), (ctypes.c_double * (f.sz_w() + 1))()
        assert function(a, r, *scratch, 0) == 0
        return {f.name_out(k): values for k, values in enumerate(results)}

    return compute

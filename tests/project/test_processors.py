"""Runs of the tests on other processors: what they need, and that a run is the same to the bit with every kernel."""

from __future__ import annotations

import subprocess
import sys

import processors
import pytest
from conftest import ROOT

FLIGHT = """
import hashlib, malta
controller = malta.gains.read("design/gains/robust.json")
scenario = malta.Scenario.stroke(1e-3, fidelity="dq", noise=1.0, duration=0.02)
run = malta.simulate(malta.plant_of(controller.parameters), controller, scenario, engine="virtual machine")
print(hashlib.sha256(b"".join(x.tobytes() for x in (run.x, run.xi_hat, run.v, run.u))).hexdigest())
"""
OLD = {"features": ["SSE3"], "dispatched": ["X86_V2", "X86_V3", "X86_V4"], "baseline": ["X86_V2"]}


def test_what_a_processor_lacks_is_said() -> None:
    assert processors.why_not("SkylakeX", OLD) == "this processor has no AVX512_SKX"
    assert [processors.why_not(kernel, OLD) for kernel in ("own", "rounded", "Prescott")] == [""] * 3


def test_numpy_has_the_features_of_such_a_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Zen")
    assert "OPENBLAS_CORETYPE" not in processors.environment_of("own", OLD)
    assert processors.environment_of("Haswell", OLD)["NPY_DISABLE_CPU_FEATURES"] == "X86_V4"
    assert processors.environment_of("Prescott", OLD)["NPY_DISABLE_CPU_FEATURES"] == "X86_V3 X86_V4"


def test_an_unknown_run_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert processors.main(["Zen4:fast"]) == 2
    assert capsys.readouterr().err.startswith("processors: found Zen4:fast, expected some of Haswell:fast ")


@pytest.mark.slow
def test_a_run_of_a_gain_file_is_the_same_to_the_bit_with_every_kernel() -> None:
    """The forces that a reference commands came from solvers that rounded as kernels do, 1e-13 N apart."""
    own = processors.probed(processors.environment_of("own", {}))
    kernels = [kernel for kernel in processors.KERNELS if not processors.why_not(kernel, own)]
    flown = set()
    for kernel in ("own", *kernels):
        environment = processors.environment_of(kernel, own)
        environment.pop("NPY_DISABLE_CPU_FEATURES", None)
        command = [sys.executable, "-c", FLIGHT]
        done = subprocess.run(
            command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True, timeout=600
        )
        flown.add(done.stdout)
    assert len(flown) == 1

"""`make processors`: the tests as other processors run them, by the kernels of OpenBLAS and the features of numpy.

    PYTHONPATH=tests python -m processors                       # all that this processor can do
    PYTHONPATH=tests python -m processors Prescott:fast Sandybridge:linear

Each run is KERNEL:TESTS. A kernel is one of OpenBLAS, with the features of numpy that such processors have, or `own`,
what OpenBLAS chooses itself, or `rounded`, which no processor has (rounded.py). Tests are `fast`, those of `make test`,
or `linear`, the longer ones of linear algebra. What runs is asked of the libraries, not of the variables: OpenBLAS
takes another kernel where it has to, and says nothing. Wheels of numpy and scipy have none for Zen: Haswell's run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
# Proofs that ask numpy and scipy: responses, multipliers, bounds of couplings. Others are of exact and ball arithmetic.
PROOFS = ("blocks", "checked_multipliers", "gain", "held", "robust", "weak")
LINEAR = ("synthesis", "loops", "margins", *(f"proof/test_{name}.py" for name in PROOFS))
TESTS = {"fast": ("-m", "not slow"), "linear": ("-m", "slow", *(f"tests/{name}" for name in LINEAR))}
ALL = (
    *("own:fast", "Prescott:fast", "Sandybridge:fast", "Haswell:fast", "Zen:fast", "SkylakeX:fast"),
    *("rounded:fast", "own:linear", "Prescott:linear", "Sandybridge:linear", "SkylakeX:linear"),
)


class Kernel(NamedTuple):
    """A kernel of OpenBLAS: the feature that a processor needs for it, and those of numpy that its processors lack."""

    needs: str
    lacks: tuple[str, ...]  # as the names begin
    called: str = ""  # by OpenBLAS, where several names have one table of kernels


KERNELS = {
    "Prescott": Kernel("SSE3", ("",), "Katmai"),
    "Sandybridge": Kernel("AVX", ("",)),
    "Haswell": Kernel("AVX2", ("AVX512", "X86_V4")),
    "Zen": Kernel("AVX2", ("AVX512", "X86_V4")),
    "SkylakeX": Kernel("AVX512_SKX", ("AVX512_ICL", "AVX512_SPR")),
}
VARIABLES = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
PROBE = """
import json, numpy, scipy.linalg, threadpoolctl
from contextlib import suppress
with suppress(ImportError):
    import slycot
from numpy._core._multiarray_umath import __cpu_baseline__, __cpu_dispatch__, __cpu_features__
libraries = [one for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"]
print(json.dumps({
    "kernels": sorted({one.get("architecture") or one["internal_api"] for one in libraries}),
    "features": [name for name, has in __cpu_features__.items() if has],
    "dispatched": [name for name in (*__cpu_baseline__, *__cpu_dispatch__) if __cpu_features__.get(name)],
    "baseline": list(__cpu_baseline__),
}))
"""


def probed(environment: Mapping[str, str]) -> Any:
    """What a process with this environment has: kernels of each BLAS that is loaded, features that numpy uses."""
    run = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True)
    return json.loads(run.stdout) if run.returncode == 0 else None


def environment_of(kernel: str, own: Mapping[str, Any]) -> dict[str, str]:
    """The variables under which a kernel is taken, beside the features of numpy that its processors have."""
    found = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    if kernel in KERNELS:
        newer = [name for name in own["dispatched"] if name not in own["baseline"]]
        found["OPENBLAS_CORETYPE"] = kernel
        found["NPY_DISABLE_CPU_FEATURES"] = " ".join(
            name for name in newer if name.startswith(KERNELS[kernel].lacks)
        )
    return found


def why_not(kernel: str, own: Mapping[str, Any]) -> str:
    """Why this processor cannot run a kernel; "" where it can."""
    if kernel not in KERNELS or KERNELS[kernel].needs in own["features"]:
        return ""
    return f"this processor has no {KERNELS[kernel].needs}"


def run_tests(asked: str, own: Mapping[str, Any]) -> tuple[str, bool]:
    """Run one KERNEL:TESTS; what it was, and whether all passed."""
    kernel, tests = asked.split(":")
    if reason := why_not(kernel, own):
        return f"{asked}: skipped, {reason}", True
    environment = environment_of(kernel, own)
    has = probed(environment)
    if has is None or (kernel in KERNELS and not set(has["kernels"]) <= {kernel, KERNELS[kernel].called}):
        ran = "nothing" if has is None else " ".join(has["kernels"])
        return f"{asked}: skipped, where {kernel} is asked for {ran} runs", True
    said = f"{asked}: kernels {' '.join(has['kernels'])}, numpy with {' '.join(has['dispatched'])}"
    print(said, flush=True)
    command = (sys.executable, "-m", "pytest", "-q", "-n", "auto", "--dist", "loadfile", *TESTS[tests])
    command += ("-p", "rounded") if kernel == "rounded" else ()
    passed = subprocess.run(command, cwd=ROOT, env=environment).returncode == 0
    return f"{said}: {'passed' if passed else 'FAILED'}", passed


def main(asked: Sequence[str]) -> int:
    """Run what is asked for, or all, and say what ran."""
    known = {f"{kernel}:{tests}" for kernel in ("own", "rounded", *KERNELS) for tests in TESTS}
    if unknown := set(asked) - known:
        print(
            f"processors: found {min(unknown)}, expected some of {' '.join(sorted(known))}", file=sys.stderr
        )
        return 2
    own = probed(environment_of("own", {}))
    if own is None:
        print(
            "processors: found no numpy, scipy and threadpoolctl, expected those of `make test`",
            file=sys.stderr,
        )
        return 2
    runs = [run_tests(one, own) for one in asked or ALL]
    print("\n".join(said for said, _ in runs))
    return int(not all(passed for _, passed in runs))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

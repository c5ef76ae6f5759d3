"""`make mutants`: run the tests of every mutant on a copy of the project, and list those that no test notices.

The output says which share was noticed, and by which modules of tests. Of drawn mutants the fast tests run alone.

MUTANTS=gains,margins runs the lists of these names alone, MUTANT_JOBS=1 one mutant at a time; MUTANT_SECONDS=60 ends
the tests of a mutant that hangs. The tests have to pass without a mutant first. Exit code 1 where a mutant survives
without a reason, or is noticed in spite of one.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from mutants import ROOT, Mutant, mutants

SECONDS = float(
    os.environ.get("MUTANT_SECONDS") or 300
)  # of the tests of a mutant: those that do not end notice it
PARTS = (
    "malta",
    "papers",
    "tests",
    "bench",
    "data",
    "design",
    "examples",
    "notebooks",
    "docs",
    "pyproject.toml",
    "README.md",
)


def main() -> int:
    """Run the mutants; print a line for each, and how many were noticed."""
    lists = os.environ.get("MUTANTS", "").split(",")
    chosen = [one for one in mutants() if lists == [""] or one.name.partition(".")[0] in lists]
    jobs = int(os.environ.get("MUTANT_JOBS") or os.cpu_count() or 1)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folders: Queue[Path] = Queue()
        for k in range(jobs):
            folders.put(_copy(Path(scratch) / str(k)))
        for quick in (False, True):
            tests = sorted({test for one in chosen if one.drawn is quick for test in one.tests})
            if tests and _failure(folders.queue[0], tests, None, quick=quick):
                print("mutants: the tests fail without any")
                return 1
        with ThreadPoolExecutor(jobs) as pool:
            noticed = list(pool.map(lambda one: _try(one, folders), chosen))
    wrong = [one for one, by in zip(chosen, noticed, strict=True) if bool(by) == bool(one.equivalent)]
    modules = Counter(by for by in noticed if by)
    print(f"mutants: {modules.total()} of {len(chosen)} noticed, {time.monotonic() - begun:.0f} s")
    for module, count in modules.most_common():
        print(f"mutants: {count:4} by {module}")
    for one in wrong:
        print(f"mutants: {one.name}: {'noticed in spite of its reason' if one.equivalent else 'survives'}")
    return int(bool(wrong))


def _copy(target: Path) -> Path:
    target.mkdir()
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, target / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target / part)
    return target


def _try(mutant: Mutant, folders: Queue[Path]) -> str:
    """The module whose tests notice a mutant; "" where none does."""
    folder = folders.get()
    path = folder / mutant.file
    text = path.read_text(encoding="utf-8")
    begun = time.monotonic()
    try:
        path.write_text(mutant.applied(text), encoding="utf-8")
        by = _failure(folder, mutant.tests, SECONDS, quick=mutant.drawn)
    finally:
        path.write_text(text, encoding="utf-8")
        folders.put(folder)
    said = "noticed" if by else "equivalent" if mutant.equivalent else "SURVIVES"
    print(f"{said:10} {mutant.name:16} {time.monotonic() - begun:5.0f} s  {mutant.file}  {by}", flush=True)
    return by


def _failure(folder: Path, tests: Sequence[str], seconds: float | None, *, quick: bool) -> str:
    """The first module of tests that fails or does not end in a folder, whose malta is imported; "" where all pass."""
    fast = ["-m", "not slow"] if quick else []
    command = [
        sys.executable,
        "-B",
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n0",
        "-p",
        "no:cacheprovider",
        *fast,
        *tests,
    ]
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, timeout=seconds, capture_output=True, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no end in {seconds:.0f} s"
    if done.returncode not in (0, 1, 2, 3):  # 2: not even collected; 4, 5: no such tests
        raise RuntimeError(f"pytest ended with {done.returncode}: {done.stdout[-2000:].decode()}")
    found = re.search(r"^(?:FAILED|ERROR) (\S+?\.py)", done.stdout.decode(), re.MULTILINE)
    return "" if done.returncode == 0 else found[1] if found else tests[0].partition("::")[0]


if __name__ == "__main__":
    sys.exit(main())

"""`make fuzz`: fuzz all kinds of input for FUZZ_SECONDS, ten minutes without it.

The seed is printed: FUZZ_SEED=N tries the same cases again, FUZZ_KINDS=design,log some kinds alone. A case that fails
is made small, printed and kept in .hypothesis/fuzz: the next `make fuzz` begins with it. Exit code 1 with failures.
"""

from __future__ import annotations

import os
import resource
import secrets
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hypothesis.database import DirectoryBasedExampleDatabase

from fuzz.kinds import KINDS, Kind
from fuzz.session import cases_of

MEMORY = 6 * 1024**3  # bytes: what asks for more fails here and leaves the computer alone
MOST_TEXT = 4000  # characters about a failure
ROUND = 10  # a round has so many times fewer cases than the tests


def main() -> int:
    """Try rounds of cases until the time is up; print how many of each kind were tried, and those that failed."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    number = int(os.environ.get("FUZZ_SEED") or secrets.randbelow(2**32))
    names = (os.environ.get("FUZZ_KINDS") or ",".join(KINDS)).split(",")
    until = time.monotonic() + float(os.environ.get("FUZZ_SECONDS") or 600)
    print(f"fuzz: FUZZ_SEED={number}, kinds {' '.join(names)}", flush=True)
    tried, failed = dict.fromkeys(names, 0), set[str]()
    while time.monotonic() < until and failed != set(names):
        for name in [name for name in names if name not in failed]:
            if not _round(name, KINDS[name], number, tried):
                failed.add(name)
        number += 1
    print("fuzz:", ", ".join(f"{count} {name}" for name, count in tried.items()))
    print(f"fuzz: failures in {' '.join(sorted(failed))}" if failed else "fuzz: no failure")
    return int(bool(failed))


def _round(name: str, kind: Kind, number: int, tried: dict[str, int]) -> bool:
    """Try some cases of a kind; False where one fails, which is printed."""

    def read(case: Any) -> None:
        tried[name] += 1
        with tempfile.TemporaryDirectory() as folder:
            kind.read(case, Path(folder))

    database = DirectoryBasedExampleDatabase(Path(".hypothesis") / "fuzz" / name)
    try:
        cases_of(kind, read, max(kind.share // ROUND, 1), number=number, database=database)()
    except Exception as error:
        notes = "\n".join([str(error), *getattr(error, "__notes__", ())])
        print(f"fuzz: {name}, FUZZ_SEED={number}: {type(error).__name__}\n{notes[:MOST_TEXT]}", flush=True)
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())

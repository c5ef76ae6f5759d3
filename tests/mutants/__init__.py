"""Own mutants: faults put into the code that refuses, proves, seals and limits, one at a time; tests have to notice.

Each `*.toml` lists mutants: file, the text it has, the text in its place, the tests that have to fail, and, where no
test can notice, why: `equivalent`. `make mutants` runs them; `tests/project/test_mutants.py` checks that the texts
still apply.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class Mutant(NamedTuple):
    """A fault: `old` becomes `new` in a file."""

    name: str  # "gains.toml 3"
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    equivalent: str  # why no test can notice; "" where one has to

    @property
    def drawn(self) -> bool:
        """Whether it was drawn at random: see draw.py."""
        return self.name.startswith("drawn")

    def applied(self, text: str) -> str:
        """The text of the file with the fault. Raises ValueError where `old` does not stand in it exactly once."""
        if text.count(self.old) != 1:
            raise ValueError(f"{self.name}: {self.file} has {text.count(self.old)} times {self.old!r}")
        if self.old == self.new:
            raise ValueError(f"{self.name}: {self.file}: no fault: {self.old!r}")
        return text.replace(self.old, self.new)


def mutants() -> list[Mutant]:
    """All mutants, in the order of their files."""
    found = []
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        for number, entry in enumerate(content["mutants"], start=1):
            tests = tuple(entry.get("tests", content["tests"]))
            equivalent = entry.get("equivalent", "")
            found.append(
                Mutant(f"{path.name} {number}", entry["file"], entry["old"], entry["new"], tests, equivalent)
            )
    return found

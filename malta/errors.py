"""The two ways in which malta says no: the input is wrong, or the answer is."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used: one sentence with file, field, what was found and what was expected.

    The command line prints it without a traceback and exits with code 2.
    """

    def __init__(self, where: str | Path, field: str, found: str, expected: str) -> None:
        self.where, self.field, self.found, self.expected = str(where), field, found, expected
        subject = f"{where}: {field}" if field else str(where)
        # One line, whatever a key or a library's message holds.
        line = " ".join(f"{subject}: found {found}, expected {expected}".split())
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in line))


class CheckError(ArithmeticError):
    """A result that failed its own check (residual, stability, symmetry); nothing is written then.

    The command line prints it and exits with code 1.
    """

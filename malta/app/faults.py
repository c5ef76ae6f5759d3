"""What goes wrong behind the page, in one sentence: a page has no place for a traceback."""

from __future__ import annotations

from malta.errors import CheckError, InputError


def describe_error(error: Exception) -> str:
    """The sentence of an error; of one that malta does not raise on purpose, its kind and text as well."""
    if isinstance(error, InputError | CheckError):
        return str(error)
    if isinstance(error, ArithmeticError):
        return f"numbers beyond what can be computed ({error})"
    if isinstance(error, MemoryError):
        return "more was asked for than this computer has memory for"
    return f"a defect of malta or of the machine's module: {type(error).__name__} ({error})"

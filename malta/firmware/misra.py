"""MISRA C:2012 of the exported C: the rules that it deviates from, each with its reason.

cppcheck and its MISRA addon find no other rule; directives, and rules that cppcheck does not look at, are not covered.
"""

from __future__ import annotations

from typing import NamedTuple


class Deviation(NamedTuple):
    """A rule that files deviate from."""

    rule: str
    files: str  # whose names end so
    reason: str


DEVIATIONS = (
    Deviation("2.5", ".h", "macros of the interface are for the caller: a program need not use all of them"),
    Deviation("8.7", "_supervisor.c", "the caller too uses the table of monitors and the initialization"),
    Deviation("21.6", "_test.c", "the test prints its verdict; the controller has no output of its own"),
    Deviation("21.6", "_pil.c", "a PC has its port in the standard streams; a target defines NAME_PIL_PORT"),
    Deviation("21.15", "_pil.c", "memcpy between numbers and words: the line carries bits"),
    Deviation(
        "21.15",
        "_test.c",
        "memcpy of numbers into words and records: the test compares bits, and calls pieces with records",
    ),
)

"""How long work may take that nobody agreed to: it is refused as soon as its own progress tells that it is longer."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic

from malta.errors import InputError

LONGEST = 600.0  # s, without --yes
ENOUGH = 5.0  # s, between the two reports that an estimate is made of
SURE = 60.0  # s, from the first report to the last estimate: who has waited longer is not refused


def limit_time(
    show: Callable[[float], None] | None, what: str, *, agreed: bool, times: float = 1.0
) -> Callable[[float], None] | None:
    """The function that takes the share done, 0 to 1, shows it, and refuses work that takes more than LONGEST.

    what : the work, for the sentence;  agreed : whether the user said --yes: nothing is refused
    times : the work that follows, as a multiple of the one that reports

    Estimates begin at the first report, and each counts the pace since the one before: what comes earlier, as a
    compiler or parts that were done already, is not in them.

    Raises InputError from the call that tells.
    """
    if agreed:
        return show
    begun: float | None = None
    looked = 0.0, 0.0  # time and share of the last estimate

    def report(share: float) -> None:
        nonlocal begun, looked
        if show is not None:
            show(share)
        now = monotonic()
        if begun is None:
            begun, looked = now, (now, share)
        since, done = now - looked[0], share - looked[1]
        if since < ENOUGH or done <= 0 or now - begun > SURE:
            return
        looked = now, share
        total = times * (now - begun + (1 - share) * since / done)
        if total > LONGEST:
            found, most = f"about {duration_text(total)} of work", duration_text(LONGEST)
            raise InputError(what, "", found, f"at most {most}, or --yes")

    return report


def duration_text(seconds: float) -> str:
    """A duration in the unit that people would use: 12 s, 14 min, 3.2 h, 5 days."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size or (unit != "days" and seconds >= size):
            return f"{seconds / size:.2g} {unit}" if seconds / size < 100 else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"

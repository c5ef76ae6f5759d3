"""`make times`: measure the processor time of every fast test, and name those that `make test` should leave out.

A test's own time counts, with that of the processes that it starts, and not that of what fixtures make for many tests.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Generator
from operator import itemgetter

import pytest

LIMIT = 0.3  # s of processor time


def processor_time() -> float:
    """Seconds of this process and of its children that have ended."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


class Times:
    """A plugin of pytest that adds up the time of each test's call."""

    def __init__(self) -> None:
        self.spent = dict[str, float]()

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None]:
        begun = processor_time()
        yield
        self.spent[item.nodeid] = processor_time() - begun


def main() -> int:
    """Run the fast tests, and print those that take longer than LIMIT: their place is under `slow` or `slow_for`."""
    times = Times()
    code = int(pytest.main(["-q", "-m", "not slow"], plugins=[times]))
    long = {name: spent for name, spent in times.spent.items() if spent > LIMIT}
    for name, spent in sorted(long.items(), key=itemgetter(1), reverse=True):
        print(f"{spent:6.2f} s  {name}")
    print(f"{len(long)} of {len(times.spent)} tests take more than {LIMIT} s")
    return code


if __name__ == "__main__":
    sys.exit(main())

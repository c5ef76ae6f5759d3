"""Python processes that malta starts: they import what malta imports, and nothing from the current folder."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar


def python_module(module: str, *arguments: str) -> list[str]:
    """The command that runs a module; -P: a random.py or json.py in the current folder is not what malta imports."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment(**more: str) -> dict[str, str]:
    """The environment of such a process, with further variables: it finds this malta wherever it is started."""
    places = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places)), "PYTHONSAFEPATH": "1"} | more


# One thread of the linear algebra: matrices of some twenty rows are done before a second thread has woken up.


P = ParamSpec("P")
R = TypeVar("R")


@cache
def _libraries() -> Any:
    """The linear algebra of numpy and scipy, loaded and found once: looking for it takes milliseconds."""
    import scipy.linalg  # noqa: F401  brings a library of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within the block, and restore what was there after it.

    The limit holds for the whole process. OpenBLAS takes it from the main thread alone, so that in other threads the
    block does nothing, and the order in which they leave it cannot matter.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not (in_main and any(library.num_threads > 1 for library in _libraries().lib_controllers)):
        yield
        return
    with _libraries().limit(limits=1):
        yield


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The same function within `one_blas_thread`."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_blas_thread():
            return function(*args, **kwargs)

    return limited

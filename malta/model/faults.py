"""What is wrong with a function of a machine's module that raised an error, and in which line."""

from __future__ import annotations

import os
import re
import sysconfig
import traceback
from pathlib import Path

from malta.errors import InputError
from malta.files import PACKAGE


def fault_of(error: Exception, where: str, field: str) -> InputError:
    """What is wrong with a function of a machine's module that raised an error: its line, and what to change."""
    text = " ".join(re.sub(r"\S*casadi/\S+:\d+:", "", str(error)).split())
    expected = "a function of CasADi expressions"
    if "truth value" in text:
        expected = "ca.fmax, ca.fmin or ca.if_else in place of max, min, if, and, or"
    elif "overloaded function" in text or "loop of ufunc" in text:
        text = text.partition(" Possible prototypes")[0]
        expected = "CasADi's functions, as ca.sin and ca.vertcat, in place of math's and numpy's"
    line = line_of(error)
    return InputError(
        where, field, f"{type(error).__name__}: {text[:100]}{line and f', at {line}'}", expected
    )


def line_of(error: BaseException) -> str:
    """The line of a user's module in which an error arose, as `ball.py:40`; "" for one that arose in no such line."""
    places = traceback.extract_tb(error.__traceback__)
    own = [place for place in places if not _is_library(place.filename)]
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""


def _is_library(file: str) -> bool:
    """Whether a file is of malta, of Python or of an installed package."""
    kinds = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = (str(PACKAGE), *(sysconfig.get_path(kind) for kind in kinds))
    return file.startswith(("<", *(folder + os.sep for folder in folders)))

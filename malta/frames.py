"""Results as tables of pandas, where it is installed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from malta.errors import InputError


def data_frame(columns: Mapping[str, Iterable[Any]], index: tuple[str, Iterable[Any]]) -> Any:
    """A pandas.DataFrame of named columns, with a named index.

    Raises InputError where pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise InputError("to_pandas", "pandas", "not installed", "pip install pandas") from error
    rows = pandas.Index(list(index[1]), name=index[0])
    return pandas.DataFrame({name: list(column) for name, column in columns.items()}, index=rows)

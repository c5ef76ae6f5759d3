"""The options of all commands that read a log: which columns of another program's file are which signals."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from malta.cli.options import TIME_HELP, positive_time, read_assignments
from malta.errors import InputError

LogFile = Annotated[Path, typer.Argument(metavar="LOG", help="A log, of any program.")]
LogFiles = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", help="Logs of any program: one, or several of the same machine."),
]
LOGS = "Logs of other programs"  # a panel of a help
Reading = dict[str, Any]
"""Arguments of `malta.identification.read_log`, as the options give them."""

OPTIONS: dict[str, Any] = {
    "columns": Annotated[
        str,
        typer.Option(
            metavar="NAME=COLUMN",
            help="y1=CH1:10um/V,i1='Coil current':A,x*:um",
            show_default=False,
            rich_help_panel=LOGS,
        ),
    ],
    "period": Annotated[
        str,
        typer.Option(
            metavar="SECONDS", help="Sample period, as 50us.", show_default=False, rich_help_panel=LOGS
        ),
    ],
    "stamps": Annotated[
        str,
        typer.Option(metavar="COLUMN", help="Times, as stamp:ms.", show_default=False, rich_help_panel=LOGS),
    ],
    "excitation": Annotated[
        Path | None, typer.Option(metavar="FILE", help="One period of it, or all.", rich_help_panel=LOGS)
    ],
}


def _time_or_column(text: str, *, lasting: bool) -> tuple[float | None, str]:
    """What --time says: after how many seconds a command ends; or, of a log, its column of times."""
    try:
        seconds = float(text)
    except ValueError:
        return None, text
    return (positive_time(seconds), "") if lasting else (None, text)


def add_log_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command with the options that say how a log is read; it gets them as its argument `reading`."""
    own = inspect.signature(command, eval_str=True)
    lasting = "time" in own.parameters
    timed = inspect.Parameter(
        "time",
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default="",
        annotation=Annotated[
            str,
            typer.Option("--time", metavar="SECONDS", hidden=not lasting, show_default=False, help=TIME_HELP),
        ],
    )
    kept = [parameter for name, parameter in own.parameters.items() if name not in ("reading", "time")]
    added = [
        inspect.Parameter(
            name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=None if name == "excitation" else "",
            annotation=annotation,
        )
        for name, annotation in OPTIONS.items()
    ]

    @wraps(command)
    def with_reading(**given: Any) -> None:
        columns, period, stamps, excitation = (given.pop(name) for name in OPTIONS)
        ends, column = _time_or_column(given.pop("time"), lasting=lasting)
        if lasting:
            given["time"] = ends
        if column and stamps:
            raise InputError("--stamps", "", "--time COLUMN too", "one of them")
        stamps = stamps or column
        seconds = (
            read_assignments("--period", [f"period={period}"], {"period": "s"})["period"] if period else 0.0
        )
        reading = {"columns": columns, "time": stamps, "sample_time": seconds, "excitation": excitation}
        command(**given, reading=reading)

    parameters = [*kept, timed, *added]
    changed: Any = with_reading
    changed.__signature__ = own.replace(parameters=parameters)
    changed.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": None}
    return with_reading

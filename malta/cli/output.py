"""What commands print: tables and JSON on standard output, notes, errors and progress on standard error."""

from __future__ import annotations

import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from malta.errors import CheckError, InputError, shorten
from malta.files import json_text

if TYPE_CHECKING:
    from rich.console import Console

    from malta.cli.documents.parts import Part

WIDTH = 100  # columns of tables on wide terminals, and in files and pipes where COLUMNS says nothing else
NARROWEST = 20  # columns; COLUMNS below is no width
PATIENCE = 5.0  # s, from the first bounds of a margin to the first line about them
INTERVAL = 2.0  # s, between the lines
NO_COMPILER = "no C compiler: simulated on CasADi's virtual machine, some hundred times slower"
LINES = 10.0  # s, between lines of how far other work is


def make_console() -> Console:
    """A console on standard output that prints text as it stands.

    A terminal has its own width, up to WIDTH; files and pipes have that of the variable COLUMNS, else WIDTH.
    """
    from rich.console import Console

    console = Console(highlight=False, markup=False, emoji=False)
    if console.is_terminal:
        console.width = min(console.width, WIDTH)
    else:
        columns = os.environ.get("COLUMNS", "")
        console.width = max(int(columns), NARROWEST) if re.fullmatch(r"0*[1-9]\d{0,3}", columns) else WIDTH
    return console


def print_text(console: Console, text: str) -> None:
    """Print a paragraph that folds to the console's width and parts no number from its unit."""
    from malta.report.tables.layout import Paragraph

    console.print(Paragraph(text))


def print_line(console: Console, text: str) -> None:
    """Print a line that has names of files: whole in files and pipes, folded on a terminal."""
    if console.is_terminal:
        print_text(console, text)
    else:
        console.print(text, soft_wrap=True)


def print_written(console: Console, files: Iterable[Path]) -> None:
    """Print one line for each file that a command wrote."""
    for file in files:
        console.print(f"wrote {file}", soft_wrap=True)


def print_document(document: Part) -> None:
    """Print one JSON document, its schema and version first; numbers that are not finite become null."""
    content = document.model_dump(by_alias=True)
    head = {key: content.pop(key) for key in ("schema", "version")}
    print(json_text(head | content))


def print_note(text: str) -> None:
    """Print one line on standard error, after the name of the program."""
    try:
        print(f"malta: {text}", file=sys.stderr, flush=True)
    except OSError:  # a full device: nobody can be told
        silence(sys.stderr)


def silence(stream: TextIO) -> None:
    """Drop what a stream still holds, and all that is written to it from now on."""
    with suppress(OSError, ValueError, AttributeError):  # a stream without a file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def print_error(error: InputError | CheckError, file: Path | None = None) -> int:
    """Print an error as one line and return the exit code; a failed check is printed with its file."""
    failed, text = isinstance(error, CheckError), str(error)
    print_note(shorten(f"{file}: {text}" if failed and file and str(file) not in text else text))
    return 1 if failed else 2


def track_files(files: list[Path], what: str, *, quiet: bool) -> Iterable[Path]:
    """Iterate over files behind a progress bar, on a terminal's standard error when there are several files."""
    if quiet or len(files) < 2 or not sys.stderr.isatty():
        return files
    from rich.console import Console
    from rich.progress import track

    return track(files, what, console=Console(stderr=True), transient=True)


@contextmanager
def progress_bar(what: str, *, quiet: bool) -> Iterator[Callable[[float], None] | None]:
    """Show how far the work is on standard error: a bar with the time left on a terminal, elsewhere lines.

    Yields the function that takes the share done, 0 to 1, or None where nothing is shown. A line comes every LINES,
    once the work has taken PATIENCE.
    """
    if quiet:
        yield None
        return
    if not sys.stderr.isatty():
        yield _progress_lines(what)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def _progress_lines(what: str) -> Callable[[float], None]:
    """The function that takes the share done and prints a line of it now and then."""
    started = time.monotonic()
    due = started + PATIENCE

    def show(share: float) -> None:
        nonlocal due
        now = time.monotonic()
        if now < due or not 0 < share < 1:
            return
        due = now + LINES
        spent = now - started
        print_note(f"{what}: {100 * share:.0f} %, {spent:.0f} s, about {spent * (1 / share - 1):.0f} s left")

    return show


@contextmanager
def margin_progress(
    what: str, *, quiet: bool
) -> Iterator[tuple[Callable[[float], None] | None, Callable[[float, float], None]]]:
    """Show a progress bar and the bounds of a margin while its proof is searched.

    Yields the functions that take the share done and the bounds so far. Without a terminal the bounds are printed as
    a line every INTERVAL, once the proof has taken PATIENCE. Ctrl-C prints the last bounds and ends with exit code 130.
    """
    last: tuple[float, float] | None = None  # the bounds so far
    due: float | None = None  # when the next line is printed; None before the first bounds
    terminal = sys.stderr.isatty()

    def show(lower: float, upper: float) -> None:
        nonlocal last, due
        last = lower, upper
        due = time.monotonic() + PATIENCE if due is None else due
        if quiet or terminal or time.monotonic() < due:
            return
        due = time.monotonic() + INTERVAL
        print_note(f"{what}: {_bounds_text(lower, upper)}")

    with progress_bar(what, quiet=quiet or not terminal) as progress:
        try:
            yield progress, show
        except KeyboardInterrupt:
            print_note("interrupted; " + (_bounds_text(*last) if last else "nothing proven"))
            raise typer.Exit(130) from None


def _bounds_text(lower: float, upper: float) -> str:
    """The bounds of a margin as shares of the uncertainty."""
    high = "not found" if math.isinf(upper) else f"{100 * upper:.2f} %"
    return f"proven {100 * max(lower, 0):.2f} %, lost at {high}"

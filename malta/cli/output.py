"""What commands print: tables and JSON on standard output, notes, errors and progress on standard error."""

from __future__ import annotations

import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import TYPE_CHECKING, Any, TextIO

import typer

from malta.bound import at_least, at_most
from malta.errors import CheckError, InputError, shorten
from malta.interrupts import is_interrupt, press_again, soften_first_interrupt, watch_interrupts
from malta.work import WorkEnd, count_work
from malta.writing import json_text

if TYPE_CHECKING:
    from rich.console import Console

    from malta.cli.documents.loops import DocumentPart


# How long work may take that nobody agreed to: it is refused as soon as its own progress tells that it is longer.


UNCONFIRMED_TIME = 600.0  # s, without --yes
ESTIMATE_INTERVAL = 5.0  # s, between the two reports that an estimate is made of
ESTIMATE_PERIOD = 60.0  # s, from the first report to the last estimate: who has waited longer is not refused


def limit_time(
    show: Callable[[float], None] | None, what: str, *, agreed: bool, times: float = 1.0
) -> Callable[[float], None] | None:
    """The function that takes the share done, 0 to 1, shows it, and refuses work that takes more than UNCONFIRMED_TIME.

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
        if since < ESTIMATE_INTERVAL or done <= 0 or now - begun > ESTIMATE_PERIOD:
            return
        looked = now, share
        total = times * (now - begun + (1 - share) * since / done)
        if total > UNCONFIRMED_TIME:
            found, most = f"about {duration_text(total)} of work", duration_text(UNCONFIRMED_TIME)
            raise InputError(what, "", found, f"at most {most}, or --yes")

    return report


def duration_text(seconds: float) -> str:
    """A duration in the unit that people would use: 12 s, 14 min, 3.2 h, 5 days."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size or (unit != "days" and seconds >= size):
            return f"{seconds / size:.2g} {unit}" if seconds / size < 100 else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


WIDTH = 100  # columns of tables on wide terminals, and in files and pipes where COLUMNS says nothing else
MIN_WIDTH = 20  # columns; COLUMNS below is no width
PATIENCE = 2.0  # s, from the begin of work to the first line about it
INTERVAL = 2.0  # s, between the first lines
NO_COMPILER = "no C compiler: simulated on CasADi's virtual machine, some hundred times slower"
INTERRUPT_TIME = 2.0  # s after Ctrl-C; work that goes on has not heard of it
LINES = 10.0  # s, between later lines


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
        console.width = max(int(columns), MIN_WIDTH) if re.fullmatch(r"0*[1-9]\d{0,3}", columns) else WIDTH
    return console


def print_text(console: Console, text: str) -> None:
    """Print a paragraph that folds to the console's width and parts no number from its unit."""
    from malta.report.tables import Paragraph

    console.print(Paragraph(text))


def print_line(console: Console, text: str, style: str = "") -> None:
    """Print a line that has names of files: whole in files and pipes, folded on a terminal.

    style : on a terminal with colours, as rich has it
    """
    from malta.report.tables import Paragraph

    if console.is_terminal:
        console.print(Paragraph(text, style))
    else:
        console.print(text, soft_wrap=True)


def print_written(console: Console, files: Iterable[Path]) -> None:
    """Print one line for each file that a command wrote."""
    for file in files:
        console.print(f"wrote {file}", soft_wrap=True)


def print_document(document: DocumentPart) -> None:
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


class WorkProgress:
    """Work that takes a while, and what is known of how far it is.

    Whoever works reports; a thread speaks where no report comes. Lines on standard error begin after PATIENCE and
    become rarer, up to one in LINES. Libraries may drop the KeyboardInterrupt of Ctrl-C: where the work goes on
    INTERRUPT_TIME seconds after it, the thread presses again.

    insists : whether it does; not for work that ends by itself after Ctrl-C, with what it has
    """

    def __init__(self, what: str, *, insists: bool = True) -> None:
        self.what, self.share, self.found, self.doing, self.insists = what, 0.0, "", "", insists
        self.started = time.monotonic()
        self.pressed: list[float] = []  # when Ctrl-C was
        self.answer = ""  # what is said to Ctrl-C, once; "": nothing before the work has ended
        self.due = self.started + PATIENCE
        self.ended = Event()

    def report(self, share: float) -> None:
        """Note the share that is done, 0 to 1."""
        self.share = share
        self.speak()

    def bound(self, lower: float, upper: float) -> None:
        """Note the bounds of a margin."""
        self.note(_bounds_text(lower, upper))

    def note(self, found: str) -> None:
        """Note in words how far the work is."""
        self.found = found
        self.speak()

    def step(self, doing: str) -> None:
        """Note in words what is being done."""
        self.doing = doing
        self.speak()

    def speak(self) -> None:
        """Print a line if one is due."""
        now = time.monotonic()
        if now < self.due:
            return
        spent = now - self.started
        self.due = now + min(LINES, max(INTERVAL, spent / 4))
        shown = [
            self.doing,
            self.found,
            f"{100 * self.share:.0f} %" if self.share > 0 else "",
            duration_text(spent),
        ]
        if self.share > 0:
            shown.append(f"about {duration_text(spent * (1 / min(self.share, 1) - 1))} left")
        print_note(f"{self.what}: {', '.join(filter(None, shown))}")

    def attend(self) -> None:
        """Print lines as they become due, and press Ctrl-C again where it was dropped, until the work has ended."""
        while not self.ended.wait(min(max(self.due - time.monotonic(), 0.05), 0.25)):
            self.speak()
            if self.pressed and self.answer:
                print_note(self.answer)
                self.answer = ""
            if self.insists and self.pressed and time.monotonic() > self.pressed[-1] + INTERRUPT_TIME:
                press_again()


@contextmanager
def progress_on(what: str, *, insists: bool = True) -> Iterator[WorkProgress]:
    """Say how far work is on standard error: a bar on a terminal, elsewhere lines. `insists` as of Work.

    Example: `with working("claims") as work: work.report(0.5)`
    """
    work = WorkProgress(what, insists=insists)
    thread = Thread(target=work.attend, daemon=True)
    bar = _draw_bar(work) if sys.stderr.isatty() else nullcontext()
    with watch_interrupts(typer.Exit) as work.pressed, bar:
        thread.start()
        try:
            yield work
        finally:
            work.ended.set()
            thread.join()


@contextmanager
def _draw_bar(work: WorkProgress) -> Iterator[None]:
    """Draw a bar for work on a terminal: it pulses until the first report, then has the time left."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())

    class Bar(Progress):
        """A bar that looks at the work whenever it is drawn."""

        def get_renderables(self) -> Iterable[Any]:
            for task in self.tasks:
                task.description = " ".join(filter(None, (work.what, work.doing, work.found)))
                task.total, task.completed = (1.0, work.share) if work.share > 0 else (None, 0)
            return super().get_renderables()

    work.due = math.inf  # no lines
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        bar.add_task(work.what, total=None)
        yield


@contextmanager
def progress_bar(what: str, *, insists: bool = True) -> Iterator[Callable[[float], None]]:
    """Say how far work is; yields the function that takes the share done, 0 to 1. `insists` as of Work."""
    with progress_on(what, insists=insists) as work:
        yield work.report


@contextmanager
def work_until(
    what: str, seconds: float | None, stands: str = "nothing was written"
) -> Iterator[WorkProgress]:
    """Say how far work is that ends with what it knows, after some seconds or at the first Ctrl-C.

    Searches within the block return what they have found by then. A second Ctrl-C prints the last note, as bounds of a
    margin, else what `stands`, and ends the command at once with exit code 130.
    """
    end = WorkEnd()

    def stop() -> None:
        end.at = -math.inf

    with (
        soften_first_interrupt(stop),
        count_work(math.inf, seconds, end),
        progress_on(what, insists=False) as work,
    ):
        work.answer = "Ctrl-C: ending with what is known; once more ends at once"
        try:
            with watch_interrupts(typer.Exit):
                yield work
        except (KeyboardInterrupt, RuntimeError, SystemError) as error:
            if not is_interrupt(error):
                raise
            raise interruption(work.found or stands) from None


def require_whole(work: WorkProgress) -> None:
    """End a command that has printed what was known by Ctrl-C with exit code 130."""
    if work.pressed:
        raise interruption("what is known by then is above")


def end_early(pressed: Sequence[float], stands: str) -> None:
    """Say in one sentence what stands of work that ended early: after Ctrl-C with exit code 130."""
    if pressed:
        raise interruption(stands)
    print_note(f"the time is up; {stands}")


def interruption(stands: str) -> typer.Exit:
    """What Ctrl-C ends a command with: one sentence of what stands, and exit code 130."""
    print_note(f"interrupted; {stands}")
    return typer.Exit(130)


def _bounds_text(lower: float, upper: float) -> str:
    """The bounds of a margin as shares of the uncertainty."""
    return f"proven {at_least(max(lower, 0)).percent()}, lost at {at_most(upper).percent()}"

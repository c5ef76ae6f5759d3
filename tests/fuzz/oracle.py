"""What reading an input may do: it is read or refused in one sentence, in bounded time and memory, without a trace."""

from __future__ import annotations

import contextlib
import io
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from malta.cli import main as cli
from malta.cli.output import print_error
from malta.errors import CheckError, InputError

LONGEST = 300  # characters of a sentence
SECONDS = 20.0  # of the processor, for a case
GROWTH = 600_000  # KiB by which a case may raise the largest memory of the process


class Defect(AssertionError):
    """What no input may do."""


class Ended(NamedTuple):
    """How reading an input ended."""

    code: int
    out: str
    err: str
    value: Any  # what a function returned


def line(*arguments: str) -> Callable[[], None]:
    """Run `malta ARGUMENTS`."""

    def run() -> None:
        before, sys.argv = sys.argv, ["malta", *arguments]
        try:
            cli.main()
        finally:
            sys.argv = before

    return run


def observe(
    act: Callable[[], Any], folder: Path | None = None, named: Sequence[str] = (), *, writes: bool = False
) -> Ended:
    """Run a command or a function and judge it.

    folder : the user's files: none of them may change, and nothing may be left beside them
    writes : whether it writes files of its own where nothing is refused; hidden ones may not stay
    named : texts one of which a refusal has to name, as the file at fault

    Raises Defect.
    """
    files = _files(folder)
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with _deadline(), warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        ended = _run(act)
    spent = time.process_time() - started
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if spent > SECONDS:
        raise Defect(f"{spent:.0f} s")
    if grown > GROWTH:
        raise Defect(f"{grown / 1024:.0f} MB more memory")
    if warned:
        raise Defect(f"a warning: {warned[0].category.__name__}: {warned[0].message} ({warned[0].filename})")
    changed = {name for name, _ in set(_files(folder).items()) ^ set(files.items())}
    if writes and ended.code in (0, 1):
        changed = {name for name in changed if name in files or Path(name).name.startswith(".")}
    if changed:
        raise Defect(f"other files: {sorted(changed)[:3]}"[:500])
    _judge(ended, named)
    return ended


def _run(act: Callable[[], Any]) -> Ended:
    """Run with the exit codes of the command line, and what is printed."""
    out, err = io.StringIO(), io.StringIO()
    value, code = None, 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            value = act()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
        except (InputError, CheckError) as error:
            code = print_error(error)
        except Defect:
            raise
        except ArithmeticError as error:
            code = print_error(CheckError(f"numbers beyond what can be computed ({error})"))
        except BaseException as error:
            trace = "".join(traceback.format_exception(error)[-4:])
            raise Defect(f"{type(error).__name__}: {str(error)[:300]}\n{trace}") from error
    return Ended(code, out.getvalue(), err.getvalue(), value)


def _judge(ended: Ended, named: Sequence[str]) -> None:
    if ended.code not in (0, 1, 2):
        raise Defect(f"exit code {ended.code}")
    if "Traceback" in ended.err + ended.out:
        raise Defect("a traceback")
    if ended.code != 2:
        return
    sentence = " ".join(ended.err.split()).removeprefix("malta: ")
    if ended.err.count("\n") != 1 or not ended.err.startswith("malta: "):
        raise Defect(f"no single sentence: {ended.err[:400]!r}")
    if len(sentence) > LONGEST or not sentence.isprintable():
        raise Defect(f"{len(sentence)} characters, printable {sentence.isprintable()}: {sentence[:600]!r}")
    if named and not any(name in sentence for name in named):
        raise Defect(f"names none of {list(named)}: {sentence!r}")


def _files(folder: Path | None) -> dict[str, int]:
    """The files of a folder with hashes of what is in them; without what Python keeps of modules that it imports."""
    if folder is None:
        return {}
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {str(path): hash(path.read_bytes()) for path in files}


@contextlib.contextmanager
def _deadline() -> Iterator[None]:
    """Stop what does not end: ten times SECONDS by the clock, since the computer may have other work."""

    def stop(_: int, __: FrameType | None) -> None:
        raise Defect(f"no end after {10 * SECONDS:.0f} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 10 * SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)

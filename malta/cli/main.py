"""The program `malta`: its commands, its exit codes, and one sentence for everything that is wrong.

Commands read arguments, call the same functions as a notebook, and print the records; each has a module of its name.
"""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from malta.cli.app import app as live_page
from malta.cli.campaign import campaign
from malta.cli.check import check
from malta.cli.claims import claims
from malta.cli.command import Command
from malta.cli.compare import compare
from malta.cli.design import design
from malta.cli.excite import excite
from malta.cli.export import export
from malta.cli.identify import identify
from malta.cli.learn import learn
from malta.cli.log import log
from malta.cli.new import new
from malta.cli.output import interruption, print_error, print_note, silence
from malta.cli.pil import pil
from malta.cli.plot import plot
from malta.cli.replay import replay
from malta.cli.report import report
from malta.cli.schema import schema
from malta.cli.simulate import simulate
from malta.cli.tune import tune
from malta.cli.verify import verify
from malta.errors import CheckError, InputError, shorten
from malta.files import noting_files
from malta.interrupts import is_interrupt

UsageError: Any = (
    typer.BadParameter.__base__
)  # of click, or of the copy of click that newer versions of typer have


class Grouped(TyperGroup):
    """The group of all commands: its help lists them under the headings of GROUPS, with their whole first lines."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; Ctrl-C says which files it has written."""
        with noting_files() as written:
            try:
                return super().invoke(ctx)
            except (KeyboardInterrupt, RuntimeError, SystemError) as error:
                if not is_interrupt(error):
                    raise
                raise interruption(_files_text(written)) from None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of the commands."""
        for heading, commands in GROUPS.items():
            known = [(c.__name__, _first_line(c)) for c in commands if self.get_command(ctx, c.__name__)]
            with formatter.section(heading):
                formatter.write_dl(known)


def _files_text(written: Sequence[Path]) -> str:
    """Which files stand, for the sentence after Ctrl-C; those of a scratch folder are gone."""
    stand = [str(path) for path in dict.fromkeys(written) if path.exists()]
    if not stand:
        return "nothing was written"
    more = f" and {len(stand) - 3} more" if len(stand) > 3 else ""
    return f"complete: {' '.join(stand[:3])}{more}; all other files stand as they were"


def _first_line(command: Callable[..., None]) -> str:
    """The first paragraph of a command's help, as its entry in the list of commands."""
    return " ".join((command.__doc__ or "").split("\n\n")[0].split()).rstrip(".")


GROUPS: dict[str, tuple[Callable[..., None], ...]] = {  # the order of the help
    "Commands": (design, verify, check, simulate, campaign, tune),
    "From the bench": (excite, log, identify, learn, replay),
    "Pages and pictures": (plot, report, compare, live_page, claims),
    "For other programs": (export, pil, schema),
    "A machine of your own": (new,),
}
app = typer.Typer(
    cls=Grouped,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="""Controllers for self-bearing and magnetically levitated actuators: from a machine's data to verified
    gain files, and a nonlinear simulation that consumes them.

    Exit codes: 0 fine; 1 a check failed (unstable, touched down), old gain files stand; 2 bad input; 130 Ctrl-C.""",
)
for command in chain.from_iterable(GROUPS.values()):
    app.command(cls=Command)(command)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"malta {version('malta')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Show the version.")
    ] = False,
) -> None:
    """Options of the program itself."""


def main() -> None:
    """Run the command line and exit with its code; an error becomes one sentence on standard error."""
    # The matrices here are small: threads of the linear algebra would only get into each other's way.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Numeric libraries make many lasting objects; going through them again and again costs a sixth of the time.
    gc.set_threshold(200_000, 50, 50)
    if sys.stderr is None:  # closed by whoever started this: work goes on, its sentences are lost
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  until the process ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters shows ? and goes on
    try:
        try:
            sys.exit(app(prog_name="malta", standalone_mode=False) or 0)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # now: at the end of the process nobody could say what went wrong
    except UsageError as error:
        sys.exit(_print_usage(error))
    except (typer.Abort, KeyboardInterrupt):  # before or after the command itself
        print_note("interrupted")
        sys.exit(130)
    except OSError as error:  # of standard output: files that are read or written have errors of their own
        sys.exit(_end_output(error))
    except (InputError, CheckError) as error:
        sys.exit(print_error(error))
    except MemoryError:
        sys.exit(print_error(CheckError("more was asked for than this computer has memory for")))
    except ArithmeticError as error:
        sys.exit(print_error(CheckError(f"numbers beyond what can be computed ({error})")))
    finally:
        gc.freeze()  # the process ends: no last walk through what the system takes back at once


def _print_usage(error: Any) -> int:
    """Say in one sentence what is wrong with the arguments, and return the exit code; no arguments get the help."""
    if not sys.argv[1:]:
        error.show()
    else:
        command = error.ctx.command_path if error.ctx is not None else "malta"
        print_note(shorten(f"{error.format_message().rstrip('.')}; see {command} --help"))
    return 2


def _end_output(error: OSError) -> int:
    """Say why output cannot be written, write no more of it, and return the exit code."""
    where, found = error.filename or "standard output", error.strerror or type(error).__name__
    silence(sys.stdout)
    if isinstance(error, BrokenPipeError):  # whoever read has read enough
        return 1
    return print_error(InputError(where, "", found, "a place to write to"))


if __name__ == "__main__":
    main()

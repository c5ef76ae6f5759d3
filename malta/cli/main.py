"""The program `malta`: its commands, its exit codes, and one sentence for everything that is wrong.

Commands read arguments, call the same functions as a notebook, and print the records; each has a module of its name.
"""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from malta.cli.bench import commission, measure
from malta.cli.campaign import campaign
from malta.cli.design import design, tune
from malta.cli.excitation import excite
from malta.cli.export import export, pil, schema
from malta.cli.identification import identify
from malta.cli.inspect import inspect, new
from malta.cli.loads import loads
from malta.cli.log_inspection import log, replay
from malta.cli.output import interruption, print_error, print_note, silence
from malta.cli.pages import app as live_page, claims, motion
from malta.cli.report import compare, plot, report
from malta.cli.simulate import simulate
from malta.cli.stroke_learning import learn
from malta.cli.verify import check, verify
from malta.errors import CheckError, InputError, shorten
from malta.files import version
from malta.interrupts import is_interrupt, watch_interrupts
from malta.writing import noting_files

# The class of all commands: help in panels, and the options of the version before, which say what replaces them.


LAST_PANEL = "Options"  # the last panel of a help, of options without one
UNITS = {  # options that `--option NAME=VALUE` takes now, and the unit that their numbers had
    "distance": "mm", "rise": "ms", "profile": "", "during": "", "fidelity": "", "noise": "", "estimator": "",
    "feedforward": "", "bearing_axes": "", "delay": "", "substeps": "",
}  # fmt: skip
FLAGS = ("quantize", "bearing", "scheduled", "real_pwm")  # others, which had no value
STUDIES = {
    "--rare": "--study rare --limit",
    "--sobol": "--study sensitivity",
    "--tolerance": "--study tolerances --keep",
}


KINDS = {"integer": "N", "integer range": "N", "text": "WORD"}  # of a value without a name


class PanelCommand(TyperCommand):
    """A command whose help has a panel for each group of options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments, with replaced options as what replaces them."""
        renewed = renew(args) if self.name in ("simulate", "campaign") else args
        return list(super().parse_args(ctx, renewed))

    def format_usage(self, ctx: Any, formatter: Any) -> None:
        """Write the line of usage: each argument by the one name that it has in all commands."""
        names = [_name_of(param) for param in self.get_params(ctx) if param.param_type_name == "argument"]
        formatter.write_usage(ctx.command_path, " ".join(["[OPTIONS]", *names]))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the panels, in the order of their first options."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None and param.param_type_name == "argument":
                record = _name_of(param), record[1]
            if record is not None:
                own = getattr(param, "rich_help_panel", None) or LAST_PANEL
                panels.setdefault("Arguments" if param.param_type_name == "argument" else own, []).append(
                    record
                )
        rest = panels.pop(LAST_PANEL, [])
        for heading, rows in [*panels.items(), (LAST_PANEL, rest)]:
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def _name_of(argument: Any) -> str:
    """How a help names an argument: GAINS, [GAINS] where it may be left out, GAINS... where there may be several."""
    name = (argument.metavar or argument.human_readable_name.upper()).strip("[].")
    return (name if argument.required else f"[{name}]") + ("..." if argument.nargs == -1 else "")


def renew(args: list[str]) -> list[str]:
    """Arguments in which replaced options are what replaces them; each one is noted.

    Raises InputError for two studies, and for strokes that learn, which are of another command.

    >>> renew(["gains.json", "--seed", "3"])
    ['gains.json', '--seed', '3']
    """
    found: list[str] = []
    rest = list(args)
    studies = [word for word in args if word.partition("=")[0] in (*STUDIES, "--study")]
    if len(studies) > 1:
        raise InputError("malta campaign", "", " and ".join(studies), "one study")
    if any(word.partition("=")[0] == "--strokes" for word in args):
        raise InputError("malta simulate", "--strokes", "strokes that learn", "malta learn GAINS --strokes N")
    while rest:
        word = rest.pop(0)
        option, sign, value = word.partition("=")
        name = option.removeprefix("--").replace("-", "_")
        flag = name.removeprefix("no_")
        if not option.startswith("--") or not (name in UNITS or flag in FLAGS or option in STUDIES):
            found.append(word)
            continue
        if flag in FLAGS:
            new = ["--option", f"{flag}={'true' if flag == name else 'false'}"]
        else:
            takes = option != "--sobol" and not sign
            if takes and not rest:  # its value is missing, which the parser says
                found.append(word)
                continue
            value = rest.pop(0) if takes else value
            new = ["--option", f"{name}={value}{UNITS[name]}"] if name in UNITS else STUDIES[option].split()
            new += [value] if option in STUDIES and option != "--sobol" else []
        print_note(f"{option} goes with the next version: write {' '.join(new)}")
        found += new
    return found


UsageError: Any = typer.BadParameter.__base__  # of click, or of the copy of it in newer versions of typer


HELP_NAMES = {"help_option_names": ["-h", "--help"]}


class Commands(Mapping[str, Any]):
    """The commands by name. Each is made of its function when it is asked for: the others are not, which takes long."""

    def __init__(self) -> None:
        self._functions = {run.__name__: run for run in chain.from_iterable(GROUPS.values())}
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        """The command of a name. Raises KeyError for an unknown one."""
        if name not in self._made:
            alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
            alone.command(cls=PanelCommand, context_settings=HELP_NAMES)(self._functions[name])
            self._made[name] = get_command(alone)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        """Their names, in the order of the help."""
        return iter(self._functions)

    def __len__(self) -> int:
        """Their number."""
        return len(self._functions)


class Grouped(TyperGroup):
    """The group of all commands: its help lists them under the headings of GROUPS, with their whole first lines."""

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        self.commands = Commands()  # type: ignore[assignment]  # only read

    def list_commands(self, _: Any) -> list[str]:
        """Their names."""
        return [*self.commands]

    def invoke(self, ctx: Any) -> Any:
        """Run a command; Ctrl-C says which files it has written."""
        with noting_files() as written:
            try:
                with watch_interrupts(typer.Exit, typer.Abort):
                    return super().invoke(ctx)
            except (KeyboardInterrupt, RuntimeError, SystemError) as error:
                if not is_interrupt(error):
                    raise
                raise interruption(_files_text(written)) from None

    def format_commands(self, _: Any, formatter: Any) -> None:
        """Write the sections of the commands."""
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(c.__name__, _first_line(c)) for c in commands])


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
    "Commands": (design, verify, loads, check, simulate, campaign, tune),
    "From the bench": (excite, log, identify, learn, replay, measure, commission),
    "Pages and pictures": (plot, report, compare, motion, live_page, claims),
    "For other programs": (export, pil, schema),
    "A machine of your own": (new, inspect),
}
app = typer.Typer(
    cls=Grouped,
    no_args_is_help=True,
    context_settings=HELP_NAMES,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="""Controllers for self-bearing and magnetically levitated actuators: from a machine's data to verified
    gain files, and a nonlinear simulation that consumes them.

    Exit codes: 0 fine; 1 a check failed (unstable, touched down), old gain files stand; 2 bad input; 130 Ctrl-C.""",
)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"malta {version()}")
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
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # typer's answer to a reader that has read enough
            sys.exit(0)
        raise
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
        print_note(shorten(f"{_usage_text(error)}; see {command} --help"))
    return 2


NUMBER_TEXTS = {
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
}


def _usage_text(error: Any) -> str:
    """What is wrong with an argument, in malta's words: what was found, and what was expected."""
    refused = getattr(error.__context__, "errors", None)  # of the library that reads values
    if refused is None or error.param is None:
        return str(error.format_message().rstrip("."))
    first, option = refused()[0], error.param.opts[0]
    name = option if option.startswith("-") else (error.param.metavar or option.upper()).strip("[].")
    if first["type"] == "value_error":  # of a path that none can be
        found = f"{first['input']!r}, {first['msg'].removeprefix('Value error, ')}"
        return str(InputError(name, "", found, "a value without it"))
    limit = first["msg"].removeprefix("Input should be ")
    expected = NUMBER_TEXTS.get(first["type"], f"a number {limit}" if "than" in limit else limit)
    return str(InputError(name, "", repr(first["input"]), expected))


def _end_output(error: OSError) -> int:
    """Say why output cannot be written, write no more of it, and return the exit code."""
    where, found = error.filename or "standard output", error.strerror or type(error).__name__
    silence(sys.stdout)
    if isinstance(error, BrokenPipeError):  # whoever read has read enough
        return 0
    return print_error(InputError(where, "", found, "a place to write to"))


if __name__ == "__main__":
    main()

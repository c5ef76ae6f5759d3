"""The class of all commands: help in panels, and the options of the version before, which say what replaces them."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

from malta.cli.output import print_note
from malta.errors import InputError

REST = "Options"  # the last panel of a help, of options without one
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


class Command(TyperCommand):
    """A command whose help has a panel for each group of options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments, with replaced options as what replaces them."""
        renewed = renew(args) if self.name in ("simulate", "campaign") else args
        return list(super().parse_args(ctx, renewed))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the panels, in the order of their first options."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                own = getattr(param, "rich_help_panel", None) or REST
                panels.setdefault("Arguments" if param.param_type_name == "argument" else own, []).append(
                    record
                )
        rest = panels.pop(REST, [])
        for heading, rows in [*panels.items(), (REST, rest)]:
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def renew(args: list[str]) -> list[str]:
    """Arguments in which replaced options are what replaces them; each one is noted. Raises InputError for two studies.

    >>> renew(["gains.json", "--seed", "3"])
    ['gains.json', '--seed', '3']
    """
    found: list[str] = []
    rest = list(args)
    studies = [word for word in args if word.partition("=")[0] in (*STUDIES, "--study")]
    if len(studies) > 1:
        raise InputError("malta campaign", "", " and ".join(studies), "one study")
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

"""Arguments and options that several commands share, with their help texts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.completion import gain_files, parameters
from malta.files import locate

MACHINE = "Machine"  # a panel of a help
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a parameter: m=0.56 (SI) or l_B=45mm.",
        rich_help_panel=MACHINE,
        autocompletion=parameters,
    ),
]
DesignChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a parameter of the machine, as m=0.56 (SI) or l_B=45mm, or an entry of the design file, as "
        "weights.state.x=4, bases.state.x=50um or delay=1. The design is named after its changes.",
    ),
]
Uncertain = Annotated[
    list[str] | None,
    typer.Option(
        "--uncertain",
        metavar="SHARE|NAME=SHARE",
        help="How far parameters vary at margin 1, either way: 20% (those of the gain file), m=10%, ... "
        "[the gain file's]",
    ),
]
SCENARIOS = "`--scenario help` lists them. [the first]"
RUN = "Run"  # panels of a help
OwnOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Of the scenario, as `--scenario help` lists them: distance=5mm, noise=1, fidelity=phase, delay=2.",
        rich_help_panel=RUN,
    ),
]
Yes = Annotated[bool, typer.Option("--yes", help="Start work of more than ten minutes too.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the noise. [0]", rich_help_panel=RUN)]
DesignFile = Annotated[
    Path | None,
    typer.Option(
        "--design",
        metavar="FILE",
        help="Design file whose [specification] is judged. [NAME.toml beside the gain file's folder]",
    ),
]
GainFile = Annotated[
    Path,
    typer.Argument(
        metavar="GAINS", help="A gain file: .json, .npz or .mat.", callback=locate, autocompletion=gain_files
    ),
]
GainFileOrNone = Annotated[
    Path | None,
    typer.Argument(
        metavar="[GAINS]",
        help="A gain file. With --status: [the campaign's own]",
        callback=lambda path: None if path is None else locate(path),
        autocompletion=gain_files,
        show_default=False,
    ),
]
MachineFile = Annotated[
    Path | None,
    typer.Option(
        "--machine",
        metavar="FILE",
        envvar="MALTA_MACHINE",
        help="Module of a machine of your own, as rotor.py.",
        rich_help_panel=MACHINE,
        show_envvar=True,
    ),
]

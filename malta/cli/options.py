"""Arguments and options that several commands share, with their help texts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.completion import gain_files, parameters
from malta.files import locate

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a parameter of the machine: m=0.56 (SI) or l_B=45mm.",
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
SCENARIOS = "one of the machine's own, which `--scenario help` lists. [its first]"
# Options of a run, in `simulate` and in `campaign`.
Distance = Annotated[float | None, typer.Option(help="Length of a stroke [mm]. [the scenario's]")]
Rise = Annotated[float | None, typer.Option(help="Rise of its reference, 10-90 % [ms]. [the scenario's]")]
ProfileName = Annotated[str | None, typer.Option(help="Its reference: logistic or quintic. [the scenario's]")]
OwnOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Any other option that `--scenario help` lists: radius=0.1mm, masses=50g,100g, during=hold, ...",
    ),
]
FidelityName = Annotated[
    str | None,
    typer.Option(
        help="What makes the forces: force (first-order lags), dq (PI loops), phase. [the scenario's]"
    ),
]
Noise = Annotated[
    float | None, typer.Option(help="Sensor noise in multiples of the machine's. [the scenario's]")
]
Quantize = Annotated[
    bool | None, typer.Option(help="Sensors with the machine's resolution. [the scenario's]")
]
Bearing = Annotated[
    bool | None,
    typer.Option(help="Touchdown bearings push back, or a touchdown ends the run. [the scenario's]"),
]
Scheduled = Annotated[bool | None, typer.Option(help="C(z) of the measured z in the filter.")]
Feedforward = Annotated[
    str | None,
    typer.Option(help="axial, as printed, or attraction: also what holds it off centre. [axial]"),
]
BearingAxes = Annotated[
    str | None,
    typer.Option(
        help="dq, phase: current controllers in fixed axes, or turning with the force as printed. [fixed]"
    ),
]
RealPwm = Annotated[
    bool | None, typer.Option(help="phase: duty cycles in steps, dead time of the half-bridges.")
]
Delay = Annotated[int | None, typer.Option(help="Samples between measurement and command. [the machine's]")]
Substeps = Annotated[
    int | None,
    typer.Option(help="Runge-Kutta steps a sample; the error is estimated. [4, more for slow samples]"),
]
Yes = Annotated[bool, typer.Option("--yes", help="Start work of more than ten minutes too.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the noise. [0]")]
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
        help="A gain file: .json, .npz or .mat. With --status: [the campaign's own]",
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
        help="The module of a machine of your own, as rotor.py, where a gain file names one.",
        show_envvar=True,
    ),
]

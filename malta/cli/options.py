"""Arguments and options that several commands share, with their help texts."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from malta.cli.output import make_console, print_note
from malta.errors import CheckError, InputError
from malta.files import locate, require_suffix, shipped_path

if TYPE_CHECKING:
    from malta.model.plant import Parameters, Plant
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec


# Options of the form NAME=VALUE, read as numbers in SI.


class GeneralOption(NamedTuple):
    """An option that every scenario takes."""

    default: Any  # of the type that is read
    meaning: str


# Fields of Scenario; each may be given as `--option NAME=VALUE`.
SCENARIO_FIELDS: Mapping[str, GeneralOption] = {
    "fidelity": GeneralOption(
        "", "force, dq (PI loops on the windings) or phase; the scenario's own without it"
    ),
    "noise": GeneralOption(0.0, "of the sensors, in multiples"),
    "settle": GeneralOption(
        0.0, "rest before the reference, which no figure counts; yields of strokes have one"
    ),
    "estimator": GeneralOption("steady-state", "steady-state, kalman (time-varying) or extended"),
    "quantize": GeneralOption(False, "sensors with the machine's resolution"),
    "bearing": GeneralOption(False, "touchdown bearings push back, or a touchdown ends the run"),
    "scheduled": GeneralOption(False, "C(z) of the measured z in the filter"),
    "feedforward": GeneralOption("own", "axial, as printed, or attraction: also what holds it off centre"),
    "bearing_axes": GeneralOption(
        "fixed", "current controllers fixed, or turning with the force, as printed"
    ),
    "real_pwm": GeneralOption(False, "in phase: duty cycles in steps, dead time of the half-bridges"),
    "delay": GeneralOption(0.0, "samples between measurement and command"),
    "substeps": GeneralOption(0, "Runge-Kutta steps a sample; the error is estimated"),
    "accuracy": GeneralOption(0.0, "wanted integration error, in m or rad; 1e-9 without it"),
}
NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)"  # a number, and the unit that may follow it
SHARES = "20% or m=10%"
EXAMPLES = {"--set": "m=0.56 or l_B=45mm", "--spread": SHARES, "--uncertain": SHARES}  # in errors of these
EXAMPLE = "gain_x1=0.02 or offset_y2=5um"  # of the others


def read_assignments(option: str, texts: list[str] | None, units: Mapping[str, str]) -> dict[str, float]:
    """Read `NAME=VALUE`, each value with the unit that may follow it, as numbers in SI.

    units : SI unit of each name that may be assigned; "1" for a number without unit, or in %

    Raises InputError for another form, an unknown name, a name given twice or a unit that does not fit.

    >>> read_assignments("--set", ["l_B=45mm"], {"l_B": "m"})
    {'l_B': 0.045}
    """
    values: dict[str, float] = {}
    for text in texts or ():
        name, value = _split(text)
        number = re.fullmatch(NUMBER, value)
        if number is None or not name.isidentifier():
            raise InputError(option, "", repr(text), f"NAME=VALUE, as {EXAMPLES.get(option, EXAMPLE)}")
        if name not in units:
            kind = "sensor error" if option == "--sensor" else "parameter"
            raise InputError(option, name, f"an unknown {kind}", "one of " + " ".join(units))
        _require_once(option, name, value, values)
        values[name] = _in_si(number, units[name], option, name)
    return values


def read_entries(option: str, texts: list[str]) -> dict[str, Any]:
    """Read `NAME=VALUE` as entries of a design file: a number, one with its unit, true or false, or a word.

    Raises InputError for another form, and for a name given twice.

    >>> read_entries("--set", ["bases.state.x=50um", "delay=1", "uncertainty.m=30%"])
    {'bases.state.x': {'value': 50.0, 'unit': 'um'}, 'delay': 1, 'uncertainty.m': 0.3}
    """
    entries: dict[str, Any] = {}
    for text in texts:
        name, value = _split(text)
        if not all(part.isidentifier() for part in name.split(".")) or not value:
            raise InputError(option, "", repr(text), f"NAME=VALUE, as {EXAMPLES[option]}")
        _require_once(option, name, value, entries)
        number = re.fullmatch(NUMBER, value)
        if number is None:
            entries[name] = {"true": True, "false": False}.get(value, value)
        elif number[2] in ("%", "percent"):
            entries[name] = float(number[1]) / 100
        elif number[2]:
            entries[name] = {"value": float(number[1]), "unit": number[2]}
        else:
            entries[name] = int(number[1]) if re.fullmatch(r"[-+]?\d+", number[1]) else float(number[1])
    return entries


def read_sensor_errors(texts: list[str] | None, plant: Plant) -> dict[str, float]:
    """Read `--sensor NAME=VALUE`, errors of a machine's sensors, in SI; raises as `read_assignments` does."""
    return read_assignments("--sensor", texts, {error.name: error.unit for error in plant.sensors.errors})


def read_shares(
    gains: Path, texts: list[str] | None, parameters: Parameters, option: str = "--spread"
) -> dict[str, float]:
    """Read how far parameters vary: `SHARE` for all that are uncertain, `NAME=SHARE` for one.

    Without a text these are the shares in the gain file, else those that the machine's paper names. The spread of a
    difference or an offset is in its own unit.

    Raises InputError for two shares for all, and as `read_assignments` does.
    """
    from malta.campaigns.plan import box_of
    from malta.model.parameters import differences, units_of
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures

    for text in texts or ():
        value = text.partition("=")[2] if "=" in text else text
        if re.fullmatch(NUMBER, value.strip()) is None or any(sign in value for sign in ("=", "..")):
            expected = f"a share, either way, as {SHARES}; for several parameters the option several times"
            raise InputError(option, "", repr(text), expected)
    named = [text for text in texts or () if "=" in text]
    general = [text for text in texts or () if "=" not in text]
    if len(general) > 1:
        raise InputError(option, "", " and ".join(general), "one share for all, others as NAME=SHARE")
    shares: dict[str, float] = {}
    if general or not named:
        shares = box_of(gains, published_figures(plant_of(parameters).name), option)
    if general:
        share = read_assignments(option, [f"all={general[0]}"], {"all": "1"})["all"]
        shares = dict.fromkeys(shares, share)
    own = differences(parameters) if option == "--spread" else {}
    units = dict.fromkeys(units_of(parameters), "1") | own
    return shares | read_assignments(option, named, units)


def require_suffixes(*files: tuple[Path | None, tuple[str, ...]]) -> None:
    """Raise InputError for a file that is to be written with another suffix, before hours of work for it.

    files : each with the suffixes that it may have; None: it is not asked for
    """
    for path, suffixes in files:
        if path is not None:
            require_suffix(path, *suffixes)


def read_uncertainty(gains: Path, texts: list[str] | None, parameters: Parameters) -> dict[str, float]:
    """Read `--uncertain`, the box of a margin: shares above 0. Raises InputError as `read_shares`."""
    box = read_shares(gains, texts, parameters, option="--uncertain")
    for name, share in box.items():
        if not 0 < share < math.inf:
            raise InputError("--uncertain", name, f"{100 * share:g} %", "a share above 0 %")
    return box


def read_options(texts: list[str] | None, scenario: str, plant: Plant) -> dict[str, Any]:
    """Read the scenario's own options and general ones, `--option NAME=VALUE`, in SI and of the type of their defaults.

    Raises InputError for an unknown option, one that is given twice, or a value of another type.
    """
    from malta.simulation.experiments.catalogue import option_of, option_units

    given = dict(_split(text) for text in texts or ())
    units = option_units(scenario, plant, given)
    merged: dict[str, Any] = {}
    for text in texts or ():
        name, value = _split(text)
        if not (name and value):
            raise InputError("--option", "", repr(text), "NAME=VALUE")
        default = (
            SCENARIO_FIELDS[name].default
            if name in SCENARIO_FIELDS
            else option_of(scenario, plant, name, SCENARIO_FIELDS)
        )
        _require_once("--option", name, value, merged)
        merged[name] = _read_like(default, value, units.get(name, "1"), name)
    return merged


def _read_like(default: Any, text: str, si_unit: str, name: str) -> Any:
    """Read the value of a scenario's option with the type of its default."""
    if isinstance(default, str) or default is None:
        return text
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise InputError("--option", name, repr(text), "true or false")
        return text == "true"
    several = isinstance(default, tuple)
    numbers = [re.fullmatch(NUMBER, part.strip()) for part in (text.split(",") if several else [text])]
    values = [_in_si(number, si_unit, "--option", name) for number in numbers if number is not None]
    if len(values) < len(numbers):
        raise InputError("--option", name, repr(text), "numbers" if several else "a number")
    if several:
        return tuple(values)
    return int(values[0]) if isinstance(default, int) and values[0].is_integer() else values[0]


def _require_once(option: str, name: str, value: str, known: Mapping[str, Any]) -> None:
    """Raise InputError for a name that has a value already."""
    if name in known:
        raise InputError(option, name, f"{value!r} for the second time", "it once")


def _split(text: str) -> tuple[str, str]:
    """The name and the value of `NAME=VALUE`; the value is empty where there is none."""
    name, _, value = (part.strip() for part in text.partition("="))
    return name, value


def _in_si(number: re.Match[str], si_unit: str, option: str, name: str) -> float:
    """The value in SI of a match of NUMBER."""
    from malta.units import to_si

    value, unit = float(number[1]), number[2]
    if si_unit not in ("", "1"):
        return to_si(value, unit or si_unit, si_unit, option, name)
    if unit and not si_unit:
        expected = "no unit, or signals that have one in common, by output=NAME or on=NAME"
        raise InputError(option, f"{name}.unit", repr(unit), expected)
    if unit not in ("", "%", "percent"):
        raise InputError(option, f"{name}.unit", repr(unit), "no unit, or %")
    return value * (0.01 if unit else 1.0)


# What a shell offers at the Tab key: gain files, designs, scenarios, parameters. Whatever fails offers nothing.


GAINS = (".json", ".npz", ".mat")
DESIGNS = (".toml",)


def gain_files(incomplete: str) -> list[str]:
    """Gain files: those in design/gains at first, later files and folders below what was typed."""
    return _files(incomplete, Path("design", "gains"), GAINS)


def complete_designs(incomplete: str) -> list[str]:
    """Design files: those in design/ at first, later files and folders below what was typed."""
    return _files(incomplete, Path("design"), DESIGNS)


def machine_modules(incomplete: str) -> list[str]:
    """Modules of machines, and folders below what was typed."""
    return _files(incomplete or "./", Path(), (".py",))


def offer(*words: str) -> Callable[[str], list[str]]:
    """The completion of an option that takes one of some words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def scenarios(ctx: Any, incomplete: str) -> list[str]:
    """The scenarios of the machine of the gain file that was typed; one's own has to be named before, by --machine."""
    found: list[str] = []
    with suppress(Exception):
        from malta import gains
        from malta.model.machines import machine
        from malta.model.plants import plant_of
        from malta.simulation.experiments.catalogue import experiments_of

        named = ctx.params.get("machine") or os.environ.get("MALTA_MACHINE")
        if named:
            machine(locate(named))
        plant = plant_of(gains.read(_typed_gains(ctx)).parameters)
        found = [name for name in experiments_of(plant) if name.startswith(incomplete)]
    return found


def parameters(ctx: Any, incomplete: str) -> list[str]:
    """The parameters in the gain file that was typed, as `m=`."""
    found: list[str] = []
    with suppress(Exception):
        from malta.gains.encodings import decode

        names = decode(_typed_gains(ctx))["plant"]["parameters"]
        found = [f"{name}=" for name in names if name.startswith(incomplete)]
    return found


def parameter_names(ctx: Any, incomplete: str) -> list[str]:
    """The parameters in the gain file that was typed, as `m`."""
    return [name.removesuffix("=") for name in parameters(ctx, incomplete)]


def _typed_gains(ctx: Any) -> Path:
    """The gain file that was typed; behind an option without its value it is still among the bare arguments."""
    from malta.files import locate

    words = [ctx.params.get("gains"), *ctx.args]
    return locate(next(word for word in words if word and Path(word).suffix in GAINS))


def _files(incomplete: str, usual: Path, suffixes: tuple[str, ...]) -> list[str]:
    """Files with one of the suffixes and folders that begin with what was typed; in the usual folder without it."""
    with suppress(OSError):
        if not incomplete and usual.is_dir():
            return sorted(f"{path}" for path in usual.iterdir() if path.suffix in suffixes)
        typed = Path(incomplete)
        folder, start = (typed, "") if incomplete.endswith("/") else (typed.parent, typed.name)
        entries = [path for path in folder.iterdir() if path.name.startswith(start)]
        found = [f"{path}/" for path in entries if path.is_dir()]
        return sorted(found + [f"{path}" for path in entries if path.suffix in suffixes])
    return []


MACHINE = "Machine"  # a panel of a help


TIME_HELP = "End after this time with what is known. [none]"


def positive_time(seconds: float | None) -> float | None:
    """The time that a command may take. Raises InputError for one that is not above zero."""
    if seconds is not None and not 0 < seconds < math.inf:
        raise InputError("--time", "", f"{seconds:g}", "seconds above 0")
    return seconds


WholeTime = Annotated[
    float | None, typer.Option("--time", metavar="SECONDS", callback=positive_time, help=TIME_HELP)
]
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
        autocompletion=parameters,
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
Seed = Annotated[int | None, typer.Option(metavar="N", help="Seed of the noise. [0]", rich_help_panel=RUN)]
DesignFile = Annotated[
    Path | None,
    typer.Option(
        "--design",
        metavar="DESIGN",
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
        metavar="MODULE",
        envvar="MALTA_MACHINE",
        autocompletion=machine_modules,
        callback=lambda path: None if path is None else locate(path),
        help="Module of a machine of your own, as rotor.py.",
        rich_help_panel=MACHINE,
        show_envvar=True,
    ),
]


# What commands read before they begin: design files, the changed machine, published figures, scenarios.


MAX_NAME_LENGTH = 48  # letters of the changes in the name of a design; more are shortened to a number


def design_files(
    command: str, named: list[Path] | None, *, reverse: bool = False, or_shipped: bool = False
) -> list[Path]:
    """The design files that were named, or all of design/ in alphabetical or reverse order.

    or_shipped : where there is no folder design/ here, those that come with malta

    Data of machines among them are named on the standard error and left out, unless they were named as designs.
    Raises InputError, naming the command, where design/ has none.
    """
    if named:
        return named
    folder = Path("design")
    if or_shipped and not folder.is_dir():
        folder = shipped_path("design")
    files = []
    for file in sorted(folder.glob("*.toml"), reverse=reverse):
        if is_machine_data(file):
            print_note(f"{file}: data of a machine, no design: left out")
        else:
            files.append(file)
    if not files:
        raise InputError(
            command, "", "no design files (*.toml) here", "a folder design/ with some, or their names"
        )
    return files


def is_machine_data(file: Path) -> bool:
    """Whether a file has what data of machines have and designs have not; a file that cannot be read is no data."""
    try:
        from malta.tables import load_toml  # loads pydantic, which no help needs

        content = load_toml(file)
    except InputError:
        return False
    return "parameters" in content and not {"weights", "pid", "sample_time"} & set(content)


def gains_folder(design_file: Path) -> Path:
    """Where the gain files of a design go: gains/ beside it; design/gains/ here, where it comes with malta."""
    return design_file.parent / "gains" if locate(design_file) == design_file else Path("design", "gains")


def read_controller(gains: Path, machine_file: Path | None) -> Controller:
    """Read a gain file. `machine_file` models the machine that it names, where that is the user's own.

    Raises InputError as `malta.machine` and `gains.read`; an unknown machine is named with the option that tells it.
    """
    from malta import gains as gain_files
    from malta.cli.inspect import note_machine
    from malta.gains.stable import require_held
    from malta.model.machines import machine
    from malta.model.plants import plant_of

    if machine_file is not None:
        machine(machine_file)
    controller = require_held(gain_files.read(gains), gains)
    note_machine(plant_of(controller.parameters))
    return controller


def verify_and_write(controller: Controller, gains: Path, folder: Path) -> list[Path]:
    """Verify a controller over the uncertainty of the gain file that it comes from, and write it in all encodings."""
    from malta import gains as gain_files
    from malta.gains.file import content_of
    from malta.tuning.verify import verify

    margins = verify(controller, uncertainty=content_of(gains)[0].uncertainty)
    paths = [folder / f"{controller.name}{suffix}" for suffix in gain_files.SUFFIXES]
    gain_files.write(controller, margins, *paths)
    return paths


def find_design(gains: Path, controller: Controller, named: Path | None) -> Spec | None:
    """The design of a gain file: the file that was named, else NAME.toml beside its folder; None where there is none.

    Raises InputError for a named file that is no design of the machine.
    """
    from malta.synthesis.design_file import read_design

    try:
        spec = read_design(named or gains.parent.parent / f"{controller.name}.toml")
    except InputError:
        if named is None:
            return None
        raise
    own, other = controller.parameters, spec.parameters
    if type(own) is type(other):
        return spec
    if named is None:
        return None
    raise InputError(named, "machine", spec.plant.name, "that of the gain file")


def read_changed_design(file: Path, changes: list[str] | None) -> Spec:
    """Read a design file with `--set NAME=VALUE`: parameters of the machine, and entries of the file.

    The design has a name of its own then, with its changes: `calibrated_m_0_56`.

    Raises InputError for a change of the design's name or machine, and as `read_design` does.
    """
    from dataclasses import replace

    from malta.cli.inspect import note_machine
    from malta.model.parameters import units_of
    from malta.synthesis.design_file import read_design
    from malta.synthesis.design_tables import DesignFile

    spec = read_design(file)
    note_machine(spec.plant)
    if not changes:
        return spec
    units = units_of(spec.parameters)
    of_machine = [text for text in changes if text.partition("=")[0].strip() in units]
    others = read_entries("--set", [text for text in changes if text not in of_machine])
    for name in others:
        if name in ("name", "machine"):
            raise InputError("--set", name, "a change of it", "another design file")
        if name.partition(".")[0] not in DesignFile.model_fields:
            expected = f"one of {' '.join(units)}, or an entry of the design file"
            known = [*units, *DesignFile.model_fields]
            raise InputError("--set", name, "an unknown parameter", expected, known)
    values = read_assignments("--set", of_machine, units)
    change_machine(spec.parameters, of_machine)  # which says what is wrong with a value
    changed = read_design(file, values, others)
    return replace(
        changed,
        name=f"{spec.name}_{name_of_changes(changes)}",
        summary=f"{spec.summary}; with {', '.join(changes)}",
    )


def name_of_changes(changes: list[str]) -> str:
    """The changes as a part of a file's name: `m=.4` is m_0_4, `m=4` is m_4 and `m=4%` m_4percent."""
    words = re.sub(r"(?<!\d)\.(?=\d)", "0.", " ".join(changes)).replace("%", "percent")
    words = re.sub(r"[\u00b5\u03bc]", "u", words)  # micro
    words = re.sub(r"[^A-Za-z0-9-]+", "_", words).strip("_")
    return words if len(words) <= MAX_NAME_LENGTH else hashlib.sha256(words.encode()).hexdigest()[:8]


def change_machine(parameters: Parameters, changes: list[str] | None) -> Parameters:
    """Apply `--set NAME=VALUE` to a machine's parameters and name the preset accordingly.

    Raises InputError for an unknown parameter, a value it cannot have, or a machine that cannot be controlled.
    """
    from dataclasses import replace

    from malta.model.parameters import units_of
    from malta.model.plants import plant_of

    values = read_assignments("--set", changes, units_of(parameters))
    try:
        preset = f"{parameters.preset}, changed" if values else parameters.preset
        machine = replace(parameters, **values, preset=preset)
        plant_of(machine)
    except InputError as error:
        raise InputError("--set", error.field, error.found, error.expected) from error
    except CheckError as error:
        raise InputError("--set", "", str(error), "a machine that can be controlled") from error
    return machine


def print_scenarios(plant: Plant, *, campaigns: bool = False) -> None:
    """Print the scenarios of a machine: all of them, or those that campaigns can run."""
    from malta import report
    from malta.simulation.experiments.catalogue import series_of

    console = make_console()
    console.print(report.scenarios_table(plant, series_of(plant) if campaigns else None))
    console.print("Every scenario takes, as --option NAME=VALUE:")
    for name, option in SCENARIO_FIELDS.items():
        console.print(f"  {name:12}  {option.meaning}", highlight=False)

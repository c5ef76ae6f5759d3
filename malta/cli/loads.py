"""`malta loads`: how large any load may be, whatever its waveform, as a theorem of the nonlinear machine."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.cli.options import (
    NUMBER,
    AsJson,
    Changes,
    GainFile,
    MachineFile,
    WholeTime,
    change_machine,
    parameters,
    read_controller,
    read_uncertainty,
    require_suffixes,
)
from malta.cli.output import (
    make_console,
    print_document,
    print_note,
    print_text,
    print_written,
    require_whole,
    work_until,
)
from malta.errors import CheckError, InputError
from malta.files import PICTURES

if TYPE_CHECKING:
    from malta.loops.loop import Loop
    from malta.margins.load_sizes import LoadLimit
    from malta.model.vibration import VibrationPreset


PRESETS = "api617, iso14839_2_a to c: shares of a clearance; workshop, office, vc_a to vc_e: motion on such a floor."
ROUNDING = 1e-13  # SI, of what is moved: less is rounding


def loads(
    gains: GainFile,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A load: F_x; at a point F_x=1,T_y=-45mm; both at once F_x+F_y. Repeatable. [each of the machine]",
        ),
    ] = None,
    change: Changes = None,
    uncertain: Annotated[
        list[str] | None,
        typer.Option(
            "--uncertain",
            metavar="SHARE|NAME=SHARE",
            autocompletion=parameters,
            help="How far parameters are off at most, and may move in flight: 5% (those of the gain file), m=5%, ... "
            "[nominal]",
        ),
    ] = None,
    noise: Annotated[
        float, typer.Option(metavar="N", help="Errors of readings are at most so many times their rms.")
    ] = 6.0,
    preset: Annotated[str | None, typer.Option(metavar="NAME", help=PRESETS)] = None,
    requests: Annotated[
        bool, typer.Option("--requests", help="How far any request drives the loop.")
    ] = False,
    time: WholeTime = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A picture: clearance used over the load. .png, .svg, .pdf."),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Prove how large any load may be before the nonlinear machine touches or saturates, whatever its waveform.

    Beside it: what ends the proof, the shares of clearances and forces that are used, and the size from which on some
    waveform makes the linear loop touch. Of the machine with forces as `fidelity=force` flies them, from rest; induced
    voltages, voltage limits and the DC link are left out. Exit code 1 where the loop is unstable.

    \b
    Example:  malta loads design/gains/robust.json --load F_x --load F_x+F_y
              malta loads design/gains/robust.json --preset iso14839_2_a
    """
    from malta.loops.loop import loop as loop_of
    from malta.margins.load_sizes import load_limits
    from malta.model.plants import plant_of
    from malta.model.vibration import vibration_preset

    require_suffixes((out, PICTURES))
    controller = read_controller(gains, machine)
    plant = plant_of(change_machine(controller.parameters, change))
    asked = [read_load(text) for text in load or ()] or None
    box = read_uncertainty(gains, uncertain, plant.parameters) if uncertain else {}
    loop = loop_of(plant, controller)
    _require_stable(gains, loop)
    bound = vibration_preset(preset, "--preset") if preset is not None else None
    head = f"{gains}: {controller.name}, {plant.name}, preset {' '.join([plant.parameters.preset, *(change or ())])}"
    if requests or (bound is not None and bound.velocity):
        if asked or box or out:
            raise InputError(
                "malta loads", "", "--load, --uncertain or --out", "none with requests or a floor"
            )
        _print_linear(gains, loop, None if requests else bound, head, as_json)
        return
    share = 1.0 if bound is None else bound.clearance
    with work_until("loads", time) as work:
        found = load_limits(loop, asked, box, noise=noise, courses=out is not None, clearance=share)
    files = [] if out is None else _draw(controller.name, found, out)
    if as_json:
        from malta.cli.documents.loads import loads_output

        print_document(loads_output(gains, loop, found, box, files))
    else:
        _print(head, loop, found, box, bound)
        print_written(make_console(), files)
    require_whole(work)


def _draw(name: str, found: Sequence[LoadLimit], picture: Path) -> list[Path]:
    """Draw the use of clearance over the load, where there is one."""
    from malta.report.figures.loads import load_limits_figure

    if not any(one.course for one in found):
        print_note(f"{picture} is not drawn: no load is proven that uses a clearance of a contact")
        return []
    load_limits_figure(found, name, picture)
    return [picture]


def read_load(text: str) -> Any:
    """Read a load as `malta.safe_load` takes it: a name, shares of several, or several at once.

    Raises InputError for another form.
    """
    parts = [_read_part(part.strip()) for part in text.split("+")]
    return parts[0] if len(parts) == 1 else parts


def _read_part(text: str) -> str | dict[str, float]:
    """A name, or shares NAME=NUMBER with a comma between them; a lever may have a unit of length."""
    from malta.units import to_si

    if "=" not in text:
        return text
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (word.strip() for word in part.partition("="))
        number = re.fullmatch(NUMBER, value)
        if number is None or name in shares:
            raise InputError("--load", name, repr(text), "a name, or shares as F_x=1,T_y=-45mm")
        shares[name] = (
            to_si(float(number[1]), number[2], "m", "--load", name) if number[2] else float(number[1])
        )
    return shares


def _require_stable(gains: Path, loop: Loop) -> None:
    """Raise CheckError for an unstable loop, of which nothing is asked."""
    if not loop.stable:
        radius = loop.sampled.spectral_radius
        raise CheckError(f"{gains}: the loop (machine) is unstable, |lambda| = {radius:.6f}")


def _print_linear(gains: Path, loop: Loop, floor: VibrationPreset | None, head: str, as_json: bool) -> None:
    """Print how far a floor moves the linear loop, or how far requests drive it, as a table or as a document."""
    from malta.cli.documents.loads import linear_output
    from malta.report.tables.loads import reaches_table

    what, found = "Any request within limits of position, speed and acceleration", []
    if floor is None:
        found = _requests(loop)
    else:
        from malta.loops.floors import floor_motion

        what = f"Floor of {floor.title}: {1e6 * floor.velocity:g} µm/s rms in each third of an octave, 8 to 80 Hz"
        units = {s.name: s.unit for s in loop.plant.outputs}
        moved = floor_motion(loop, floor.velocity).items()
        found = [(along, name, x, units[name]) for along, of in moved for name, x in of.items()]
    found = [one for one in found if one[2] > ROUNDING]
    if as_json:
        print_document(linear_output(gains, loop.controller.name, what, found))
        return
    console = make_console()
    print_text(console, head)
    console.print(reaches_table(what, found, " rms" if floor else ""))
    told = f"Source: {floor.source}." if floor else "It holds while no command reaches its limit."
    print_text(console, f"Of the linear loop at rest, at samples. {told}")


def _requests(loop: Loop) -> list[tuple[str, str, float, str]]:
    """Requests that the supervisor accepts, while no sum of errors waits: of what, what they drive, size and unit."""
    from malta.display import quantity
    from malta.firmware.signals import deepest_target
    from malta.firmware.supervisor import reference_limits
    from malta.simulation.requests import worst_request

    c, found = loop.controller, []
    for k, s in enumerate(loop.plant.outputs):
        place, speed, bend = (float(limit[k]) for limit in reference_limits(deepest_target(c)))
        pause = (1 - 1e-9) * c.pause[k] if c.pause.size else 0.0
        within = place, min(speed, pause or math.inf), bend
        text = ", ".join(quantity(x, s.unit + per) for x, per in zip(within, ("", "/s", "/s^2"), strict=True))
        for output in (f"error {s.name}", *(one.name for one in loop.plant.inputs)):
            worst = worst_request(loop, s.name, output, within)
            found.append((f"{s.name} within {text}", output, worst.upper, worst.unit))
    return found


def _print(
    head: str, loop: Loop, found: Sequence[LoadLimit], box: dict[str, float], bound: VibrationPreset | None
) -> None:
    """Print the table, and what it is of."""
    from malta.model.parameters import box_words
    from malta.report.tables.loads import load_limits_table, load_limits_text, place_text

    console, par = make_console(), loop.plant.parameters
    print_text(console, head)
    console.print(load_limits_table(found))
    if box:
        print_text(
            console,
            f"Anywhere in {box_words(box, par)}, which may move in flight; the linear loop is nominal.",
        )
    print_text(console, load_limits_text(found, place_text(loop)))
    if bound is not None:
        print_text(console, f"{bound.title}. Source: {bound.source}.")

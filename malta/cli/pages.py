"""`malta app`: a local page to design with; `malta motion`: a machine that moves; `malta claims`: a paper's numbers."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import (
    AsJson,
    GainFile,
    MachineFile,
    WholeTime,
    complete_designs,
    design_files,
    read_controller,
    scenarios,
)
from malta.cli.output import (
    end_early,
    make_console,
    print_document,
    print_note,
    print_written,
    require_whole,
    work_until,
)
from malta.errors import InputError
from malta.files import locate, read_file
from malta.work import is_stopped
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.app.session import Session
    from malta.report.ledger import Ledger
    from malta.synthesis.spec import Spec

FIRST_FOLDER = "design"  # the folder whose first design opens where none is named


def app(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="DESIGN", help="A design file. [the first of design/]", show_default=False),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print the address of the page.")
    ] = False,
    port: Annotated[
        int, typer.Option(metavar="N", min=0, max=65535, help="Port of 127.0.0.1; 0: any that is free.")
    ] = 0,
    machine_file: MachineFile = None,
) -> None:
    """Open a page to design with: sliders for weights, gains and the machine, curves at every move, then the proof.

    The page is served to this computer alone, under an address with a secret token. It saves design files and gain
    files in the folder it was started in, and nowhere else. Ctrl-C ends it.

    \b
    Example:  malta app design/robust.toml
    """
    import webbrowser

    from malta.app.server import Server
    from malta.app.session import Session

    design = _design_file(file)
    if machine_file is not None:
        from malta.model.machines import machine

        machine(machine_file)
    session = Session(design, Path.cwd(), machine_file)
    gc.freeze()
    gc.set_threshold(20_000, 5, 5)  # a page runs for hours: past machines' expressions go, the libraries stay
    with Server(session, port) as server:
        print(server.url, flush=True)
        if not no_browser and not (_has_screen() and webbrowser.open(server.url)):
            print_note("no browser found: open the address above in one")
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print_note(_farewell(session))
        finally:
            session.close()


def _has_screen() -> bool:
    """Whether a browser would open beside the terminal, and not in it."""
    return not sys.platform.startswith("linux") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def _design_file(named: Path | None) -> Path:
    """The design file that was named, or the first of design/. Raises InputError where there is none."""
    if named is not None:
        if named.suffix in (".json", ".npz", ".mat"):
            raise InputError(
                named, "", "a gain file", "the design file that it was made of, as design/NAME.toml"
            )
        return locate(named)
    found = sorted(Path(FIRST_FOLDER).glob("*.toml"))
    if not found:
        raise InputError("app", "", "no design file", f"its name, or a folder {FIRST_FOLDER}/ with some")
    return found[0]


def _farewell(session: Session) -> str:
    """What Ctrl-C left unsaved, in one sentence."""
    unsaved = session.unsaved_changes()
    name = session.files.path.name
    if not unsaved:
        return f"ended; {name} holds all that was changed"
    shown = ", ".join(unsaved[:4]) + (f" and {len(unsaved) - 4} more" if len(unsaved) > 4 else "")
    return f"ended; not saved to {name}: {shown}"


# `malta motion`: the bodies of a machine as they move, from the files of runs and from runs that are simulated for it.


def motion(
    gains: GainFile,
    run: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUN]...", help="Files (.npz) of malta simulate --out: a button each."),
    ] = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENARIO",
            help="Simulate this too, a button for each of its runs, as faults. Repeatable.",
            autocompletion=scenarios,
        ),
    ] = None,
    witness: Annotated[
        bool, typer.Option("--witness", help="Fly machines inside and beyond the proven margin too.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A page (.html), or an animated picture (.gif) of the first run. [build/RUN_motion.html]",
        ),
    ] = None,
    dark: Annotated[bool, typer.Option("--dark", help="A .gif for a dark page.")] = False,
    machine: MachineFile = None,
) -> None:
    """Show the machine in motion: its bodies in three dimensions, as they move in a run.

    The page needs no network: drag the machine to turn it, go through time with the scrubber, magnify small motion.
    Buttons choose among the runs. Bodies are those that the machine's module describes: Plant(bodies=...).

    \b
    Examples:  malta motion design/gains/robust.json build/robust_stroke.npz
               malta motion design/gains/robust.json --scenario faults --witness
    """
    from malta.gains.file import content_of
    from malta.model.plants import plant_of
    from malta.report.page.motion import motion_gif, motion_of, motion_page, read_motion
    from malta.simulation.experiments.catalogue import experiment
    from malta.simulation.experiments.witness import witness_flights

    controller = read_controller(gains, machine)
    if not (run or scenario or witness):
        raise InputError("motion", "", "no run", "files of runs, --scenario NAME, or --witness")
    stem = run[0].stem if run else "_".join([controller.name, *(scenario or ["witness"])[:1]])
    file = out or Path("build") / f"{stem}_motion.html"
    if file.suffix not in (".html", ".gif"):
        raise InputError("--out", "", f"suffix {file.suffix!r}", ".html or .gif")
    plant = plant_of(controller.parameters)
    found = [read_motion(one, plant) for one in run or ()]
    for name in scenario or ():
        cases = experiment(name, plant, controller).cases
        found += [motion_of(case.run, case.label if len(cases) > 1 else name) for case in cases]
    if witness:
        robust = content_of(gains)[0].verification.robust
        point = None if robust is None else robust.witness
        if point is None:
            raise InputError(gains, "verification.robust.witness", "none", "a margin with a witness")
        found += [motion_of(case.run, case.label) for case in witness_flights(plant, controller, point)]
    about = f"Design {controller.name}, machine {plant.name}"
    content = motion_gif(found[0], dark=dark) if file.suffix == ".gif" else motion_page(found, about).content
    replace_files({file: content})
    print_written(make_console(), [file])


# `malta claims`: every number that a machine's paper publishes beside ours.


def claims(
    designs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[DESIGN]...",
            help="Design files; of design/ those meant to reproduce a paper if none is named.",
            autocompletion=complete_designs,
        ),
    ] = None,
    why: Annotated[
        bool, typer.Option("--why", help="Print below each line the whole verdict, with its reason.")
    ] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the tables as the pages of claims hold them.")
    ] = False,
    update: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Compute the tables of a Markdown file anew, each for the designs that its header names.",
        ),
    ] = None,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Print the ledger, a line a claim: what a machine's paper publishes, ours for each design, and a verdict.

    All of it is computed now: models, gains, margins, experiments on the simulated machine. A verdict is one word:
    reproduced (to the printed digits, or within 5 % of an "about"), near (within 20 %), kept (a bound), input,
    differs, partly (of some designs), beside (of another method), ours (the paper prints no such number) or other
    (no design that is meant to reproduce it).

    \b
    Example:  malta claims design/table2.toml
              malta claims --update docs/claims/tubular.md
    """
    from malta.model.parts import require_ledger
    from malta.synthesis.design_file import read_design

    require_ledger()
    if update is not None:
        _update(update, designs or [], time)
        return

    specs = [read_design(file) for file in design_files("claims", designs, reverse=True, or_shipped=True)]
    if not designs:
        specs = [spec for spec in specs if _is_meant(spec)] or specs
    with work_until("claims", time) as work:
        ledgers = compute_ledgers(specs, work.report)
    if as_json:
        from malta.cli.documents.others import ClaimsOutput, LedgerPart

        print_document(ClaimsOutput(ledgers=[LedgerPart.of(one) for one in ledgers]))
    elif markdown:
        print("\n".join(f"### {one.title}\n\n{one.markdown()}" for one in ledgers), end="")
    else:
        from malta import report

        for one in ledgers:
            make_console().print(report.claims_table(one, why=why))
    known = {name for one in ledgers for name in one.designs}
    left = [f"{one.left} claims on {one.machine}" for one in ledgers if one.left]
    left += [f"all claims of {spec.name}" for spec in specs if spec.name not in known]
    if left:
        end_early(work.pressed, f"missing are {', '.join(left)}")
    require_whole(work)


def _is_meant(spec: Spec) -> bool:
    """Whether a design is meant to reproduce the paper on its machine."""
    from malta.model.parts import require_part

    return spec.name in getattr(require_part("claims", spec.plant.name), "REPRODUCING", (spec.name,))


def compute_ledgers(specs: Sequence[Spec], progress: Callable[[float], None] | None) -> list[Ledger]:
    """Compute the ledger of each machine, in the order in which the designs name the machines."""
    machines = dict.fromkeys(spec.plant.name for spec in specs)
    return _compute_each([[spec for spec in specs if spec.plant.name == name] for name in machines], progress)


def _compute_each(groups: Sequence[Sequence[Spec]], progress: Callable[[float], None] | None) -> list[Ledger]:
    """Compute the ledger of each group of designs of one machine, of the designs that there was time for.

    A campaign or an experiment that is cut short hands over what it has, of which a paper's figures cannot be made.
    """
    from malta.model.printed import read_published
    from malta.report.ledger import ledger
    from malta.simulation.experiments import progress_of_part

    found: list[Ledger] = []
    for n, group in enumerate(groups):
        part, published = progress_of_part(progress, n, len(groups)), read_published(group[0].machine_file)
        if is_stopped():
            break
        found.append(ledger(group, published, part))
    return [one for one in found if one.designs]


def _update(file: Path, designs: Sequence[Path], time: float | None) -> None:
    """Compute the tables of a Markdown file anew; where there is no time for one of them the file stands.

    Raises InputError for designs beside the file, a table of a design that is not there, and a file without tables.
    """
    from malta.model.parts import require_ledger
    from malta.synthesis.design_file import read_design

    tables = require_ledger()
    if designs:
        raise InputError("--update", "designs", str(designs[0]), "none: the file's tables name theirs")
    text = read_file(file, "Markdown file", lambda path: path.read_text(encoding="utf-8"))
    known = {path.stem: path for path in design_files("claims", None, or_shipped=True)}
    specs = []
    for place in tables.find_tables(text, str(file)):
        for name in place.designs:
            if name not in known:
                raise InputError(file, place.machine, repr(name), "one of " + " ".join(sorted(known)))
        specs.append([read_design(known[name]) for name in place.designs])
    with work_until("claims", time) as work:
        ledgers = _compute_each(specs, work.report)
        early = is_stopped()
    if early:
        end_early(work.pressed, f"{file} stands as it was")
        return
    replace_files({file: tables.replace_tables(text, ledgers, str(file)).encode()})
    print_written(make_console(), [file])

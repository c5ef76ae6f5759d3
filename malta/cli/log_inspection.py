"""`malta log` and `malta replay`: what a log of a bench holds, and the law of a gain file on its readings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.cli.log_options import LogFile, Reading, add_log_options
from malta.cli.options import AsJson, GainFile, MachineFile, read_controller, require_suffixes
from malta.cli.output import make_console, print_document, print_note, print_text, print_written, progress_on
from malta.display import quantity
from malta.errors import CheckError, InputError
from malta.files import PICTURES
from malta.writing import replace_files

if TYPE_CHECKING:
    pass


@add_log_options
def log(
    file: LogFile,
    reading: Reading,
    gains: Annotated[
        Path | None,
        typer.Option(metavar="GAINS", help="Its gain file: signals are held against what it predicts."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Draw it: a page to zoom in (.html), or .png, .svg, .pdf. Live: .csv."
        ),
    ] = None,
    spectrogram: Annotated[
        bool, typer.Option("--spectrogram", help="Draw amplitudes over time and frequency too.")
    ] = False,
    live: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS:PORT", help="Of an XCP slave; LOG is the NAME.a2l of its export."),
    ] = None,
    signal: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Live: a signal of the A2L; again for others.")
    ] = None,
    seconds: Annotated[float, typer.Option("--for", metavar="SECONDS", help="Live: how long [s].")] = 1.0,
    every: Annotated[int, typer.Option(metavar="N", help="Live: each so many samples of the law.")] = 1,
    baud: Annotated[int, typer.Option(metavar="N", help="Live: speed of a serial port, baud.")] = 115200,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Show a log: statistics of its signals, and what is wrong with them.

    Gaps, jitter, missing readings, sensors that are stuck or clipped, readings that stand several times or that no
    sensor gives, limits. With --gains also columns that are missing, swapped, in another unit, of the other sign or
    beyond what the machine can do.

    With --live signals of a machine that runs are shown and written, while it runs.

    \b
    Example:  malta log build/robust.npz --out build/log.html
              malta log robust.a2l --live 127.0.0.1:5555 --signal y_used.x1
              malta log scope.csv --columns x1=CH1:10um/V --gains mine.json
    """
    if live is not None:
        if as_json or gains is not None:
            raise InputError("--live", "", "--json or --gains beside it", "--live without them")
        _log_live(file, live, signal or [], seconds, every, baud, out)
        return
    if signal:
        raise InputError("--signal", "", "no --live", "--live ADDRESS:PORT beside it")
    from malta.identification.log_files import read_log
    from malta.identification.signal_checks import findings_of_machine
    from malta.identification.survey import SOUND_LOG
    from malta.report.tables.experiments import log_table

    if spectrogram and out is None:
        raise InputError("--spectrogram", "", "no --out", "--out NAME.png beside it")
    require_suffixes((out, PICTURES if spectrogram else (".html", *PICTURES)))
    found = read_log(file, **reading)
    beyond = [] if gains is None else findings_of_machine(read_controller(gains, machine), found)
    files = []
    if out is not None and out.suffix == ".html":
        from malta.report.page.log import log_page

        files.append(log_page(found, beyond).save(out))
    elif out is not None:
        from malta.report.figures import log_figure, save

        files.append(save(log_figure(found, spectrogram=spectrogram), out))
    if as_json:
        from malta.cli.documents.others import log_output

        print_document(log_output(found, files, beyond))
        return
    console, survey = make_console(), found.survey
    of = f"{found.machine or 'an unnamed machine'} under {found.controller or 'an unnamed law'}"
    length = f"{found.samples} samples of {quantity(found.sample_time, 's')}, {found.samples * found.sample_time:g} s"
    print_text(console, f"{file}: {of}, {length}")
    excited = (
        f"an excitation with a period of {found.period:g} s" if found.period else "no periodic excitation"
    )
    print_text(console, f"{excited}, jitter {1e6 * survey.jitter:.3g} us, {survey.gaps} gaps")
    console.print(log_table(found))
    for finding in (*found.notes, *([*survey.findings, *beyond] or [SOUND_LOG])):
        print_text(console, finding)
    print_written(console, files)


def _log_live(
    a2l: Path, where: str, names: list[str], seconds: float, every: int, baud: int, out: Path | None
) -> None:
    """Signals of an XCP slave, shown while they come."""
    from malta.arguments import positive
    from malta.firmware.xcp_master import read_a2l, record_live, xcp_master
    from malta.report.tables import add_row, new_table

    require_suffixes((out, (".csv",)))
    known = read_a2l(a2l)
    positive("--for", "seconds", seconds, below=86_400.0)
    if not 1 <= every <= 255:
        raise InputError("--every", "", str(every), "1 to 255")
    if not names:
        raise InputError("--signal", "", "none", "one of " + " ".join(known.signals))
    console = make_console()

    def show(t: float, row: Sequence[float]) -> None:
        print_note(f"{t:.3f} s  " + "  ".join(f"{n} {v:.6g}" for n, v in zip(names, row, strict=True)))

    with xcp_master(where, baud) as master:
        found = record_live(master, known, names, seconds, every=every, show=show)
    table: Any = new_table(
        f"{len(found.t)} samples, {found.lost} lost", "signal", "least", "mean", "largest", "last"
    )
    for s, column in zip(found.signals, found.values.T, strict=True):
        row = (column.min(), column.mean(), column.max(), column[-1]) if len(column) else ()
        add_row(table, f"{s.name} [{s.unit or '1'}]", *(f"{v:.6g}" for v in row), *[""] * (4 - len(row)))
    console.print(table)
    if out is not None:
        head = ",".join(["t [s]", *(f"{s.name} [{s.unit or '1'}]" for s in found.signals)])
        rows = [
            ",".join(repr(float(v)) for v in (t, *row)) for t, row in zip(found.t, found.values, strict=True)
        ]
        replace_files({out: ("\n".join([head, *rows]) + "\n").encode()})
        print_written(console, [out])
    if found.broken:
        raise CheckError(f"{where}: the line broke at {found.t[-1]:.6g} s; what came until then is above")


@add_log_options
def replay(
    gains: GainFile, log: LogFile, reading: Reading, machine: MachineFile = None, as_json: AsJson = False
) -> None:
    """Run a law on logged readings: does it command what was logged, and how large are its innovations?

    Commands that differ give exit code 1: another gain file flew, or another law. So do innovations that are larger, or
    less white, than those of the gain file's own machine on the same reference and excitation; the parameter that
    explains them is named. Of the .dump of exported C the same C computes the commands again, which have to agree to
    the bit.

    \b
    Example:  malta replay design/gains/robust.json build/stroke.npz
    """
    from malta.identification.dump import replay_dump
    from malta.identification.log_files import read_log
    from malta.identification.replay import replay_law
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import replay_table

    controller = read_controller(gains, machine)
    with progress_on(f"replaying {log}"):
        exact = replay_dump(controller, log) if log.suffix == ".dump" else None
    if exact is not None and not as_json:
        count = f"{exact.same} of {exact.samples} samples"
        print_text(make_console(), f"{log}: the exported C commands what is logged, to the bit, in {count}")
    if exact is not None and exact.first is not None:
        raise CheckError(
            f"{log}: from {exact.first:.6g} s on the exported C commands other bits: another export flew"
        )
    with progress_on(f"replaying {log}"):
        found = replay_law(controller, read_log(log, **reading), same=None if exact is None else True)
    if as_json:
        from malta.cli.documents.others import replay_output

        print_document(replay_output(gains, log, found, exact))
    else:
        console = make_console()
        console.print(replay_table(found, plant_of(controller.parameters)))
        same = "as logged, but for rounding" if found.same else "not those of the log"
        print_text(console, f"{log}: the commands of {controller.name} are {same}")
    if found.refusal:
        raise CheckError(f"{log}: {found.refusal}")

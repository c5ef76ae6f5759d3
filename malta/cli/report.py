"""`malta report`: everything about a gain file as one page in HTML."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import typer

from malta.cli.options import (
    NUMBER,
    AsJson,
    Changes,
    DesignFile,
    GainFile,
    MachineFile,
    Uncertain,
    WholeTime,
    change_machine,
    find_design,
    gain_files,
    offer,
    read_assignments,
    read_controller,
    read_uncertainty,
)
from malta.cli.output import (
    make_console,
    print_document,
    print_note,
    print_written,
    progress_bar,
    require_whole,
    work_until,
)
from malta.errors import InputError
from malta.files import locate, require_suffix
from malta.writing import replace_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.campaigns.summary import Summary
    from malta.loops.curves import LoopCurves
    from malta.loops.linear_loops import Place
    from malta.loops.locus import RootLocus
    from malta.margins.margin_map import MarginMap
    from malta.model.plant import Plant
    from malta.report.page.analysis import Subject
    from malta.synthesis.controller import Controller
    from malta.synthesis.curve_limits import CurveLimit
    from malta.synthesis.spec import Spec

CAMPAIGNS = Path("build", "campaigns")  # where `malta campaign` keeps its folders


def report(
    gains: GainFile,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The page. [build/NAME_report.html]")
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write the figures as a PDF for a paper too, beside the page.")
    ] = False,
    campaign: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER", help="A campaign of these gains. [those in build/campaigns/ that are of them]"
        ),
    ] = None,
    log: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG", help="A log of the machine: shown, and S over prediction if it was excited."
        ),
    ] = None,
    design: DesignFile = None,
    uncertain: Uncertain = None,
    change: Changes = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="A first look: no proof of the margins of the parameters.")
    ] = False,
    machine: MachineFile = None,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Write a page about a gain file: what it is, margins and where they go, loads, main job, noise, gains.

    One HTML file that needs no network, for light and dark screens and for paper. The same gain file gives the same
    bytes. An unstable loop gets a page that says so, and exit code 1.

    \b
    Example:  malta report design/gains/robust.json --out build/robust.html --pdf
    """
    from malta.gains.writing import require_stable
    from malta.identification.log_files import read_log
    from malta.report.page.document import SUFFIXES, pdf_of
    from malta.report.page.report import report_work

    controller = read_controller(gains, machine)
    page_file = require_suffix(out or Path("build") / f"{controller.name}_report.html", *SUFFIXES)
    subject = read_subject(gains, controller, change, uncertain, design)
    logs = [read_log(one) for one in log or ()]
    with work_until("report", time) as work:
        flown = campaigns_of(campaign, controller, subject.spec, changed=bool(change))
        analysis, page = report_work(
            subject, proof=not no_proof, campaigns=flown, logs=logs, progress=work.report
        )
        contents = {page_file: page.content}
        if pdf:
            contents[page_file.with_suffix(".pdf")] = pdf_of(page)
    replace_files(contents)
    if as_json:
        from malta.cli.documents.loops import ReportOutput, merits_of

        figures = merits_of(analysis.figures)
        print_document(ReportOutput.of(analysis, gains=gains, figures=figures, files=contents))
    else:
        print_written(make_console(), contents)
    for note in analysis.notes:
        print_note(note)
    require_whole(work)
    require_stable(analysis.report, str(gains))


def read_subject(
    gains: Path,
    controller: Controller,
    change: list[str] | None,
    uncertain: list[str] | None,
    design: Path | None,
) -> Subject:
    """Read what a page is about: the machine with its changes, the uncertainty, the design file.

    Raises InputError for a change, a share or a design file that does not fit.
    """
    from malta.report.page.report import subject_of

    parameters = change_machine(controller.parameters, change)
    spec = find_design(gains, controller, design)
    subject = subject_of(gains, parameters=parameters, spec=spec, changes=change or ())
    if not uncertain:
        return subject
    return subject._replace(box=read_uncertainty(gains, uncertain, parameters))


def campaigns_of(
    folders: Sequence[Path] | None, controller: Controller, spec: Spec | None, *, changed: bool = False
) -> list[Summary]:
    """Summarize the campaigns in some folders; without any, those in build/campaigns that are of this controller.

    changed : whether the machine is changed by --set, so that no campaign which is not named is of it

    Raises InputError for a named folder without a campaign, or with one of another controller.
    """
    kept = [] if changed else sorted(path.parent for path in CAMPAIGNS.glob("*/campaign.json"))
    if not folders and not kept:
        return []
    from malta.campaigns.run import status
    from malta.campaigns.summary import RunLimits
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures

    bounds = RunLimits(published_figures(plant_of(controller.parameters).name), spec)
    found = []
    for folder in folders or kept:
        try:
            found.append(status(folder, controller, bounds).summary)
        except InputError:
            if folders:
                raise
    return [summary for summary in found if summary.runs or folders]


# `malta plot`: the plots of a control engineer of one or several gain files.


KINDS = (
    "bode",
    "nyquist",
    "nichols",
    "pzmap",
    "sigma",
    "sensitivity",
    "gang",
    "step",
    "load",
    "rootlocus",
    "marginmap",
    "diagram",
)
LOCUS, MAP, DIAGRAM = "rootlocus", "marginmap", "diagram"
GAIN = "gain"
SUFFIXES = (".png", ".svg", ".pdf")
Machines = Mapping[str, tuple["Plant", "Controller"]]  # by the names of their loops


class NamedFigure(NamedTuple):
    """A figure with the name that its file gets: NAME_KIND."""

    name: str
    figure: Figure


def plot(
    gains: GainFile,
    kinds: Annotated[
        list[str],
        typer.Argument(
            metavar="KIND...", autocompletion=offer(*KINDS), help=f"One or more of: {', '.join(KINDS)}."
        ),
    ],
    others: Annotated[
        list[Path] | None,
        typer.Option("--with", metavar="GAINS", help="Another gain file, laid over the first. Repeatable."),
    ] = None,
    channel: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A channel to draw. Repeatable. [all]")
    ] = None,
    at: Annotated[
        str,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("sensors", "forces"),
            help="Where the loop is cut: sensors or forces.",
        ),
    ] = "sensors",
    parameter: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Root locus: a parameter of the machine, or gain. [gain]"),
    ] = None,
    span: Annotated[
        str | None,
        typer.Option(
            "--range",
            metavar="LOW..HIGH",
            help="Root locus: multiples of the nominal value, or values with units. [0.5..1.5, gain 0.1..10]",
        ),
    ] = None,
    x: Annotated[
        str | None, typer.Option("--x", metavar="NAME", help="Margin map: the parameter along x. [the first]")
    ] = None,
    y: Annotated[
        str | None,
        typer.Option("--y", metavar="NAME", help="Margin map: the parameter along y. [the second]"),
    ] = None,
    beside: Annotated[
        str | None,
        typer.Option(
            "--others",
            metavar="WORD",
            autocompletion=offer("box", "nominal"),
            help="Margin map: the other parameters are anywhere in the box, or nominal. [box]",
        ),
    ] = None,
    change: Changes = None,
    machine: MachineFile = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER", help="A .png, .svg or .pdf file, or a folder. [build/NAME_KIND.png]"
        ),
    ] = None,
    dark: Annotated[
        bool,
        typer.Option(
            "--dark", help="Light lines on a dark page. [.svg: as the reader's screen has it; else light]"
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Draw the loop of a gain file: one channel at a time with the others closed, margins where they are read.

    bode, nyquist, nichols: loop gain with margins. sigma: singular values of L, S, T. sensitivity: |S|, |T| with the
    zones of ISO 14839-3. gang: gang of four. pzmap: poles and zeros. step: references. load: 1 N or 1 N m from
    outside, and compliance. rootlocus: poles over the loop gain or a parameter. marginmap: the proven box in the plane
    of two uncertain parameters, the others anywhere in it, and the boundary of stability by eigenvalues. diagram: the
    loop's own blocks with rates, delays and limits.

    The loop is the machine's, sampled. The machine is the one in the file, with the changes given by --set.

    \b
    Examples:  malta plot design/gains/robust.json bode nyquist
               malta plot design/gains/robust.json marginmap --x K_A --y m
               malta plot design/gains/robust.json rootlocus --parameter m
    """
    _require_kinds(
        kinds, at, out, {"--parameter": parameter, "--range": span}, {"--x": x, "--y": y, "--others": beside}
    )
    machines = _read_machines([gains, *(locate(path) for path in others or ())], machine, change)
    from malta.loops.curves import loop_curves
    from malta.synthesis.curve_limits import curve_limits

    place = cast("Place", at)
    loops = {name: loop_curves(*pair, name=name) for name, pair in machines.items()}
    channels = _channels(loops, kinds, channel, place)
    loci = _loci(machines, parameter or GAIN, span, channels, place) if LOCUS in kinds else ()
    maps = _maps([gains, *(others or ())], machines, (x, y), beside or "box") if MAP in kinds else ()
    names = [*dict.fromkeys(kinds)]
    shown, note = _distinct(loops, names, place) if channels is None else (channels, "")
    spec = find_design(locate(gains), next(iter(machines.values()))[1], None)
    curved = [kind for kind in names if kind != DIAGRAM]
    pictures = _draw(
        loops, curved, shown, place, (*loci, *maps), named=channels is not None, limits=curve_limits(spec)
    )
    pictures += _diagrams(machines) if DIAGRAM in names else []
    files = _save(pictures, out, dark=dark)
    if note:
        print_note(note)
    if as_json:
        from malta.cli.documents.plots import plot_output

        print_document(plot_output(loops.values(), names, channels, place, (loci, maps), files))
    else:
        print_written(make_console(), files)
    for name, curves in loops.items():
        if not curves.stable:
            print_note(f"{name}: the loop is unstable")


def _require_kinds(
    kinds: Sequence[str],
    at: str,
    out: Path | None,
    of_locus: Mapping[str, str | None],
    of_map: Mapping[str, str | None],
) -> None:
    """Raise InputError for an unknown kind or place, options without their kind, and a file for several pictures."""
    for kind in kinds:
        if kind not in KINDS:
            raise InputError("plot", "KIND", repr(kind), "one of " + " ".join(KINDS))
    if at not in ("sensors", "forces"):
        raise InputError("--at", "", repr(at), "sensors or forces")
    for kind, options in ((LOCUS, of_locus), (MAP, of_map)):
        for option, given in options.items():
            if given is not None and kind not in kinds:
                raise InputError(option, "", f"no {kind} among the kinds", f"{kind}, which it is for")
    if out is not None and out.suffix and out.suffix not in SUFFIXES and not out.is_dir():
        raise InputError("--out", "", str(out), "a folder, or a file " + ", ".join(SUFFIXES))
    if out is not None and out.suffix in SUFFIXES and len({*kinds}) > 1:
        raise InputError("--out", "", f"one file for {len({*kinds})} pictures", "a folder")


def _read_machines(files: Sequence[Path], machine: Path | None, change: list[str] | None) -> Machines:
    """Machines and controllers by the names of the designs; designs of one name get those of their files."""
    from malta.model.plants import plant_of

    controllers = [read_controller(file, machine) for file in files]
    names = [c.name for c in controllers]
    if len({*names}) < len(names):
        names = [str(file) for file in files]
    if len({*names}) < len(names):
        raise InputError("--with", "", "the same gain file twice", "other gain files")
    plants = [plant_of(change_machine(c.parameters, change)) for c in controllers]
    return dict(zip(names, zip(plants, controllers, strict=True), strict=True))


def _channels(
    loops: Mapping[str, LoopCurves], kinds: Sequence[str], named: list[str] | None, at: Place
) -> list[str] | None:
    """The channels that were named; None: all. Raises InputError for a name that no plot of these kinds has."""
    if not named:
        return None
    signals = {
        s.name
        for curves in loops.values()
        for s in (*curves.channels(at), *(curves.loop.outputs if {"gang", "step", "load"} & {*kinds} else ()))
    }
    for name in named:
        if name not in signals:
            known = dict.fromkeys(s.name for curves in loops.values() for s in curves.channels(at))
            raise InputError("--channel", "", repr(name), "one of " + " ".join(known))
    return named


def _distinct(
    loops: Mapping[str, LoopCurves], kinds: Sequence[str], at: Place
) -> tuple[list[str] | None, str]:
    """The channels to draw where none is named, and a sentence on those that have the curves of others."""
    from malta.report.page.sections import distinct_channels

    if at != "sensors" or not {*kinds} & {"bode", "nyquist", "nichols", "sensitivity", "gang", "step"}:
        return None, ""
    panels = distinct_channels(loops)
    return (list(panels.channels), f"not drawn twice: {panels.note.strip()}") if panels.note else (None, "")


def _loci(
    machines: Machines, parameter: str, span: str | None, channels: list[str] | None, at: Place
) -> Sequence[RootLocus]:
    """The root locus of each loop, behind a progress bar."""
    from malta.loops.locus import root_locus

    if channels is not None and len(channels) > 1 and parameter == GAIN:
        raise InputError(
            "--channel", "", f"{len(channels)} channels", f"one for a {LOCUS} over the gain, or none"
        )
    only = channels[0] if channels and parameter == GAIN else None
    found = []
    for name, (plant, controller) in machines.items():
        ends = _read_span(plant, parameter, span)
        with progress_bar(f"root locus of {name}") as progress:
            one = root_locus(
                plant, controller, parameter=parameter, span=ends, channel=only, at=at, progress=progress
            )
        found.append(replace(one, name=name))
    return found


def _maps(
    files: Sequence[Path], machines: Machines, axes: tuple[str | None, str | None], beside: str
) -> Sequence[MarginMap]:
    """The margin map of each loop over two parameters that its gain file names as uncertain. Raises InputError."""
    from malta.margins.margin_map import Others, margin_map_of

    (x, y), others, found = axes, cast("Others", beside), []
    for file, (name, (plant, controller)) in zip(files, machines.items(), strict=True):
        box = read_uncertainty(file, None, plant.parameters)
        if len(box) < 2:
            raise InputError(file, "uncertainty", f"{len(box)} parameters", f"two at least for a {MAP}")
        free = [one for one in box if one not in (x, y)]
        names = x or free.pop(0), y or free.pop(0)
        with progress_bar(f"margin map of {name}"):
            found.append(replace(margin_map_of(plant, controller, names, box, others=others), name=name))
    return found


def _read_span(plant: Plant, parameter: str, span: str | None) -> tuple[float, float] | None:
    """Both ends of a range in SI: multiples of the nominal value where neither has a unit. Raises InputError."""
    from malta.model.parameters import units_of

    units = units_of(plant.parameters) | {GAIN: "1"}
    if parameter not in units:
        raise InputError(
            "--parameter", "", repr(parameter), "one of " + " ".join([GAIN, *units_of(plant.parameters)])
        )
    if span is None:
        return None
    ends = span.split("..")
    numbers = [re.fullmatch(NUMBER, end.strip()) for end in ends]
    if len(ends) != 2 or None in numbers:
        raise InputError("--range", "", repr(span), "LOW..HIGH, as 0.5..1.5 or 0.2kg..0.5kg")
    plain = all(number is not None and not number[2] for number in numbers)
    nominal = 1.0 if parameter == GAIN else float(getattr(plant.parameters, parameter))
    if plain and nominal == 0:
        unit = units[parameter]
        raise InputError(
            "--range", "", f"multiples of {parameter}, which is 0", f"values with a unit, as 1{unit}"
        )
    if plain:
        low, high = sorted(float(cast("re.Match[str]", number)[1]) * nominal for number in numbers)
    else:
        low, high = (
            read_assignments("--range", [f"{parameter}={end.strip()}"], units)[parameter] for end in ends
        )
    if not low < high:
        raise InputError("--range", "", repr(span), "a lower value, then a higher one")
    return low, high


def _diagrams(machines: Machines) -> list[NamedFigure]:
    """The block diagram of each loop."""
    from malta.report import plots

    return [
        NamedFigure(f"{name}_{DIAGRAM}", plots.block_diagram(controller, plant))
        for name, (plant, controller) in machines.items()
    ]


def _draw(
    loops: Mapping[str, LoopCurves],
    kinds: Sequence[str],
    channels: list[str] | None,
    at: Place,
    planes: Sequence[RootLocus | MarginMap],
    *,
    named: bool,
    limits: Sequence[CurveLimit] = (),
) -> list[NamedFigure]:
    """The pictures of all kinds; a root locus and a margin map are drawn of each loop.

    named : whether the user named the channels
    limits : what requirements of the first design exclude
    """
    from malta.margins.margin_map import MarginMap
    from malta.report import plots

    outputs = None
    if channels is not None:
        known = {s.name for curves in loops.values() for s in curves.loop.outputs}
        outputs = [name for name in channels if name in known] or None
    draw: Mapping[str, Callable[[], Any]] = {
        "bode": lambda: plots.bode(loops, channel=channels, at=at),
        "nyquist": lambda: plots.nyquist(loops, channel=channels, at=at, limits=limits),
        "nichols": lambda: plots.nichols(loops, channel=channels, at=at),
        "pzmap": lambda: plots.pzmap(loops),
        "sigma": lambda: plots.sigma(loops, at=at, limits=limits),
        "sensitivity": lambda: plots.sensitivity_curves(loops, channel=channels, at=at, limits=limits),
        "gang": lambda: plots.gang_of_four(loops, channel=outputs),
        "step": lambda: plots.step(loops, channel=outputs),
        "load": lambda: plots.load_response(loops, channel=outputs if named else None, limits=limits),
    }
    first = next(iter(loops))
    pictures = []
    for kind in kinds:
        if kind == LOCUS:
            loci = [found for found in planes if not isinstance(found, MarginMap)]
            pictures += [
                NamedFigure(f"{found.name}_{LOCUS}", plots.root_locus(found, loops[found.name]))
                for found in loci
            ]
        elif kind == MAP:
            maps = [found for found in planes if isinstance(found, MarginMap)]
            pictures += [NamedFigure(f"{found.name}_{MAP}", plots.margin_map(found)) for found in maps]
        else:
            pictures.append(NamedFigure(f"{first}_{kind}", draw[kind]()))
    return pictures


def _save(pictures: Sequence[NamedFigure], out: Path | None, *, dark: bool) -> list[Path]:
    """Write the pictures to the file that was named, or to a folder as NAME_KIND.png, all or none."""
    from malta.report import encode_figure

    one = out is not None and out.suffix in SUFFIXES and not out.is_dir()
    if one and len(pictures) > 1:
        raise InputError("--out", "", f"one file for {len(pictures)} pictures", "a folder")
    folder = Path("build") if out is None else out
    paths = [cast("Path", out)] if one else [folder / f"{_file_name(p.name)}.png" for p in pictures]
    contents = {
        path: encode_figure(p.figure, path, dark=dark) for path, p in zip(paths, pictures, strict=True)
    }
    replace_files(contents)
    return list(contents)


def _file_name(name: str) -> str:
    """The name of a loop as that of a file: a path of a gain file becomes one word."""
    return re.sub(r"[^\w .,()\[\]$+-]", "_", name)[:120]


# `malta compare`: several gain files beside each other.


def compare(
    gains: Annotated[
        list[Path],
        typer.Argument(
            metavar="GAINS...", autocompletion=gain_files, help="2 to 8 gain files: .json, .npz or .mat."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a page (.html) with the curves over each other."),
    ] = None,
    specification: Annotated[
        Path | None,
        typer.Option(
            metavar="DESIGN", help="A design file whose requirements judge all. [of the first that has some]"
        ),
    ] = None,
    uncertain: Uncertain = None,
    change: Changes = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="Leave out the margins of the parameters, which take longest.")
    ] = False,
    machine: MachineFile = None,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Compare gain files: which is better by one specification and where, what differs, and all figures of merit.

    The requirements of one design file judge all designs, each on the machine of its gain file. Machines that differ
    are compared in what their loops have in common. An unstable loop gives exit code 1.

    \b
    Example:  malta compare design/gains/table2.json design/gains/robust.json
    """
    from malta.gains.writing import require_stable
    from malta.report.page.comparison import (
        compare as compare_subjects,
        comparison_tables,
        judging_spec,
        require_count,
    )
    from malta.report.page.document import SUFFIXES
    from malta.synthesis.design_file import read_design

    require_count(len(gains))
    page_file = None if out is None else require_suffix(out, *SUFFIXES)
    files = [locate(file) for file in gains]
    subjects = [read_subject(file, read_controller(file, machine), change, uncertain, None) for file in files]
    spec = judging_spec(subjects, None if specification is None else read_design(specification))
    flown = [campaigns_of(None, one.controller, spec or one.spec, changed=bool(change)) for one in subjects]
    with work_until("compare", time) as work:
        found = compare_subjects(
            subjects, proof=not no_proof, spec=spec, campaigns=flown, progress=work.report
        )
        written = []
        if page_file is not None:
            from malta.report.page.report import comparison_page

            replace_files({page_file: comparison_page(found).content})
            written.append(page_file)
    if as_json:
        from malta.cli.documents.loops import compare_output

        print_document(compare_output(found, written))
    else:
        console = make_console()
        console.print(comparison_tables(found, console.width))
        print_written(console, written)
    require_whole(work)
    for file, design in zip(files, found.designs, strict=True):
        require_stable(design.report, str(file))

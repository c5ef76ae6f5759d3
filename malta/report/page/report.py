"""The report of a gain file: one page in HTML, and its figures as a PDF."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.arguments import describe, is_number
from malta.errors import InputError
from malta.report.figures.drawing import (
    MORE_STYLES,
    STYLES,
    draw_bound,
    draw_line,
    finish_axes,
    micro,
    new_figure,
)
from malta.report.page.document import Front, Page, render
from malta.report.page.sections import Illustration, Item, PageTable, Section, distinct_channels, polish
from malta.report.verdict import SIGNS, stairs_html, verdict_html
from malta.synthesis.curve_limits import curve_limits
from malta.units import FINE_UNITS, in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.summary import Summary
    from malta.gains.schema import GainFile
    from malta.identification.log import Log
    from malta.model.plant import Parameters
    from malta.report.page.analysis import Analysis, Subject
    from malta.report.page.comparison import Comparison, TableLine
    from malta.synthesis.controller import Controller
    from malta.synthesis.curve_limits import CurveLimit
    from malta.synthesis.spec import Spec

WORK = 0.75  # share of the work that is done when all is computed; the rest is drawing


def gain_page(
    gains: str | Path | Controller,
    *,
    parameters: Parameters | None = None,
    uncertainty: Mapping[str, float] | None = None,
    spec: Spec | None = None,
    campaigns: Sequence[Summary] = (),
    logs: Sequence[Log] = (),
    proof: bool = True,
) -> Page:
    """Report a gain file, or a controller, as one page in HTML that needs no network and no other file.

    gains : the gain file, or a controller
    parameters : of the machine; None: those of the controller
    uncertainty : parameter -> share, either way, at margin 1; None: those of the gain file, none of a controller
    spec : the design, whose [specification] is judged; None: none
    campaigns : summaries of campaigns of these gains
    logs : of the machine under this controller, from `malta.identification.read_log`
    proof : whether margins are proven, which takes seconds

    Returns a Page: a notebook shows it, and its `save` writes it.

    Raises InputError and CheckError as `malta.gains.read` and `malta.verify`.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> page = malta.report.gain_page(controller, spec=spec, proof=False)
    >>> page.save("build/ball.html").name, "<svg" in page.html
    ('ball.html', True)
    """
    from malta.report.page.analysis import analyse

    subject = subject_of(gains, parameters=parameters, uncertainty=uncertainty, spec=spec)
    return page_of(analyse(subject, proof=proof, campaigns=campaigns), logs)


def compare_gains(
    *gains: str | Path | Controller,
    uncertainty: Mapping[str, float] | None = None,
    spec: Spec | None = None,
    proof: bool = True,
) -> Comparison:
    """Compare 2 to 8 gain files, or controllers: what differs, and figures of merit with the better one marked.

    gains : gain files, or controllers
    uncertainty : parameter -> share, either way, at margin 1, of all designs; None: of each gain file its own
    spec : the design whose [specification] judges all of them; None: none
    proof : whether the margin of the parameters is proven for each, which takes seconds

    Returns a Comparison with `names`, `differences`, `rows`, the figures of merit, and `standings`, what is better.

    Raises InputError for another number of them, a specification of another machine, and as `malta.gains.read`.

    >>> import malta
    >>> files = [f"examples/ball/design/{name}.toml" for name in ("ball", "ball_pid")]
    >>> specs = [malta.read_design(file) for file in files]
    >>> models = [malta.linearize(spec.plant, spec.plant.at()) for spec in specs]
    >>> designs = [malta.synthesize(*pair) for pair in zip(specs, models)]
    >>> found = malta.report.compare_gains(*designs, proof=False)
    >>> [one.texts for one in found.differences if one.name == "kind"]
    [('LQG', 'PID')]
    """
    from malta.report.page.comparison import compare, require_count

    require_count(len(gains))
    return compare([subject_of(one, uncertainty=uncertainty) for one in gains], proof=proof, spec=spec)


def subject_of(
    gains: str | Path | Controller,
    *,
    parameters: Parameters | None = None,
    uncertainty: Mapping[str, float] | None = None,
    spec: Spec | None = None,
    changes: Sequence[str] = (),
) -> Subject:
    """Read what a page is about. Raises InputError as `malta.gains.read`."""
    from malta.files import locate
    from malta.gains.file import content_of
    from malta.gains.stable import read_stable
    from malta.report.page.analysis import Subject

    for name, share in (uncertainty or {}).items():
        if not is_number(share):
            raise InputError("report", f"uncertainty.{name}", describe(share), "a share of its value, as 0.2")
    if not isinstance(gains, str | Path):
        box = dict(uncertainty or {})
        return Subject(gains, parameters or gains.parameters, box, spec, "", changes)
    path = locate(gains)
    controller = read_stable(path)
    file, _ = content_of(path)
    box = file.uncertainty if uncertainty is None else dict(uncertainty)
    return Subject(
        controller, parameters or controller.parameters, box, spec, str(gains), changes, provenance_of(file)
    )


def provenance_of(file: GainFile) -> tuple[tuple[str, str], ...]:
    """The seal of a gain file, and the versions that it was written with."""
    written: dict[str, Any] = file.provenance.model_dump()
    versions = tuple((f"written with {name}", str(value)) for name, value in written.items())
    return (("sha256 of the gain file's content", file.sha256), *versions)


def page_of(
    found: Analysis, logs: Sequence[Log] = (), progress: Callable[[float], None] | None = None
) -> Page:
    """Write an analysis as a page, with what logs show of the machine."""
    from malta.report.page.analysis import key_figures
    from malta.report.page.bodies import machine_svg
    from malta.report.page.document import Front, render
    from malta.report.page.sections import report_sections
    from malta.report.verdict import verdict_lines

    c = found.subject.controller
    changes = f", changed: {', '.join(found.subject.changes)}" if found.subject.changes else ""
    about = f"Machine {found.plant.name}, preset {found.subject.parameters.preset}{changes}"
    verdict = verdict_html(verdict_lines(found.report, found.campaigns))
    front = Front(
        "Design report", c.name, about, key_figures(found), _foot(found), verdict, machine_svg(found.plant)
    )
    sections = report_sections(found)
    if logs:
        from malta.report.page.bench import log_items

        shown = [item for log in logs for item in log_items(c, log, found.subject.box)]
        sections.append(Section("bench", "On the bench", tuple(shown)))
    return render(front, sections, progress)


def _foot(found: Analysis) -> str:
    seal = dict(found.subject.provenance).get("sha256 of the gain file's content", "")
    return f"malta report of {found.subject.controller.name}" + (
        f", gain file sha256 {seal[:16]}" if seal else ""
    )


def report_work(
    subject: Subject,
    *,
    proof: bool,
    campaigns: Sequence[Summary],
    logs: Sequence[Log] = (),
    progress: Callable[[float], None] | None,
) -> tuple[Analysis, Page]:
    """Analyse a subject and write its page, behind one measure of progress."""
    from malta.report.page.analysis import analyse

    def report_work_share(share: float) -> None:
        if progress is not None:
            progress(WORK * share)

    found = analyse(subject, proof=proof, campaigns=campaigns, progress=report_work_share)
    return found, page_of(
        found, logs, None if progress is None else lambda share: progress(WORK + (1 - WORK) * share)
    )


# Curves of several designs over each other, for the page of a comparison.


def overlaid(found: Comparison) -> Iterator[Item]:
    """The figures of a comparison: sensitivities, Nyquist plots, singular values, loads, the main job."""
    from malta.report import plots

    named = dict(zip(found.names, found.designs, strict=True))
    loops = {name: a.curves for name, a in named.items()}
    stable = {name: loops[name] for name, a in named.items() if a.report.stable}
    panels, limits = distinct_channels(loops), curve_limits(found.spec)
    asked = " Shaded in red: what the requirements exclude, hatched where a design fails." if limits else ""
    if stable and found.one_machine:
        shown = distinct_channels(stable)
        yield Illustration(
            partial(plots.sensitivity_curves, stable, channel=shown.channels, limits=limits),
            f"Sensitivity S and complementary sensitivity T, with the zones of ISO 14839-3.{shown.note}{asked}",
        )
    if found.one_machine:
        yield Illustration(
            partial(plots.nyquist, loops, channel=panels.channels, limits=limits),
            f"Nyquist plots of the loop at each sensor, the others closed.{panels.note}",
        )
    if stable:
        yield Illustration(
            partial(plots.sigma, stable, limits=limits),
            "Singular values of L, S and T with all sensors at once.",
        )
    if stable and found.one_machine and found.designs[0].plant.disturbances:
        yield Illustration(
            partial(plots.load_response, stable, limits=limits),
            "Deviation after a unit step of each load from outside, and compliance over frequency.",
        )
    flown = [(name, a) for name, a in named.items() if a.job is not None]
    if found.one_machine and len(flown) > 1:
        yield Illustration(
            lambda: _job_figure(flown, limits),
            "The main job on the nonlinear machine: the leading output, its distance from the reference, and the "
            "leading command.",
        )


LONG_JOB = 10.0  # s, beyond which a main job is drawn over seconds


def _job_figure(designs: Sequence[tuple[str, Analysis]], limits: Sequence[CurveLimit]) -> Figure:
    """The leading output of the main job, its error, and the leading command, of the first run of each design.

    A bound of the error is a line, since it is judged on machines that differ.
    """
    figure = new_figure("", size=(9.0, 6.4))
    figure.subplots_adjust(left=0.095, right=0.985, bottom=0.085, top=0.9, hspace=0.28)
    panels = figure.subplots(3, 1, sharex=True)
    plant = designs[0][1].plant
    k, m = plant.leading_output, plant.leading_input
    signal, force = plant.outputs[k], plant.inputs[m]
    shown = {"m": "mm", "rad": "mrad"}.get(signal.unit, signal.unit)
    fine = FINE_UNITS.get(signal.unit, signal.unit)
    longest = max(float(a.job.run.t[-1]) for _, a in designs if a.job is not None)
    unit, per = ("s", 1.0) if longest > LONG_JOB else ("ms", 1e-3)
    for (name, a), style in zip(designs, cycle((*STYLES, *MORE_STYLES)), strict=False):
        assert a.job is not None
        run = a.job.run
        t = run.t / per
        draw_line(panels[0], t, in_unit(1.0, shown) * run.p[:, k], label=name, **style)
        draw_line(panels[1], t, in_unit(1.0, fine) * (run.p - run.reference)[:, k], **style)
        draw_line(panels[2], t, run.v[:, m], **style)
    for limit in limits:
        if limit.curve == "error" and signal.name in limit.signals:
            draw_bound(panels[1], in_unit(limit.limit, fine), f"{limit.words} asked", both=True)
    labels = (
        f"{signal.name}{_in_brackets(shown)}",
        f"{signal.name}, off reference{_in_brackets(fine)}",
        f"command {force.name}{_in_brackets(force.unit)}",
    )
    for axes, label in zip(panels, labels, strict=True):
        finish_axes(axes, f"time [{unit}]" if axes is panels[-1] else "", label)
    _add_legend(figure, panels[0])
    return figure


def _in_brackets(unit: str) -> str:
    return "" if unit == "1" else f" [{micro(unit)}]"


def _add_legend(figure: Figure, axes: Axes) -> None:
    """One legend above all panels, in rows of four."""
    handles, labels = axes.get_legend_handles_labels()
    shown = [label if len(label) <= 40 else f"{label[:37]}..." for label in labels]
    figure.legend(
        handles, shown, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 0.995), frameon=False, fontsize=9
    )


# The page of a comparison: the same tables as in a terminal, and the curves of all designs over each other.


SIGN = "★"  # before the better value, beside bold letters


def comparison_page(found: Comparison, progress: Callable[[float], None] | None = None) -> Page:
    """Write a comparison as one page in HTML that needs no network and no other file.

    found : from `malta.report.compare_gains`
    progress : takes the share of the figures that are drawn

    Returns a Page: a notebook shows it, and its `save` writes it to a file.

    >>> import malta
    >>> A, B, C = [[0, 1], [100, 0]], [[0], [1]], [[1, 0]]
    >>> plant = malta.linear_machine(A, B, C, name="compared")
    >>> model = malta.linearize(plant, plant.at())
    >>> weights = malta.synthesis.weights
    >>> chosen = [weights(q=[q, 1], r=[1], w=[1], v=[1e-8]) for q in (1e2, 1e4)]
    >>> designs = [malta.lqg(model, one, Ts=1e-3) for one in chosen]
    >>> found = malta.report.compare_gains(*designs, proof=False)
    >>> b"What differs in the designs" in malta.report.comparison_page(found).content
    True
    """
    machines = ", ".join(dict.fromkeys(a.plant.name for a in found.designs))
    front = Front(
        "Comparison of designs",
        " · ".join(found.names),
        f"Machine {machines}",
        foot="malta compare",
        verdict=(verdict_html(found.standings) if found.standings else "") + _margin_bars(found),
    )
    sections = (
        Section("verdict", "Verdict", tuple(_verdicts(found))),
        Section("curves", "Curves", tuple(overlaid(found))),
        Section("figures", "Figures of merit", tuple(_figures(found))),
        Section("differences", "What differs in the designs", tuple(_differences(found))),
    )
    return render(front, [section for section in sections if section.items], progress)


def _margin_bars(found: Comparison) -> str:
    """The proven margins of the designs as bars beside each other; "" where they cannot be compared."""
    bars = stairs_html(found.margins)
    return bars and f'<dl class="verdict"><div><dt>proven margin</dt><dd>{bars}</dd></div></dl>'


def _verdicts(found: Comparison) -> Iterator[Item]:
    """The five lines of each design's verdict, beside each other."""
    rows, marks = [], []
    for lines in zip(*found.verdicts, strict=True):
        rows.append((lines[0].label, *(polish(f"{SIGNS[line.state]} {line.value}") for line in lines)))
        marks.append(("", *(line.state for line in lines)))
    left = tuple(False for _ in found.names)
    yield PageTable("", ("", *found.names), tuple(rows), (False, *left), tuple(marks))
    if found.judged_text:
        yield found.judged_text


def _differences(found: Comparison) -> Iterator[Item]:
    if not found.differences:
        yield "The designs do not differ."
        return
    yield _sheet(found.names, found.difference_lines)


def _figures(found: Comparison) -> Iterator[Item]:
    if found.is_marked:
        yield f"{SIGN} and bold: better than another design, in digits that are shown. Ties are not marked."
    yield _sheet(found.names, found.figure_lines)
    yield from found.remarks


def _sheet(names: Sequence[str], lines: Sequence[TableLine]) -> PageTable:
    """A table with a heading line for each group."""
    rows: list[tuple[str, ...]] = []
    marks: list[tuple[str, ...]] = []
    group = ""
    for own, heading, texts, best in lines:
        if own != group:
            group = own
            rows.append((own.capitalize(),))
            marks.append(("",))
        cells = (f"{SIGN} {text}" if star else text for text, star in zip(texts, best, strict=True))
        rows.append((polish(heading), *map(polish, cells)))
        marks.append(("", *("best" if star else "" for star in best)))
    return PageTable("", ("", *names), tuple(rows), (False, *(True for _ in names)), tuple(marks))

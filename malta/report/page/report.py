"""The report of a gain file: one page in HTML, and its figures as a PDF."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.gains.schema import GainFile
    from malta.model.plant import Parameters
    from malta.report.page.analysis import Analysis, Subject
    from malta.report.page.comparison import Comparison
    from malta.report.page.document import Page
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

WORK = 0.75  # share of the work that is done when all is computed; the rest is drawing


def gain_page(
    gains: str | Path | Controller,
    *,
    parameters: Parameters | None = None,
    uncertainty: Mapping[str, float] | None = None,
    spec: Spec | None = None,
    campaigns: Sequence[Summary] = (),
    proof: bool = True,
) -> Page:
    """Report a gain file, or a controller, as one page in HTML that needs no network and no other file.

    gains : the gain file, or a controller
    parameters : of the machine; None: those of the controller
    uncertainty : parameter -> share, either way, at margin 1; None: those of the gain file, none of a controller
    spec : the design, whose [specification] is judged; None: none
    campaigns : summaries of campaigns of these gains
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
    return page_of(analyse(subject, proof=proof, campaigns=campaigns))


def compare_gains(
    *gains: str | Path | Controller, uncertainty: Mapping[str, float] | None = None, proof: bool = True
) -> Comparison:
    """Compare 2 to 8 gain files, or controllers: what differs, and figures of merit with the better one marked.

    gains : gain files, or controllers
    uncertainty : parameter -> share, either way, at margin 1, of all designs; None: of each gain file its own
    proof : whether the margin of the parameters is proven for each, which takes seconds

    Returns a Comparison with `names`, `differences` and `rows`, the figures of merit.

    Raises InputError for another number of them, and as `malta.gains.read`.

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
    return compare([subject_of(one, uncertainty=uncertainty) for one in gains], proof=proof)


def comparison_page(found: Comparison) -> Page:
    """Write a comparison as one page in HTML that needs no network and no other file.

    found : from `malta.report.compare_gains`

    Returns a Page: a notebook shows it, and its `save` writes it to a file.

    >>> import malta
    >>> A, B, C = [[0, 1], [100, 0]], [[0], [1]], [[1, 0]]
    >>> plant = malta.linear_machine(A, B, C, name="compared")
    >>> model = malta.linearize(plant, plant.at())
    >>> chosen = [malta.weights(q=[q, 1], r=[1], w=[1], v=[1e-8]) for q in (1e2, 1e4)]
    >>> designs = [malta.lqg(model, one, Ts=1e-3) for one in chosen]
    >>> found = malta.report.compare_gains(*designs, proof=False)
    >>> b"What differs in the designs" in malta.report.comparison_page(found).content
    True
    """
    from malta.report.page.compared import comparison_page as write

    return write(found)


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
    from malta.gains.file import content_of, read
    from malta.report.page.analysis import Subject

    if not isinstance(gains, str | Path):
        box = dict(uncertainty or {})
        return Subject(gains, parameters or gains.parameters, box, spec, "", changes)
    path = locate(gains)
    controller = read(path)
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


def page_of(found: Analysis, progress: Callable[[float], None] | None = None) -> Page:
    """Write an analysis as a page."""
    from malta.report.page.document import Front, render
    from malta.report.page.headline import key_figures
    from malta.report.page.sections import report_sections

    c = found.subject.controller
    changes = f", changed: {', '.join(found.subject.changes)}" if found.subject.changes else ""
    about = f"Machine {found.plant.name}, preset {found.subject.parameters.preset}{changes}"
    front = Front("Design report", c.name, about, key_figures(found), _foot(found))
    return render(front, report_sections(found), progress)


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
    progress: Callable[[float], None] | None,
) -> tuple[Analysis, Page]:
    """Analyse a subject and write its page, behind one measure of progress."""
    from malta.report.page.analysis import analyse

    def report_work_share(share: float) -> None:
        if progress is not None:
            progress(WORK * share)

    found = analyse(subject, proof=proof, campaigns=campaigns, progress=report_work_share)
    return found, page_of(
        found, None if progress is None else lambda share: progress(WORK + (1 - WORK) * share)
    )

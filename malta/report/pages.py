"""Pages and pictures of a report: the page of a design, and figures saved to files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Group

from malta.loops.time_domain import recovery
from malta.margins.loop_report import LoopReport
from malta.model.linearize import LinearModel
from malta.model.parameters import box_words
from malta.report.figures import (
    distributions_figure,
    experiment_figure,
    front_figure,
    save,
    stroke_figure,
    worst_figure,
    yield_figure,
)
from malta.report.figures.campaign import sensitivity_figure
from malta.report.figures.drawing import Published
from malta.report.figures.margins import chain_figure, recovery_figure
from malta.report.tables.design import bandwidth_table, loop_poles_table, poles_table, sensitivity_table
from malta.report.tables.experiments import experiment_table
from malta.report.tables.layout import Paragraph
from malta.simulation.trajectory import Trajectory
from malta.synthesis.lqg import continuous_poles
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.campaigns.result import Campaign
    from malta.campaigns.studies import Sensitivity
    from malta.campaigns.summary import Summary
    from malta.loops.time_domain import Recovery
    from malta.model.plant import Plant
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.tuning.tune import Tuned


def design_page(
    spec: Spec, model: LinearModel, margins: LoopReport, flown: Experiment, published: Published | None
) -> Group:
    """Make the page of a design for a terminal: its loop, its margins, and the machine's main experiment.

    spec : the design, from `malta.read_design`
    model : the machine's linear model
    margins : from `malta.verify`
    flown : the experiment that is the machine's main job, from `malta.experiment`
    published : figures of the machine's paper, from `malta.model.published`; None: none

    Returns a rich Group, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> margins = malta.verify(model, controller)
    >>> page = malta.report.design_page(spec, model, margins, push, None)
    >>> for line in page.renderables[:2]:
    ...     rich.print(line)
    ball: LQG with integral action
    ball, preset data, sampled-data, 5 kHz, delay 1 in the design model
    """
    made = f"{spec.discretization}, {_rate_text(spec.sample_time)}, delay {spec.delay} in the design model"
    made += ", with the lag of the current loops" if spec.current_lag else ""
    if spec.pid is not None:
        made = f"PID, {_rate_text(spec.sample_time)}"
    if spec.structure is not None:
        made = f"elements of a given structure, {_rate_text(spec.sample_time)}"
    made += ", commutated for the predicted place" if spec.commutation == "predicted" else ""
    return Group(
        Paragraph(f"{spec.name}: {spec.summary}", style="bold"),
        Paragraph(f"{model.plant.name}, preset {spec.parameters.preset}, {made}"),
        "",
        poles_table(model, published),
        loop_poles_table(margins, continuous_poles(model, spec.weights) if spec.kind == "LQG" else None),
        bandwidth_table(margins, published),
        sensitivity_table(margins),
        *([] if margins.robust is None else [_margin_text(margins)]),
        experiment_table(flown, published),
    )


def _margin_text(margins: LoopReport) -> Paragraph:
    box = box_words(margins.uncertainty, margins.plant.parameters)
    assert margins.robust is not None
    where = margins.places_covered
    if margins.covers_travel:
        where = where.replace("the travel", "the whole travel")
    return Paragraph(f"{f'Parametric margin {where}'.rstrip()} ({box}): {margins.robust}\n")


def _rate_text(Ts: float) -> str:
    return f"{1e-3 / Ts:g} kHz" if Ts <= 1e-3 else f"a sample every {Ts * 1e3:g} ms"


def front(tuned: Tuned, path: str | Path | None = None) -> Figure:
    """Draw the Pareto front of a search, and save the figure where a path is given.

    tuned : from `malta.tune`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for another suffix.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import Tuned
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = Tuned(spec, front[1], (), front, trials=120)  # as malta.tune finds it
    >>> figure = malta.report.front(tuned, "build/front.svg")
    >>> figure.axes[0].get_xlabel()
    'proven margin [% of the box]'
    """
    return _save_figure(front_figure(tuned), path)


def stroke(run: Trajectory, path: str | Path | None = None, published: Published | None = None) -> Figure:
    """Draw a run, and save the figure where a path is given.

    run : from `malta.simulate`
    path : .png, .svg or .pdf file; None: nothing is written
    published : figures of the machine's paper, from `malta.model.published`; None: none

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> low = {"q": -50e-6}  # m
    >>> hold = malta.Scenario("hold", 20e-3, malta.references.hold, low, fidelity="force")
    >>> figure = malta.report.stroke(malta.simulate(spec.plant, controller, hold))
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['commanded force [N]', 'y, off reference [µm]', 'clearance used up [%]', '']
    """
    return _save_figure(stroke_figure(run, published), path)


def experiment(e: Experiment, path: str | Path | None = None, published: Published | None = None) -> Figure:
    """Draw an experiment, and save the figure where a path is given.

    e : from `malta.experiment`
    path : .png, .svg or .pdf file; None: nothing is written
    published : figures of the machine's paper, from `malta.model.published`; None: none

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for an experiment that the machine does not have, and for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> figure = malta.report.experiment(push)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['commanded force [N]', 'y, off reference [µm]', 'clearance used up [%]', '']
    """
    return _save_figure(experiment_figure(e, published), path)


def robustness(found: LoopReport, path: str | Path | None = None) -> Figure:
    """Draw the margins of a design stage by stage, and save the figure where a path is given.

    found : from `malta.verify`, with `stages`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> figure = malta.report.robustness(found)
    >>> figure.axes[0].get_xlabel()
    'proven margin without loads [% of the box]'
    """
    return _save_figure(chain_figure(found), path)


def loads(
    plant: Plant,
    controller: Controller,
    path: str | Path | None = None,
    found: Sequence[Recovery] | None = None,
) -> Figure:
    """Draw the answer to constant loads from outside and the compliance over frequency.

    plant : the machine
    controller : its controller
    path : .png, .svg or .pdf file; None: nothing is written
    found : from `malta.loops.recovery`, where it is known already; None: it is computed

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for a machine without disturbances and for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.loads(spec.plant, controller)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['deviation under 1 N [µm]', 'compliance [µm/N]']
    """
    found = recovery(plant, controller) if found is None else found
    return _save_figure(recovery_figure(plant, controller, found), path)


def sensitivity(found: Sensitivity, path: str | Path | None = None) -> Figure:
    """Draw the Sobol indices of a campaign's yield and merits, and save the figure where a path is given.

    found : from `malta.campaigns.sensitivity`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> options = {"duration": 0.02, "noise": 0.0}
    >>> box = {"m": 0.2, "C": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=64, options=options
    ... )
    >>> found = malta.campaigns.sensitivity(
    ...     plan, malta.campaigns.limit_of(plan, "touchdown"), workers=1
    ... )
    >>> figure = malta.report.sensitivity(found)
    >>> figure.axes[0].get_ylabel()
    'share of the variance [-]'
    """
    return _save_figure(sensitivity_figure(found), path)


class CampaignFigures(NamedTuple):
    """The figures of a campaign; a notebook shows all three as the value of a cell.

    distributions : of the figures of merit
    endings : how runs end over the parameters
    worst : the worst runs

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> figures = malta.report.campaign(malta.campaign(plan, workers=1))
    >>> figures._fields
    ('distributions', 'endings', 'worst')
    """

    distributions: Figure
    endings: Figure
    worst: Figure

    def _ipython_display_(self) -> None:
        """Show every figure, as IPython asks for it."""
        from IPython.display import display

        for figure in self:
            display(figure)


CAMPAIGN_FILES = ("distributions.png", "yield.png", "worst.png")  # of CampaignFigures, in a campaign's folder
"""The files of `CampaignFigures` in a campaign's folder, in their order.

>>> import malta
>>> malta.report.CAMPAIGN_FILES
('distributions.png', 'yield.png', 'worst.png')
"""


def campaign(
    found: Campaign | Summary, folder: str | Path | None = None, published: Published | None = None
) -> CampaignFigures:
    """Draw the results of a campaign, and save them as CAMPAIGN_FILES where a folder is given.

    found : the campaign, or its summary
    folder : of the files; None: nothing is written
    published : figures of the machine's paper, from `malta.model.published`; None: none; a summary has its own

    Returns CampaignFigures.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> figures = malta.report.campaign(malta.campaign(plan, workers=1), "build")
    >>> figures.worst is figures[-1], malta.report.CAMPAIGN_FILES[-1]
    (True, 'worst.png')
    """
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    figures = CampaignFigures(distributions_figure(summary), yield_figure(summary), worst_figure(summary))
    for figure, name in zip(figures, CAMPAIGN_FILES, strict=True):
        _save_figure(figure, None if folder is None else Path(folder) / name)
    return figures


def _save_figure(figure: Figure, path: str | Path | None) -> Figure:
    """The figure itself, saved where a path is given."""
    if path is not None:
        save(figure, path)
    return figure

"""Pages and pictures of a report: the page of a design, and figures saved to files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Group

from malta.margins.recovery import recovery
from malta.margins.verify import Margins
from malta.model.linearize import LinearModel
from malta.report.figures import (
    distributions_figure,
    experiment_figure,
    front_figure,
    save,
    stroke_figure,
    worst_figure,
    yield_figure,
)
from malta.report.figures.margins import chain_figure
from malta.report.figures.parts import Published
from malta.report.figures.recovery import recovery_figure
from malta.report.figures.sensitivity import sensitivity_figure
from malta.report.tables.design import bandwidth_table, loop_poles_table, poles_table, sensitivity_table
from malta.report.tables.experiments import experiment_table
from malta.report.tables.layout import Paragraph
from malta.report.tables.margins import is_of_whole_travel
from malta.simulation.trajectory import Trajectory
from malta.synthesis.lqg import continuous_poles
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.campaigns.result import Campaign
    from malta.campaigns.sensitivity import Sensitivity
    from malta.campaigns.summary import Summary
    from malta.margins.gain import Gain
    from malta.margins.recovery import Recovery
    from malta.margins.stages import Robustness
    from malta.model.plant import Plant
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.tuning.tune import Tuned


def design_page(
    spec: Spec, model: LinearModel, margins: Margins, flown: Experiment, published: Published | None
) -> Group:
    """A page about a design: its loop, its margins, and the experiment that is the machine's main job."""
    made = f"{spec.discretization}, {_rate_text(spec.sample_time)}, delay {spec.delay} in the design model"
    made += ", with the lag of the current loops" if spec.current_lag else ""
    if spec.pid is not None:
        made = f"PID, {_rate_text(spec.sample_time)}"
    made += ", commutated for the predicted place" if spec.commutation == "predicted" else ""
    return Group(
        Paragraph(f"{spec.name}: {spec.summary}", style="bold"),
        Paragraph(f"{model.plant.name}, preset {spec.parameters.preset}, {made}"),
        "",
        poles_table(model, published),
        loop_poles_table(margins, continuous_poles(model, spec.weights) if spec.pid is None else None),
        bandwidth_table(margins, published),
        sensitivity_table(margins),
        *([] if margins.robust is None else [_margin_text(margins)]),
        experiment_table(flown, published),
    )


def _margin_text(margins: Margins) -> Paragraph:
    box_text = " ".join(f"{name} +-{100 * share:g} %" for name, share in margins.uncertainty.items())
    assert margins.robust is not None
    where = str(margins.extent).replace("the travel", "the whole travel")
    if not is_of_whole_travel(margins.robust):
        where = "in the middle and at the end of the travel"
    return Paragraph(f"{f'Parametric margin {where}'.rstrip()} ({box_text}): {margins.robust}\n")


def _rate_text(Ts: float) -> str:
    return f"{1e-3 / Ts:g} kHz" if Ts <= 1e-3 else f"a sample every {Ts * 1e3:g} ms"


def front(tuned: Tuned, path: str | Path | None = None) -> Figure:
    """Draw the Pareto front of a search, and save it where a path is given."""
    return _saved(front_figure(tuned), path)


def stroke(run: Trajectory, path: str | Path | None = None, published: Published | None = None) -> Figure:
    """Draw a run, and save it where a path is given.

    published : figures of the machine's paper, drawn beside the run's

    Example: `malta.report.stroke(run)` as the last line of a cell shows the picture.
    """
    return _saved(stroke_figure(run, published), path)


def experiment(e: Experiment, path: str | Path | None = None, published: Published | None = None) -> Figure:
    """Draw an experiment, and save it where a path is given; arguments as those of `stroke`."""
    return _saved(experiment_figure(e, published), path)


def robustness(
    found: Robustness,
    name: str,
    uncertainty: Mapping[str, float],
    path: str | Path | None = None,
    position: str = "position",
    worst: Mapping[str, Gain] | None = None,
) -> Figure:
    """Draw the margins of a design stage by stage, and save the figure where a path is given.

    Other arguments as those of `chain_figure`.
    """
    return _saved(chain_figure(found, name, uncertainty, position, worst), path)


def loads(
    plant: Plant,
    controller: Controller,
    path: str | Path | None = None,
    found: Sequence[Recovery] | None = None,
) -> Figure:
    """Draw the answer to a constant load from outside and the compliance over frequency; save it where a path is given.

    found : malta.recovery(plant, controller), where it is known already

    Example: `malta.report.loads(plant, controller, "build/robust_loads.png")`
    """
    found = recovery(plant, controller) if found is None else found
    return _saved(recovery_figure(plant, controller, found), path)


def sensitivity(found: Sensitivity, path: str | Path | None = None) -> Figure:
    """Draw the Sobol indices of a campaign's yield and merits, and save the figure where a path is given."""
    return _saved(sensitivity_figure(found), path)


class CampaignFigures(NamedTuple):
    """The figures of a campaign; a notebook shows all three as the value of a cell."""

    distributions: Figure
    endings: Figure  # how runs end over the parameters
    worst: Figure

    def _ipython_display_(self) -> None:
        """Show every figure, as IPython asks for it."""
        from IPython.display import display

        for figure in self:
            display(figure)  # type: ignore[no-untyped-call]


CAMPAIGN_FILES = ("distributions.png", "yield.png", "worst.png")  # of CampaignFigures, in a campaign's folder


def campaign(
    found: Campaign | Summary, folder: str | Path | None = None, published: Published | None = None
) -> CampaignFigures:
    """Draw the results of a campaign, and save them as CAMPAIGN_FILES where a folder is given.

    published : figures of the machine's paper; a summary has its own

    Example: `malta.report.campaign(found).worst` is the figure of the worst runs.
    """
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    figures = CampaignFigures(distributions_figure(summary), yield_figure(summary), worst_figure(summary))
    for figure, name in zip(figures, CAMPAIGN_FILES, strict=True):
        _saved(figure, None if folder is None else Path(folder) / name)
    return figures


def _saved(figure: Figure, path: str | Path | None) -> Figure:
    """The figure itself, saved where a path is given."""
    if path is not None:
        save(figure, path)
    return figure

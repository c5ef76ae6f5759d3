"""Tables and figures of everything that malta computes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from malta.contents import contents

if TYPE_CHECKING:  # each is loaded when it is first asked for: commands that draw nothing start sooner
    from malta.report.figures import experiment_figure as experiment_figure, stroke_figure as stroke_figure
    from malta.report.figures.campaign import (
        CAMPAIGN_FILES as CAMPAIGN_FILES,
        CampaignFigures as CampaignFigures,
        campaign as campaign,
        distributions_figure as distributions_figure,
        sensitivity_figure as sensitivity_figure,
        worst_figure as worst_figure,
        yield_figure as yield_figure,
    )
    from malta.report.figures.drawing import (
        STYLES as STYLES,
        encode_figure as encode_figure,
        new_figure as new_figure,
        save as save,
    )
    from malta.report.figures.loads import load_limits_figure as load_limits_figure
    from malta.report.figures.margins import (
        chain_figure as chain_figure,
        front_figure as front_figure,
        recovery_figure as recovery_figure,
    )
    from malta.report.page.report import (
        compare_gains as compare_gains,
        comparison_page as comparison_page,
        gain_page as gain_page,
    )
    from malta.report.plots import (
        block_diagram as block_diagram,
        bode as bode,
        gang_of_four as gang_of_four,
        load_response as load_response,
        nichols as nichols,
        nyquist as nyquist,
        pzmap as pzmap,
        root_locus as root_locus,
        sensitivity_curves as sensitivity_curves,
        sigma as sigma,
        statechart as statechart,
        step as step,
    )
    from malta.report.plots.polar import margin_map as margin_map
    from malta.report.tables import Paragraph as Paragraph
    from malta.report.tables.campaign import (
        campaign_tables as campaign_tables,
        rare_event_tables as rare_event_tables,
        sensitivity_tables as sensitivity_tables,
        spreads_table as spreads_table,
    )
    from malta.report.tables.design import (
        bandwidth_table as bandwidth_table,
        design_page as design_page,
        front_markdown as front_markdown,
        front_table as front_table,
        loop_poles_table as loop_poles_table,
        poles_table as poles_table,
        recovery_table as recovery_table,
        requirements_table as requirements_table,
        sensitivity_table as sensitivity_table,
    )
    from malta.report.tables.experiments import (
        claims_table as claims_table,
        experiment_table as experiment_table,
        limits_text as limits_text,
        scenarios_table as scenarios_table,
    )
    from malta.report.tables.loads import load_limits_table as load_limits_table
    from malta.report.tables.margins import (
        chain_table as chain_table,
        disk_table as disk_table,
        gang_table as gang_table,
        loop_tables as loop_tables,
        open_bounds as open_bounds,
        places_table as places_table,
        tolerance_table as tolerance_table,
        worst_case_table as worst_case_table,
    )
    from malta.report.verdict import (
        verdict_html as verdict_html,
        verdict_lines as verdict_lines,
        verdict_text as verdict_text,
    )

# Names that go with the next minor version: functions whose second argument was the path.
_OLD = {
    "experiment": "experiment_figure",
    "front": "front_figure",
    "robustness": "chain_figure",
    "sensitivity": "sensitivity_figure",
    "stroke": "stroke_figure",
    "loads": "recovery_figure",
}
_INNER_PLACES = {  # others, which are parts of what prints them
    "front_rows": "design",
    **dict.fromkeys(
        ("box_text", "rare_event_sentence", "run_text", "sensitivity_sentence", "tolerance_sentence"),
        "campaign",
    ),
}

_NAMES = {
    "malta.report.figures": "experiment_figure stroke_figure",
    "malta.report.figures.campaign": "CAMPAIGN_FILES CampaignFigures campaign distributions_figure"
    " sensitivity_figure worst_figure yield_figure",
    "malta.report.figures.drawing": "STYLES encode_figure new_figure save",
    "malta.report.figures.loads": "load_limits_figure",
    "malta.report.figures.margins": "chain_figure front_figure recovery_figure",
    "malta.report.page.report": "compare_gains comparison_page gain_page",
    "malta.report.plots": "block_diagram bode gang_of_four load_response nichols nyquist pzmap root_locus"
    " sensitivity_curves sigma statechart step",
    "malta.report.plots.polar": "margin_map",
    "malta.report.tables": "Paragraph",
    "malta.report.tables.campaign": "campaign_tables rare_event_tables sensitivity_tables spreads_table",
    "malta.report.tables.design": "bandwidth_table design_page front_markdown front_table loop_poles_table"
    " poles_table recovery_table requirements_table sensitivity_table",
    "malta.report.tables.experiments": "claims_table experiment_table limits_text scenarios_table",
    "malta.report.tables.loads": "load_limits_table",
    "malta.report.tables.margins": "chain_table disk_table gang_table loop_tables open_bounds places_table"
    " tolerance_table worst_case_table",
    "malta.report.verdict": "verdict_html verdict_lines verdict_text",
}
__all__, _load, __dir__ = contents(__name__, _NAMES)


def __getattr__(name: str) -> Any:
    if name in _INNER_PLACES:
        warnings.warn(f"malta.report.{name} goes without another name", DeprecationWarning, stacklevel=2)
        return getattr(import_module(f"malta.report.tables.{_INNER_PLACES[name]}"), name)
    if name not in _OLD:
        return _load(name)
    new = _OLD[name]
    warnings.warn(
        f"malta.report.{name} goes: write malta.report.{new}(..., path=...)", DeprecationWarning, stacklevel=2
    )
    return partial(_draw_as_before, _load(new), 2 if name == "loads" else 1)


def _draw_as_before(draw: Callable[..., Any], subjects: int, *given: Any, **named: Any) -> Any:
    """Draw with the arguments of the version before: what is drawn, path, published figures or answers to loads."""
    others = ("path", "found" if subjects == 2 else "published")
    return draw(*given[:subjects], **dict(zip(others, given[subjects:], strict=False)), **named)

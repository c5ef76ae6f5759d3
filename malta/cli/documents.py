"""Results as plain tables for the JSON documents of the commands; all numbers in SI."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from malta.campaigns.result import Campaign
    from malta.margins.gain import Gain
    from malta.margins.recovery import Recovery
    from malta.margins.robust import Margin
    from malta.margins.stages import Robustness
    from malta.margins.verify import Margins
    from malta.simulation.experiments import Experiment
    from malta.synthesis.spec import Spec
    from malta.tuning.outcomes import Outcome


def margins_document(margins: Margins) -> dict[str, Any]:
    """Stability, poles, bandwidths and peak sensitivities of a loop."""
    return {
        "stable": margins.stable,
        "poles": margins.poles.pairs(),
        "bandwidth": dict(margins.bandwidth),
        "peak_sensitivity": {stage.name: dict(stage.peak_sensitivity) for stage in margins.stages},
    }


def recovery_document(found: Recovery) -> dict[str, Any]:
    """The answer to a constant load, by output; times in s."""
    outputs = {
        d.output: {
            "largest": d.largest,
            "left": [{"after": t, "value": left} for t, left in zip(found.after, d.left, strict=True)],
            "settled": d.settled,
            "final": d.final,
            "compliance": {"peak": d.compliance, "frequency": d.frequency},
        }
        for d in found.outputs
    }
    return {"load": dict(found.load), "outputs": outputs}


def robustness_document(
    robustness: Robustness, box: Mapping[str, float], worst: Mapping[str, Gain]
) -> dict[str, Any]:
    """Margins over an uncertainty and over the travel, and the largest |S| where it was asked for."""
    document = {
        "uncertainty": dict(box),
        "chain": [
            {"stage": link.name, "peak_sensitivity": link.peak, "at": link.broken_at, "loads": link.loaded}
            | _margin_document(link.margin)
            for link in robustness.chain
        ],
        "travel": _margin_document(robustness.travel),
        "disks": [
            {
                "channels": disk.channels,
                "size": disk.size,
                "gain": disk.gain,
                "phase": disk.phase,
                "frequency": disk.frequency,
            }
            for disk in robustness.disks
        ],
        "delay": dict(robustness.delay),
        "gang_of_four": {
            name: dict(zip(("S", "T", "SP", "FS"), peaks, strict=True))
            for name, peaks in robustness.gang.items()
        },
        "tolerance": {
            name: {"down": _margin_document(down), "up": _margin_document(up)}
            for name, (down, up) in robustness.tolerance.items()
        },
        "mass_margin": None if robustness.mass is None else _margin_document(robustness.mass),
        "places": [
            {
                "position": place.position,
                "peak_sensitivity": place.peak,
                "disk": place.disk,
                "delay": place.delay,
            }
            | _margin_document(place.margin)
            for place in robustness.places
        ],
    }
    return document | (
        {"worst_sensitivity": {name: _gain_document(gain) for name, gain in worst.items()}} if worst else {}
    )


def experiment_document(experiment: Experiment) -> dict[str, Any]:
    """Verdicts, limits and merits of each run of an experiment."""
    document: dict[str, Any] = {
        "engine": experiment.run.engine,
        "fidelity": experiment.run.scenario.fidelity,
        "verdict": experiment.run.verdict._asdict(),
        "merits": {merit.label: merit.value for merit in experiment.merits},
        "cases": [
            {
                "label": case.label,
                "verdict": case.run.verdict._asdict(),
                "limits": list(case.run.limits),
                "merits": {merit.label: merit.value for merit in case.merits},
            }
            for case in experiment.cases
        ],
    }
    if experiment.name == "stroke":
        from dataclasses import asdict

        from malta.simulation.trajectory import stroke_figures

        document["stroke"] = asdict(stroke_figures(experiment.run))
    return document


def campaign_document(
    campaign: Campaign, published: Mapping[str, Any] | None, worst: int, spec: Spec | None = None
) -> dict[str, Any]:
    """The yield of a campaign, the distribution of each merit, and its worst runs."""
    from malta.campaigns.statistics import worst_of
    from malta.campaigns.yields import yields_of

    completed, within, specified = yields_of(campaign, published, spec)
    return {
        "manifest": campaign.plan.manifest,
        "runs": len(campaign.index),
        "interrupted": campaign.interrupted,
        "engines": list(campaign.engines),
        "yield": completed._asdict(),
        "within_published": None if within is None else within.passed,
        "within_specification": None if specified is None else specified.passed,
        "ends": campaign.ends,
        "merits": _percentiles(campaign, published),
        "worst": [_run_document(campaign, row) for row in worst_of(campaign, worst)],
    }


def requirement_document(outcome: Outcome) -> dict[str, Any]:
    """A requirement on a design, and what the design reaches; the ratio is null where it is infinite."""
    ratio = outcome.ratio if outcome.ratio < float("inf") else None
    fields = {name: value for name, value in outcome._asdict().items() if name != "at_least"}
    return {**fields, "ratio": ratio, "holds": outcome.holds}


def _margin_document(margin: Margin) -> dict[str, Any]:
    """A margin in multiples of the uncertainty; `upper` is null where no unstable loop was found."""
    return {
        "lower": margin.lower,
        "upper": None if margin.exhausted else margin.upper,
        "frequency": margin.frequency,
        "witness": None if margin.witness is None else dict(margin.witness),
        "sensitivity": dict(margin.sensitivity),
        "cells": sum(proof.cells for proof in margin.certificate),
        "reason": margin.reason,
    }


def _gain_document(gain: Gain) -> dict[str, Any]:
    """The largest gain that was found and the bound that is proven, null where none is."""
    return {
        "found": gain.lower,
        "frequency": gain.frequency,
        "proven": gain.upper,
        "reason": gain.reason,
    }


def _percentiles(campaign: Campaign, published: Mapping[str, Any] | None) -> dict[str, Any]:
    """Percentiles of each merit over the runs that have it, and its published figure."""
    import numpy as np

    from malta.campaigns.statistics import figures_of

    merits = {}
    for figure in figures_of(campaign, published):
        values = figure.values[np.isfinite(figure.values)]
        marks = np.percentile(values, (5, 50, 95, 99, 100)) if values.size else [float("nan")] * 5
        names = ("p5", "p50", "p95", "p99", "largest")
        merits[figure.label] = dict(zip(names, map(float, marks), strict=True)) | {
            "published": figure.published
        }
    return merits


def _run_document(campaign: Campaign, row: int) -> dict[str, Any]:
    """One run of a campaign, by its row in the campaign's arrays."""
    from malta.simulation.digest import verdicts

    names = verdicts(campaign.plan.plant)
    return {
        "run": int(campaign.index[row]),
        "end": names[int(campaign.batch.verdict[row])],
        "time": float(campaign.batch.duration[row]),
        "values": dict(zip(campaign.names, campaign.values[row].tolist(), strict=True)),
        "deviation": campaign.batch.deviation[row].tolist(),
        "contact": campaign.batch.contact[row].tolist(),
        "replay": f"{campaign.folder}:{campaign.index[row]}",
    }

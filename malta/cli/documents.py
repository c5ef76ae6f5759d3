"""Results as plain tables for the JSON documents of the commands; all numbers in SI."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from malta.campaigns.status import Status
    from malta.campaigns.summary import Merit, Runs, Summary
    from malta.margins.gain import Gain
    from malta.margins.recovery import Recovery
    from malta.margins.robust import Margin
    from malta.margins.stages import Robustness
    from malta.margins.verify import Margins
    from malta.simulation.experiments import Experiment
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


def campaign_document(found: Summary, worst: int) -> dict[str, Any]:
    """The yield of a campaign, the distribution of each merit, and its worst runs."""
    from malta.campaigns.sketch import ACCURACY
    from malta.campaigns.summary import worst_runs

    completed, within, specified = found.yields
    runs = worst_runs(found, worst)
    return {
        "manifest": found.plan.manifest,
        "runs": found.runs,
        "interrupted": found.interrupted,
        "engines": list(found.engines),
        "yield": completed._asdict(),
        "within_published": None if within is None else within.passed,
        "within_specification": None if specified is None else specified.passed,
        "ends": found.ends,
        "percentiles": {"exact": found.exact, "relative_error": 0.0 if found.exact else ACCURACY},
        "merits": {merit.label: _merit_document(merit) for merit in found.merits},
        "worst": [_run_document(found, runs, row) for row in range(len(runs.index))],
    }


def status_document(found: Status) -> dict[str, Any]:
    """How far a campaign is; times in s."""
    return {
        "blocks": {"done": found.blocks, "all": found.of, "runs": found.size, "bytes": found.stored},
        "damaged": [str(file) for file in found.summary.damaged],
        "running": found.running,
        "pace": found.pace,
        "age": found.age,
        "left": found.left,
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


def _merit_document(merit: Merit) -> dict[str, Any]:
    """The distribution of a merit over the runs that have it, and its published figure."""
    marks = merit.percentiles((5, 50, 95, 99, 100)).tolist()
    return dict(zip(("p5", "p50", "p95", "p99", "largest"), marks, strict=True)) | {
        "smallest": merit.sketch.smallest,
        "mean": merit.mean,
        "standard_deviation": merit.standard_deviation,
        "published": merit.published,
    }


def _run_document(found: Summary, runs: Runs, row: int) -> dict[str, Any]:
    """One run of a campaign, by its row among some runs."""
    from malta.campaigns.plan import varied_names
    from malta.simulation.digest import verdicts

    return {
        "run": int(runs.index[row]),
        "end": verdicts(found.plan.plant)[int(runs.batch.verdict[row])],
        "time": float(runs.batch.duration[row]),
        "values": dict(zip(varied_names(found.plan), runs.values[row].tolist(), strict=True)),
        "deviation": runs.batch.deviation[row].tolist(),
        "contact": runs.batch.contact[row].tolist(),
        "replay": f"{found.folder}:{runs.index[row]}",
    }

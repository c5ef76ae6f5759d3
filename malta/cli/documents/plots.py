"""The document of `malta plot`: the numbers that each kind of plot draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from malta.cli.documents.parts import Files, Number, Part

if TYPE_CHECKING:
    from pathlib import Path

    from malta.margins.channels import ChannelMargins
    from malta.margins.curves import LoopCurves
    from malta.margins.linear_loops import Place
    from malta.margins.locus import RootLocus
    from malta.synthesis.step_response import StepResponse

Names = Sequence[str]
POINTS = 500  # of a line over time


Lines = dict[str, dict[str, list[Number]]]  # curves by channel and quantity
Pairs = Annotated[list[list[Number]], Field(description="rows of real and imaginary part")]


class ChannelPart(Part):
    """The margins of one channel; what nothing bounds is null, as is what an unstable loop has not."""

    channel: str
    stable: bool
    gain_margin_lower: Number
    gain_margin_lower_frequency_rad_per_s: Number
    gain_margin_upper: Number
    gain_margin_upper_frequency_rad_per_s: Number
    phase_margin_rad: Number
    phase_margin_frequency_rad_per_s: Number
    delay_margin_s: Number
    delay_margin_frequency_rad_per_s: Number
    disk_margin: Number
    disk_margin_frequency_rad_per_s: Number
    modulus_margin: Number
    peak_sensitivity: Number
    peak_sensitivity_frequency_rad_per_s: Number
    encirclements: int | None
    unstable_poles: int | None


class AnswerPart(Part):
    """An answer over time, in the output's unit for a unit step, and the figures that are read off."""

    rise_s: Number
    overshoot_share: Number
    settling_s: Number
    peak: Number
    peak_time_s: Number
    final: Number
    time_s: list[float]
    value: list[Number]


class LoadPart(AnswerPart):
    """What a unit load from outside does to one output, over time and over frequency."""

    load: str
    load_unit: str
    output: str
    output_unit: str
    compliance: list[Number]


class GangPart(Part):
    """The gang of four of one output and the force of its axis, over frequency."""

    output_unit: str
    force: str
    force_unit: str
    S: list[Number]
    T: list[Number]
    SP: list[Number]
    FS: list[Number]


class PolesPart(Part):
    """Poles and zeros; of sampled loops ln(z) / Ts."""

    plant_poles_rad_per_s: Pairs
    law_poles_rad_per_s: Pairs
    closed_loop_poles_rad_per_s: Pairs
    zeros_rad_per_s: Pairs


class LoopPart(Part):
    """One loop: its margins, and the curves of each kind of plot that was asked for."""

    name: str
    stable: bool
    sample_time_s: Number = Field(description="null for a continuous loop")
    margins: list[ChannelPart]
    frequency_rad_per_s: list[float] | None = None
    bode: Lines | None = Field(default=None, description="magnitude and phase_rad by channel")
    nyquist: Lines | None = Field(default=None, description="real and imaginary part by channel")
    nichols: Lines | None = Field(default=None, description="magnitude and phase_rad by channel")
    sigma: dict[str, list[list[Number]]] | None = Field(default=None, description="of L, S, T; largest first")
    sensitivity: Lines | None = Field(default=None, description="|S| and |T| by channel")
    gang: dict[str, GangPart] | None = None
    pzmap: PolesPart | None = None
    step: dict[str, AnswerPart] | None = Field(default=None, description="of each reference's own output")
    load: list[LoadPart] | None = None


class LocusPart(Part):
    """The poles of the closed loop over a parameter of the machine, or over the gain of the loop."""

    name: str
    parameter: str
    unit: str
    nominal: float
    stability_changes: list[float]
    values: list[float]
    branches_rad_per_s: list[Pairs]
    nominal_poles_rad_per_s: Pairs


class PlotOutput(Part):
    """What `malta plot --json` prints."""

    kind: Literal["malta-plot-output"] = Field(default="malta-plot-output", alias="schema")
    version: Literal[1] = 1
    at: Literal["sensors", "forces"] = Field(description="where the loops are cut")
    loops: list[LoopPart]
    rootlocus: list[LocusPart] = Field(default=[])
    files: Files


def plot_output(
    loops: Iterable[LoopPart], loci: Iterable[RootLocus], at: Place, files: Iterable[Path]
) -> PlotOutput:
    """The document of a command."""
    return PlotOutput(
        at=at, loops=list(loops), rootlocus=list(map(_locus, loci)), files=list(map(str, files))
    )


def loop_part(curves: LoopCurves, kinds: Sequence[str], channels: Names, at: Place) -> LoopPart:
    """One loop: its margins, and what each kind draws of these channels."""
    of_kind: Mapping[str, Callable[[LoopCurves, Names, Place], Any]] = {
        "bode": _bode,
        "nyquist": _nyquist,
        "nichols": _bode,
        "sigma": _sigma,
        "sensitivity": _sensitivity,
        "gang": _gang,
        "pzmap": _poles,
        "step": _steps,
        "load": _loads,
    }
    drawn = [kind for kind in kinds if kind in of_kind]
    return LoopPart(
        name=curves.name,
        stable=curves.stable,
        sample_time_s=curves.loop.sample_time,
        margins=[_channel(m) for m in curves.margins_at(at) if m.channel in channels],
        frequency_rad_per_s=curves.w.tolist() if {*drawn} - {"pzmap", "step"} else None,
        **{kind: of_kind[kind](curves, channels, at) for kind in drawn},
    )


def _channel(found: ChannelMargins) -> ChannelPart:
    lower, upper = found.gain
    below, above = found.gain_frequency
    return ChannelPart(
        channel=found.channel,
        stable=found.stable,
        gain_margin_lower=lower,
        gain_margin_lower_frequency_rad_per_s=below,
        gain_margin_upper=upper,
        gain_margin_upper_frequency_rad_per_s=above,
        phase_margin_rad=found.phase,
        phase_margin_frequency_rad_per_s=found.phase_frequency,
        delay_margin_s=found.delay,
        delay_margin_frequency_rad_per_s=found.delay_frequency,
        disk_margin=found.disk.size,
        disk_margin_frequency_rad_per_s=found.disk.frequency,
        modulus_margin=found.modulus,
        peak_sensitivity=found.peak_sensitivity,
        peak_sensitivity_frequency_rad_per_s=found.peak_frequency,
        encirclements=found.encirclements,
        unstable_poles=found.unstable_poles,
    )


def _indices(curves: LoopCurves, channels: Names, at: Place) -> dict[str, int]:
    return {s.name: k for k, s in enumerate(curves.channels(at)) if s.name in channels}


def _bode(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    gain = curves.responses.alone(at)
    return {
        name: {
            "magnitude": np.abs(gain[:, k]).tolist(),
            "phase_rad": np.unwrap(np.angle(gain[:, k])).tolist(),
        }
        for name, k in _indices(curves, channels, at).items()
    }


def _nyquist(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    gain = curves.responses.alone(at)
    return {
        name: {"real": gain[:, k].real.tolist(), "imaginary": gain[:, k].imag.tolist()}
        for name, k in _indices(curves, channels, at).items()
    }


def _sigma(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    del channels  # all of them together
    return {
        letter: curves.singular_values(G).T.tolist()
        for letter, G in zip("LST", curves.responses.cut(at), strict=True)
    }


def _sensitivity(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    _, S, T = curves.responses.cut(at)
    return {
        name: {"S": np.abs(S[:, k, k]).tolist(), "T": np.abs(T[:, k, k]).tolist()}
        for name, k in _indices(curves, channels, at).items()
    }


def _gang(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    del at  # of each output and the force of its axis
    r, found = curves.responses, {}
    for name, k in _indices(curves, channels, "sensors").items():
        if k < len(curves.loop.inputs):
            parts = {"S": r.S, "T": r.T, "SP": r.SP, "FS": r.FS}
            found[name] = {
                "output_unit": curves.loop.outputs[k].unit,
                "force": curves.loop.inputs[k].name,
                "force_unit": curves.loop.inputs[k].unit,
            } | {key: np.abs(G[:, k, k]).tolist() for key, G in parts.items()}
    return found


def _poles(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    del channels, at  # of the whole loop
    sets = {f"{name}_poles_rad_per_s": values for name, values in curves.poles.items()}
    return {key: pairs(values) for key, values in (sets | {"zeros_rad_per_s": curves.zeros}).items()}


def pairs(values: Any) -> list[list[float | None]]:
    """Complex numbers as rows of real and imaginary parts."""
    return [[float(value.real), float(value.imag)] for value in values]


def _line(answer: StepResponse, output: int, column: int) -> dict[str, Any]:
    """A step response at POINTS times at most until it has settled, and the figures that are read off."""
    from malta.margins.steps import step_figures

    found = step_figures(answer, output, column)
    end = 1.6 * found.settling if 0 < found.settling < math.inf else float(answer.t[-1])
    last = min(int(np.searchsorted(answer.t, end)) + 1, len(answer.t))
    k = np.unique(np.searchsorted(answer.t[:last], np.linspace(0, answer.t[last - 1], POINTS)))
    return {
        "rise_s": found.rise,
        "overshoot_share": found.overshoot,
        "settling_s": found.settling,
        "peak": found.peak,
        "peak_time_s": found.peak_time,
        "final": found.final,
        "time_s": answer.t[k].tolist(),
        "value": answer.y[k, output, column].tolist(),
    }


def _steps(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    from malta.margins.steps import loop_steps

    del at  # of the outputs after their references
    answer = loop_steps(curves.loop).references
    return {name: _line(answer, k, k) for name, k in _indices(curves, channels, "sensors").items()}


def _loads(curves: LoopCurves, channels: Names, at: Place) -> list[dict[str, Any]]:
    from malta.margins.steps import loop_steps

    del at  # of the outputs after loads from outside
    answer, compliance = loop_steps(curves.loop).loads, curves.responses.compliance
    return [
        {
            "load": load.name,
            "load_unit": load.unit,
            "output": name,
            "output_unit": curves.loop.outputs[k].unit,
        }
        | {"compliance": np.abs(compliance[:, k, column]).tolist()}
        | _line(answer, k, column)
        for column, load in enumerate(curves.loop.loads)
        for name, k in _indices(curves, channels, "sensors").items()
    ]


def _locus(found: RootLocus) -> LocusPart:
    return LocusPart(
        name=found.name,
        parameter=found.parameter,
        unit=found.unit,
        nominal=found.nominal,
        stability_changes=list(found.changes),
        values=found.values.tolist(),
        branches_rad_per_s=[pairs(branch) for branch in found.poles.T],
        nominal_poles_rad_per_s=pairs(found.nominal_poles),
    )

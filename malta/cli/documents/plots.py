"""The document of `malta plot`: the margins of each loop, and the numbers that each kind of plot draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from malta.cli.documents.loops import DocumentPart, Files, Number

if TYPE_CHECKING:
    from malta.loops.channel_margins import ChannelMargins
    from malta.loops.curves import LoopCurves
    from malta.loops.linear_loops import Place
    from malta.loops.locus import RootLocus
    from malta.margins.margin_map import MarginMap
    from malta.synthesis.step_response import StepResponse

Line = Annotated[list[Number], Field(description="one number for each frequency, time or value")]
Poles = Annotated[list[list[float]], Field(description="rows of real and imaginary part")]
POINTS = 500  # of a line over time


class MarginsPart(DocumentPart):
    """The margins of one channel with the others closed; null where nothing bounds them, or the loop is unstable."""

    READS: ClassVar = {
        "phase_at_rad_per_s": "phase_frequency",
        "delay_at_rad_per_s": "delay_frequency",
        "disk": "disk.size",
        "disk_at_rad_per_s": "disk.frequency",
        "peak_sensitivity_at_rad_per_s": "peak_frequency",
    }

    channel: str
    stable: bool
    gain_lower: Number = Field(description="the loop is stable for factors of the gain between both")
    gain_lower_at_rad_per_s: Number
    gain_upper: Number
    gain_upper_at_rad_per_s: Number
    phase_rad: Number
    phase_at_rad_per_s: Number
    delay_s: Number
    delay_at_rad_per_s: Number
    disk: Number = Field(description="symmetric disk margin")
    disk_at_rad_per_s: Number
    modulus: Number = Field(description="1 / peak_sensitivity")
    peak_sensitivity: Number
    peak_sensitivity_at_rad_per_s: Number
    encirclements: int = Field(description="of -1, counterclockwise")
    unstable_poles: int = Field(description="with this channel open")


class LoopGainPart(DocumentPart):
    """The loop gain of a channel with the others closed."""

    magnitude: Line
    phase_rad: Line


class PlanePart(DocumentPart):
    """The same in the complex plane."""

    real: Line
    imaginary: Line


class SensitivityPart(DocumentPart):
    """|S_ii| and |T_ii| of a channel."""

    S: Line
    T: Line


class GangCurvesPart(DocumentPart):
    """Magnitudes of the gang of four of an output and the force of its axis."""

    output_unit: str
    force: str
    force_unit: str
    S: Line
    T: Line
    SP: Line = Field(description="output_unit over force_unit")
    FS: Line = Field(description="force_unit over output_unit")


class PoleZeroPart(DocumentPart):
    """Poles and zeros; of sampled loops ln(z) / T."""

    closed_loop_rad_per_s: Poles
    plant_rad_per_s: Poles
    law_rad_per_s: Poles
    zeros_rad_per_s: Poles


class AnswerPart(DocumentPart):
    """The answer of an output to a unit step, and what is read off."""

    READS: ClassVar = {"peak_at_s": "peak_time"}

    rise_s: Number
    overshoot_share: Number
    settling_s: Number = Field(description="to 2 %")
    peak: Number
    peak_at_s: Number
    final: Number
    time_s: list[float]
    value: list[float]


class LoadPart(AnswerPart):
    """The answer of an output to a constant load, and the compliance over frequency."""

    load: str
    load_unit: str
    output: str
    output_unit: str
    compliance: Line


class LoopCurvesPart(DocumentPart):
    """One loop; a kind that was not asked for is null."""

    name: str
    stable: bool
    sample_time_s: Number = Field(description="null: continuous")
    margins: list[MarginsPart]
    frequency_rad_per_s: list[float]
    bode: dict[str, LoopGainPart] | None = Field(default=None, description="by channel; of nichols too")
    nyquist: dict[str, PlanePart] | None = None
    sigma: dict[str, list[Line]] | None = Field(default=None, description="of L, S and T, the largest first")
    sensitivity: dict[str, SensitivityPart] | None = None
    gang: dict[str, GangCurvesPart] | None = None
    pzmap: PoleZeroPart | None = None
    step: dict[str, AnswerPart] | None = None
    load: list[LoadPart] | None = None


class LocusPart(DocumentPart):
    """A root locus: closed-loop poles over a parameter, a list for each branch."""

    name: str
    parameter: str
    channel: str | None = Field(description="whose gain it is; null: all")
    unit: str
    nominal: float
    stability_changes: list[float] = Field(description="values at which the loop becomes stable or unstable")
    values: list[float]
    branches_rad_per_s: list[list[list[Number]]]
    nominal_rad_per_s: Poles


class MapPart(DocumentPart):
    """A margin map: growth of the worst pole over two parameters, and the proven box."""

    name: str
    x: str
    y: str
    units: list[str] = Field(description="SI units of x and y")
    nominal: list[float]
    half: list[float] = Field(description="half widths of the uncertainty box")
    others: Literal["box", "nominal"] = Field(description="what the parameters are that are not drawn")
    beside: list[str] = Field(description="uncertain parameters that are not drawn")
    proven: float = Field(description="margin in multiples of the box that is proven; 0: nothing")
    witness: list[float] | None = Field(
        description="x and y at the limit of stability; null where others reach it first"
    )
    x_values_si: list[float]
    y_values_si: list[float]
    growth_per_s: list[list[Number]] = Field(description="a row for each y, positive where unstable")


class PlotOutput(DocumentPart):
    """What `malta plot --json` prints."""

    kind: Literal["malta-plot-output"] = Field(default="malta-plot-output", alias="schema")
    version: Literal[1] = 1
    at: Literal["sensors", "forces"]
    loops: list[LoopCurvesPart]
    root_loci: list[LocusPart]
    margin_maps: list[MapPart]
    files: Files


def plot_output(
    loops: Iterable[LoopCurves],
    kinds: Sequence[str],
    channels: Sequence[str] | None,
    at: Place,
    planes: tuple[Iterable[RootLocus], Iterable[MarginMap]],
    files: Iterable[Path],
) -> PlotOutput:
    """The document of plots of these kinds; channels : by name; None: all."""
    return PlotOutput(
        at=at,
        loops=[_loop_part(curves, kinds, channels, at) for curves in loops],
        root_loci=[_locus_part(found) for found in planes[0]],
        margin_maps=[MapPart.of(found) for found in planes[1]],
        files=list(map(str, files)),
    )


def _loop_part(
    curves: LoopCurves, kinds: Sequence[str], channels: Sequence[str] | None, at: Place
) -> LoopCurvesPart:
    r, S, T = curves.responses, *curves.responses.cut(at)[1:]
    gain, here = r.alone(at), _indices(curves, channels, at)
    outputs = _indices(curves, channels, "sensors")
    of_kind: dict[str, Any] = {}
    if {"bode", "nichols"} & {*kinds}:
        of_kind["bode"] = {name: _gain_part(gain[:, k]) for name, k in here.items()}
    if "nyquist" in kinds:
        of_kind["nyquist"] = {
            name: PlanePart(real=gain[:, k].real.tolist(), imaginary=gain[:, k].imag.tolist())
            for name, k in here.items()
        }
    if "sigma" in kinds:
        of_kind["sigma"] = {
            letter: curves.singular_values(G).T.tolist() for letter, G in zip("LST", r.cut(at), strict=True)
        }
    if "sensitivity" in kinds:
        of_kind["sensitivity"] = {
            name: SensitivityPart(S=_sizes(S[:, k, k]), T=_sizes(T[:, k, k])) for name, k in here.items()
        }
    if "gang" in kinds:
        of_kind["gang"] = {
            name: _gang_part(curves, k) for name, k in outputs.items() if k < len(curves.loop.inputs)
        }
    if "pzmap" in kinds:
        of_kind["pzmap"] = _poles_part(curves)
    if {"step", "load"} & {*kinds}:
        of_kind |= _answers(curves, kinds, outputs)
    return LoopCurvesPart(
        name=curves.name,
        stable=curves.stable,
        sample_time_s=curves.loop.sample_time,
        margins=[_margins_part(m) for m in curves.margins_at(at) if m.channel in here],
        frequency_rad_per_s=curves.w.tolist(),
        **of_kind,
    )


def _indices(curves: LoopCurves, channels: Sequence[str] | None, at: Place) -> dict[str, int]:
    """Channels by name: those named, or all where none of the names is one of this place."""
    known = {s.name: k for k, s in enumerate(curves.channels(at))}
    return {name: k for name, k in known.items() if channels is None or name in channels} or known


def _margins_part(found: ChannelMargins) -> MarginsPart:
    (lower, upper), (lower_at, upper_at) = found.gain, found.gain_frequency
    return MarginsPart.of(
        found,
        gain_lower=lower,
        gain_lower_at_rad_per_s=lower_at,
        gain_upper=upper,
        gain_upper_at_rad_per_s=upper_at,
    )


def _sizes(values: Any) -> list[float | None]:
    found: list[float | None] = np.abs(values).tolist()
    return found


def _gain_part(gain: Any) -> LoopGainPart:
    return LoopGainPart(magnitude=_sizes(gain), phase_rad=np.unwrap(np.angle(gain)).tolist())


def _gang_part(curves: LoopCurves, k: int) -> GangCurvesPart:
    r, output, force = curves.responses, curves.loop.outputs[k], curves.loop.inputs[k]
    sizes = {key: _sizes(getattr(r, key)[:, k, k]) for key in ("S", "T", "SP", "FS")}
    return GangCurvesPart(output_unit=output.unit, force=force.name, force_unit=force.unit, **sizes)


def _pairs(values: Any) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]


def _poles_part(curves: LoopCurves) -> PoleZeroPart:
    sets = {f"{name}_rad_per_s": _pairs(values) for name, values in curves.poles.items()}
    return PoleZeroPart(**sets, zeros_rad_per_s=_pairs(curves.zeros))


def _answers(curves: LoopCurves, kinds: Sequence[str], outputs: dict[str, int]) -> dict[str, Any]:
    """The answers to steps and loads."""
    from malta.loops.steps import loop_steps

    found = loop_steps(curves.loop)
    made: dict[str, Any] = {}
    if "step" in kinds:
        made["step"] = {name: AnswerPart(**_line(found.references, k, k)) for name, k in outputs.items()}
    if "load" in kinds:
        made["load"] = [
            LoadPart(
                load=load.name,
                load_unit=load.unit,
                output=name,
                output_unit=curves.loop.outputs[k].unit,
                compliance=_sizes(curves.responses.compliance[:, k, column]),
                **_line(found.loads, k, column),
            )
            for column, load in enumerate(curves.loop.loads)
            for name, k in outputs.items()
        ]
    return made


def _line(answer: StepResponse, output: int, column: int) -> dict[str, Any]:
    """A step response at POINTS times at most until it has settled, and the figures that are read off."""
    from malta.loops.steps import step_figures

    found = step_figures(answer, output, column)
    end = 1.6 * found.settling if 0 < found.settling < math.inf else float(answer.t[-1])
    last = min(int(np.searchsorted(answer.t, end)) + 1, len(answer.t))
    k = np.unique(np.searchsorted(answer.t[:last], np.linspace(0, answer.t[last - 1], POINTS)))
    line = {"time_s": answer.t[k].tolist(), "value": answer.y[k, output, column].tolist()}
    return AnswerPart.fields_of(found) | line


def _locus_part(found: RootLocus) -> LocusPart:
    return LocusPart.of(
        found,
        stability_changes=list(found.changes),
        branches_rad_per_s=[_pairs(branch) for branch in found.poles.T],
        nominal_rad_per_s=_pairs(found.nominal_poles),
    )

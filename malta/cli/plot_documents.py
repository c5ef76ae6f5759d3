"""The numbers of `malta plot` as JSON documents: what each kind of plot draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from malta.margins.channels import ChannelMargins
    from malta.margins.curves import LoopCurves
    from malta.margins.linear_loops import Place
    from malta.margins.locus import RootLocus
    from malta.synthesis.step_response import StepResponse

Names = Sequence[str]
POINTS = 500  # of a line over time


def loop_document(curves: LoopCurves, kinds: Sequence[str], channels: Names, at: Place) -> dict[str, Any]:
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
    found: dict[str, Any] = {
        "name": curves.name,
        "stable": curves.stable,
        "sample_time_s": curves.loop.sample_time,
        "margins": [margins_document(m) for m in curves.margins_at(at) if m.channel in channels],
    }
    drawn = [kind for kind in kinds if kind in of_kind]
    if {*drawn} - {"pzmap", "step"}:
        found["frequency_rad_per_s"] = curves.w.tolist()
    return found | {kind: of_kind[kind](curves, channels, at) for kind in drawn}


def margins_document(found: ChannelMargins) -> dict[str, Any]:
    """The margins of one channel; what nothing bounds is null, as is what an unstable loop has not."""
    lower, upper = found.gain
    below, above = found.gain_frequency
    return {
        "channel": found.channel,
        "stable": found.stable,
        "gain_margin_lower": lower,
        "gain_margin_lower_frequency_rad_per_s": below,
        "gain_margin_upper": upper,
        "gain_margin_upper_frequency_rad_per_s": above,
        "phase_margin_deg": math.degrees(found.phase),
        "phase_margin_frequency_rad_per_s": found.phase_frequency,
        "delay_margin_s": found.delay,
        "delay_margin_frequency_rad_per_s": found.delay_frequency,
        "disk_margin": found.disk.size,
        "disk_margin_frequency_rad_per_s": found.disk.frequency,
        "modulus_margin": found.modulus,
        "peak_sensitivity": found.peak_sensitivity,
        "peak_sensitivity_frequency_rad_per_s": found.peak_frequency,
        "encirclements": found.encirclements,
        "unstable_poles": found.unstable_poles,
    }


def _indices(curves: LoopCurves, channels: Names, at: Place) -> dict[str, int]:
    return {s.name: k for k, s in enumerate(curves.channels(at)) if s.name in channels}


def _bode(curves: LoopCurves, channels: Names, at: Place) -> dict[str, Any]:
    gain = curves.responses.alone(at)
    return {
        name: {
            "magnitude": np.abs(gain[:, k]).tolist(),
            "phase_deg": np.degrees(np.unwrap(np.angle(gain[:, k]))).tolist(),
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


def pairs(values: Any) -> list[list[float]]:
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
        "overshoot": found.overshoot,
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


def locus_document(found: RootLocus) -> dict[str, Any]:
    """A root locus: values, and poles by branch."""
    return {
        "name": found.name,
        "parameter": found.parameter,
        "unit": found.unit,
        "nominal": found.nominal,
        "stability_changes": list(found.changes),
        "values": found.values.tolist(),
        "branches_rad_per_s": [pairs(branch) for branch in found.poles.T],
        "nominal_poles_rad_per_s": pairs(found.nominal_poles),
    }

"""What the page draws of a design at each move: poles, S and T, Nyquist, a run, a load, figures; numbers only, in SI.

The loop is the machine's own, `malta.loop`, and the figures are those of malta.verify and malta.loops.recovery.
Nothing here is proven: the eigenvalue margin is an upper bound, and the proof follows in proof.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from malta.app.files import Edited
from malta.arrays import FloatArray
from malta.bound import at_most
from malta.errors import CheckError, InputError
from malta.loops.classical import phase_and_delay
from malta.loops.curves import LoopCurves, loop_curves
from malta.loops.loop import Loop, loop_of_model
from malta.loops.waveforms import bound_any_waveform
from malta.margins.loop_report import BANDWIDTH, BANDWIDTHS, LoopReport, pole_figures, zone
from malta.margins.margin_map import margin_map_of, plane_of
from malta.margins.travel import travel_loops
from malta.margins.verify import machine_report
from malta.merits import Merit, figure
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import Plant, Signal
from malta.model.plants import plant_of
from malta.proof.loss import RayBound, ray_bound
from malta.simulation.experiments import PlannedRun
from malta.simulation.experiments.catalogue import cases_of, main_job, series_of, step_cases
from malta.simulation.experiments.worst_load import worst_load_cases
from malta.simulation.linear_run import LinearRun, linear_run
from malta.synthesis.controller import Controller
from malta.synthesis.spec import Spec
from malta.synthesis.step_response import StepResponse
from malta.synthesis.synthesize import synthesize
from malta.units import in_unit

# The runs that the page can show: the machine's main job, a step of each output, the worst load of the chosen kind.


STEP, WORST_RUN = "step ", "worst load"


def run_names(plant: Plant, controller: Controller) -> list[str]:
    """The runs by name, the one that the page begins with first: the main job, unless nothing moves in it."""
    job, steps = main_job(plant), [STEP + s.name for s in plant.outputs]
    steps += [WORST_RUN] if plant.disturbances else []
    if job not in series_of(plant):
        return steps
    scenario = cases_of(job, plant, controller)[0].scenario
    moves = scenario.reference(plant)(np.linspace(0.0, scenario.duration, 50)).p
    return [job, *steps] if np.ptp(moves, axis=0).any() else [*steps, job]


def planned_run(plant: Plant, controller: Controller, name: str, load: str = "") -> tuple[str, PlannedRun]:
    """A run by its name, and the name; "": the first. Raises InputError for an unknown one.

    load : the disturbance of a worst load, which its name has then; "": the first
    """
    known = run_names(plant, controller)
    name = name or known[0]
    if name not in known:
        raise InputError("run", "name", repr(name), "one of " + ", ".join(known))
    if name == WORST_RUN:
        (planned,) = worst_load_cases(plant, controller, on=load)
        return f"{WORST_RUN} {load}".rstrip(), planned
    if name.startswith(STEP):
        return name, step_cases(plant, controller, output=name.removeprefix(STEP), size=0.0, time=0.0)[0]
    return name, cases_of(name, plant, controller)[0]


POINTS = 400  # of a curve over time, at most
LOAD_POINTS = 240
DIGITS = 6  # of what is drawn
FAR_BEYOND_NOISE = 1e3  # of a sensor's noise: an unstable loop is not drawn further


@dataclass(frozen=True)
class View:
    """What the page looks at: a run of picture.py, and a disturbance of the machine; "": the first of each."""

    run: str = ""
    load: str = ""


@dataclass(frozen=True, eq=False)
class PictureSubject:
    """A design that has been synthesized, and the machine that it runs on."""

    spec: Spec
    plant: Plant
    model: LinearModel  # of the machine that it runs on
    controller: Controller

    @cached_property
    def loop(self) -> Loop:
        """The machine's own loop. Raises CheckError where no input holds the machine."""
        return loop_of_model(self.model, self.controller)

    @cached_property
    def report(self) -> LoopReport:
        """What is known of it without a proof, the record of `malta.verify`."""
        return machine_report(self.model, self.controller)

    @cached_property
    def curves(self) -> LoopCurves:
        """Its frequency responses and the margins of its channels."""
        return loop_curves(self.loop)


def solve(edited: Edited) -> PictureSubject:
    """Synthesize the controller of an edited design. Raises InputError and CheckError as `synthesize`."""
    spec = edited.spec
    at = tuple(spec.operating_point.items())
    controller = synthesize(spec, _design_model(spec.plant, at), solver="scipy")
    plant = _machine(edited)
    return PictureSubject(spec, plant, _design_model(plant, at), controller)


def _machine(edited: Edited) -> Plant:
    try:
        return plant_of(edited.truth)
    except CheckError as error:
        raise InputError(edited.spec.machine_file.name, "parameters", str(error), "a machine") from error


@lru_cache(maxsize=8)  # every controller of a machine needs it; plants compare by identity
def _design_model(plant: Plant, at: tuple[tuple[str, float], ...]) -> LinearModel:
    return linearize(plant, plant.at(**dict(at)))


def picture(problem: PictureSubject, view: View, *, margin: bool = True) -> dict[str, Any]:
    """Compute the document that the page draws: what it opens with, and its PARTS.

    margin : whether the eigenvalue margin is asked for

    Raises CheckError where no input holds the machine.
    """
    document = first_picture(problem)
    for name in PARTS:
        add_part(document, name, problem, view)
    return document | {"margin": eigenvalue_margin(problem) if margin else None}


@np.errstate(all="ignore")  # an unstable loop runs away
def first_picture(problem: PictureSubject) -> dict[str, Any]:
    """Stability, poles, and the figures that need no curve. Raises CheckError where no input holds the machine."""
    stage = problem.report.stages[-1]
    figures = _figures(problem, None)
    return {
        "stable": stage.stable, "radius": stage.spectral_radius, "poles": _poles(problem), "figures": figures,
    }  # fmt: skip


Part = Callable[[PictureSubject, View, Mapping[str, Any]], Any]
# Of a picture, in the order in which they are computed, each from what is known before.
PARTS: Mapping[str, Part] = {
    "frequency": lambda problem, _view, _known: _frequency(problem.curves),
    "run": lambda problem, view, _known: run_document(problem, view),
    "load": lambda problem, view, _known: _load(problem, view),
    "figures": lambda problem, _view, known: _figures(problem, known),
}


@np.errstate(all="ignore")
def add_part(document: dict[str, Any], name: str, problem: PictureSubject, view: View) -> None:
    """Add one of PARTS to a document that has what comes before it."""
    document[name] = PARTS[name](problem, view, document)


def _poles(problem: PictureSubject) -> dict[str, list[list[float]]]:
    """The poles of the continuous machine, of regulator, filter and closed loop, rad/s, as rows [re, im]."""
    poles = problem.report.poles.pairs
    sets = {
        "machine": "open_loop",
        "closed loop": "closed_loop",
        "regulator": "regulator",
        "filter": "filter",
    }
    return {name: poles[key] for name, key in sets.items() if poles[key]}


def _frequency(curves: LoopCurves) -> dict[str, Any]:
    """|S_ii|, |T_ii| and the loop of each sensor with the others closed, up to half of sampling."""
    w, responses, rows = curves.w, curves.responses, slice(None)
    if not curves.stable:
        rows = slice(0, 0)
    alone = responses.alone("sensors")
    S, T = (np.abs(np.einsum("kii->ki", G)).T[rows] for G in (responses.S, responses.T))
    return {
        "w": round_values(w),
        "sensors": [s.name for s in curves.loop.outputs],
        "S": round_values(S),
        "T": round_values(T),
        "L": round_values(np.stack([alone.T.real, alone.T.imag], axis=1)),
        "crossover": crossovers(curves) if curves.stable else [],
    }


def crossovers(curves: LoopCurves) -> list[tuple[float, float] | None]:
    """The highest gain crossover of each sensor's loop, rad/s, and its phase margin there, rad; None without one.

    The others are closed. The margin is the angle from -1 to the loop, 0 to 2 pi.
    """
    last = [crossings[-1] if crossings else None for crossings in curves.crossings]
    return [c and (c.frequency, float(np.angle(c.value) + math.pi) % (2 * math.pi)) for c in last]


def run_document(problem: PictureSubject, view: View) -> dict[str, Any] | None:
    """The chosen run on the linear loop; None where there is no such run, as of an unstable loop's worst load, or it is
    too long."""
    try:
        name, planned = planned_run(problem.plant, problem.controller, view.run, view.load)
        found = linear_run(problem.loop.sampled, problem.controller, planned.scenario)
    except (InputError, CheckError):
        return None
    end = len(found.t) if problem.report.stable else _end_of_run(problem.plant, found)
    return curves(name, found.t[:end], found.reference[:end], found.p[:end], found.v[:end])


def _end_of_run(plant: Plant, found: LinearRun) -> int:
    """The samples of an unstable loop until an output is as far off as its unit is asked to move, beyond any noise."""
    units = [s.unit for s in plant.outputs]
    moved = np.ptp(found.reference, axis=0)
    asked = np.array([max(moved[k] for k, other in enumerate(units) if other == unit) for unit in units])
    noise = np.array(ca.DM(plant.sensors.deviations)).ravel()
    scale = np.maximum(asked, FAR_BEYOND_NOISE * noise)
    share = np.abs(found.p - found.reference) / np.where(scale > 0, scale, np.inf)
    off = np.flatnonzero(share.max(axis=1) > 1)
    return max(int(off[0]), 2) if len(off) else len(share)


def curves(name: str, t: FloatArray, reference: FloatArray, p: FloatArray, v: FloatArray) -> dict[str, Any]:
    """A run as the page draws it: every so many samples of it, by output and by input."""
    step = -(-len(t) // POINTS)
    rows = [round_values(np.asarray(series)[::step].T) for series in (reference, p, v)]
    return {"name": name, "t": round_values(t[::step]), "reference": rows[0], "p": rows[1], "v": rows[2]}


def _load(problem: PictureSubject, view: View) -> dict[str, Any] | None:
    """The outputs under a unit of one disturbance, until little of it is left; None without disturbances."""
    names = [s.name for s in problem.plant.disturbances]
    if not names or not problem.report.stable:
        return None
    one, k = _answer(problem, view)
    settled = one.within(0.02)
    ends = settled[np.isfinite(settled)]
    end = max(1.3 * float(ends.max(initial=0.0)), 20 * problem.controller.sample_time)
    t = np.linspace(0.0, min(end, float(one.t[-1])), LOAD_POINTS)
    y = np.array([np.interp(t, one.t, row) for row in one.y[..., 0].T])
    return {
        "name": names[k],
        "t": round_values(t),
        "y": round_values(y),
        "largest": round_values(one.largest[:, 0]),
        "any": round_values(bound_any_waveform(problem.loop, np.eye(len(names))[k])),
    }


def _answer(problem: PictureSubject, view: View) -> tuple[StepResponse, int]:
    """The answer of the loop to a unit of the chosen load, and which that is."""
    names = [s.name for s in problem.plant.disturbances]
    k = names.index(view.load) if view.load in names else 0
    return problem.loop.sampled.answer(k), k


def largest_moved(problem: PictureSubject, view: View) -> FloatArray | None:
    """How far the chosen load moves each output at most; None without loads from outside."""
    return _answer(problem, view)[0].largest[:, 0] if problem.plant.disturbances else None


def eigenvalue_margin(
    problem: PictureSubject, first: tuple[int, float] | None = None
) -> dict[str, Any] | None:
    """The eigenvalue margin, an upper bound; None without an uncertainty, or where the model is none of parameters.

    first : the ray of the last eigenvalue margin, and that margin
    """
    box = problem.spec.uncertainty
    if not box:
        return None
    try:
        loops, over = travel_loops(problem.plant, problem.controller, tuple(box))
        bound = ray_bound(loops, box, over, first)
    except (InputError, CheckError) as error:
        return {"upper": None, "reason": str(error)}
    return margin_document(bound)


def margin_document(bound: RayBound) -> dict[str, Any]:
    """An eigenvalue margin for the page, as a number and as it is shown; no upper bound is null."""
    upper = bound.upper if math.isfinite(bound.upper) else None
    return {
        "upper": upper,
        "lost": at_most(bound.upper).percent(),
        "at": dict(bound.at),
        "frequency": bound.frequency,
        "ray": bound.ray,
    }


def map_document(problem: PictureSubject, names: tuple[str, str], lost: float) -> dict[str, Any]:
    """The plane of two uncertain parameters: where eigenvalues are unstable on a grid, which proves nothing.

    The other uncertain parameters are anywhere in the box, as in the proof.

    names : of the parameters along x and y
    lost : where about stability is lost, in multiples of the box

    Raises InputError for parameters that are not uncertain.
    """
    from contourpy import FillType, contour_generator  # with matplotlib, which draws the same map elsewhere

    box = problem.spec.uncertainty
    found = margin_map_of(problem.plant, problem.controller, names, box, proof=False, lost=lost)
    lines: Any = contour_generator(
        found.x_values, found.y_values, found.growth, fill_type=FillType.OuterOffset
    )
    rings, offsets = lines.filled(0.0, math.inf)
    areas = [
        [round_values(ring[a:b].T) for a, b in pairwise(at)] for ring, at in zip(rings, offsets, strict=True)
    ]
    boundary = [round_values(line.T) for line in lines.lines(0.0)] if found.growth.min() < 0 else []
    return {
        "x": found.x, "y": found.y, "words": found.words, "units": found.units,
        "nominal": found.nominal, "half": found.half,
        "reach": [round_values(values[[0, -1]]) for values in (found.x_values, found.y_values)],
        "unstable": areas, "boundary": boundary, "beside": found.beside_text,
    }  # fmt: skip


def poles_document(problem: PictureSubject, at: Mapping[str, float]) -> dict[str, Any]:
    """Poles of the closed loop at a point of the map, rad/s: of the worst machine that the point stands for.

    at : values of x and of y

    Raises InputError for values that are none of a machine.
    """
    plant, (x, y) = problem.plant, at
    try:
        plant_of(replace(plant.parameters, **at))
    except CheckError as error:
        raise InputError("malta app", "map", str(error), "a machine") from error
    plane = plane_of(plant, problem.controller, (x, y), problem.spec.uncertainty)
    found = plane.worst(at[x], at[y])
    worst = found.poles[np.argmax(found.poles.real)]
    return {
        "at": dict(at),
        "beside": {name: found.values[name] for name in plane.names[2:]},
        "poles": [[float(s.real), float(s.imag)] for s in found.poles],
        "worst": [float(worst.real), float(worst.imag)],
        "stable": found.growth < 0,
    }


# The figures that pinned designs are compared by: those of the report, with the words of a narrow column, and of the
# run and the load that are drawn. Numbers are SI but for angles.


SHORT_LABELS = {
    "peak_sensitivity": "peak |S|",
    f"bandwidth_{BANDWIDTH}": "bandwidth, T",
    "bandwidth_crossover_max": "crossover, L",
    "smallest_damping": "least damping",
    "slowest_pole": "slowest pole",
}
SIDES = {"high": 1, "low": -1, "": 0}  # of the better values


def _figures(problem: PictureSubject, known: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """The figures of the picture: numbers without a value are null.

    known : with the run and the load; None: the figures that need no curve
    """
    merits = [*reversed([*pole_figures(problem.report.poles.closed_loop)])]
    if problem.report.stable:
        over_time = [] if known is None else _time_merits(problem, known["run"], known["load"])
        merits = [*_loop_merits(problem, curves=known is not None), *over_time, *merits]
    return [
        {
            "label": SHORT_LABELS.get(one.key, one.label),
            "value": in_unit(one.value, one.unit) if math.isfinite(one.value) else None,
            "unit": one.unit,
            "frequency": one.is_frequency,
            "note": one.note,
            "better": SIDES[one.better],
        }
        for one in merits
    ]


def _loop_merits(problem: PictureSubject, *, curves: bool) -> list[Merit]:
    """Of the machine's loop: sensitivity, bandwidths, margins of the channels where there are curves, noise."""
    found = problem.report.quick_figures
    known = {one.key: one for one in found}
    peak, sensors = known["peak_sensitivity"], [one for one in found if one.kind == "peak_s_of"]
    worst = max(sensors, key=lambda one: one.value)
    noise = {kind: [one.value for one in found if one.kind == kind] for kind in ("motion", "command")}
    return [
        peak._replace(note=f"at {worst.signal}, zone {zone(peak.value)}"),
        *(known[f"bandwidth_{key}"]._replace(note=BANDWIDTHS[key]) for key in (BANDWIDTH, "crossover_max")),
        *(_channel_margins(problem) if curves else ()),
        *_worst_by_unit("motion", "motion at rest, rms", noise["motion"], problem.plant.outputs),
        *_worst_by_unit("command", "command noise, rms", noise["command"], problem.plant.inputs),
    ]


def _channel_margins(problem: PictureSubject) -> tuple[Merit, Merit]:
    """The smallest phase margin and delay margin of the sensors."""
    turns = [phase_and_delay(crossings) for crossings in problem.curves.crossings]
    names = [s.name for s in problem.curves.channels()]
    phase, phase_at = min(zip((turn[0] for turn in turns), names, strict=True))
    delay, delay_at = min(zip((turn[2] for turn in turns), names, strict=True))
    alone = "smallest of the sensors, the others closed"
    return (
        figure("phase_margin", "", "phase margin", phase, note=f"{phase_at}, {alone}"),
        figure("delay_margin", "", "delay margin", delay, "s", note=f"{delay_at}, {alone}"),
    )


def _time_merits(
    problem: PictureSubject, run: Mapping[str, Any] | None, load: Mapping[str, Any] | None
) -> list[Merit]:
    """The largest errors of the run, and what the load moves, on the linear loop."""
    outputs, merits = problem.plant.outputs, []
    if run is not None:
        error = np.abs(np.array(run["p"]) - np.array(run["reference"])).max(axis=1)
        merits += _worst_by_unit("job", f"error, {run['name']}", error.tolist(), outputs)
    if load is not None:
        merits += _worst_by_unit("load_any", f"moved by {load['name']}, any waveform", load["any"], outputs)
        merits += _worst_by_unit("load_moves", f"moved by {load['name']}, a step", load["largest"], outputs)
    return merits


def _worst_by_unit(kind: str, label: str, values: Sequence[float], signals: Sequence[Signal]) -> list[Merit]:
    """The largest of the values of each unit."""
    worst: dict[str, tuple[float, str]] = {}
    for value, s in zip(values, signals, strict=True):
        worst[s.unit] = max(worst.get(s.unit, (0.0, s.name)), (value, s.name))
    return [
        figure(
            kind,
            "",
            label if len(worst) == 1 else f"{label} [{unit}]",
            value,
            unit,
            note=f"largest at {name}",
        )
        for unit, (value, name) in worst.items()
        if value > 0
    ]


def round_values(values: Any) -> list[Any]:
    """Numbers with DIGITS digits, as lists; what is not finite becomes None."""
    x = np.asarray(values, dtype=float)
    finite = np.isfinite(x)
    with np.errstate(all="ignore"):
        size = np.where(finite & (x != 0), np.floor(np.log10(np.abs(x))), 0.0)
        scale = 10.0 ** np.clip(DIGITS - 1 - size, -300, 300)
        short = np.where(finite, np.round(x * scale) / scale, x)
    if not finite.all():
        boxed = short.astype(object)
        boxed[~finite] = None
        return list(boxed.tolist())
    return list(short.tolist())

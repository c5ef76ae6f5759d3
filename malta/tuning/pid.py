"""Specification -> gains of a PID: the smallest errors that constant forces leave, within what is asked for.

On the machine's own sampled loop (hold, held currents, delay, current loops), with the sizes of the design's [cost]:

    load error         J_i = sqrt(sum of Ts p_i^2), the output i at the samples after a constant force from outside has
                       set in at its input, which acts between samples too; discrete Lyapunov equation
    noise motion       rms of p_i from white forces, which act between samples too, and from the sensors' noise
    peak sensitivity   largest |S_ii|; bandwidth: the smaller of T's and the last crossover, in every part

The root of the sum of J_i^2 is minimized, in SI units, so that the forces weigh the axes; [specification] bounds the
rest. Integral gains become as large as that allows. Parts of the machine that nothing joins are searched by themselves.
Differential evolution finds the region, COBYQA (Ragonneau and Zhang) the place on the bounds. What else is asked for
is estimated in each trial (pid.py) where forces do not depend on where the machine is; elsewhere a margin
over the travel is only judged, as the regulator's natural frequencies are everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import optimize, sparse

from malta.arrays import FloatArray
from malta.linear.matrices import system_matrix
from malta.loops.sampled_loops import SampledLoop
from malta.loops.windings import estimated_rows, with_estimated_emf
from malta.model.linearize import linearize
from malta.synthesis.linear_law import linear_law_of, with_readings
from malta.synthesis.pid import PidAxisSet, axes_of, law_of_outputs, pid_gains
from malta.synthesis.requirements import base_of, ratio_of
from malta.synthesis.spec import Pid, Spec, pid_signals
from malta.tuning.groups import TuningGroup, figures_of_gains, groups_of
from malta.tuning.pid_loop import PidPart, loads_of, loop_figures, whole_machine
from malta.tuning.search import (
    UNSTABLE_RATIO,
    Effort,
    Journal,
    Progress,
    Trial,
    TrialSearch,
    apply_trial,
    at_least_of,
    combine,
    distance_outside,
    merge,
    model_and_controller,
    separate,
)
from malta.work import WorkUp, check_clock, without_limit

# What requirements estimate of a trial of PID gains: noise of forces, answers to loads, margin at corners of the box.
#
# The loops are those of tuning.groups, closed with a PID, so a machine whose currents are held between samples has
# none.


EXACT_FIGURES = {"load_error", "noise_motion", "peak_sensitivity", "bandwidth"}  # tuning.pid computes these
CORNER_TOLERANCE = 1e-3  # of a margin: the corners of the box are interpolated between samples of the machine
ESTIMATE_JOINT = " of "  # between the name of an estimate and the outputs that it is of


class Estimates(NamedTuple):
    """The groups of a machine whose figures [specification] bounds; of mirror images one."""

    spec: Spec
    axes: PidAxisSet
    groups: tuple[TuningGroup, ...]

    def figures(self, terms: Pid, outputs: Sequence[int]) -> list[dict[str, float]]:
        """Compute the figures of the groups among some outputs, named as "force_noise of x1 x2"."""
        found = []
        for group in self.groups:
            if set(group.outputs) <= set(outputs):
                own = " ".join(self.spec.plant.outputs[k].name for k in group.outputs)
                figures = _figures(self.spec, group, terms, self.axes)
                found.append({f"{name}{ESTIMATE_JOINT}{own}": value for name, value in figures.items()})
        return found


def estimates_of(spec: Spec, touched: Sequence[set[int]]) -> Estimates:
    """Find what of [specification] needs estimates.

    touched : the outputs that each variable of the search touches; mirror images have the same variables
    """
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    terms, axes = spec.pid, axes_of(model, spec.axes)
    asked = {base_of(name) for name in spec.specification} - EXACT_FIGURES
    if terms is None or not asked or model.E.any():
        return Estimates(spec, axes, ())
    distinct: dict[tuple[object, ...], TuningGroup] = {}
    for group in groups_of(spec):
        few, _ = law_of_outputs(terms, axes, group.outputs)
        numbers = tuple(tuple(v.tolist()) for v in (few.Kp, few.Ki, few.Kd, few.filters))
        variables = tuple(k for k, own in enumerate(touched) if own & set(group.outputs))
        distinct.setdefault((group.picture, numbers, variables), group)
    return Estimates(spec, axes, tuple(distinct.values()))


def outputs_of(figure: str) -> list[str]:
    """Name the outputs that a figure is of: of "noise_motion x" and of estimates; none of one of the whole machine."""
    _, of, own = figure.rpartition(ESTIMATE_JOINT)
    return own.split() if of else own.split()[1:]


def name_of(figure: str) -> str:
    """Return a figure's name in [specification]: "force_noise" of "force_noise of x1 x2"."""
    name, of, own = figure.rpartition(ESTIMATE_JOINT)
    return name if of else own


def _figures(spec: Spec, group: TuningGroup, terms: Pid, axes: PidAxisSet) -> dict[str, float]:
    """The estimates of one group; none where its loop is unstable."""
    P = group.model.C[:, : len(group.states) // 2]
    few, own = law_of_outputs(terms, axes, group.outputs)
    gains = pid_gains(P, few, spec.sample_time, own._replace(of_positions=own.of_outputs @ P))
    figures = {}
    for name, value in figures_of_gains(spec, group, gains).items():
        if base_of(name) not in EXACT_FIGURES:
            figures[name] = (1 - CORNER_TOLERANCE if base_of(name) == "margin" else 1.0) * value
    return figures


JOINS = 1e-9  # of the largest entries of its row and column: smaller ones are rounding
BOUND_COST = 30.0  # cost of a bound's logarithm in that of the load error: far beyond what any bound is worth
MIN_BOUND_RATIO = 1e-6  # ratio to a bound that counts; nearer to nothing is as good
ROOM = 1e-5  # below a bound, for what a part's grid and rounding may hide of the whole machine
RADII = ((0.05, 1e-3), (0.01, 1e-4))  # of COBYQA's trust region at first and last, in the unit cube


def parts_of(whole: PidPart) -> list[PidPart]:
    """Split a machine into parts that nothing joins to each other."""
    n, m = len(whole.Ad), len(whole.Cd)
    M = np.abs(system_matrix(whole.Ad, whole.Bd, whole.Cd))
    least = JOINS * np.sqrt(np.outer(M.max(axis=1), M.max(axis=0)))
    counts = least < M
    touch = np.zeros((n + m, n + m), dtype=bool)
    touch[:, :n] = counts[:, :n]
    for first in range(n, n + whole.Bd.shape[1], m):  # forces, then readings: each of its output
        touch[:n, n:] |= counts[:n, first : first + m]
    touch[n:, n:] = whole.slope != 0
    for first in range(0, whole.forecast.shape[1], m):
        touch[n:, n:] |= whole.forecast[:, first : first + m] != 0
    count, label = sparse.csgraph.connected_components(touch, directed=False)
    parts = []
    for k in range(count):
        i, o = np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)
        inputs = np.concatenate([o + first for first in range(0, whole.Bd.shape[1], m)])
        parts.append(
            PidPart(
                tuple(o.tolist()),
                whole.Ad[np.ix_(i, i)],
                whole.Bd[np.ix_(i, inputs)],
                whole.Cd[np.ix_(o, i)],
                whole.slope[np.ix_(o, o)],
                whole.push[np.ix_(i, o)],
                whole.shaken[np.ix_(i, i)],
                whole.forecast[np.ix_(o, np.append(o, m + o))] if whole.forecast.size else whole.forecast,
                None if whole.true is None else whole.true[np.ix_(o, i)],
            )
        )
    return parts


def close_loop(part: PidPart, terms: Pid, Ts: float, axes: PidAxisSet | None = None) -> SampledLoop:
    """Close a part's loop with gains, as `malta.loop` closes the whole machine's.

    axes : of the whole machine; None: each output with the input of its index
    """
    k = len(part.outputs)
    one = np.eye(len(terms.Kp))
    few, own = law_of_outputs(terms, axes or PidAxisSet(one, one, one), part.outputs)
    g = pid_gains(np.eye(k), few, Ts, own)
    law = linear_law_of(g, Ts)
    linear = law._replace(D_y=law.D_y + part.slope)
    if part.forecast.size:
        linear = with_estimated_emf(linear, estimated_rows(part.forecast, g.L, g.Cd))
    elif part.Bd.shape[1] > k:
        linear = with_readings(linear)
    return SampledLoop(part.Ad, part.Bd, part.Cd, linear, Ts, part.true)


def _ratios(spec: Spec, figures: Mapping[str, float]) -> list[float]:
    """How near their bounds the figures are: each output's by its own bound, or by one of all outputs.

    A load that is carried to the last digit has a ratio of 0, no margin an infinite one; logarithms need numbers.
    """
    asked, ratios, at_least = spec.specification, [], at_least_of(spec.plant)
    for figure, value in figures.items():
        name = name_of(figure)
        bound = asked.get(name, asked.get(base_of(name)))
        if bound is not None:
            ratio = ratio_of(bound, value, at_least=base_of(name) in at_least)
            ratios.append(min(max(ratio, MIN_BOUND_RATIO), 1 / MIN_BOUND_RATIO))
    return ratios


def load_error(figures: Mapping[str, float]) -> float:
    """Of all outputs together."""
    return math.hypot(*(value for name, value in figures.items() if name.startswith("load_error")))


def goal_value(search: TrialSearch, u: FloatArray, outputs: Collection[str]) -> float:
    """The logarithm of these outputs' load error; beyond a bound it costs more than it can gain."""
    figures = _of(search.figures(u), outputs)
    if not figures:
        return UNSTABLE_RATIO + distance_outside(u)
    beyond = max([math.log(ratio) + ROOM for ratio in _ratios(search.spec, figures)], default=0.0)
    return math.log(load_error(figures)) + BOUND_COST * (max(beyond, 0.0) + distance_outside(u))


def _of(figures: Mapping[str, float], outputs: Collection[str]) -> dict[str, float]:
    """Those of some outputs, and of all together."""
    found = {}
    for name, value in figures.items():
        own = outputs_of(name)
        if not own or not set(own).isdisjoint(outputs):
            found[name] = value
    return found


def _polish(search: TrialSearch, u: FloatArray, trials: int, outputs: Collection[str]) -> FloatArray:
    """The place: the best of what COBYQA tries on its way, bounds given as their ratios' logarithms."""
    if not (trials and len(u)):
        return u
    tried = [u]
    count = len(_ratios(search.spec, _of(search.figures(u), outputs))) or 1

    def error(u: FloatArray) -> float:
        check_clock()
        tried.append(u.copy())
        figures = _of(search.figures(u), outputs)
        return math.log(load_error(figures)) if figures else 0.0

    def bounds(u: FloatArray) -> FloatArray:
        return np.log(_ratios(search.spec, _of(search.figures(u), outputs)) or [math.e] * count)

    for first, last in RADII:  # once more from the best, as peaks that change places mislead its models
        with suppress(WorkUp):
            optimize.minimize(
                error, u, method="COBYQA", bounds=optimize.Bounds(np.zeros(len(u)), np.ones(len(u))),
                constraints=optimize.NonlinearConstraint(bounds, -np.inf, -2 * ROOM),
                options={"maxfev": trials, "initial_tr_radius": first, "final_tr_radius": last},
            )  # fmt: skip
        u = min(tried, key=partial(goal_value, search, outputs=outputs))
    return u


def search_gains(
    spec: Spec, journal: Journal, effort: Effort, progress: Progress | None
) -> tuple[Trial, tuple[Trial, ...]]:
    """Find the trial with the smallest load error that the bounds allow. There is no front.

    In a part of several outputs each is searched by itself, twice around, then all together from there.
    """
    with without_limit():
        model, controller = model_and_controller(spec)
        parts, axes = parts_of(whole_machine(model, controller, loads_of(spec))), axes_of(model, spec.axes)
    named = zip(pid_signals(spec.plant, spec.axes)["Kp"], axes.of_outputs, strict=True)
    axis = {s.name: set(np.flatnonzero(row).tolist()) for s, row in named}
    everything = set(range(len(axis)))  # what the filter of all axes touches
    outputs = [
        set[int]().union(*(axis.get(entry.rpartition(".")[2], everything) for entry in variable.entries))
        for variable in spec.search
    ]
    with without_limit():
        estimates = estimates_of(spec, outputs)
    touched = [{k for k, part in enumerate(parts) if own & set(part.outputs)} for own in outputs]
    clusters, blocks = separate(touched, len(parts)), separate(outputs, len(axis))
    numbers = [len(own) for own, _ in blocks if own]
    journal.expect(
        sum(max(8 * k, 6) * (effort.generations + 1) + 4 * effort.polish * k for k in numbers), progress
    )
    places, at_least = [], at_least_of(spec.plant)
    for variables, members in clusters:

        def compute(design: Spec, members: tuple[int, ...] = members) -> dict[str, float]:
            terms, Ts = design.pid, design.sample_time
            assert terms is not None
            figures = [loop_figures(spec, parts[k], close_loop(parts[k], terms, Ts, axes)) for k in members]
            if all(figures):
                figures += estimates.figures(terms, [o for k in members for o in parts[k].outputs])
            return merge(figures, at_least)

        own = [block for block in blocks if block[0] and set(block[0]) <= set(variables)]
        rounds = [(*block, effort.generations) for block in own]
        if own[1:]:
            rounds += [(*block, 0) for block in own]
            rounds.append((variables, tuple(o for k in members for o in parts[k].outputs), 0))
        there = spec
        for some, chosen, generations in rounds:
            names = [spec.plant.outputs[o].name for o in chosen]
            search = TrialSearch(there, some, spec.delay, journal, compute, among=variables)
            u = search.evolve(partial(goal_value, search, outputs=names), generations)
            u = _polish(search, u, 3 * effort.polish * len(some), names)
            there = apply_trial(there, combine(there, [(search, u)]))
        search = TrialSearch(there, variables, spec.delay, journal, compute)
        places.append((search, search.start))
    return combine(spec, places), ()

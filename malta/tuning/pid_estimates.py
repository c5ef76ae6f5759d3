"""What requirements estimate of a trial of PID gains: noise of forces, answers to loads, margin at corners of the box.

The loops are those of tuning.groups, closed with a PID, so a machine whose currents are held between samples has none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from malta.model.linearize import linearize
from malta.synthesis.pid import axes_of, law_of_outputs, pid_gains
from malta.tuning.groups import figures_of_gains, groups_of
from malta.tuning.search import base_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from malta.synthesis.pid import Axes
    from malta.synthesis.spec import Pid, Spec
    from malta.tuning.groups import Group

EXACT = {"load_error", "noise_motion", "peak_sensitivity", "bandwidth"}  # tuning.pid computes these
BETWEEN = 1e-3  # of a margin: the corners of the box are interpolated between samples of the machine
OF = " of "  # between the name of an estimate and the outputs that it is of


class Estimates(NamedTuple):
    """The groups of a machine whose figures [specification] bounds; of mirror images one."""

    spec: Spec
    axes: Axes
    groups: tuple[Group, ...]

    def figures(self, terms: Pid, outputs: Sequence[int]) -> list[dict[str, float]]:
        """Compute the figures of the groups among some outputs, named as "force_noise of x1 x2"."""
        found = []
        for group in self.groups:
            if set(group.outputs) <= set(outputs):
                own = " ".join(self.spec.plant.outputs[k].name for k in group.outputs)
                figures = _figures(self.spec, group, terms, self.axes)
                found.append({f"{name}{OF}{own}": value for name, value in figures.items()})
        return found


def estimates_of(spec: Spec, touched: Sequence[set[int]]) -> Estimates:
    """Find what of [specification] needs estimates.

    touched : the outputs that each variable of the search touches; mirror images have the same variables
    """
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    terms, axes = spec.pid, axes_of(model, spec.axes)
    asked = {base_of(name) for name in spec.specification} - EXACT
    if terms is None or not asked or model.E.any():
        return Estimates(spec, axes, ())
    distinct: dict[tuple[object, ...], Group] = {}
    for group in groups_of(spec):
        few, _ = law_of_outputs(terms, axes, group.outputs)
        numbers = tuple(tuple(v.tolist()) for v in (few.Kp, few.Ki, few.Kd, few.filters))
        variables = tuple(k for k, own in enumerate(touched) if own & set(group.outputs))
        distinct.setdefault((group.picture, numbers, variables), group)
    return Estimates(spec, axes, tuple(distinct.values()))


def outputs_of(figure: str) -> list[str]:
    """Name the outputs that a figure is of: of "noise_motion x" and of estimates; none of one of the whole machine."""
    _, of, own = figure.rpartition(OF)
    return own.split() if of else own.split()[1:]


def name_of(figure: str) -> str:
    """Return a figure's name in [specification]: "force_noise" of "force_noise of x1 x2"."""
    name, of, own = figure.rpartition(OF)
    return name if of else own


def _figures(spec: Spec, group: Group, terms: Pid, axes: Axes) -> dict[str, float]:
    """The estimates of one group; none where its loop is unstable."""
    P = group.model.C[:, : len(group.states) // 2]
    few, own = law_of_outputs(terms, axes, group.outputs)
    gains = pid_gains(P, few, spec.sample_time, own._replace(of_positions=own.of_outputs @ P))
    figures = {}
    for name, value in figures_of_gains(spec, group, gains).items():
        if base_of(name) not in EXACT:
            figures[name] = (1 - BETWEEN if base_of(name) == "margin" else 1.0) * value
    return figures

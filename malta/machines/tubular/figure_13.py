"""Fig. 13 by modules and a mover that are not ideal: what is carried at z = 5 mm, and what moves x1 and x2.

The paper measures 3.25 N of vertical bearing force, where m g is 3.53 N, and up to 20 um in x1 and x2 during a stroke,
where its model has none. Its text blames irregular fields of the modules and unequal magnets of the mover. Our reading:

    e_y     the magnetic centre lies below the sensors' centre, so that attraction carries the rest of the weight:
            m g + 2 K_A e_y = 3.25 N. v0(z) knows of it: the paper records v0 at rest.
    c_x     the line of thrust passes the centre of gravity at this distance, so thrust tilts the mover. Nothing else
            here moves x during a stroke: modules that differ leave the mirror x -> -x, and the pull of an offset e_x is
            constant in the plane of each module, whatever z is. Of magnets at the radius a whose strength differs by
            +-s around the mover, thrust acts s a / 2 off the axis.

The stroke starts from rest with c along x. Where c is an offset of mass, the mover then rolls until c hangs down, as in
unbalance.py, and a mover at rest has done so before; so unequal magnets are the likelier cause.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from malta.machines.tubular.experiments.strokes import DISTANCE, RISE
from malta.model.data import plant_of
from malta.model.published import published_figures, published_value
from malta.report.ledger import Row
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory, stroke_figures
from malta.synthesis.feedforward import static_feedforward

if TYPE_CHECKING:
    from malta.machines.tubular.plant import Parameters
    from malta.report.ledger import Evidence
    from malta.synthesis.controller import Controller

FIRST_TRY = 0.1e-3  # m, of the centre of gravity: deviations grow in proportion


class Figure13(NamedTuple):
    """The stroke of Fig. 13 with an offset magnetic centre, and with an unbalance besides. SI."""

    offset: float  # e_y, m
    unbalance: float  # c_x, m: x1 and x2 deviate by as much as in the figure
    balanced: Trajectory  # with the offset alone
    unbalanced: Trajectory  # with both


def magnetic_offset(par: Parameters, carried: float) -> float:
    """The offset e_y, m, with which the bearings carry so much of the weight (N): m g + 2 K_A e_y = carried."""
    return (carried - par.m * par.g) / (2 * par.K_A)


def deviation_across(run: Trajectory) -> float:
    """Largest deviation of x1 and x2, m."""
    return max(stroke_figures(run).radial[name] for name in ("x1", "x2"))


def carried_weight(run: Trajectory) -> float:
    """Sum of the vertical bearing forces at the end of a run, N."""
    return float(run.v[-1, 1] + run.v[-1, 3])


def figure_13(controller: Controller, carried: float, deviation: float) -> Figure13:
    """Solve for the offset and the unbalance that reproduce Fig. 13 under a controller.

    carried : sum of the vertical bearing forces at the end of the stroke, N
    deviation : of x1 and x2, m
    """
    par: Any = controller.parameters
    centred = replace(par, e_y=magnetic_offset(par, carried))
    v0 = static_feedforward(plant_of(centred)).v0
    informed = replace(controller, feedforward=replace(controller.feedforward, v0=v0))

    def stroke(unbalance: float) -> Trajectory:
        machine = plant_of(replace(centred, c_x=unbalance))
        return simulate(machine, informed, Scenario.stroke(DISTANCE, rise=RISE))

    unbalance = FIRST_TRY * deviation / deviation_across(stroke(FIRST_TRY))
    return Figure13(centred.e_y, unbalance, stroke(0.0), stroke(unbalance))


@lru_cache(maxsize=8)  # several rows need it; records of evidence compare by identity
def _figure_of(e: Evidence) -> Figure13:
    published = published_figures("tubular") or {}
    weight, deviation = (
        published_value(published, f"figure_13.{name}") for name in ("weight", "radial_deviation")
    )
    return figure_13(e.controller, weight, deviation)


ROWS: tuple[Row, ...] = (
    Row(
        "Fig. 13: magnetic centre, off the sensors' in y",
        "um",
        "{:.1f}",
        lambda e: _figure_of(e).offset,
        note="solved: attraction carries m g − 3.25 N",
    ),
    Row(
        "Fig. 13: weight carried at z = 5 mm with this offset",
        "N",
        "{:.2f}",
        lambda e: carried_weight(_figure_of(e).balanced),
        "figure_13.weight",
        "equal",
        "the offset is solved from it, and v0 knows of it",
    ),
    Row(
        "Fig. 13: line of thrust, off the centre of gravity in x",
        "um",
        "{:.0f}",
        lambda e: _figure_of(e).unbalance,
        note="solved in proportion: thrust then moves x1, x2 by 20 µm",
    ),
    Row(
        "Fig. 13: deviation of x1, x2 with both offsets",
        "um",
        "{:.1f}",
        lambda e: deviation_across(_figure_of(e).unbalanced),
        "figure_13.radial_deviation",
        "about",
        "the second offset is solved from it",
    ),
)

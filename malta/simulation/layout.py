"""Setup of a simulation, and the names, sizes and order of all its numbers.

A setup decides which functions a control period consists of; everything else is a number. `layout_of` gives the order
of the state, of the inputs of a sample and of the row that a sample leaves. `numbers_of` gives every number of machine,
controller and sensors by name, and `flatten` puts them in one vector, theta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.drive import Electronics
from malta.model.parameters import acting_names, twins_of
from malta.model.plant import Plant, symbolic
from malta.synthesis.controller import Controller, CurrentLoop
from malta.synthesis.law import gains_of
from malta.synthesis.schedule import SCHEDULED_MATRICES

# Names of numbers_of that all machines of a batch share: those of the controller and of its samples.
SHARED_NUMBERS = (
    *("Ad", "Bd", "Cd", "K", "Ki", "L", "force_limit", "control_time", "Kp", "Ki_current", "rate"),
    *("pause", "braking", "lead", "ahead", "grid_ends", "substep"),
    *("places", *(f"{name}_steps" for name in SCHEDULED_MATRICES)),
)

Fidelity = Literal["force", "dq", "phase"]
FIDELITIES: tuple[Fidelity, ...] = get_args(Fidelity)


@dataclass(frozen=True)
class Setup:
    """The choices that decide which functions are simulated; everything else is a number."""

    fidelity: Fidelity
    delay: int  # samples between measurement and command
    quantize: bool = False  # sensors with a resolution
    disturbed: bool = False  # an external wrench acts
    bearing: bool = False  # touchdown bearings push back
    sensed: bool = False  # sensors with errors, Hall sensors for the stroke
    faulty: bool = False  # held measurements, missed steps, open phases, sagging link
    scheduled: bool = False  # the filter uses C at the measured z
    real_pwm: bool = False  # duty cycles with a resolution, dead time
    turning: bool = False  # current controllers in axes that turn with the forces, eq. (18) as printed
    outside: bool = False  # a Kalman filter of filterpy makes the estimate
    anticipated: bool = False  # forces beside v0 counter a disturbance that is known in advance
    open_loop: bool = False  # feedforward alone, commutated for the reference
    lagging: bool = False  # sensors with a lag
    late: int | None = None  # sensors with a dead time, of so many whole samples and a rest; None: without
    current_sensors: bool = False  # the current controllers read sensors with noise, offsets and steps
    electronics: Any = None  # options of the machine's own electronics


class Layout(NamedTuple):
    """Names and sizes of all signals, in order."""

    machine: dict[str, int]
    controller: dict[str, int]
    given: dict[str, int]  # inputs of a sample, the same for every machine
    row: dict[str, int]  # outputs of a sample: a row of the trajectory


class LoopPlan(NamedTuple):
    """The closed loop that a control period is built of."""

    plant: Plant  # the simulated machine
    controller: Controller
    setup: Setup
    numbers: Mapping[str, Any]  # of machine, controller and sensors by name: constants or symbols


class Symbols(NamedTuple):
    """Symbols of one sample by name, sized by a layout."""

    machine: Mapping[str, Any]
    controller: Mapping[str, Any]
    given: Mapping[str, Any]


@lru_cache(maxsize=64)
def layout_of(plant: Plant, c: Controller, s: Setup) -> Layout:
    """Names and sizes of the state, of a sample's inputs and of the row that a sample leaves."""
    n, m, p = len(c.states), len(c.forces), len(c.measurements)
    coils, fast = len(plant.actuator.coils), electronics_of(plant, s)
    axes, phases = _winding_counts(plant)
    driven = s.fidelity != "force" and fast is None
    electric_state: dict[str, int] = {"i_coil": coils}
    if fast is not None:
        electric_state |= fast.state
    elif s.fidelity != "force":
        electric_state = {"i": axes, "link": 1} if s.fidelity == "dq" else {"i_phase": phases, "link": 1}
    electric_state |= {"lagged": p} if s.lagging else {}
    electric_state |= {} if s.late is None else {"late": p * (s.late + 2), "clock": 1}
    held = command_size(plant, s)
    controller = {"xi_pred": n, "e": p, "frozen": p}
    if driven:
        controller |= {"u_integral": axes, "u_limited": axes}
    if s.faulty:
        controller |= {"y_last": p, "command": held}
    controller |= {"under_way": held * s.delay}
    given = {"p_ref": p, "dp_ref": p, "v_ff": m}
    # v_past: the stored forces, and zeros for observed disturbances.
    given["v_past"] = n - len(c.A) if c.tracks == "states" else 0
    if s.disturbed:
        given |= {"w": len(plant.disturbances)}
    if s.anticipated:
        given |= {"v_known": m}
    if s.faulty:
        given |= {"stuck": p, "missed": 1, "sag": 1, "open": phases if s.fidelity == "phase" else 0}
    if s.outside:
        given |= {"xi_hat": n}
    row = {"x": len(plant.states), "p": p, "y": p, "xi_hat": n, "v": m, "force": m, "saturated": m}
    met = 1 + (len(fast.flags) if fast else 0)
    row |= {"contact": len(plant.contacts.names), "current": coils, "met": met}
    if driven:
        row |= {"i": axes, "u": axes, "link": 1}
    if s.fidelity == "phase":
        row |= dict.fromkeys(("i_phase", "duty"), phases if driven else coils)
    return Layout({"x": len(plant.states)} | electric_state, controller, given, row)


@lru_cache(maxsize=64)
def columns_of_row(plant: Plant, c: Controller, s: Setup) -> dict[str, slice]:
    """The columns of each signal in the row that a sample leaves."""
    return places_of(layout_of(plant, c, s).row)


def places_of(sizes: Mapping[str, int], begin: int = 0) -> dict[str, slice]:
    """The places of signals of these sizes in a vector, from entry `begin` on."""
    ends = accumulate(sizes.values(), initial=begin)
    return {name: slice(*edges) for name, edges in zip(sizes, pairwise(ends), strict=True)}


def ending_columns(plant: Plant, c: Controller, s: Setup) -> tuple[int, ...]:
    """The columns of a row whose contacts end a run; a contact that a touchdown bearing cushions ends none."""
    first = columns_of_row(plant, c, s)["contact"].start
    cushioned = plant.contacts.cushioned
    return tuple(first + i for i, soft in enumerate(cushioned) if not (s.bearing and soft))


def numbers_of(
    plant: Plant, c: Controller, substeps: float, errors: Mapping[str, float] | None = None
) -> dict[str, ca.DM]:
    """Every number of machine, controller and sensors, by name.

    substeps : of the simulation in a sample
    errors : of the sensors, by name; 0 where none is given
    """
    machine = {k: ca.DM(getattr(plant.parameters, k)) for k in acting_names(plant.parameters)}
    loop = c.current_loop or CurrentLoop(0.0, 0.0, 0.0)
    known = dict.fromkeys((signal.name for signal in plant.sensors.errors), 0.0) | dict(errors or {})
    return {
        **{f"machine.{name}": ca.DM(value) for name, value in machine.items()},
        **gains_of(c),
        "Kp": ca.DM(loop.Kp),
        "Ki_current": ca.DM(loop.Ki),
        "current_limit": ca.DM(c.limits.current),
        "voltage_limit": ca.DM(c.limits.voltage.min(initial=math.inf)),
        "rate": ca.DM(c.feedforward.rate),
        "grid_ends": ca.DM([c.feedforward.z_grid[0], c.feedforward.z_grid[-1]]),
        "substep": ca.DM(c.sample_time / substeps),
        "errors": ca.DM(list(known.values())),
    }


def flatten(values: Mapping[str, ca.DM]) -> FloatArray:
    """theta: the nonzeros of all numbers, in order."""
    return np.concatenate([np.array(value.nonzeros(), dtype=float) for value in values.values()])


def with_symbols(plant: Plant, values: Mapping[str, ca.DM]) -> tuple[Plant, dict[str, Any], Any]:
    """The machine with a symbol for every number, the symbols by name, and theta, the vector of them all."""
    g = {name: ca.SX.sym(name, value.sparsity()) for name, value in values.items()}
    theta = ca.vertcat(*(ca.vertcat(*symbol.nonzeros()) for symbol in g.values()))
    return plant.variant(_symbolic_parameters(plant, g)), g, theta


def electronics_of(plant: Plant, s: Setup) -> Electronics | None:
    """The electronics of the machine in fidelity `phase`; None where it has none, and in other fidelities."""
    if s.fidelity != "phase" or plant.actuator.electronics is None:
        return None
    return plant.actuator.electronics(s.electronics)


def fidelities(plant: Plant) -> tuple[Fidelity, ...]:
    """The fidelities in which a machine can be simulated."""
    if plant.actuator.windings is not None:
        return FIDELITIES
    return ("force",) if plant.actuator.electronics is None else ("force", "phase")


def read_currents(plant: Plant, s: Setup) -> int:
    """The number of phase currents that are read by sensors which are not ideal."""
    return len(plant.drive.phases) if s.current_sensors else 0


def noise_scales(plant: Plant, s: Setup) -> tuple[Any, ...]:
    """Standard deviations of the noise of all sensors: of the outputs, then of the phase currents.

    A run draws as many numbers a sample. So the noise of the outputs is another one where currents are read.
    """
    if not s.current_sensors or plant.drive.sensors is None:
        return (*plant.sensors.noise, *[0.0] * read_currents(plant, s))
    return (*plant.sensors.noise, *[plant.drive.sensors.noise] * read_currents(plant, s))


def _winding_counts(plant: Plant) -> tuple[int, int]:
    """Number of axes and phases of the drive."""
    drive = plant.actuator.windings
    return (0, 0) if drive is None else (len(drive.axes), len(drive.phases))


def signals_of(sizes: Layout, kind: Any) -> Symbols:
    """Symbols of CasADi's `kind`, SX or MX, for every signal of a layout."""
    return Symbols(*({name: kind.sym(name, size) for name, size in part.items()} for part in sizes[:3]))


def _symbolic_parameters(plant: Plant, g: Mapping[str, Any]) -> Any:
    """The parameters with symbols in place of numbers; twins share a symbol.

    Parameters that shape the model, and those with their defaults, stay numbers.
    """
    par = plant.parameters
    symbols = {name: g[f"machine.{name}"] for name in acting_names(par)}
    return symbolic(par, symbols | {name: symbols[twin] for name, twin in twins_of(par).items()})


def command_size(plant: Plant, s: Setup) -> int:
    """How many numbers are held between samples: currents, voltages, duty cycles, or those of the electronics."""
    fast = electronics_of(plant, s)
    if fast is not None:
        return len(fast.set_points)
    axes, phases = _winding_counts(plant)
    return {"force": len(plant.actuator.coils), "dq": axes, "phase": phases}[s.fidelity]

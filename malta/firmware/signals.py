"""Names, units and order of all that goes into the exported controller, stays in it, and comes out of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import InputError
from malta.firmware.program import TYPES, Precision
from malta.model.places import place_states
from malta.model.plant import Plant, Signal
from malta.model.plants import plant_of
from malta.model.table_look_ups import LookUp, recorded_look_ups
from malta.simulation.layout import Fidelity, Setup, electronics_of, fidelities
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.margins.tuned_gains import GainBox

SUM_SHARE = 0.1  # share that a state changes by in a sample without anything added, at most: it is then a sum
UNLIMITED_RANGE = 1e6  # of a position that nothing bounds: beyond, single precision has no room
POSITION_UNITS = ("m", "rad", "1")  # of outputs that may be unbounded


class CField(NamedTuple):
    """A vector of named numbers."""

    name: str
    signals: tuple[Signal, ...]
    meaning: str

    @property
    def size(self) -> int:
        return len(self.signals)


class XcpPort(NamedTuple):
    """Where a slave listens by default: an address and port of UDP, and the speed of a serial line."""

    address: str = "127.0.0.1"
    port: int = 5555
    baud: int = 115200


@dataclass(frozen=True, eq=False)
class Target:
    """What is exported: a controller, in a precision, down to forces, axes or half-bridges."""

    controller: Controller
    precision: Precision = "double"
    fidelity: Fidelity = "phase"  # ends with duty cycles; "force" with currents, "dq" with voltages of axes
    tunable: bool = False  # gains, limits, references and monitors from a record that the target may change
    gains: GainBox | None = None  # what is proven of other gains; None: nothing was asked for
    excited: bool = False  # forces beside the law's are read at every sample
    logged: float = 0.0  # s, of a ring buffer of all signals; 0: none
    xcp: XcpPort | None = None  # a slave for calibration tools; None: none
    wiring: bool = False  # the supervisor tries the wiring before the first lift-off
    fused: bool = False  # products and the sums that take them are one operation of the target

    def __post_init__(self) -> None:
        if self.precision not in ("double", "float"):
            raise InputError("export", "precision", repr(self.precision), "double or float")
        if self.fidelity not in fidelities(self.believed):
            found = f"a {self.believed.name} without a model of its current loops"
            raise InputError("export", self.controller.name, found, "an export down to currents")
        if self.tunable and self.controller.schedule is not None:
            raise InputError("export", "tunable", "a scheduled law", "a law of one set of gains")
        if self.xcp is not None and not self.tunable:
            raise InputError("export", "xcp", "an export without parameters", "one that is tunable")
        if self.driven and self.controller.current_loop is None:
            found = "a gain file with no current loops"
            raise InputError("export", self.controller.name, found, "an export down to currents")

    @property
    def steps(self) -> int:
        """Runge-Kutta steps in a sample of recorded flights: one a time constant of the current loops, at least 4.

        They are not those that simulations choose, so that the bytes of an export depend on the export alone.
        """
        lag = self.controller.sample_time * self.believed.actuator.crossover
        return max(4, math.ceil(lag)) if math.isfinite(lag) else 4

    @property
    def believed(self) -> Plant:
        """The machine as the gain file knows it."""
        return plant_of(self.controller.parameters)

    @cached_property
    def look_ups(self) -> tuple[LookUp, ...]:
        """Where the currents of a sample read a table; none for most machines.

        Raises InputError for several tables.
        """
        if not self.believed.actuator.tabulated:
            return ()
        y, v = (
            ca.SX.sym("y", len(self.controller.measurements)),
            ca.SX.sym("v", len(self.controller.forces)),
        )
        with recorded_look_ups() as found:
            self.believed.actuator.currents(y, v)
        if any(one.nodes is not found[0].nodes for one in found):
            raise InputError("export", self.controller.name, "currents from several tables", "one table")
        return tuple(found)

    @property
    def setup(self) -> Setup:
        """The setup of simulations whose functions the firmware shares."""
        return Setup(fidelity=self.fidelity, delay=0)

    @property
    def has_set_points(self) -> bool:
        """Whether the machine's own electronics take set points in place of currents."""
        return self.fidelity == "phase" and self.believed.actuator.electronics is not None

    @property
    def driven(self) -> bool:
        """Whether current loops are part of the export."""
        return self.fidelity != "force" and not self.has_set_points

    @property
    def summing_states(self) -> tuple[int, ...]:
        """The states that sum up what is added to them: observed disturbances, and slow states of a law of errors."""
        Ad, Bd = self.controller.Ad, self.controller.Bd
        if self.controller.tracks == "errors":
            return tuple(k for k in range(len(Ad)) if abs(Ad[k, k] - 1) < SUM_SHARE)
        unit = np.eye(len(Ad))
        return tuple(k for k in range(len(Ad)) if (Ad[k] == unit[k]).all() and not Bd[k].any())

    @property
    def real(self) -> Any:
        """The type of its numbers."""
        return TYPES[self.precision]

    @property
    def real_bytes(self) -> int:
        """Bytes of each."""
        return 8 if self.precision == "double" else 4

    @property
    def compensated(self) -> bool:
        """Whether sums keep what rounding took from them: in single precision they would stop moving."""
        return self.precision == "float"

    @cached_property
    def state_fields(self) -> list[CField]:
        """What the controller remembers from one sample to the next."""
        c, m = self.controller, self.controller.forces
        errors = tuple(Signal(f"sum of {s.name}* - {s.name}", f"{s.unit} s") for s in c.measurements)
        fields = [
            CField("xi_pred", c.states, "what the filter expects of the states at the next sample"),
            CField("e", errors, "sums of the errors p* - y"),
            CField("frozen", signals_after("waits ", c.measurements, "1"), "1 where the sum of errors waits"),
        ]
        if self.compensated:
            fields.append(CField("e_rest", errors, "what rounding took from the sums of errors"))
            if self.summing_states:
                fields.append(CField("xi_rest", c.states, "the same, of states that sum up"))
        if c.tracks == "states" and (c.lagging or c.stored):
            ages = range(c.stored, 0, -1)
            stored = [Signal(f"{s.name}*[k-{age}]", s.unit) for age in ages for s in m]
            lag = [Signal(f"{s.name}*[i]", s.unit) for s in m] if c.lagging else []
            forward = (
                [Signal(f"{s.name}_ff[k-{age}]", s.unit) for age in ages for s in m] if c.lagging else []
            )
            fields.append(
                CField("memory", (*lag, *stored, *forward), "references of forces that are under way")
            )
        if self.driven:
            drive = self.believed.drive
            volts = tuple(Signal(s.name.replace("i_", "u_"), "V") for s in drive.axes)
            fields.append(CField("u_integral", volts, "integrals of the current loops"))
            fields.append(
                CField(
                    "u_limited",
                    signals_after("limited ", drive.axes, "1"),
                    "1 where a half-bridge was at its limit",
                )
            )
            if self.compensated:
                fields.append(CField("u_rest", volts, "what rounding took from the integrals"))
            fields.append(CField("i_last", self.current_readings, "the last valid readings of currents"))
            fields.append(CField("link_last", (Signal("V_link", "V"),), "the last valid reading of the link"))
        return fields

    @cached_property
    def reference_fields(self) -> list[CField]:
        """The reference of a sample."""
        outputs = self.controller.measurements
        return [
            CField("p", signals_after("", outputs, "", "*"), "reference"),
            CField("dp", tuple(Signal(f"{s.name}*'", f"{s.unit}/s") for s in outputs), "its rate"),
            CField(
                "ddp", tuple(Signal(f"{s.name}*''", f"{s.unit}/s^2") for s in outputs), "its acceleration"
            ),
        ]

    @cached_property
    def input_fields(self) -> list[CField]:
        """What is read at a sample."""
        outputs = self.controller.measurements
        fields = [
            CField("y", outputs, "measured outputs"),
            CField("y_valid", signals_after("valid ", outputs, "1"), "1 where a reading may be used, else 0"),
        ]
        if self.driven:
            fields += [
                CField("i", self.current_readings, "measured currents"),
                CField(
                    "i_valid",
                    signals_after("valid ", self.current_readings, "1"),
                    "1 where a reading may be used, else 0",
                ),
                CField("link", (Signal("V_link", "V"),), "measured voltage of the DC link"),
            ]
        if self.excited:
            meaning = "forces beside those of the law, which the filter knows as sent"
            fields.append(CField("excitation", signals_after("exc ", self.controller.forces, ""), meaning))
        return fields

    @cached_property
    def output_fields(self) -> list[CField]:
        """What is commanded at a sample, and what else a supervisor or a log wants of it."""
        c, plant = self.controller, self.believed
        outputs = c.measurements
        fields = [
            CField("y_used", outputs, "readings, or what the filter expected in place of refused ones"),
            CField("refused", signals_after("refused ", outputs, "1"), "1 where a reading was refused"),
            CField("xi_hat", c.states, "estimated states"),
            CField("v", c.forces, "commanded forces, within their limits"),
            CField("saturated", signals_after("limited ", c.forces, "1"), "1 where a force is at its limit"),
            CField("current", plant.actuator.coils, "commanded currents"),
            CField("met", (Signal("current limit", "1"),), "1 where a current is at its limit"),
        ]
        if self.has_set_points:
            electronics = electronics_of(plant, self.setup)
            points = () if electronics is None else electronics.set_points
            fields.append(CField("command", points, "set points of the electronics"))
        elif self.driven:
            phases = plant.drive.phases if self.fidelity == "phase" else plant.drive.axes
            sign = "d_" if self.fidelity == "phase" else "m_"
            meaning = (
                "duty cycles of the half-bridges"
                if sign == "d_"
                else "voltages of the axes as shares of the link's"
            )
            fields.append(
                CField("command", tuple(Signal(s.name.replace("i_", sign), "1") for s in phases), meaning)
            )
        return fields

    @property
    def current_readings(self) -> tuple[Signal, ...]:
        """The currents that the current loops read."""
        return self.believed.drive.phases if self.fidelity == "phase" else self.believed.drive.axes


def fidelity_of(plant: Plant) -> Fidelity:
    """How far down a machine's controller can be exported."""
    return fidelities(plant)[-1]


@lru_cache(maxsize=16)  # what is compiled of a target is remembered by it
def deepest_target(c: Controller) -> Target:
    """A controller in double precision, as far down as its machine is modelled."""
    return Target(c, "double", fidelity_of(plant_of(c.parameters)))


def signals_after(before: str, signals: tuple[Signal, ...], unit: str, after: str = "") -> tuple[Signal, ...]:
    """Signals named after others; unit "": their own."""
    return tuple(Signal(f"{before}{s.name}{after}", unit or s.unit) for s in signals)


def place_of_readings(plant: Plant, y: Any) -> Any:
    """The states of a machine at rest that is read as y, as an expression."""
    return place_states(plant, ca.SX(plant.position_of(y)))


def used_clearances(plant: Plant) -> Callable[[int, float], FloatArray]:
    """(index of an output, its reading) -> used share of each clearance, while the other outputs read zero."""
    x = ca.SX.sym("x", len(plant.states))
    contact = ca.Function("contact", [x], [ca.densify(ca.vertcat(plant.contacts.contact(x), 0))])

    def share_used(k: int, reading: float) -> FloatArray:
        p = np.zeros(len(plant.outputs))
        p[k] = reading
        state = place_states(plant, ca.DM(plant.position_of(ca.DM(p))))
        return np.array(contact(state)).ravel()[: len(plant.contacts.names)]

    return share_used


@lru_cache(maxsize=16)
def reading_ranges(plant: Plant) -> FloatArray:
    """The largest reading of each output, either way; beyond, an exported controller refuses it.

    What the sensor declares; else twice where the machine touches, or its travel. UNLIMITED_RANGE for positions of a
    machine without contacts, as a motor that turns.

    Raises InputError for another output without a declared range: readings that are true would be refused.
    """
    share_used, sizes = used_clearances(plant), 10.0 ** np.arange(-7, 9.01, 0.05)
    ranges = []
    for k, (s, declared) in enumerate(zip(plant.outputs, plant.sensors.range, strict=True)):
        if declared:
            ranges.append(float(declared))
            continue
        reach = max(_reach(share_used, k, side * sizes) for side in (1.0, -1.0))
        if plant.has_stroke and k == plant.stroke_output and plant.stroke.travel:
            reach = max(plant.stroke.travel, reach if math.isfinite(reach) else 0.0)
        if not math.isfinite(reach) and (plant.contacts.names or s.unit not in POSITION_UNITS):
            found = f"none for {s.name}, which meets no contact"
            expected = f"its largest reading either way, {s.unit}, as Sensors(range=(...)), 0 for the others"
            raise InputError(plant.name, "sensors.range", found, expected)
        ranges.append(2 * reach if math.isfinite(reach) else UNLIMITED_RANGE)
    return readonly(ranges)


def _reach(share_used: Callable[[int, float], FloatArray], k: int, readings: FloatArray) -> float:
    """How large the first of these readings of an output is that uses a clearance up; infinite for none."""
    return next((abs(float(y)) for y in readings if share_used(k, y).max(initial=0.0) >= 1), math.inf)

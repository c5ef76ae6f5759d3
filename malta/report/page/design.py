"""What a design is, entry by entry: machine, law, weights, noise, gains. Reports list it, comparisons seek changes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.identifiers import identifier
from malta.model.linear import is_linear
from malta.model.parameters import units_of
from malta.model.plant import Signal
from malta.synthesis.spec import Pid, Weights, integral_signals, pid_signals, process_signals
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.report.page.analysis import Subject
    from malta.synthesis.controller import Controller


# Units for values below a size, SI, the smallest first.
FINER: dict[str, tuple[tuple[str, float], ...]] = {
    "s": (("us", 1e-3), ("ms", 1.0)),
    "m": (("um", 1e-4), ("mm", 1.0)),
    "rad": (("urad", 1e-4), ("mrad", 0.1)),
}


GROUPS = (
    *(
        "machine",
        "parameters",
        "uncertainty",
        "law",
        "PID gains",
        "weights",
        "bases",
        "cost",
        "noise",
        "gains",
    ),
    "limits",
)


class Entry(NamedTuple):
    """A number or a word of a design, as it stands in its files."""

    group: str  # of GROUPS
    name: str
    value: float | str  # SI
    unit: str = ""
    signal: str = ""  # in the name, of an entry that each signal has

    @property
    def key(self) -> str:
        """The entry as an identifier with its unit."""
        return identifier(f"{self.group} {self.name}", self.unit)

    def text(self, unit: str) -> str:
        """The value in a unit of display, with six digits."""
        if isinstance(self.value, str):
            return self.value
        return f"{in_unit(self.value, unit) if unit else self.value:.6g}"

    def equals(self, other: Entry | None) -> bool:
        """Whether another design has the same value, but for rounding."""
        if other is None or isinstance(self.value, str) or isinstance(other.value, str):
            return other is not None and self.value == other.value
        return bool(np.isclose(self.value, other.value, rtol=1e-9, atol=0.0))


def display_unit(unit: str, values: Iterable[float | str]) -> str:
    """The unit in which some values of an SI unit have few digits: "us" of 5e-5 s."""
    sizes = [abs(value) for value in values if not isinstance(value, str) and value]
    small = (fine for fine, size in FINER.get(unit, ()) if sizes and max(sizes) < size)
    return next(small, unit)


def kind_of(controller: Controller) -> str:
    """The kind of a control law in a word."""
    if controller.cost is not None:
        return "LQG"
    return "linear law of the errors" if controller.tracks == "errors" else "PID"


def design_entries(subject: Subject) -> list[Entry]:
    """List what a design is: the machine, the law, its weights and its noise, the size of its gains."""
    parts = (_machine, _law, _weights, _noise, _gains, _limits)
    return sorted((entry for part in parts for entry in part(subject)), key=lambda e: GROUPS.index(e.group))


def _machine(subject: Subject) -> Iterator[Entry]:
    parameters = subject.parameters
    yield Entry("machine", "name", "linear" if is_linear(parameters) else subject.plant.name)
    yield Entry("machine", "preset", parameters.preset)
    for name, unit in units_of(parameters).items():
        yield Entry("parameters", name, float(getattr(parameters, name)), unit)
    for name, share in subject.box.items():
        yield Entry("uncertainty", name, share, "1")


def _law(subject: Subject) -> Iterator[Entry]:
    c = subject.controller
    yield Entry("law", "kind", kind_of(c))
    yield Entry("law", "sample time", c.sample_time, "s")
    yield Entry("law", "delay in the design model", float(c.delay), "1")
    yield Entry("law", "lag of the current loops in the design model", "yes" if c.lagging else "no")
    yield Entry("law", "integrals of errors", "yes" if c.integrating else "no")
    yield Entry("law", "observed forces of disturbance", "yes" if c.observed else "no")
    yield Entry("law", "commutation", "measured place" if c.commutation is None else "predicted place")
    spec = subject.written_from
    if spec is not None and spec.pid is None:
        yield Entry("law", "discretization", spec.discretization)
    for signal, pause in zip(c.measurements, c.pause, strict=False):
        if pause:
            name, unit = f"integral of {signal.name} waits above", f"{signal.unit}/s"
            yield Entry("law", name, float(pause), unit, signal.name)
    for signal, error in zip(c.measurements, c.braking, strict=False):
        if error:
            yield Entry("law", f"{signal.name} brakes from", float(error), signal.unit, signal.name)
    for words, per, row in zip(
        ("reference", "speed", "acceleration"), ("", "/s", "/s^2"), c.references, strict=False
    ):
        for signal, limit in zip(c.measurements, row, strict=True):
            if limit:
                yield Entry(
                    "law",
                    f"largest {words} of {signal.name}",
                    float(limit),
                    f"{signal.unit}{per}",
                    signal.name,
                )
    if c.current_loop is not None:
        yield Entry("law", "current loop Kp", c.current_loop.Kp, "V/A")
        yield Entry("law", "current loop Ki", c.current_loop.Ki, "V / (A s)")


def _weights(subject: Subject) -> Iterator[Entry]:
    c, plant = subject.controller, subject.plant
    law = None if subject.written_from is None else subject.written_from.law
    if isinstance(law, Pid):
        for table, signals in pid_signals(plant, law.axes).items():
            plain = [Signal(s.name, re.sub(r"\((\w+)\)", r"\1", s.unit).replace(" / ", "/")) for s in signals]
            yield from _row("PID gains", f"{table} ", plain, getattr(law, table))
    elif isinstance(law, Weights):
        integrals = integral_signals(plant, law.coordinates)
        for table, states, weight, base in (
            ("state", plant.design_states, law.q, law.q_base),
            ("input", plant.inputs, law.r, law.r_base),
            ("integral", integrals, law.q_i, law.q_i_base),
        ):
            plain = [Signal(s.name, "1") for s in states]
            yield from _row("weights", f"{table} ", plain, weight)
            yield from _row("bases", f"{table} ", states, base)
    elif c.cost is not None:
        integrals = integral_signals(plant, c.cost.coordinates)
        for table, states, cost in (
            ("state", plant.design_states, c.cost.state),
            ("input", plant.inputs, c.cost.input),
            ("integral", integrals, c.cost.integral),
        ):
            squares = [Signal(s.name, _over_square(s.unit)) for s in states]
            yield from _row("cost", f"{table} ", squares, cost)


def _over_square(unit: str) -> str:
    """The unit of a weight on a square: "1/m^2" of m, "1/(m/s)^2" of m/s."""
    if unit == "1":
        return unit
    return f"1/{unit}^2" if unit.isalpha() else f"1/({unit})^2"


def _noise(subject: Subject) -> Iterator[Entry]:
    noise, cost, plant = subject.controller.noise, subject.controller.cost, subject.plant
    if noise is None or cost is None:
        return
    sources = process_signals(plant, cost.coordinates)
    yield from _row("noise", "process ", sources, np.sqrt(noise.process))
    yield from _row("noise", "sensor ", plant.outputs, np.sqrt(noise.sensor))
    yield from _row("noise", "drift ", sources, np.sqrt(noise.drift))
    plain = [Signal(s.name, "1") for s in sources]
    yield from _row("noise", "correlation ", plain, noise.correlation)


def _gains(subject: Subject) -> Iterator[Entry]:
    for name in ("K", "Ki", "L"):
        yield Entry("gains", f"norm of {name}", float(np.linalg.norm(getattr(subject.controller, name))), "1")
    yield Entry("gains", "states of the law", float(len(subject.controller.states)), "1")


def _limits(subject: Subject) -> Iterator[Entry]:
    c = subject.controller
    for signal, limit in zip(c.forces, c.limits.force, strict=True):
        if np.isfinite(limit):
            yield Entry("limits", signal.name, float(limit), signal.unit, signal.name)


def _row(group: str, prefix: str, signals: Sequence[Signal], values: FloatArray) -> Iterator[Entry]:
    """An entry for each signal that has a value; none of an empty vector."""
    for signal, value in zip(signals, values, strict=False):
        yield Entry(group, f"{prefix}{signal.name}", float(value), signal.unit, signal.name)

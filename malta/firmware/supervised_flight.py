"""A supervised controller in flight: the exported C with its supervisor in the place of a law."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.firmware.flight import (
    REALS,
    TUNABLES,
    Native,
    Step,
    call_valid,
    compile_controller,
    compile_files,
    engine_of_c,
    record_type,
    view,
)
from malta.firmware.program import Precision
from malta.firmware.signals import Target
from malta.firmware.sources import sources
from malta.firmware.supervisor import IN_FLIGHT
from malta.firmware.supervisor_text import (
    NUMBERS,
    OFF_COMMAND,
    Member,
    request_members,
    supervisor_members,
    supervisor_sources,
    time_members,
)
from malta.model.plant import Plant
from malta.simulation.engine.compiled import compiler
from malta.simulation.engine.engines import Engine
from malta.simulation.simulate import Prepared


class Supervised(NamedTuple):
    """A compiled controller with its supervisor; records are ctypes structures."""

    native: Native
    Supervisor: Any
    Request: Any


def supervised_texts(t: Target, name: str) -> list[str]:
    """The C of controller and supervisor in the order in which it is one text."""
    files = sources(t, "", name) | supervisor_sources(t, name)
    order = (".h", "_supervisor.h", ".c", "_parts.c", *TUNABLES, "_supervisor.c")
    return [files[f"{name}{end}"] for end in order if f"{name}{end}" in files]


@lru_cache(maxsize=16)
def compile_supervised(t: Target) -> Supervised:
    """The C of controller and supervisor, compiled. Raises InputError without a C compiler."""
    own = compile_controller(t)
    lib = compile_files(supervised_texts(t, own.name))
    kinds: dict[str, Any] = {
        "int32_t": ctypes.c_int32,
        "real": REALS[t.precision],
        "reference": own.Reference,
        "parameters": ctypes.c_void_p,
        "calibration": ctypes.c_void_p,
    }

    def record(title: str, members: Sequence[Member]) -> Any:
        of = ((m.name, kinds[m.kind] * m.size if m.size else kinds[m.kind]) for m in members)
        return record_type(title, tuple(of))

    kinds["times"] = record("Times", time_members())
    return Supervised(
        own._replace(lib=lib),
        record("Supervisor", supervisor_members(t)),
        record("Request", request_members()),
    )


def require_compiler(what: str) -> None:
    """Raise InputError where no C compiler is found, which `what` needs."""
    if compiler() is None:
        found = "none, and what flies is the exported C"
        raise InputError("simulate", f"{what}: C compiler", found, "a C compiler: cc, gcc, clang or $CC")


class Requests(NamedTuple):
    """When a supervisor is asked for what, s; take_over: it flies from the start, and would rest there."""

    start: float = 0.0
    operate: float = 0.0
    land: float = np.inf
    take_over: tuple[float, ...] = ()


class Interference(NamedTuple):
    """What faults do to a sample: to readings and requests before the step, to commands after it.

    before : (t in s, inputs, request or None) -> nothing;  after : (t, outputs) -> nothing
    """

    before: Callable[[float, Any, Any], None]
    after: Callable[[float, Any], None]


@dataclass(eq=False)
class Flown:
    """What a supervisor did in a run, a row for each step that it made."""

    t: list[float] = field(default_factory=list)  # s
    state: list[int] = field(default_factory=list)  # index in STATES
    monitor: list[int] = field(default_factory=list)  # index in MONITORS, or -1
    reference: list[FloatArray] = field(default_factory=list)  # that the controller followed
    motion: list[Any] = field(default_factory=list)  # the same with its rates, as records of the C
    v: list[FloatArray] = field(default_factory=list)  # commanded forces

    def states(self, t: FloatArray) -> FloatArray:
        """The state at each time; that of the last step where one was missed."""
        return np.asarray(np.array(self.state)[self._last_steps(t)])

    def references(self, t: FloatArray) -> FloatArray:
        """The reference that the controller followed at each time."""
        return np.asarray(np.array(self.reference)[self._last_steps(t)])

    def _last_steps(self, t: FloatArray) -> Any:
        return np.maximum(np.searchsorted(np.array(self.t), np.asarray(t) + 1e-9, side="right") - 1, 0)


def supervised_engine(
    flights: list[Flown],
    requests: Requests,
    precision: Precision = "double",
    faults: Interference | None = None,
) -> Callable[[Prepared, Plant, float], Engine]:
    """What `malta.simulate` takes as its engine to fly controller and supervisor; each run adds a record to `flights`.

    Raises InputError as `engine_of_c` does.

        flights = []
        run = malta.simulate(plant, controller, scenario, engine=supervised_engine(flights, Requests()))
    """

    def stepped(native: Native, state: Any) -> Step:
        flown = Flown()
        flights.append(flown)
        s = compile_supervised(native.target)
        supervisor, request = s.Supervisor(), s.Request()
        step = getattr(s.native.lib, f"{native.name}_supervisor_step")
        if requests.take_over:
            rest = type(supervisor.rest)(*requests.take_over)
            getattr(s.native.lib, f"{native.name}_supervisor_take_over")(ctypes.byref(supervisor), rest)
        else:
            getattr(s.native.lib, f"{native.name}_supervisor_init")(ctypes.byref(supervisor))
        last = _copy(native, state.reference)
        Ts = native.target.controller.sample_time

        def fly(inputs: Any, outputs: Any, sample: int, missed: int) -> None:
            nonlocal last
            t = sample * Ts
            request.reference = state.reference
            state.reference = last
            begin = max(requests.start, Ts)  # after a sample without the request: it counts when it comes
            request.start = int(begin <= t < begin + Ts)
            request.operate = int(t >= requests.operate)
            request.land = int(t >= requests.land)
            request.missed = missed
            if faults:
                call_valid(inputs)
                faults.before(t, inputs, request)
            step(*(ctypes.byref(r) for r in (supervisor, state, inputs, request, outputs)))
            if faults and supervisor.enable:  # gates that are off obey no command
                faults.after(t, outputs)
            last = _copy(native, state.reference)
            flown.t.append(t)
            flown.state.append(int(supervisor.state))
            flown.monitor.append(int(supervisor.monitor))
            flown.reference.append(view(state.reference, "p").copy())
            flown.motion.append(last)
            flown.v.append(view(outputs, "v").copy())

        return fly

    return engine_of_c(precision, stepped)


def unsupervised_engine(
    healthy: Flown, faults: Interference, precision: Precision = "double"
) -> Callable[[Prepared, Plant, float], Engine]:
    """As supervised_engine, without the supervisor: the controller alone follows what it followed in a healthy flight.

    It is off where it was off in that flight, and starts where it started.
    """

    def stepped(native: Native, state: Any) -> Step:
        Ts = native.target.controller.sample_time
        step, start = (getattr(native.lib, f"{native.name}_{key}") for key in ("step", "start"))
        flying = [NUMBERS[key] for key in IN_FLIGHT]
        was_on = healthy.state[0] in flying
        index = {round(t / Ts): k for k, t in enumerate(healthy.t)}

        def fly(inputs: Any, outputs: Any, sample: int, _: int) -> None:
            nonlocal was_on
            t = sample * Ts
            k = index.get(sample, len(healthy.t) - 1)
            on = healthy.state[k] in flying
            state.reference = healthy.motion[k]
            if on and not was_on:
                start(ctypes.byref(state))
            was_on = on
            call_valid(inputs)
            faults.before(t, inputs, None)
            step(*(ctypes.byref(r) for r in (state, inputs, outputs)))
            if on:
                faults.after(t, outputs)
            else:
                for name, value in (("v", 0.0), ("current", 0.0), ("command", OFF_COMMAND)):
                    view(outputs, name)[:] = value

        return fly

    return engine_of_c(precision, stepped)


def _copy(native: Native, reference: Any) -> Any:
    """A reference of its own: a record's member is a view."""
    found = native.Reference()
    ctypes.pointer(found)[0] = reference
    return found

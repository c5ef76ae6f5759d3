"""What a simulation begins with, remembered for runs that can only begin with the same again."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from malta.errors import InputError
from malta.model.parameters import shape_parameters, units_of
from malta.model.plant import Plant
from malta.simulation.engines import evaluate, substeps_until
from malta.simulation.inputs import Inputs, electronics_noise, initial_values, inputs_of, sensor_noise
from malta.simulation.period import initial_state_function
from malta.simulation.scenario import Scenario, Simulation, simulation_of, substeps_of
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

REMEMBERED = 8  # simulations
LARGEST = 4_000_000  # bytes of a simulation that is remembered


class Prepared(NamedTuple):
    """What a simulation begins with."""

    simulation: Simulation  # its records must live as long as their addresses are a key
    inputs: Inputs
    state: FloatArray  # of machine and controller at the start
    stages: list[tuple[int, Plant]]  # see stages_of
    substeps: float  # in a sample
    noise: FloatArray  # of the sensors, k x sensors
    fast_noise: FloatArray  # of the electronics, substeps x numbers

    @property
    def size(self) -> int:
        """Bytes of its arrays."""
        arrays = (self.inputs.t, *self.inputs.motion, self.inputs.given, self.noise, self.fast_noise)
        return sum(array.nbytes for array in arrays)


_memory: OrderedDict[tuple[int, ...], Prepared] = OrderedDict()


def prepare(plant: Plant, controller: Controller, scenario: Scenario) -> Prepared:
    """The inputs of every sample, their noise and the first state; those of the last runs of the same records are
    remembered.

    Raises InputError as `simulation_of`, `inputs_of`, `stages_of`, `sensor_noise` and `substeps_of` do.
    """
    key = (id(plant), id(controller), id(scenario))
    found = _memory.get(key)
    if found is None:
        run = simulation_of(plant, controller, scenario)
        inputs = inputs_of(run)
        start = initial_state_function(run.plant, run.controller, run.setup)
        state = evaluate(start, *initial_values(run, inputs.given[0]))[0].ravel()
        stages = stages_of(plant, scenario, controller.sample_time)
        noise = sensor_noise(run, stages, inputs.t)
        steps = substeps_of(plant, controller, run.setup, scenario)
        fast = electronics_noise(run, substeps_until(len(inputs.t), steps))
        found = Prepared(run, inputs, state, stages, steps, noise, fast)
        if is_repeatable(scenario) and found.size <= LARGEST:
            _memory[key] = found
            if len(_memory) > REMEMBERED:
                _memory.popitem(last=False)
    return found


def is_repeatable(s: Scenario) -> bool:
    """Whether inputs follow from the scenario's own numbers: a reference of malta with numbers for arguments, and
    nothing that a caller may write into or that looks at the run."""
    reference = s.reference
    arguments: tuple[object, ...] = ()
    if isinstance(reference, partial):
        arguments = (*reference.args, *reference.keywords.values())
        reference = reference.func
    own = str(getattr(reference, "__module__", "")).partition(".")[0] == __name__.partition(".")[0]
    plain = all(isinstance(value, int | float | str | None) for value in arguments)
    functions = s.disturbance or s.anticipated or s.excitation or s.correction or s.electronics
    written = s.faults or s.start or s.changes or s.sensor_errors
    return own and plain and not functions and not written


def stages_of(plant: Plant, scenario: Scenario, Ts: float) -> list[tuple[int, Plant]]:
    """(first sample, machine): the machine before and after every change of its parameters.

    Raises InputError for unknown parameters, and for those that shape the machine's functions.
    """
    stages = [(0, plant)]
    for at, values in sorted(scenario.changes, key=lambda change: change[0]):
        known = units_of(plant.parameters)
        for name in values:
            if name not in known:
                raise InputError(
                    f"scenario {scenario.name}", f"changes.{name}", "an unknown parameter", " ".join(known)
                )
            if name in shape_parameters(plant.parameters):
                found = "a parameter that shapes the machine's functions"
                raise InputError(
                    f"scenario {scenario.name}", f"changes.{name}", found, "one that enters them"
                )
        before = stages[-1][1]
        par: Any = replace(before.parameters, **values)
        stages.append((max(0, round(at / Ts) + scenario.settling_samples(Ts)), before.variant(par)))
    return stages

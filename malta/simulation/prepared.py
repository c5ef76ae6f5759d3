"""What a simulation begins with, remembered for runs that can only begin with the same again."""

from __future__ import annotations

from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from malta.model.plant import Plant
from malta.simulation.engines import evaluate
from malta.simulation.inputs import Inputs, initial_values, inputs_of
from malta.simulation.period import initial_state_function
from malta.simulation.scenario import Scenario, Simulation, simulation_of
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

REMEMBERED = 8  # simulations
LONGEST = 20_000  # samples of a simulation that is remembered: 3 MB


class Prepared(NamedTuple):
    """What a simulation begins with."""

    simulation: Simulation  # its records must live as long as their addresses are a key
    inputs: Inputs
    state: FloatArray  # of machine and controller at the start


_memory: OrderedDict[tuple[int, ...], Prepared] = OrderedDict()


def prepare(plant: Plant, controller: Controller, scenario: Scenario) -> Prepared:
    """The inputs of every sample and the first state; those of the last runs of the same records are remembered.

    Raises InputError as `simulation_of` and `inputs_of` do.
    """
    key = (id(plant), id(controller), id(scenario))
    found = _memory.get(key)
    if found is None:
        run = simulation_of(plant, controller, scenario)
        inputs = inputs_of(run)
        start = initial_state_function(run.plant, run.controller, run.setup)
        state = evaluate(start, *initial_values(run, inputs.given[0]))[0].ravel()
        found = Prepared(run, inputs, state)
        if is_repeatable(scenario) and len(inputs.t) <= LONGEST:
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
    functions = s.disturbance or s.anticipated or s.correction or s.electronics
    written = s.faults or s.start or s.changes or s.sensor_errors
    return own and plain and not functions and not written

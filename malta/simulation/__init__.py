"""Nonlinear simulation: control period, engines, scenarios, batches and experiments.

layout, current_control, period          one control period of machine and controller as CasADi functions
scenario, references, readings, inputs   the reference, and everything that disturbs the machine
simulate, trajectory                     one machine, its time series, and its observer at the start
engine                                   the period as C or in CasADi, on one machine or on thousands
experiments                              scenarios with figures of merit, the fastest stroke among them
"""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.simulation.engine.batch import replay_run as replay_run, simulate_many as simulate_many
    from malta.simulation.engine.digest import Batch as Batch
    from malta.simulation.experiments import Experiment as Experiment
    from malta.simulation.experiments.time_optimal import fastest_stroke as fastest_stroke
    from malta.simulation.flown_strokes import stroke_figures as stroke_figures
    from malta.simulation.multisine import Multisine as Multisine
    from malta.simulation.scenario import Fault as Fault
    from malta.simulation.steps import choose_steps as choose_steps
    from malta.simulation.trajectory import Trajectory as Trajectory

_NAMES = {
    "malta.simulation.engine.batch": "replay_run simulate_many",
    "malta.simulation.engine.digest": "Batch",
    "malta.simulation.experiments": "Experiment",
    "malta.simulation.experiments.time_optimal": "fastest_stroke",
    "malta.simulation.flown_strokes": "stroke_figures",
    "malta.simulation.multisine": "Multisine",
    "malta.simulation.scenario": "Fault",
    "malta.simulation.steps": "choose_steps",
    "malta.simulation.trajectory": "Trajectory",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES, {"replayed": "malta.simulation.replay_run"})

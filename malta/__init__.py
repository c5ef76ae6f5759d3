"""LQG/MIMO control of self-bearing and magnetically levitated actuators.

data -> plant -> linearize -> synthesize -> verify -> export -> simulate -> report
"""

from __future__ import annotations

import re
import warnings
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the contents page, as type checkers and readers see it
    from malta import gains as gains
    from malta import report as report
    from malta import schemas as schemas
    from malta.app.server import app_widget as app_widget
    from malta.campaigns.limits import limit_of as limit_of
    from malta.campaigns.plan import Plan as Plan
    from malta.campaigns.rare import rare_event as rare_event
    from malta.campaigns.result import Campaign as Campaign
    from malta.campaigns.run import campaign as campaign
    from malta.campaigns.studies import sensitivity as sensitivity
    from malta.campaigns.studies import tolerances as tolerances
    from malta.campaigns.summary import Summary as Summary
    from malta.campaigns.survey import summarize as summarize
    from malta.errors import CheckError as CheckError
    from malta.errors import InputError as InputError
    from malta.firmware.exports import export_c as export_c
    from malta.firmware.exports import export_fmu as export_fmu
    from malta.firmware.flight import engine_of_c as engine_of_c
    from malta.firmware.pil import Replay as Replay
    from malta.firmware.pil import replay_on_target as replay_on_target
    from malta.identification.excite import ExcitationPlan as ExcitationPlan
    from malta.identification.excite import excite as excite
    from malta.identification.identify import Identified as Identified
    from malta.identification.identify import identify as identify
    from malta.identification.learn import Learned as Learned
    from malta.identification.learn import learn as learn
    from malta.identification.log import Log as Log
    from malta.identification.log import log_of as log_of
    from malta.identification.log import read_log as read_log
    from malta.identification.log import write_log as write_log
    from malta.identification.measure import Measurement as Measurement
    from malta.identification.measure import MeasurementPlan as MeasurementPlan
    from malta.identification.measure import measure as measure
    from malta.identification.measure import plan_measurement as plan_measurement
    from malta.identification.replay import LawReplay as LawReplay
    from malta.identification.replay import replay_law as replay_law
    from malta.loops.curves import LoopCurves as LoopCurves
    from malta.loops.curves import loop_curves as loop_curves
    from malta.loops.linear_loops import LoopSystems as LoopSystems
    from malta.loops.linear_loops import loop_systems as loop_systems
    from malta.loops.loop import Loop as Loop
    from malta.loops.loop import loop as loop
    from malta.loops.time_domain import Recovery as Recovery
    from malta.loops.time_domain import recovery as recovery
    from malta.margins.loop_report import LoopReport as LoopReport
    from malta.model.data import plant_of as plant_of
    from malta.model.data import published as published
    from malta.model.data import read as read
    from malta.model.equilibrium import trim as trim
    from malta.model.linear import linear_machine as linear_machine
    from malta.model.linearize import InverseCheck as InverseCheck
    from malta.model.linearize import LinearModel as LinearModel
    from malta.model.linearize import linearize as linearize
    from malta.model.machines import machine as machine
    from malta.model.parameters import check_parameters as check_parameters
    from malta.model.parameters import si as si
    from malta.model.plant import Actuator as Actuator
    from malta.model.plant import OperatingPoint as OperatingPoint
    from malta.model.plant import Plant as Plant
    from malta.model.plant import Signal as Signal
    from malta.proof.blocks.blocks import Dynamic as Dynamic
    from malta.proof.blocks.gain import Gain as Gain
    from malta.proof.blocks.gain import dynamic_margin as dynamic_margin
    from malta.proof.blocks.gain import worst_case_gain as worst_case_gain
    from malta.proof.margin import Margin as Margin
    from malta.proof.robust import margin_of_polynomial as margin_of_polynomial
    from malta.proof.robust import robust_margin as robust_margin
    from malta.proof.systems import uncertain as uncertain
    from malta.proof.uncertain import Compensator as Compensator
    from malta.proof.uncertain import UncertainSystem as UncertainSystem
    from malta.report.ledger import ledger as ledger
    from malta.simulation import references as references
    from malta.simulation.engine.batch import replayed as replayed
    from malta.simulation.engine.batch import simulate_many as simulate_many
    from malta.simulation.engine.digest import Batch as Batch
    from malta.simulation.experiments import Experiment as Experiment
    from malta.simulation.experiments.catalogue import experiment as experiment
    from malta.simulation.experiments.time_optimal import fastest_stroke as fastest_stroke
    from malta.simulation.references import Multisine as Multisine
    from malta.simulation.scenario import Fault as Fault
    from malta.simulation.scenario import Scenario as Scenario
    from malta.simulation.simulate import simulate as simulate
    from malta.simulation.trajectory import Trajectory as Trajectory
    from malta.simulation.trajectory import stroke_figures as stroke_figures
    from malta.synthesis.calibrate import calibrate as calibrate
    from malta.synthesis.controller import Controller as Controller
    from malta.synthesis.design_file import read_design as read_design
    from malta.synthesis.lqg import kalman as kalman
    from malta.synthesis.lqg import lqg as lqg
    from malta.synthesis.lqg import lqi as lqi
    from malta.synthesis.lqg import lqr as lqr
    from malta.synthesis.lqg import synthesize as synthesize
    from malta.synthesis.lqg import weights as weights
    from malta.synthesis.spec import Spec as Spec
    from malta.synthesis.spec import Weights as Weights
    from malta.synthesis.state_space import controller_of as controller_of
    from malta.tuning.tune import tune as tune
    from malta.tuning.verify import verify as verify
    from malta.units import in_unit as in_unit

# The lines above are the one list: a name is looked for where they say, at its first use.
_PLACES = {
    name: module
    for module, name in re.findall(
        r"^    from (\S+) import (\w+) as", Path(__file__).read_text("utf-8"), re.M
    )
}
_MODULES = ("gains", "references", "report", "schemas")

_OLD = {  # names that go with the next minor version, and what to write for them
    "Margins": "malta.LoopReport",
    "Robustness": "malta.LoopReport",
    "robustness": "malta.verify(plant, controller, uncertainty, stages=True)",
}

__all__ = [*_PLACES]


def __getattr__(name: str) -> Any:
    if name in _OLD:
        warnings.warn(f"malta.{name} goes: write {_OLD[name]}", DeprecationWarning, stacklevel=2)
        return partial(__getattr__("verify"), stages=True) if name.islower() else __getattr__("LoopReport")
    if name not in _PLACES:
        raise AttributeError(f"module 'malta' has no attribute {name!r}")
    place = _PLACES[name]
    value = import_module(f"{place}.{name}") if name in _MODULES else getattr(import_module(place), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

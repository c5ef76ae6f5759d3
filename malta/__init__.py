"""LQG/MIMO control of self-bearing and magnetically levitated actuators.

data -> plant -> linearize -> synthesize -> verify -> export -> simulate -> report
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

from malta.contents import contents

if TYPE_CHECKING:  # the contents page, as type checkers and readers see it
    from malta import (
        app as app,
        campaigns as campaigns,
        firmware as firmware,
        gains as gains,
        identification as identification,
        loops as loops,
        margins as margins,
        model as model,
        proof as proof,
        report as report,
        schemas as schemas,
        simulation as simulation,
        structured as structured,
        synthesis as synthesis,
    )
    from malta.campaigns.run import campaign as campaign
    from malta.errors import CheckError as CheckError, InputError as InputError
    from malta.firmware.export import export_c as export_c
    from malta.firmware.export_fmu import export_fmu as export_fmu
    from malta.identification.excite import excite as excite
    from malta.identification.identify import identify as identify
    from malta.identification.learn import learn as learn
    from malta.identification.measure import measure as measure
    from malta.identification.realization import realize as realize
    from malta.loops.loop import loop as loop
    from malta.loops.uncertain_models import uncertain as uncertain
    from malta.margins.safe_loads import safe_load as safe_load, safe_start as safe_start
    from malta.margins.worst_waveforms import worst_waveform as worst_waveform
    from malta.model.data import read as read
    from malta.model.equilibrium import trim as trim
    from malta.model.inspection import inspect as inspect
    from malta.model.linear.machine import linear_machine as linear_machine
    from malta.model.linearize import linearize as linearize
    from malta.model.machines import machine as machine
    from malta.model.plants import plant_of as plant_of
    from malta.proof.blocks.gain import dynamic_margin as dynamic_margin, worst_case_gain as worst_case_gain
    from malta.proof.robust import robust_margin as robust_margin
    from malta.report.ledger import ledger as ledger
    from malta.simulation import references as references
    from malta.simulation.experiments.catalogue import experiment as experiment
    from malta.simulation.requests import worst_request as worst_request
    from malta.simulation.scenario import Scenario as Scenario
    from malta.simulation.simulate import simulate as simulate
    from malta.synthesis.design_file import read_design as read_design
    from malta.synthesis.lqg import lqg as lqg
    from malta.synthesis.spec import Spec as Spec
    from malta.synthesis.synthesize import synthesize as synthesize
    from malta.tuning.tune import tune as tune
    from malta.tuning.verify import verify as verify

# Names that go with the next minor version, and what to write for them.
_NOW_OF = {
    "app": "app_widget",
    "model": "Actuator InverseCheck LinearModel OperatingPoint Plant Signal check_parameters in_unit"
    " published si",
    "synthesis": "Controller Weights calibrate controller_of kalman lqi lqr weights",
    "proof": "Compensator Dynamic Gain Margin UncertainSystem margin_of_polynomial",
    "loops": "Loop LoopCurves LoopSystems Recovery loop_curves loop_systems recovery",
    "margins": "LoopReport",
    "campaigns": "Campaign Plan Summary limit_of rare_event sensitivity summarize tolerances",
    "firmware": "Replay engine_of_c replay_on_target",
    "identification": "ExcitationPlan Identified LawReplay Learned Log log_of plan_measurement read_log replay_law"
    " write_log",
    "simulation": "Batch Experiment Fault Multisine Trajectory fastest_stroke replayed simulate_many"
    " stroke_figures",
}
_OLD = {
    **{name: f"malta.{package}.{name}" for package, names in _NOW_OF.items() for name in names.split()},
    "LateSensors": "malta.model.Sensors",
    "published": "malta.model.read_published",
    "replayed": "malta.simulation.replay_run",
    "Margins": "malta.margins.LoopReport",
    "Robustness": "malta.margins.LoopReport",
}

_NAMES = {
    "malta": "app campaigns firmware gains identification loops margins model proof report schemas simulation"
    " structured synthesis",
    "malta.campaigns.run": "campaign",
    "malta.errors": "CheckError InputError",
    "malta.firmware.export": "export_c",
    "malta.firmware.export_fmu": "export_fmu",
    "malta.identification.excite": "excite",
    "malta.identification.identify": "identify",
    "malta.identification.learn": "learn",
    "malta.identification.measure": "measure",
    "malta.identification.realization": "realize",
    "malta.loops.loop": "loop",
    "malta.loops.uncertain_models": "uncertain",
    "malta.margins.safe_loads": "safe_load safe_start",
    "malta.margins.worst_waveforms": "worst_waveform",
    "malta.model.data": "read",
    "malta.model.equilibrium": "trim",
    "malta.model.inspection": "inspect",
    "malta.model.linear.machine": "linear_machine",
    "malta.model.linearize": "linearize",
    "malta.model.machines": "machine",
    "malta.model.plants": "plant_of",
    "malta.proof.blocks.gain": "dynamic_margin worst_case_gain",
    "malta.proof.robust": "robust_margin",
    "malta.report.ledger": "ledger",
    "malta.simulation": "references",
    "malta.simulation.experiments.catalogue": "experiment",
    "malta.simulation.requests": "worst_request",
    "malta.simulation.scenario": "Scenario",
    "malta.simulation.simulate": "simulate",
    "malta.synthesis.design_file": "read_design",
    "malta.synthesis.lqg": "lqg",
    "malta.synthesis.spec": "Spec",
    "malta.synthesis.synthesize": "synthesize",
    "malta.tuning.tune": "tune",
    "malta.tuning.verify": "verify",
}
__all__, _load, __dir__ = contents(__name__, _NAMES, _OLD)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from malta.files import version

        return version()
    if name == "robustness":
        write = "malta.verify(plant, controller, uncertainty, stages=True)"
        warnings.warn(f"malta.{name} goes: write {write}", DeprecationWarning, stacklevel=2)
        return partial(__getattr__("verify"), stages=True)
    return _load(name)

"""LQG/MIMO control of self-bearing and magnetically levitated actuators.

data -> plant -> linearize -> synthesize -> verify -> export -> simulate -> report
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the contents page, as type checkers and readers see it
    from malta import gains as gains
    from malta import plants as plants
    from malta import references as references
    from malta import report as report
    from malta.campaign import Campaign as Campaign
    from malta.campaign import Plan as Plan
    from malta.campaign import campaign as campaign
    from malta.chain import Robustness as Robustness
    from malta.chain import robustness as robustness
    from malta.claims import ledger as ledger
    from malta.controller import Controller as Controller
    from malta.data import in_unit as in_unit
    from malta.data import plant_of as plant_of
    from malta.data import published as published
    from malta.data import read as read
    from malta.errors import CheckError as CheckError
    from malta.errors import InputError as InputError
    from malta.experiments import Experiment as Experiment
    from malta.experiments import experiment as experiment
    from malta.fastest import fastest_stroke as fastest_stroke
    from malta.linearize import LinearModel as LinearModel
    from malta.linearize import linearize as linearize
    from malta.many import Batch as Batch
    from malta.many import replayed as replayed
    from malta.many import simulate_many as simulate_many
    from malta.margins.blocks import Dynamic as Dynamic
    from malta.margins.dynamic import dynamic_margin as dynamic_margin
    from malta.margins.gain import Gain as Gain
    from malta.margins.gain import worst_case_gain as worst_case_gain
    from malta.margins.robust import Margin as Margin
    from malta.margins.robust import margin_of_polynomial as margin_of_polynomial
    from malta.margins.robust import robust_margin as robust_margin
    from malta.margins.systems import uncertain as uncertain
    from malta.plant import OperatingPoint as OperatingPoint
    from malta.plant import Plant as Plant
    from malta.plant import Signal as Signal
    from malta.plant import trim as trim
    from malta.simulate import Fault as Fault
    from malta.simulate import Scenario as Scenario
    from malta.simulate import Trajectory as Trajectory
    from malta.simulate import simulate as simulate
    from malta.simulate import stroke_figures as stroke_figures
    from malta.spec import Spec as Spec
    from malta.spec import Weights as Weights
    from malta.spec import read_design as read_design
    from malta.synthesize import calibrate as calibrate
    from malta.synthesize import kalman as kalman
    from malta.synthesize import lqg as lqg
    from malta.synthesize import lqi as lqi
    from malta.synthesize import lqr as lqr
    from malta.synthesize import synthesize as synthesize
    from malta.tune import tune as tune
    from malta.uncertain import Compensator as Compensator
    from malta.uncertain import UncertainSystem as UncertainSystem
    from malta.verify import Margins as Margins
    from malta.verify import verify as verify

_NAMES = {  # the same, for the first use of each name
    "campaign": ("Campaign", "Plan", "campaign"),
    "chain": ("Robustness", "robustness"),
    "claims": ("ledger",),
    "controller": ("Controller",),
    "data": ("in_unit", "plant_of", "published", "read"),
    "errors": ("CheckError", "InputError"),
    "experiments": ("Experiment", "experiment"),
    "fastest": ("fastest_stroke",),
    "linearize": ("LinearModel", "linearize"),
    "many": ("Batch", "replayed", "simulate_many"),
    "plant": ("OperatingPoint", "Plant", "Signal", "trim"),
    "margins.blocks": ("Dynamic",),
    "margins.dynamic": ("dynamic_margin",),
    "margins.gain": ("Gain", "worst_case_gain"),
    "margins.robust": ("Margin", "margin_of_polynomial", "robust_margin"),
    "margins.systems": ("uncertain",),
    "simulate": ("Fault", "Scenario", "Trajectory", "simulate", "stroke_figures"),
    "spec": ("Spec", "Weights", "read_design"),
    "synthesize": ("calibrate", "kalman", "lqg", "lqi", "lqr", "synthesize"),
    "tune": ("tune",),
    "uncertain": ("Compensator", "UncertainSystem"),
    "verify": ("Margins", "verify"),
}
_MODULES = ("gains", "plants", "references", "report")
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_MODULE_OF, *_MODULES]


class _Contents(ModuleType):
    """The package, loading each name when it is first used: `malta --help` waits for no numerics.

    `malta.simulate` is the function. Importing the module of the same name would bind that module to the package, so
    such bindings are ignored.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _MODULE_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Contents


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = getattr(import_module(f"malta.{_MODULE_OF[name]}"), name)
    elif name in _MODULES:
        value = import_module(f"malta.{name}")
    else:
        raise AttributeError(f"module 'malta' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""LQG/MIMO control of self-bearing and magnetically levitated actuators.

data -> plant -> linearize -> synthesize -> verify -> export -> simulate -> report
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from malta import gains, plants, references, report
    from malta.controller import Controller
    from malta.data import plant_of, read
    from malta.errors import CheckError, InputError
    from malta.linearize import LinearModel, linearize
    from malta.plant import OperatingPoint, Plant, Signal, trim
    from malta.simulate import Scenario, Trajectory, simulate, stroke_figures
    from malta.spec import Spec, Weights, read_design
    from malta.synthesize import calibrate, kalman, lqg, lqi, lqr, synthesize
    from malta.verify import Margins, verify

_MODULE_OF = {
    "read": "data",
    "plant_of": "data",
    "InputError": "errors",
    "CheckError": "errors",
    "Signal": "plant",
    "Plant": "plant",
    "OperatingPoint": "plant",
    "trim": "plant",
    "read_design": "spec",
    "Spec": "spec",
    "Weights": "spec",
    "linearize": "linearize",
    "LinearModel": "linearize",
    "lqr": "synthesize",
    "lqi": "synthesize",
    "kalman": "synthesize",
    "lqg": "synthesize",
    "synthesize": "synthesize",
    "calibrate": "synthesize",
    "Controller": "controller",
    "verify": "verify",
    "Margins": "verify",
    "simulate": "simulate",
    "Scenario": "simulate",
    "Trajectory": "simulate",
    "stroke_figures": "simulate",
}
_MODULES = ("gains", "plants", "references", "report")

__all__ = [
    "CheckError",
    "Controller",
    "InputError",
    "LinearModel",
    "Margins",
    "OperatingPoint",
    "Plant",
    "Scenario",
    "Signal",
    "Spec",
    "Trajectory",
    "Weights",
    "calibrate",
    "gains",
    "kalman",
    "linearize",
    "lqg",
    "lqi",
    "lqr",
    "plant_of",
    "plants",
    "read",
    "read_design",
    "references",
    "report",
    "simulate",
    "stroke_figures",
    "synthesize",
    "trim",
    "verify",
]


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
    return __all__

"""Controllers: design files, Riccati equations, LQG, and the law that all else consumes."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.synthesis.calibration import calibrate as calibrate
    from malta.synthesis.controller import Controller as Controller
    from malta.synthesis.filter_check import check_filter as check_filter
    from malta.synthesis.filters import kalman as kalman
    from malta.synthesis.regulators import lqi as lqi, lqr as lqr
    from malta.synthesis.state_space import controller_of as controller_of
    from malta.synthesis.synthesize import schedule_laws as schedule_laws
    from malta.synthesis.weighting import Weights as Weights, weights as weights

_NAMES = {
    "malta.synthesis.calibration": "calibrate",
    "malta.synthesis.controller": "Controller",
    "malta.synthesis.filter_check": "check_filter",
    "malta.synthesis.filters": "kalman",
    "malta.synthesis.regulators": "lqi lqr",
    "malta.synthesis.state_space": "controller_of",
    "malta.synthesis.synthesize": "schedule_laws",
    "malta.synthesis.weighting": "Weights weights",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

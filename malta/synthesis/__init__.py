"""Controllers: design files, Riccati equations, LQG, and the law that all else consumes."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller as Controller
    from malta.synthesis.filter_check import check_filter as check_filter
    from malta.synthesis.lqg import kalman as kalman, lqi as lqi, lqr as lqr, weights as weights
    from malta.synthesis.spec import Weights as Weights
    from malta.synthesis.state_space import controller_of as controller_of
    from malta.synthesis.synthesize import schedule_laws as schedule_laws
    from malta.synthesis.tunable_lqg import calibrate as calibrate

_NAMES = {
    "malta.synthesis.controller": "Controller",
    "malta.synthesis.filter_check": "check_filter",
    "malta.synthesis.lqg": "kalman lqi lqr weights",
    "malta.synthesis.spec": "Weights",
    "malta.synthesis.state_space": "controller_of",
    "malta.synthesis.synthesize": "schedule_laws",
    "malta.synthesis.tunable_lqg": "calibrate",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

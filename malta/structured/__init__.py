"""Laws of a given structure, tuned on figures with exact derivatives and proven; H-infinity laws of full order.

elements   what is tuned: gains, PIDs, leads, notches, transfer functions, observers, LQGs, state spaces, diagrams
goals      what is asked for: sensitivity, disks, gains, noise, tracking, poles, a stable law
tune       from a start to a proof: goals on models, worst parameters from proofs, until they close
tune_design  the same of a design file with [structure]
h_infinity from a generalized plant to the best law of its order, by two Riccati equations
"""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.structured.design import tune_design as tune_design
    from malta.structured.goals import (
        Goal as Goal,
        disk_margin as disk_margin,
        gain_limit as gain_limit,
        noise_limit as noise_limit,
        poles as poles,
        sensitivity as sensitivity,
        soft as soft,
        stable_law as stable_law,
        tracking as tracking,
    )
    from malta.structured.riccati import (
        Synthesized as Synthesized,
        h_infinity as h_infinity,
        mixed_sensitivity as mixed_sensitivity,
        shape_loop as shape_loop,
    )
    from malta.structured.rounds import Tuned as Tuned, tune as tune
    from malta.synthesis.elements import (
        Element as Element,
        gain as gain,
        lead as lead,
        notch as notch,
        observer as observer,
        pid as pid,
        states as states,
        transfer as transfer,
    )
    from malta.synthesis.structure import Place as Place
    from malta.synthesis.tunable_lqg import lqg as lqg

_NAMES = {
    "malta.structured.design": "tune_design",
    "malta.structured.goals": "Goal disk_margin gain_limit noise_limit poles sensitivity soft stable_law tracking",
    "malta.structured.riccati": "Synthesized h_infinity mixed_sensitivity shape_loop",
    "malta.structured.rounds": "Tuned tune",
    "malta.synthesis.elements": "Element gain lead notch observer pid states transfer",
    "malta.synthesis.structure": "Place",
    "malta.synthesis.tunable_lqg": "lqg",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

"""Laws of a given structure, tuned on figures with exact derivatives and proven; H-infinity laws of full order.

elements   what is tuned: gains, PIDs, leads, notches, transfer functions, observers, LQGs, state spaces, diagrams
goals      what is asked for: sensitivity, disks, gains, noise, tracking, poles, a stable law
tune       from a start to a proof: goals on models, worst parameters from proofs, until they close
tune_design  the same of a design file with [structure]
h_infinity from a generalized plant to the best law of its order, by two Riccati equations
"""

from malta.structured.design import tune_design as tune_design
from malta.structured.goals import Goal as Goal
from malta.structured.goals import disk_margin as disk_margin
from malta.structured.goals import gain_limit as gain_limit
from malta.structured.goals import noise_limit as noise_limit
from malta.structured.goals import poles as poles
from malta.structured.goals import sensitivity as sensitivity
from malta.structured.goals import soft as soft
from malta.structured.goals import stable_law as stable_law
from malta.structured.goals import tracking as tracking
from malta.structured.riccati import Synthesized as Synthesized
from malta.structured.riccati import h_infinity as h_infinity
from malta.structured.riccati import mixed_sensitivity as mixed_sensitivity
from malta.structured.riccati import shape_loop as shape_loop
from malta.structured.rounds import Tuned as Tuned
from malta.structured.rounds import tune as tune
from malta.synthesis.elements import Element as Element
from malta.synthesis.elements import gain as gain
from malta.synthesis.elements import lead as lead
from malta.synthesis.elements import notch as notch
from malta.synthesis.elements import observer as observer
from malta.synthesis.elements import pid as pid
from malta.synthesis.elements import states as states
from malta.synthesis.elements import transfer as transfer
from malta.synthesis.structure import Place as Place
from malta.synthesis.tunable_lqg import lqg as lqg

"""The mover's centre of gravity off its axis, by c = (c_x, c_y, 0) in frame R.

The position x y z is that of the point A of the mover's axis, the axis of its magnets and the one that the sensors see.
The centre of gravity O is off it by r = R_IR c, so with F at the axis, moments T_A about A, and w at O

    m (A'' + r'') = F + w,     I omega' + omega x I omega = T_A - r x F + w_T.

Two effects remain of an unbalance on a mover that is not driven round: thrust along the axis tilts the mover by
the torque c x f_D, and the weight hangs below the axis: the mover rolls as a pendulum of the frequency
sqrt(m g |c| / I_zz). A principal axis that is tilted against the axis of the magnets acts only through products of
angular rates, so it is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

from malta.model.rigidbody import EXACT, Trig, rotation

if TYPE_CHECKING:
    from malta.machines.tubular.plant import Parameters


def centre_of_gravity(par: Parameters, q_r: Any, trig: Trig = EXACT) -> Any:
    """r = R_IR c: from the mover's axis to its centre of gravity, in frame I, m."""
    return rotation(q_r, trig).T @ ca.vertcat(par.c_x, par.c_y, 0)


def second_derivative(r: Any, q: Any, dq: Any, ddq: Any) -> Any:
    """r'' of an expression r of q; q and dq are CasADi SX symbols."""
    return ca.jtimes(ca.jtimes(r, q, dq), q, dq) + ca.jtimes(r, q, ddq)

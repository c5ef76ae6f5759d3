"""The loop of a machine and a controller as systems of python-control: to plot, to simulate, to compute with.

       v  +-----+        +-----+  y             at the sensors   L = -P F,  S = (I + L)^-1,  T = I - S
    +--o->|  P  |------->|  F  |--+             at the forces    L = -F P,  likewise
    |     +-----+        +-----+  |
    +-----------------------------+

P is the machine as it runs, sampled: hold, delay, current loops, the loads against v0(z). F is the law, with negative
feedback inside. They are those of `malta.loop`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from malta.display import Description, display, quantity
from malta.loops.loop import Loop, loop_from
from malta.model.plant import Plant
from malta.synthesis.controller import Controller
from malta.synthesis.state_space import named_system, reference_names, set_point
from malta.threads import on_one_thread


@display
@dataclass(frozen=True, eq=False)
class LoopSystems:
    """The systems of a machine's sampled loop, discrete control.StateSpace with the names of the machine's signals.

    Negative feedback stands in F. Gains are in SI.

    P : from forces to outputs: hold, delay, current loops and the loads against v0(z)
    F : from measurements to forces, the control law
    L : loop gain at the sensors, -P F
    S : sensitivity at the sensors, (I + L)^-1
    T : complementary sensitivity at the sensors, I - S
    L_forces : loop gain at the forces, -F P
    S_forces : sensitivity at the forces
    T_forces : complementary sensitivity at the forces
    tracking : from references at rest, as "z_ref", to outputs
    plant : the machine
    controller : its controller

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> loop = malta.loop_systems(malta.plant_of(controller.parameters), controller)
    >>> loop.F.input_labels, loop.F.output_labels[:2], loop.S.dt
    (['x1', 'y1', 'x2', 'y2', 'z'], ['fx_B1', 'fy_B1'], 5e-05)
    """

    P: Any
    F: Any
    L: Any
    S: Any
    T: Any
    L_forces: Any
    S_forces: Any
    T_forces: Any
    tracking: Any
    plant: Plant
    controller: Controller

    @property
    def description(self) -> Description:
        """The size of each system."""
        systems = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        rows = tuple(
            (name, f"{s.ninputs} inputs, {s.noutputs} outputs, {s.nstates} states")
            for name, s in systems
            if name not in ("plant", "controller")
        )
        title = f"LoopSystems of {self.controller.name!r} on {self.plant.name!r}"
        return Description(f"{title}, every {quantity(self.controller.sample_time, 's')}", rows)


@on_one_thread
def loop_systems(plant: Plant | Loop, controller: Controller | None = None) -> LoopSystems:
    """Make python-control systems of a machine's loop; of a plant and a controller at the controller's operating point.

    Currents that are held between samples hang on the last reading, too: at the sensors this is part of F, and broken
    with it; P, F and what is taken at the forces have it in the machine.

    plant : the machine, or its Loop at any operating point
    controller : of the plant; None: the Loop has it

    Returns a LoopSystems, for control.bode_plot and its like.

    Raises CheckError where no input holds the machine at the operating point.

    >>> import malta
    >>> import numpy as np
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> loop = malta.loop_systems(spec.plant, controller)
    >>> w = np.logspace(0, 4, 200)  # rad/s
    >>> f"largest |S| {loop.S.frequency_response(w).magnitude.max():.2f}"
    'largest |S| 1.57'
    """
    whole = loop_from(plant, controller)
    plant, controller, loop = whole.plant, whole.controller, whole.sampled_forces
    law, m = loop.control, len(controller.forces)
    n, k, p = len(loop.Ad), len(law.A), len(loop.Cd)
    Cd, B1 = loop.Cd, loop.Bd[:, :m]
    Ad = loop.Ad + (loop.Bd[:, m:] @ Cd if loop.Bd.shape[1] > m else 0)  # with what hangs on the reading
    C1, D1, R = law.C[:m], law.D_y[:m], set_point(controller)
    read = np.vstack([loop.Bd @ law.D_y, law.B_y])  # of an error of the reading
    pushed = np.vstack([B1, np.zeros((k, m))])
    sent = np.vstack([B1 @ law.D_r[:m] @ R, law.B_r @ R])
    y, v = np.hstack([Cd, np.zeros((p, k))]), np.hstack([D1 @ Cd, C1])
    cut_at_sensors = np.block([[loop.Ad, loop.Bd @ law.C], [np.zeros((k, n)), law.A]])
    cut_at_forces = np.block([[Ad, np.zeros((n, k))], [law.B_y @ Cd, law.A]])
    forces, outputs = ([s.name for s in signals] for signals in (plant.inputs, plant.outputs))
    Ts, references = controller.sample_time, reference_names(controller)
    one_p, one_m = np.eye(p), np.eye(m)
    return LoopSystems(
        P=named_system("P", forces, outputs, Ts, Ad, B1, Cd),
        F=named_system("F", outputs, forces, Ts, law.A, law.B_y, C1, D1),
        L=named_system("L", outputs, outputs, Ts, cut_at_sensors, read, -y),
        S=named_system("S", outputs, outputs, Ts, loop.closed, read, y, one_p),
        T=named_system("T", outputs, outputs, Ts, loop.closed, read, -y),
        L_forces=named_system("L_forces", forces, forces, Ts, cut_at_forces, pushed, -v),
        S_forces=named_system("S_forces", forces, forces, Ts, loop.closed, pushed, v, one_m),
        T_forces=named_system("T_forces", forces, forces, Ts, loop.closed, pushed, -v),
        tracking=named_system("tracking", references, outputs, Ts, loop.closed, sent, y),
        plant=plant,
        controller=controller,
    )

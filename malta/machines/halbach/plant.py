"""A Halbach linear motor: three phase currents make one horizontal and one vertical force.

Source: L. C. Díaz-Pérez et al., Actuators 7(4), 2018; equation and figure numbers are its own.

    reference --> [ position law ] --> F_x --> [ commutation ] --> currents --> [ current loops ] --> [ motor ] --> x
                        ^  every 55 ms              ^  F_z, y, held                  ^  every 68 us      |
                        +--- laser -----------------+                                +--- two of three --+

SCALING. The transform is the paper's (6), P(x), with its inverse (9): they carry the factor 3/2 in one direction, so Id
and Iq are 1.5 x the amplitude of the phase currents, and F = A (Id, Iq) without a factor. Voltages are transformed
alike, so u = R i + L i' holds in these axes as it stands; power is 2/3 (Vd Id + Vq Iq).

AIR GAP. A is that of a gap of 400 um; at another gap the motor has A(z_0) = A e^(-k (z_0 - 400 um)), by (2).

HELD ANGLE. Between two readings of the laser the Park angle is constant, and so are the phase currents. At a distance d
from the position of the reading the motor has the horizontal force F_x cos(k d) - F_z sin(k d), which contains a spring
of stiffness k F_z. Every model that a position controller is designed on contains that spring.
"""

from __future__ import annotations

import math
from functools import partial

import casadi as ca

from malta.machines.halbach.electronics import (
    MEAN_SAMPLES,
    current_delay,
    current_loop,
    electronics,
    forces,
    motion,
    motor_constant,
    phase_currents,
)
from malta.machines.halbach.parameters import Parameters as Parameters
from malta.model.actuator import Actuator
from malta.model.contacts import Contacts
from malta.model.plant import Plant, Signal
from malta.model.rigid_body import Body, Resultant
from malta.model.sensors import Sensors
from malta.model.stroke import Stroke

POSITION = Signal("x", "m")
FORCE = Signal("F_x", "N")
COILS = tuple(Signal(f"i_{phase}", "A") for phase in "abc")


def plant(par: Parameters) -> Plant:
    """The motor along its travel: the input is F_x; F_z is a parameter, and commutation produces both."""
    return Plant(
        name="halbach",
        parameters=par,
        states=(POSITION, Signal("x_dot", "m/s")),
        inputs=(FORCE,),
        outputs=(POSITION,),
        disturbances=(FORCE,),
        f=lambda x, u, w: motion(par, x, u[0], w[0]),
        h=lambda x, _: x[0],
        preload=lambda _: ca.DM.zeros(1),
        actuator=Actuator(
            coils=COILS,
            force_limit=(par.F_max,),
            force_constant=(motor_constant(par),),
            current_limit=par.I_adc,
            voltage_limit=par.V_dc / 2,
            R=par.R,
            L=par.L,
            crossover=current_loop(par, MEAN_SAMPLES).crossover,
            phase_margin=par.pm_cc,
            sample_time=1 / par.f_pwm,
            loop_delay=current_delay(par, MEAN_SAMPLES),
            dead_time=(par.latency + 0.5) * par.T_laser,
            currents=lambda y, v: phase_currents(par, y[0], v[0], par.F_z),
            forces=lambda x, i: forces(par, x[0], i)[0],
            limited=lambda i: i / ca.fmax(1, ca.mmax(ca.fabs(i)) / par.I_adc),  # their sum stays zero
            electronics=partial(electronics, par),
        ),
        contacts=Contacts(("left the travel",), lambda x: ca.fabs(x[0]) / par.travel),
        sensors=Sensors(
            sense=lambda x, errors: x[0] + errors[0],
            errors=(Signal("offset_x", "m"),),  # of the Park angle: k times this
            noise=(par.n_laser / math.sqrt(3),),
            uniform=True,
            resolution=(par.dx,),
        ),
        inertia=(par.m,),
        stroke=Stroke("x", thrust="F_x", travel=par.travel, mass=par.m),
        variant=plant,
        bodies=partial(_bodies, par),
    )


def _bodies(par: Parameters) -> tuple[Body, ...]:
    """A slider above the magnets; the source prints no sizes but those of the travel and the gap."""
    size = par.travel
    thrust = (Resultant("coils", (FORCE.name, "", "")),)
    return (
        Body("magnets", "box", (4 * size, size, 0.3 * size), (0.0, 0.0, -0.3 * size - par.z_0)),
        Body("slider", "box", (1.5 * size, size, 0.3 * size), moves=("x",), resultants=thrust),
    )

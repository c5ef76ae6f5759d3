"""How far any load moves an output, nominal and anywhere in a box of parameters: what `malta.proof` is asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.loops.loop import Loop
from malta.loops.parametric_plants import in_symbols, rest_model
from malta.loops.waveforms import CALLER, WorstWaveform, nominal_waveform
from malta.model.places import position_in
from malta.model.plant import Plant
from malta.processes import on_one_thread
from malta.proof.box import box_of
from malta.proof.margin import Ranges


@on_one_thread
def worst_waveform(
    loop: Loop,
    disturbance: str | Mapping[str, float],
    output: str,
    limit: float = 1.0,
    ranges: Ranges | None = None,
    *,
    time: float | None = None,
) -> WorstWaveform:
    """Find the signal of bounded size that moves an output of a loop furthest: its l1 norm, and the signal's signs.

        max over |w| <= limit of |y(t)| = limit * integral of |g|,   w(t) = limit * sign g(t_peak - t)

    g is the response to an impulse of the sampled loop with its motion between samples. The value is that of the
    linear loop at rest: current limits, contacts and large motions are not in it, and rest itself is where the design
    has it.

    loop : from `malta.loop`
    disturbance : a load by name, N or N m; a load at a point as {"F_x": 1, "T_y": -0.045}, of which `limit` is the
        multiple; "noise x1", the error of a sensor in each sample; "rate z", of a reference by position alone
    output : an output or an input of the plant by name, "error z" of an output beside its reference, or a contact
        (share of its clearance, 1 touches)
    limit : largest size of the signal, SI
    ranges : of parameters, as in `malta.robust_margin`: what a load does to an output of the plant is also proven
        anywhere in this box, at samples and with the machine at rest under its loads. None: at nominal values alone
    time : s, longest search of the proof; None: as long as 30 units of work take

    Returns a WorstWaveform. Outputs under loads are looked at at four places of each sample, all else at samples.

    Raises InputError for signals that the machine does not have, and for a limit that is not above zero; CheckError for
    an unstable loop, and for references that the loop does not follow.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/tubular_pid.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> found = malta.worst_waveform(loop, "F_x", "touchdown at sensor plane 1", 5.0)
    >>> f"5 N use {found.at_most.percent()} of the clearance"
    '5 N use 10.70 % of the clearance'
    """
    found = nominal_waveform(loop, disturbance, output, limit)
    if not ranges:
        return found
    from malta.proof.worst_load import prove_load  # ball arithmetic, which a nominal figure does not need

    plant, names, outputs = loop.plant, tuple(ranges), [s.name for s in loop.plant.outputs]
    if not len(found.shares) or output not in outputs:
        wanted = "a load and an output of the plant, or no ranges"
        raise InputError(CALLER, "ranges", f"{found.disturbance!r} to {output!r}", wanted)
    system, law = loop.uncertain(names)
    box = box_of(system.names, system.nominal, system.limits, ranges, {}, caller=CALLER)
    n, row = system.matrices.size1_out(0), loop.model.C[outputs.index(output)]
    load = _load_in_parameters(plant, names, tuple(loop.at.items()), tuple(found.shares.tolist()), n)
    over = prove_load(system, law, load, np.pad(row, (0, n - len(row))), box, time=time)
    return replace(found, over=over)


@lru_cache(maxsize=16)  # plants compare by identity
def _load_in_parameters(
    plant: Plant,
    names: tuple[str, ...],
    at: tuple[tuple[str, float], ...],
    shares: tuple[float, ...],
    size: int,
) -> ca.Function:
    """p -> what a unit of a load adds to the rates of the system's states, at rest under its loads."""
    states = dict(at)
    own = tuple((name, x) for name, x in at if name != plant.stroke.name)
    p, z = ca.SX.sym("p", len(names)), position_in(plant, plant.state(states))
    machine = in_symbols(plant, dict(zip(names, ca.vertsplit(p), strict=True)))
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    w = ca.SX.sym("w", len(plant.disturbances))
    slope = ca.jacobian(machine.f(x, u, w + machine.load(x)), w) @ ca.DM(shares)
    point, acting, _ = rest_model(plant, names, own).function(p, z)
    (b,) = ca.substitute([slope[list(plant.controlled)]], [w], [ca.SX.zeros(w.numel())])
    (b,) = ca.substitute([b], [x, u], [point, acting])
    return ca.Function("load", [p], [ca.densify(ca.vertcat(b, ca.SX.zeros(size - b.numel())))])

"""How far any load, any noise or any reference of bounded size moves a machine, and the signal that does it.

       w(t), |w| <= limit
         |         y
    [ machine ] ------> [ law ] --+        the loop of loop.py, at rest
         ^                        |
         +------------------------+

A load acts between samples: it is any measurable signal, not one that is held. Noise of a sensor is a number for each
sample, and a reference moves at a bounded rate, from sample to sample. The statement is of the linear loop at rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from malta.arguments import describe, number, plural, positive
from malta.arrays import FloatArray, readonly
from malta.bound import Bound, at_most
from malta.display import Curves, Description, display, quantity
from malta.errors import CheckError, InputError, require_known
from malta.linear.impulses import Impulses, impulses, l1_bounds, sign_changes
from malta.loops.clearances import LEAST_SHARE, Clearance, clearances_of
from malta.loops.linear_loops import linear_loop
from malta.loops.loop import Loop
from malta.loops.sampled_loops import disturbance_map, pad, push_through, states_within
from malta.model.plant import Plant, Signal
from malta.synthesis.law_system import reference_names

PARTS = 4  # of a sample in which a load has one sign, and places of it that are looked at
MOST_PARTS = 64  # of a sample that is long beside the machine's motion
TURN = 0.2  # rad, that the machine's fastest motion turns in a part
FORGOTTEN = 1e-4  # of the value: what is left out of the beginning of the signal
CALLER = "worst_waveform"


@display
@dataclass(frozen=True, eq=False)
class WorstWaveform:
    """The bounded signal that moves an output of a loop furthest, and how far.

    disturbance : what is bounded, as it was asked for
    output : what it moves
    limit : largest size of the signal, SI
    limit_unit : its unit
    value : the largest output that the signal makes, SI; share of a clearance
    unit : of the value
    error : what any signal of this size may add to it: the tail, bounded; changes of sign within parts, estimated from
        the parts beside them; the beginning that is left out
    peak_time : s, when the output is at its largest; the signal begins at 0
    t : s, when the signal changes; the last one is the peak
    w : the signal from each of these on, +limit or -limit
    shares : of each of the machine's disturbances in the signal; none: it is no load
    sample_time : s, of the loop
    response : s and unit, the output on the way to its peak, at one place of each sample
    over : a malta.proof.worst_load.LoadBound of a load of size 1 over the box that was asked for; None: none was
    """

    disturbance: str
    output: str
    limit: float
    limit_unit: str
    value: float
    unit: str
    error: float
    peak_time: float
    t: FloatArray
    w: FloatArray
    shares: FloatArray
    sample_time: float
    response: tuple[FloatArray, FloatArray] = field(repr=False)
    over: Any = None

    @property
    def proven(self) -> Bound:
        """What no load of this size exceeds at samples, anywhere in the box, as it is shown."""
        upper = None if self.over is None else self.over.upper
        return at_most(None if upper is None else upper * self.limit)

    @property
    def at_most(self) -> Bound:
        """The value with its `error`, rounded up, as it is shown: nominal and computed, where `proven` is proven."""
        return at_most(self.value + self.error)

    def load(self, t: FloatArray) -> FloatArray:
        """The signal at times t, s, as the `disturbance` of a malta.Scenario: times x disturbances; 0 after the peak.

        Raises InputError for a signal that is no load.
        """
        if not len(self.shares):
            raise InputError("load", "disturbance", f"{self.disturbance!r}", "a load on the machine")
        if not len(self.w):  # an output that the load does not move
            return np.zeros((len(t), len(self.shares)))
        # A simulation holds what it reads over the sample.
        held = np.asarray(t, dtype=float) + 0.5 * self.sample_time
        at = np.searchsorted(self.t, held, side="right") - 1
        inside = (held >= self.t[0]) & (held < self.peak_time)
        size = np.where(inside, self.w[np.clip(at, 0, len(self.w) - 1)], 0.0)
        return np.asarray(size[:, None] * self.shares)

    @property
    def description(self) -> Description:
        """The bound, the peak's time and the signal's changes."""
        limit, value = quantity(self.limit, self.limit_unit), quantity(self.value, self.unit)
        rows = (
            (
                "reached",
                f"{value} after {quantity(self.peak_time, 's')}, {plural(len(self.t) - 2, 'change')} of sign",
            ),
            ("error", quantity(self.error, self.unit)),
            *((("in the box", f"{self.proven.text()} {self.unit} proven"),) if self.over is not None else ()),
            ("of", "the linear loop at rest; nothing is said of large motions"),
        )
        title = f"Any {self.disturbance} of {limit} moves {self.output} by at most {self.at_most.text()} {self.unit}"
        curves = Curves(self.response[0], "time [s]", {self.output: self.response[1]}, f"[{self.unit}]")
        return Description(title, rows, curves)


class _Channel(NamedTuple):
    """A bounded signal on its way to outputs, in a loop sampled at one place within its samples."""

    M: FloatArray
    C: FloatArray  # p x n, of the outputs at that place
    pushed: FloatArray  # n x parts
    direct: FloatArray  # p x parts
    within: float  # s, of the place
    is_load: bool
    sample_time: float


def nominal_waveform(
    loop: Loop, disturbance: str | Mapping[str, float], output: str, limit: float
) -> WorstWaveform:
    """The worst waveform at nominal parameters: `malta.worst_waveform` without a box."""
    if not isinstance(loop, Loop):
        raise InputError(CALLER, "loop", describe(loop), "a Loop, from malta.loop")
    size = positive(CALLER, "limit", limit)
    name = disturbance if isinstance(disturbance, str) else "load"
    contacts = loop.plant.contacts.names
    if output in contacts:
        return _of_clearance(loop, name, disturbance, contacts.index(output), size)
    unit = _unit_of(loop.plant, output)
    each = [(one, impulses(*one[:4])) for one in _channels(loop, disturbance, output)]
    channel, response = max(each, key=lambda pair: float(pair[1].norms[0] + pair[1].tail[0]))
    return _record(loop, (name, disturbance), (output, unit), size, channel, response)


def bound_any_waveform(loop: Loop, shares: FloatArray) -> FloatArray:
    """How far a load of any waveform, of size 1, moves each output at samples at most.

    shares : of each disturbance in the load

    Raises CheckError for an unstable loop.
    """
    channel = _of_load(loop, shares, pad(loop.sampled.outputs, len(loop.matrix)), None, 0.0)
    return l1_bounds(*channel[:4])


def largest_load(loop: Loop, disturbance: str | Mapping[str, float], limit: float = 1.0) -> tuple[float, str]:
    """How large a load may be, whatever its waveform, before a contact is touched, SI; and this contact.

    limit : share of a clearance that may be used; 1: what touches ends it

    Infinite where none is touched. Of the linear loop at rest; contacts by their own formula.

    Raises InputError for a machine without contacts, and otherwise as `worst_waveform`.
    """
    names = loop.plant.contacts.names
    if not names:
        raise InputError(loop.plant.name, "contacts", "none", "a machine with contacts, to be touched")
    clearances, responses = _clearances(loop, disturbance)
    ranked = sorted(clearances, key=lambda one: -one.share_of_rest(1.0, responses))
    found = ranked[0].size_at_share(responses, limit), ranked[0].name
    for one in ranked[1:]:  # few are touched before the one of which a small load uses most
        if math.isfinite(found[0]) and one.most(found[0], responses).share >= limit:
            found = min(found, (one.size_at_share(responses, limit), one.name))
    return found


def used_clearances(loop: Loop, disturbance: str | Mapping[str, float], sizes: FloatArray) -> FloatArray:
    """The share of its clearance that a load of each size uses at most, whatever its waveform: sizes x contacts.

    Of the linear loop at rest; contacts by their own formula. Raises InputError as `worst_waveform`.
    """
    clearances, responses = _clearances(loop, disturbance)
    return np.array([[one.most(size, responses).share for one in clearances] for size in sizes.tolist()])


def _unit_of(plant: Plant, output: Any) -> str:
    """The unit of an output by name. Raises InputError."""
    name = output.removeprefix("error ") if isinstance(output, str) else output
    known: dict[str, Signal] = {s.name: s for s in (*plant.outputs, *plant.inputs)}
    if not isinstance(name, str) or name not in known:
        some = " ".join([*known, *(repr(one) for one in plant.contacts.names)])
        raise InputError(CALLER, "output", describe(output), f"one of {some}")
    return known[name].unit


def _input_of(plant: Plant, disturbance: Any) -> tuple[str, FloatArray]:
    """The unit of a bounded signal, and its shares in the plant's disturbances; none where it is no load."""
    if isinstance(disturbance, str):
        kind, _, name = disturbance.rpartition(" ")
        if kind in ("noise", "rate"):
            units = {s.name: s.unit for s in plant.outputs}
            require_known([name], units, CALLER, "disturbance")
            return units[name] + ("/s" if kind == "rate" else ""), np.zeros(0)
    return load_shares(plant, disturbance)


def load_shares(plant: Plant, load: Any, caller: str = CALLER) -> tuple[str, FloatArray]:
    """The unit of a load, by name or in shares, and its shares in the plant's disturbances. Raises InputError."""
    if isinstance(load, str):
        load = {load: 1.0}
    if not isinstance(load, Mapping) or not load:
        raise InputError(caller, "disturbance", describe(load), "a name, or shares of loads by name")
    known = {s.name: s.unit for s in plant.disturbances}
    if not known:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    require_known(load, known, caller, "disturbance")
    shares = np.array([number(caller, f"disturbance.{key}", load.get(key, 0.0)) for key in known])
    if not shares.any():
        raise InputError(caller, "disturbance", "shares of 0", "a load")
    return known[next(iter(load))], shares


def _channels(loop: Loop, disturbance: Any, output: str) -> list[_Channel]:
    """The signal's way to an output, for each place within a sample that is looked at."""
    plant, s, T = loop.plant, loop.sampled, loop.sample_time
    c, (_, shares) = s.control, _input_of(plant, disturbance)
    inputs = [one.name for one in plant.inputs]
    if output.startswith("error ") and not str(disturbance).startswith("rate "):
        raise InputError(CALLER, "output", repr(output), f"{output[6:]!r}, or the rate of a reference")
    if not len(shares):
        kind, _, name = disturbance.rpartition(" ")
        if kind == "rate":
            return [_of_reference(loop, name, output)]
        j = [one.name for one in plant.outputs].index(name)
        pushed = np.vstack([s.Bd @ c.D_y, c.B_y])[:, [j]]
        C, D = _closed_rows(loop, output), np.zeros((1, 1))
        if output in inputs:
            D[:] = c.D_y[inputs.index(output), j]
        return [_Channel(s.closed, C, pushed, D, 0.0, False, T)]
    if output in inputs:
        return [_of_load(loop, shares, _closed_rows(loop, output), None, 0.0)]
    k = [one.name for one in plant.outputs].index(output)
    return [_of_load(loop, shares, None, loop.model.C[[k]], place) for place in _places(loop)]


def _closed_rows(loop: Loop, output: str) -> FloatArray:
    """The row of the closed loop's states that is an output, or a command."""
    s, plant = loop.sampled, loop.plant
    inputs = [one.name for one in plant.inputs]
    if output in inputs:
        k = inputs.index(output)
        return np.asarray(np.hstack([s.control.D_y[[k]] @ s.Cd, s.control.C[[k]]]))
    return pad(s.outputs[[[one.name for one in plant.outputs].index(output)]], len(s.closed))


def _places(loop: Loop) -> list[float]:
    """Times within a sample at which outputs are looked at, s."""
    return [loop.sample_time * k / PARTS for k in range(PARTS)]


def _of_load(
    loop: Loop, shares: FloatArray, C: FloatArray | None, of_states: FloatArray | None, place: float
) -> _Channel:
    """The way of a load to outputs of the closed loop (C), or of the design model's states at a place of a sample."""
    s, T, fastest = loop.sampled, loop.sample_time, float(np.abs(np.linalg.eigvals(loop.model.A)).max())
    parts = int(np.clip(math.ceil(fastest * T / TURN), PARTS, MOST_PARTS))
    assert s.continuous is not None
    B_w, left = disturbance_map(loop.model) @ shares[:, None], []
    for begin in np.linspace(0, T, parts + 1).tolist():  # of a load that acts from there to the sample's end
        caught = s.caught
        if caught is not None:
            caught = caught[0], caught[1]._replace(time=max(caught[1].time - begin, 0.0))
        left.append(push_through(s.continuous, B_w, T - begin, len(s.Ad), caught))
    pushed = np.hstack([a - b for a, b in pairwise(left)])
    pushed = np.vstack([pushed, np.zeros((len(s.control.A), parts))])
    if of_states is None:
        assert C is not None
        return _Channel(s.closed, C, pushed, np.zeros((len(C), parts)), 0.0, True, T)
    C = of_states @ states_within(loop.model, loop.controller, s, loop.current_loops, place)
    n, size = len(loop.model.A), len(s.continuous)
    now = [push_through(s.continuous, B_w, max(place - T * k / parts, 0.0), size) for k in range(parts + 1)]
    direct = np.hstack([of_states @ (a - b)[:n] for a, b in pairwise(now)])
    return _Channel(s.closed, C, pushed, direct, place, True, T)


def _of_reference(loop: Loop, name: str, output: str) -> _Channel:
    """The way of a reference's rate to an output beside its reference: the loop follows constant ones.

    With xi = (1 - M)^-1 B r + zeta, zeta+ = M zeta - (1 - M)^-1 B (r+ - r), and r+ - r = Ts x rate.
    """
    outputs, T = [s.name for s in loop.plant.outputs], loop.sample_time
    if not output.startswith("error "):
        wanted = f"'error {output if output in outputs else name}'"
        raise InputError(CALLER, "output", f"{output!r} of a reference", wanted)
    closed = linear_loop(loop).closed_loop()
    j = reference_names(loop.controller).index(f"{name}_ref")
    k = outputs.index(output.removeprefix("error "))
    M, C = np.eye(len(closed.A)) + T * closed.A, closed.C[[k]]
    settled = -np.linalg.solve(closed.A, closed.B[:, [j]])
    left = float((C @ settled)[0, 0] + closed.D[k, j]) - (j == k)
    if abs(left) > 1e-6:
        raise CheckError(f"{loop.controller.name}: {outputs[k]} does not follow the reference of {name}")
    return _Channel(M, C, -T * settled, np.zeros((1, 1)), 0.0, False, T)


def _record(
    loop: Loop,
    what: tuple[str, Any],
    output: tuple[str, str],
    limit: float,
    channel: _Channel,
    response: Impulses,
) -> WorstWaveform:
    """The record of a response: its signs played backwards, without the beginning that hardly counts."""
    unit, shares = _input_of(loop.plant, what[1])
    h, T, parts = response.values[0], channel.sample_time, channel.pushed.shape[1]
    sizes = np.abs(h)
    reached = np.cumsum(sizes)
    last = int(np.searchsorted(reached, (1 - FORGOTTEN) * reached[-1])) + 1 if reached[-1] > 0 else 1
    last = min(parts * math.ceil(last / parts), len(h))
    value, error = float(reached[last - 1]), float(reached[-1] - reached[last - 1] + response.tail[0])
    if channel.is_load:  # the sign may change within a part, by which it loses a quarter of its slope
        error += sign_changes(h[:last])
    signs = np.where(h[:last] < 0, -1.0, 1.0)[::-1]
    ages = T / parts * np.arange(last, 0, -1) - (T - channel.within)  # of the beginnings of parts, s
    kept = int((ages > (1e-9 * T if channel.is_load else -1e-9 * T)).sum())
    peak, changes = float(ages[0]), np.flatnonzero(np.diff(signs[:kept], prepend=0.0))
    t = np.append(peak - ages[changes], max(peak, peak - ages[kept - 1] + T / parts * (not channel.is_load)))
    motion = _convolve(signs, h[:last])[parts - 1 : last : parts]  # at this place of each sample
    times = peak - T * np.arange(len(motion) - 1, -1, -1)
    return WorstWaveform(
        what[0], output[0], limit, unit, limit * value, output[1], limit * error, peak,
        readonly(t), readonly(limit * signs[changes]), readonly(shares), T,
        (readonly(times), readonly(limit * motion)),
    )  # fmt: skip


def _convolve(one: FloatArray, other: FloatArray) -> FloatArray:
    """The convolution of two signals, by their spectra. scipy.signal, which has it too, takes 0.3 s to load."""
    size = len(one) + len(other) - 1
    spectra = (np.fft.rfft(signal, 1 << size.bit_length()) for signal in (one, other))
    return np.asarray(np.fft.irfft(np.prod(list(spectra), axis=0))[:size])


def _responses(loop: Loop, disturbance: Any) -> list[tuple[_Channel, Impulses]]:
    """What a load does to all design states, at each place of a sample. Raises InputError for what is no load."""
    _, shares = _input_of(loop.plant, disturbance)
    if not len(shares):
        raise InputError(CALLER, "disturbance", describe(disturbance), "a load, for a clearance")
    rows = np.eye(len(loop.plant.controlled))
    each = [_of_load(loop, shares, None, rows, place) for place in _places(loop)]
    return [(one, impulses(*one[:4])) for one in each]


def _clearances(loop: Loop, disturbance: Any) -> tuple[list[Clearance], list[FloatArray]]:
    """The contacts, and the responses of the design states to a load."""
    responses = [response.values for _, response in _responses(loop, disturbance)]
    return clearances_of(loop.plant, loop.model.operating_point.x), responses


def _of_clearance(loop: Loop, name: str, disturbance: Any, contact: int, size: float) -> WorstWaveform:
    """The load that uses most of a clearance, by an ascent over directions: exact where planes do not couple."""
    each = _responses(loop, disturbance)
    clearance = clearances_of(loop.plant, loop.model.operating_point.x)[contact]
    share, n, k = clearance.most(size, [response.values for _, response in each])
    channel, response = each[k]
    if not len(n) or share - clearance.rest < LEAST_SHARE:
        raise InputError(CALLER, "output", repr(clearance.name), f"a contact that {name} moves")
    rows = list(clearance.rows)
    along = Impulses((n @ response.values[rows])[None], (np.abs(n) @ response.tail[rows])[None])
    found = _record(loop, (name, disturbance), (clearance.name, "1"), size, channel, along)
    return replace(found, value=share)

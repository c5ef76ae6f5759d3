"""The curves of a loop as numbers, for plots, pages and tables: responses, poles, zeros and margins of any loop.

    at the sensors   L = -P F,  S = (I + L)^-1,  T = L S        at the forces   L = -F P, likewise
    gang of four     S, T, S P (forces -> outputs), F S (readings -> forces)
    compliance       loads -> true outputs

The grid of frequencies is logarithmic, to the Nyquist frequency of a sampled loop, finer about lightly damped poles and
wherever a curve turns. Margins are not read off it: see linear/peaks.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.display import Curves, Description, display
from malta.errors import require_known
from malta.frames import data_frame
from malta.linear.interconnection import series
from malta.linear.peaks import Crossing
from malta.linear.system import System
from malta.loops.channel_margins import ChannelMargins, channel_margins
from malta.loops.classical import crossings_at, loop_at_forces
from malta.loops.linear_loops import LinearLoop, Place, linear_loop
from malta.model.plant import Signal
from malta.processes import on_one_thread

BASE = 160  # frequencies of the logarithmic grid
DECADES = 8.0  # at most
POLE_RANGE_FACTOR = 30.0  # times the slowest and the fastest pole
TURN = 0.15  # |ln| of the ratio of neighbours, above which an interval is halved
MIN_INTERVAL = 5e-4  # of the frequency: not halved further, so that none falls on a pole on the axis
ROUNDS = 3  # of halving
MAX_ADDED_FREQUENCIES = 90  # frequencies that a round may add
RESONANCE_OFFSETS = np.array([-4.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 4.0])  # half-widths of a resonance
MIN_WIDTH = 1e-9  # relative half-width of a resonance
MAX_RESONANT_DAMPING = 0.5  # damping below which a pole makes a resonance
ZERO_POLE_SHARE = 1e-7  # of the fastest rate: poles that count as zero
CROSSING_RANGE_SHARE = 1e-9  # of the lowest frequency: as far as gain crossings are looked for
CROSSING_FREQUENCIES = 10  # frequencies from there to the lowest


class Responses(NamedTuple):
    """Frequency responses of a loop at k frequencies: p outputs, m forces, d loads."""

    w: FloatArray  # rad/s
    L: ComplexArray  # k x p x p, at the sensors
    S: ComplexArray
    T: ComplexArray
    L_forces: ComplexArray  # k x m x m
    S_forces: ComplexArray
    T_forces: ComplexArray
    SP: ComplexArray  # k x p x m: forces -> outputs
    FS: ComplexArray  # k x m x p: readings -> forces
    compliance: ComplexArray  # k x p x d: loads -> true outputs

    def cut(self, at: Place) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """L, S and T at the sensors or at the forces."""
        return (self.L, self.S, self.T) if at == "sensors" else (self.L_forces, self.S_forces, self.T_forces)

    def alone(self, at: Place) -> ComplexArray:
        """The loop gain of each channel with the others closed, T_ii / S_ii: k x channels."""
        _, S, T = self.cut(at)
        with np.errstate(all="ignore"):
            return _diagonal(T) / _diagonal(S)


@display
@dataclass(frozen=True, eq=False)
class LoopCurves:
    """The curves of one loop: responses, poles, zeros and margins. Frequencies and poles are in rad/s.

    loop : matrices and signals of the loop
    responses : L, S, T at the sensors and at the forces, gang of four and compliance at the frequencies `w`

    >>> import control, malta
    >>> curves = malta.loops.loop_curves(control.tf([4], [1, 1, 0], name="servo"))
    >>> curves.stable, curves.channels()[0].name
    (True, 'y[0]')
    >>> f"{curves.singular_values(curves.responses.S).max():.2f}"
    '2.28'
    """

    loop: LinearLoop
    responses: Responses

    @property
    def name(self) -> str:
        """The name of the loop."""
        return self.loop.name

    @property
    def w(self) -> FloatArray:
        """Frequencies, rad/s."""
        return self.responses.w

    @property
    def nyquist(self) -> float:
        """The Nyquist frequency, rad/s; infinite for a continuous loop."""
        T = self.loop.sample_time
        return np.inf if T is None else float(np.pi / T)

    @property
    def stable(self) -> bool:
        """Whether the closed loop is stable."""
        return self.loop.stable

    def channels(self, at: Place = "sensors") -> tuple[Signal, ...]:
        """The signals at which the loop is cut.

        at : "sensors" or "forces"
        """
        return self.loop.outputs if at == "sensors" else self.loop.inputs

    def channel_index(self, name: str, at: Place = "sensors") -> int:
        """The index of a channel by its name. Raises InputError for an unknown one.

        name : of the output or force
        at : where it is, "sensors" or "forces"
        """
        known = [s.name for s in self.channels(at)]
        require_known([name], known, self.name, "channel")
        return known.index(name)

    def singular_values(self, G: ComplexArray) -> FloatArray:
        """Singular values of a response, the largest first: k x n; NaN where it is infinite.

        G : k x outputs x inputs, as `responses.S`
        """
        fine = np.isfinite(G).all(axis=(1, 2))
        found = np.full((len(G), min(G.shape[1:])), np.nan)
        found[fine] = np.linalg.svd(G[fine], compute_uv=False)
        return found

    def over(self, low: float, high: float) -> LoopCurves:
        """The same curves from a lower and, of a continuous loop, to a higher frequency.

        low : lowest frequency, rad/s
        high : highest frequency, rad/s
        """
        top = min(high, self.nyquist)
        below = np.geomspace(low, self.w[0], BASE // 4)[:-1] if low < self.w[0] else np.zeros(0)
        above = np.geomspace(self.w[-1], top, BASE // 4)[1:] if top > self.w[-1] else np.zeros(0)
        more = np.concatenate([below, above])
        if not len(more):
            return self
        return LoopCurves(self.loop, _merge(self.responses, respond(self.loop, more)))

    @cached_property
    def crossings(self) -> tuple[tuple[Crossing, ...], ...]:
        """The gain crossings of each channel at the sensors, the others closed."""
        cut = self.loop.cut
        return tuple(crossings_at(cut, i) for i in cut.sensors)

    @cached_property
    def margins(self) -> tuple[ChannelMargins, ...]:
        """The margins of each channel at the sensors, the others closed."""
        return _margins(self, "sensors")

    @cached_property
    def margins_at_forces(self) -> tuple[ChannelMargins, ...]:
        """The margins of each channel at the forces, the others closed."""
        return _margins(self, "forces")

    def margins_at(self, at: Place) -> tuple[ChannelMargins, ...]:
        """The margins at the sensors or at the forces.

        at : "sensors" or "forces"
        """
        return self.margins if at == "sensors" else self.margins_at_forces

    @cached_property
    def poles(self) -> dict[str, ComplexArray]:
        """Poles of the plant, the law and the closed loop; of sampled loops ln(z) / T, without those of pure delay."""
        loop = self.loop
        open_loop = {"plant": loop.poles_of(loop.plant.A), "law": loop.poles_of(loop.law.A)}
        return open_loop | {"closed_loop": loop.closed_poles}

    @cached_property
    def zeros(self) -> ComplexArray:
        """The transmission zeros of L, finite ones, in the measure of the poles: at the sensors, or at the forces where
        there are fewer of them, since L at the sensors has no full rank then."""
        loop, p = self.loop, len(self.loop.outputs)
        P, F = loop.plant, loop.law
        u, T = len(F.C), loop.sample_time
        P = System(P.A, P.B[:, :u], P.C[:p], P.D[:p, :u])
        s = (series(P, F) if u < p else series(F, P)).zeros
        if T is None:
            return s
        z = 1 + T * s
        return np.asarray(np.log1p(T * s[(np.abs(z) > 1e-6) & (np.abs(z) < 1e3)]) / T)

    def to_pandas(self) -> Any:
        """Responses by frequency as a pandas.DataFrame, complex: "S z y1" of a loop's S from sensor y1 to z.

        Raises InputError where pandas is not installed.
        """
        names, columns = [s.name for s in self.channels()], dict[str, ComplexArray]()
        for key in ("L", "S", "T"):
            response = getattr(self.responses, key)
            for i, k in itertools.product(range(len(names)), repeat=2):
                columns[f"{key} {names[i]} {names[k]}"] = response[:, i, k]
        return data_frame(columns, ("w [rad/s]", self.w))

    @property
    def description(self) -> Description:
        """Stability, poles and the peaks of S and T."""
        peaks = {key: self.singular_values(getattr(self.responses, key))[:, 0] for key in ("S", "T")}
        rows = (
            ("closed loop", "stable" if self.stable else "UNSTABLE"),
            ("frequencies", f"{len(self.w)}, {self.w.min():.3g} .. {self.w.max():.3g} rad/s"),
            *(
                (f"largest |{key}|", f"{y.max():.3g} at {self.w[y.argmax()]:.3g} rad/s")
                for key, y in peaks.items()
            ),
            ("channels", " ".join(channel.name for channel in self.channels())),
        )
        curves = Curves(self.w, "frequency [rad/s]", peaks, "largest singular value [1]", logarithmic=True)
        return Description(f"Curves of {self.name!r}", rows, curves)


def loop_curves(
    source: Any,
    controller: Any = None,
    *,
    name: str = "",
    position: float | None = None,
    w: Sequence[float] | FloatArray | None = None,
) -> LoopCurves:
    """Compute the curves of a loop: frequency responses on a grid that fits them, poles, zeros, margins.

    source : a malta.loops.Loop; a plant; LoopSystems; a system of python-control, P or the loop gain L; or curves,
        which are returned
    controller : of the plant, or the system C of the errors (L = P C, negative feedback); None: the source has it
    name : of the loop; "": that of the controller or of the system
    position : of the stroke, m, of a plant; None: the controller's operating point
    w : frequencies, rad/s; None: a grid that fits the loop, to the Nyquist frequency

    Margins are those of one channel at a time, the others closed. An open loop that is unstable has a lower bound of
    its gain as well.

    Raises InputError for what is no loop, and CheckError where no input holds the machine.

    >>> import control, malta
    >>> unstable = malta.loops.loop_curves(control.tf([3], [1, -1])).margins[0]
    >>> [round(bound, 3) for bound in unstable.gain], unstable.encirclements
    ([0.333, inf], 1)
    """
    if isinstance(source, LoopCurves):
        return source
    loop = linear_loop(source, controller, name=name, position=position)
    if w is not None:
        return LoopCurves(loop, respond(loop, np.asarray(w, dtype=float)))
    return _refine(loop)


@on_one_thread
def respond(loop: LinearLoop, w: FloatArray) -> Responses:
    """The frequency responses of a loop at frequencies w, rad/s."""
    p, m, u = len(loop.outputs), len(loop.inputs), len(loop.law.C)
    with np.errstate(all="ignore"):
        s = loop.frequencies(w)
        whole, F = (response(s) for response in loop.responses)
        P, P_w = whole[:, :p, :u], whole[:, :p, u:]
        L, S = _at_sensors(loop, whole, F)
        L_m = -loop_at_forces(P, F, m)
        S_m = _inverse(np.eye(m) + L_m)
        read = S @ P_w
        compliance = read if len(loop.plant.C) == p else whole[:, p:, u:] + whole[:, p:, :u] @ F @ read
        return Responses(w, L, S, L @ S, L_m, S_m, L_m @ S_m, S @ P[..., :m], F[:, :m] @ S, compliance)


def _at_sensors(loop: LinearLoop, whole: ComplexArray, F: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """L and S at the sensors, from the responses of the plant with its loads and of the law."""
    p = len(loop.outputs)
    L = np.asarray(-whole[:, :p, : len(loop.law.C)] @ F)
    return L, _inverse(np.eye(p) + L)


def _inverse(M: ComplexArray) -> ComplexArray:
    """The inverses of k matrices; NaN for a singular one, as on a pole of an unstable loop."""
    try:
        return np.asarray(np.linalg.inv(M))
    except np.linalg.LinAlgError:
        found = np.full_like(M, np.nan)
        for k, one in enumerate(M):
            with suppress(np.linalg.LinAlgError):
                found[k] = np.linalg.inv(one)
        return found


def _diagonal(G: ComplexArray) -> ComplexArray:
    return np.asarray(np.einsum("kii->ki", G))


def _refine(loop: LinearLoop) -> LoopCurves:
    """The curves on a grid that is finer where they turn."""
    found = _to_crossings(loop, respond(loop, _grid(loop)))
    for _ in range(ROUNDS):
        parts = [found.alone("sensors"), found.alone("forces"), _diagonal(found.S)]
        with np.errstate(all="ignore"):
            values = np.log(np.concatenate(parts, axis=1))
            step = np.abs(values[1:].real - values[:-1].real) + np.abs(
                np.mod(values[1:].imag - values[:-1].imag + np.pi, 2 * np.pi) - np.pi
            )
        coarse = np.nan_to_num(step, nan=0.0, posinf=0.0).max(axis=1)
        coarse[np.diff(found.w) < MIN_INTERVAL * found.w[:-1]] = 0.0
        widest = np.argsort(-coarse)[:MAX_ADDED_FREQUENCIES]
        k = np.sort(widest[coarse[widest] > TURN])
        if not len(k):
            break
        found = _merge(found, respond(loop, np.sqrt(found.w[k] * found.w[k + 1])))
    return LoopCurves(loop, found)


def _to_crossings(loop: LinearLoop, found: Responses) -> Responses:
    """The same with frequencies to a gain crossing far below, as of a weak integrator beside fast poles."""
    w = found.w[0] * np.geomspace(CROSSING_RANGE_SHARE, 1.0, CROSSING_FREQUENCIES)
    far = respond(loop, w)
    with np.errstate(divide="ignore"):
        size = np.log(np.abs(np.concatenate([far.alone("sensors"), far.alone("forces")], axis=1)))
    crossed = np.flatnonzero((np.sign(size[1:]) * np.sign(size[:-1]) < 0).any(axis=1))  # not of NaN
    if not len(crossed):
        return found
    return _merge(found, respond(loop, np.geomspace(w[crossed[0]], w[-1], BASE)[:-1]))


def _merge(one: Responses, other: Responses) -> Responses:
    """Both responses in the order of frequency."""
    order = np.argsort(np.concatenate([one.w, other.w]), kind="stable")
    return Responses(*(np.concatenate(pair)[order] for pair in zip(one, other, strict=True)))


def _grid(loop: LinearLoop) -> FloatArray:
    """Frequencies from well below the slowest pole to the Nyquist frequency or well above the fastest pole, rad/s."""
    poles = np.concatenate([loop.poles_of(loop.plant.A), loop.poles_of(loop.law.A), loop.closed_poles])
    sizes = np.abs(poles)
    known = sizes[sizes > ZERO_POLE_SHARE * sizes.max(initial=0.0)]
    T = loop.sample_time
    top = (known.max() * POLE_RANGE_FACTOR if len(known) else 1e2) if T is None else np.pi / T
    low = min(known.min() / POLE_RANGE_FACTOR if len(known) else top / 1e4, top / 1e3)
    low = max(low, top / 10**DECADES)
    light = poles[(np.abs(poles.real) < MAX_RESONANT_DAMPING * sizes) & (poles.imag > 0)]
    width = np.maximum(np.abs(light.real) / np.maximum(np.abs(light), 1e-300), MIN_WIDTH)
    near = (np.abs(light.imag)[:, None] * np.exp(width[:, None] * RESONANCE_OFFSETS)).ravel()
    closed = loop.closed_poles.imag
    near = np.concatenate([near, closed[closed > 0]]) if loop.stable else near
    w = np.concatenate([np.geomspace(low, top, BASE), near[(near > low) & (near < top)]])
    return np.unique(w)


def _margins(curves: LoopCurves, at: Place) -> tuple[ChannelMargins, ...]:
    """The margins of each channel."""
    loop, cut = curves.loop, curves.loop.cut
    growing, made = int((loop.closed_poles.real >= 0).sum()), []
    for i, signal in enumerate(curves.channels(at)):
        factors = np.ones(len(curves.channels(at)))
        factors[i] = 0.0
        channel = (cut.sensors if at == "sensors" else cut.inputs)[i]
        unstable = loop.unstable_poles(factors, at), growing
        made.append(channel_margins(cut, channel, signal.name, unstable))
    return tuple(made)

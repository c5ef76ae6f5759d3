"""A set that a loop with remainders does not leave: what is proven of a linear loop, made true of a nonlinear one.

    x' = A x + B u + b w + r,   u = h F (y + e) + (d, 0),   |w| <= X,  |r| <= R(Z),  |e| <= E(Z),  |d| <= D(Z)

r is what a machine adds to the rates of its linear model, e to its readings, d to its commands, while all signals stay
within Z. By the l1 norms G of the linear loop, no signal exceeds T(Z) = G (X, R(Z), E(Z), D(Z)) as long as they do.
Where T(Z) is below Z they stay for ever: states are continuous, so that at the first time at which a signal leaves Z
it was below T(Z) until then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat
from scipy import linalg

from malta.arrays import FloatArray
from malta.linear.balls import POINTS
from malta.linear.expressions import NotAnalytic
from malta.linear.matrices import covariance
from malta.linear.uncertain import Compensator, StateGroup, UncertainSystem
from malta.proof.groups import loop_of
from malta.proof.impulse_bounds import EPS, UP, Enclosed, enclose, l1_norms, push_in_parts, reach_of, sizes_of
from malta.proof.polynomial.closed_loop import add_lag, closed_loop, dense, driven_group, join_columns
from malta.proof.polynomial.enclosure import Unproven, precision

BITS = 96  # of balls
SHARE = 3e-3  # of a norm, left to samples that are not computed
ROUNDS = 40  # of the search of a set
ROOM = 0.01  # by which a set is larger than what it is mapped to
LEAST_WIDTH = 1e-30  # half width of a signal that nothing moves
PARTS_PER_TURN, MOST_PARTS = (
    8.0,
    16,
)  # of a sample, in which a load is taken as constant, and the rest is bounded
STEPS_PER_TURN, FEWEST_STEPS, MOST_STEPS = (
    8.0,
    4,
    512,
)  # of the motion within a sample, in units of the machine's fastest rate


@dataclass(frozen=True, eq=False)
class DisturbedLoop:
    """A loop at its nominal parameters, and where it is disturbed.

    system, law : as `malta.robust_margin` takes them
    b : n x loads, what a unit of each load adds to the rates of the system's states
    commands : the first outputs of the law, to which d is added
    rows : of (y, the law's states), signals that are asked for: r x p and r x k; the first ones are the commands, to
        which d is added as well
    noise : p, rms of the readings' noise
    starts : (n + k) x starts, deviations of the system's and the law's states in which the loop may begin
    """

    system: UncertainSystem
    law: Compensator
    b: FloatArray
    commands: int
    rows: tuple[FloatArray, FloatArray]
    noise: FloatArray
    starts: FloatArray


class Remainders(NamedTuple):
    """What a machine adds to its linear model while its signals stay in a set."""

    rates: FloatArray
    readings: FloatArray
    commands: FloatArray


class SignalNorms(NamedTuple):
    """l1 norms, proven: of states at any time, of readings without their errors and of rows at samples."""

    loads: FloatArray  # signals x (loads + starts)
    rates: FloatArray  # signals x states: of what is added to each rate
    readings: FloatArray  # signals x p: of an error of each reading
    commands: FloatArray  # signals x m: of what is added to each command
    noise: FloatArray  # rms of each signal at samples by the readings' noise, computed
    matrices: tuple[Enclosed, Enclosed, Enclosed]  # A, B and C of the system

    @property
    def load(self) -> FloatArray:
        """Of each signal, of all loads and starts at once."""
        return np.asarray(self.loads.sum(axis=1))

    def of_loads(self, columns: Sequence[int]) -> SignalNorms:
        """Those of some of the loads alone."""
        return self._replace(loads=self.loads[:, list(columns)])

    def bound(self, X: float, more: Remainders) -> FloatArray:
        """How far signals go, T, without noise."""
        R, E, D = more
        return UP * (X * self.load + self.rates @ R + self.readings @ E + self.commands @ D)


class _Pieces(NamedTuple):
    """What the norms of a loop are made of: x states with lags, size states of the closed loop."""

    closed: Enclosed  # size x size
    pushed: list[
        Enclosed
    ]  # of each part of a sample: what a unit of each load, and of each rate, leaves: x x (loads + n)
    spread: FloatArray  # by how much a signal of any waveform may leave more than its mean in a part
    from_u: Enclosed
    within: tuple[FloatArray, FloatArray]  # see _within_sample
    plant: tuple[Enclosed, Enclosed, Enclosed]


def _pieces(loop: DisturbedLoop) -> _Pieces:
    """The closed loop and its inputs in balls. Raises Unproven."""
    law, uncertain = loop.law, loop_of(loop.system, loop.law)
    n, T = uncertain.states, float(law.sample_time or 0.0)
    every = StateGroup(tuple(range(n)), tuple(range(len(law.A))), None)
    with precision(BITS):
        try:
            entries = uncertain.program.run([arb(x) for x in loop.system.nominal.tolist()], POINTS)
            group = driven_group(uncertain, every, entries, arb_mat)
            M, shapes = enclose(closed_loop(group)[0]), uncertain.program.shapes
            a, b, c = (dense(arb_mat, *shape, own) for shape, own in zip(shapes, entries, strict=False))
            plant, turning = (enclose(a), enclose(b), enclose(c)), np.linalg.eigvals(sizes_of(a))
            if law.lag is not None:
                a, b, *_ = add_lag(arb_mat, a, b, c, None, arb(law.lag))
            unit = np.zeros((a.nrows(), n + loop.b.shape[1]))
            unit[:n] = np.hstack([loop.b, np.eye(n)])
            count = int(np.clip(math.ceil(PARTS_PER_TURN * T * np.abs(turning).max()), 1, MOST_PARTS))
            units = arb_mat(unit.tolist())
            pushed, spread = push_in_parts(a, units, T, count)
            within = _within_sample(a, join_columns(arb_mat, units, b), T)
        except (NotAnalytic, ZeroDivisionError) as error:
            raise Unproven(f"{error}") from error
    closed = Enclosed(M.mid + np.eye(len(M.mid)), M.rad + EPS * (np.abs(M.mid) + np.eye(len(M.mid))))
    return _Pieces(closed, pushed, spread, enclose(group.b), within, plant)


def signal_norms(loop: DisturbedLoop) -> SignalNorms:
    """The norms of a loop. Raises Unproven where it is not proven stable, or is too fast for its sample time."""
    law, own = loop.law, _pieces(loop)
    (x, k), loads = own.spread.shape, loop.b.shape[1]
    n = k - loads
    p, inputs, size, parts = law.D.shape[1], len(law.D), len(own.closed.mid), len(own.pushed)
    table, direct = _signals(loop, own.plant[2], x, size)
    through = np.hstack([law.D, np.eye(inputs, loop.commands)])  # of u, from e and d
    rounding = 8 * inputs * EPS * np.abs(own.from_u.mid)
    at_once = own.from_u.mid @ through, (own.from_u.rad + rounding) @ np.abs(through)
    into_law = np.pad(law.B, ((0, 0), (0, loop.commands)))
    columns = Enclosed(np.vstack([at_once[0], into_law]), np.vstack([at_once[1], 0 * into_law]))
    found = _norms(own.closed, table, columns, np.zeros(columns.mid.shape)) + UP * direct
    blank = np.zeros((size - x, k))
    pushed = Enclosed(
        *(
            np.hstack([np.vstack([getattr(one, kind), blank]) for one in own.pushed])
            for kind in ("mid", "rad")
        )
    )
    spread = np.hstack([np.vstack([own.spread, blank])] * parts)
    begun = _peaks(own.closed, table, loop)
    moved = _norms(own.closed, table, pushed, spread).reshape(len(found), parts, k).sum(axis=1)
    found = np.hstack([UP * moved, found, begun])
    between = own.within[0] @ found[:x] + own.within[1][:, k:] @ found[x : x + inputs]
    between[:, :k] += own.within[1][:, :k]
    found[:x] += UP * between
    heard = columns.mid[:, :p] * loop.noise
    power = np.einsum("ij,jk,ik->i", table.mid, covariance(own.closed.mid, heard @ heard.T), table.mid)
    rms = np.sqrt(power.clip(0) + (direct[:, :p] ** 2) @ loop.noise**2)
    kept = [*range(n), *range(x + inputs, len(found))]
    ends = [loads, k, k + p, k + p + loop.commands]
    load, rates, readings, commands, start = np.split(found[kept], ends, axis=1)
    return SignalNorms(np.hstack([load, start]), rates, readings, commands, rms[kept], own.plant)


def _peaks(M: Enclosed, rows: Enclosed, loop: DisturbedLoop) -> FloatArray:
    """The largest |c M^i s| of each row from each start s."""
    n, k = len(loop.b), len(loop.law.A)
    s = np.zeros((len(M.mid), loop.starts.shape[1]))
    s[:n], s[len(M.mid) - k :] = loop.starts[:n], loop.starts[n:]
    return _norms(M, rows, Enclosed(s, 0 * s), 0 * s, largest=True)


def _signals(loop: DisturbedLoop, C: Enclosed, x: int, size: int) -> tuple[Enclosed, FloatArray]:
    """Rows of the closed loop's states: states with lags, u, y and further ones; what e and d are in them at once."""
    law, p = loop.law, len(C.mid)
    of_y = np.vstack([law.D, np.eye(p), loop.rows[0]])
    of_law = np.vstack([law.C, np.zeros((p, len(law.A))), loop.rows[1]])
    mid, rad = np.zeros((2, x + len(of_y), size))
    mid[:x, :x] = np.eye(x)
    mid[x:, : C.mid.shape[1]], mid[x:, size - len(law.A) :] = of_y @ C.mid, of_law
    rad[x:, : C.mid.shape[1]] = np.abs(of_y) @ (C.rad + 4 * (p + 2) * EPS * np.abs(C.mid))
    direct = np.zeros((len(mid), p + loop.commands))
    direct[x:, :p] = np.abs(of_y)
    readings = x + len(law.D)
    direct[readings : readings + p] = 0  # without their errors
    direct[x : x + loop.commands, p:] = np.eye(loop.commands)
    direct[readings + p : readings + p + loop.commands, p:] = np.eye(loop.commands)
    return Enclosed(mid, rad), direct


def _norms(
    M: Enclosed, rows: Enclosed, columns: Enclosed, spread: FloatArray, *, largest: bool = False
) -> FloatArray:
    """`l1_norms` of rows, each in the part of the loop that acts on it: responses of slow loops are long."""
    joins = reach_of((M.mid != 0) | (M.rad != 0))
    found = np.zeros((len(rows.mid), columns.mid.shape[1]))
    acting = ((rows.mid != 0) | (rows.rad != 0)) @ joins
    for states in np.unique(acting, axis=0):
        if not (states.any() and columns.mid.size):
            continue
        own, part = np.flatnonzero((acting == states).all(axis=1)), np.flatnonzero(states)
        every = np.arange(columns.mid.shape[1])
        for row in own:
            one = M.part(part, part), rows.part([row], part), columns.part(part, every), spread[part]
            found[row] = l1_norms(*one, SHARE, largest=largest)[1][0]
    return found


def _within_sample(a: Any, b: Any, T: float) -> tuple[FloatArray, FloatArray]:
    """Bounds of |e^(a t) - 1| and of the integral of |e^(a t) b| up to any time t of a sample, entry by entry."""
    n, rate = a.nrows(), sizes_of(a)
    count = int(
        np.clip(np.ceil(STEPS_PER_TURN * T * np.abs(np.linalg.eigvals(rate)).max()), FEWEST_STEPS, MOST_STEPS)
    )
    step = (a * (arb(T) / count)).exp()
    grow = linalg.expm(rate * (T / count)) * UP
    apart, caught = np.zeros((n, n)), np.zeros((n, b.ncols()))
    power = dense(arb_mat, n, n, ((i, i, 1) for i in range(n)))
    for _ in range(count):
        # Of a step from here: e^(a (t + d)) - 1 = e^(a t) - 1 + e^(a t) (e^(a d) - 1).
        size = sizes_of(power)
        apart = np.maximum(apart, sizes_of(power - 1) + size @ (grow - np.eye(n)))
        caught += (sizes_of(power * b) + size @ (grow - np.eye(n)) @ sizes_of(b)) * (T / count)
        power = power * step
    if not (np.isfinite(apart).all() and np.isfinite(caught).all()):
        raise Unproven("a machine that is too fast for its sample time")
    return UP * apart, UP * caught


def held_set(
    norms: SignalNorms, noise: FloatArray, X: float, remainders: Callable[[FloatArray], Remainders]
) -> FloatArray:
    """Bounds of the signals under any load of at most X, from rest.

    noise : of each signal, what the linear loop makes of the sensors' noise at most
    remainders : half widths of a set -> what is added in it; raises Unproven where the machine is none of the model's

    Raises Unproven, with the reason, where no set is found.
    """
    none = np.zeros(len(norms.loads))
    T = noise + norms.bound(X, remainders(none))
    for _ in range(ROUNDS):
        Z = (1 + ROOM) * T + LEAST_WIDTH
        T = noise + norms.bound(X, remainders(Z))
        if (T < Z).all():
            return T
        if not np.isfinite(T).all():
            break
    raise Unproven("what is not linear may drive the machine away")

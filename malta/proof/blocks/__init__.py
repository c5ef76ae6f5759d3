"""Complex blocks in a loop: unmodelled dynamics, and the fictitious blocks of gains.

A block Delta reads a signal z of the loop and adds w = Delta z to another:

    multiplicative   sensors or forces pass 1 + Delta            z, w at the same channels
    feedback         sensors or forces pass 1 / (1 - Delta)
    additive         P + Delta, from forces (behind lag, hold and delay) to sensors
    compliance       from the plant's outputs to a force on the plant: its gain is (1 - P F)^-1 P
    effort           from commands to the sensors: its gain is F (1 - P F)^-1

With entry (i, j) of a block as one more parameter of the plant, the loop's characteristic polynomial is affine in it,
as a determinant is in an entry of rank one; its change from zero to -unit gives M_ji f, M the transfer from w to z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.arguments import describe, is_number
from malta.display import display
from malta.errors import InputError
from malta.linear.uncertain import Compensator, UncertainSystem

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray


# The size of unmodelled dynamics: a weight W(s), expanded on intervals of frequency.
#
# On a cell (branch, from, to) of the search, x = x0 + h t with -1 <= t <= 1 is v / 2^scale or its inverse, and
#
#     W = W_0 + W_1 t + rest,
#
# as the quotient of Taylor's expansions of numerator and denominator. v is the frequency of a continuous loop; of a
# sampled one v = tan(w T / 2).


class Expanded(NamedTuple):
    """W on cells: W_0 + W_1 t, and a bound of the error."""

    value: ComplexArray
    slope: ComplexArray
    rest: FloatArray

    def times(self, share: float) -> Expanded:
        return Expanded(share * self.value, share * self.slope, share * self.rest * (1 + 1e-12))


@dataclass(frozen=True, eq=False)
class Weight:
    """W = num / den, coefficients in s, the lowest power first."""

    num: FloatArray
    den: FloatArray

    @property
    def most(self) -> float:
        """An upper bound of |W| at all frequencies; infinite when it is not a number."""
        return float(abs(self.num[0] / self.den[0])) if len(self.den) == 1 else math.inf

    def at(self, w: FloatArray) -> FloatArray:
        """|W(jw)|."""
        s = 1j * np.asarray(w, dtype=float)
        return np.abs(np.polyval(self.num[::-1], s) / np.polyval(self.den[::-1], s))

    def on(self, cells: FloatArray, scale: int, T: float | None) -> Expanded:
        """W on cells (rows of branch, from, to) in units of 2^scale; T: sample time, s."""
        x, h = (cells[:, 2] + cells[:, 1]) / 2, (cells[:, 2] - cells[:, 1]) / 2 * (1 + 1e-12)
        none = np.zeros(len(cells), dtype=complex)
        if len(self.den) == 1:
            return Expanded(none + self.num[0] / self.den[0], none, none.real)
        inverse = cells[:, 0] == 1
        if T is not None:
            unit = np.where(inverse, 2.0**-scale, 2.0**scale)
            v, end = x * unit, (np.abs(x) + h) * unit
            z = np.where(inverse, math.pi / 2 - np.arctan(v), np.arctan(v)) * 2 / T
            slope = none + h * unit / (1 + v**2) * 2 / T * np.where(inverse, -1, 1)
            bent = (h * unit) ** 2 * end / (1 + np.maximum(v - h * unit, 0) ** 2) ** 2 * 2 / T
            num, den = self.num * _turns(self.num, 0), self.den * _turns(self.den, 0)
            return _quotient(num, den, z, slope.astype(complex), bent)
        found = [
            _quotient(num * _turns(num, power, turn), den * _turns(den, power, turn), x, h + 0j, none.real)
            for num, den, power, turn in (
                (self.num, self.den, scale, 1j),
                (self.num[::-1], self.den[::-1], -scale, -1j),
            )
        ]
        return Expanded(*(np.where(inverse, high, low) for low, high in zip(*found, strict=True)))


def _turns(c: FloatArray, power: int, turn: complex = 1j) -> ComplexArray:
    """s^k = (turn 2^power)^k x^k."""
    k = np.arange(len(c))
    return np.asarray(turn**k * 2.0 ** (power * k))


def _quotient(
    num: ComplexArray, den: ComplexArray, z: FloatArray, slope: ComplexArray, bent: FloatArray
) -> Expanded:
    """num / den at z + slope t + rest, |rest| <= bent."""
    n, d = _taylor(num, z, slope, bent), _taylor(den, z, slope, bent)
    value = n.value / d.value
    rate = (n.slope - value * d.slope) / d.value
    room = np.abs(d.value) - np.abs(d.slope) - d.rest
    left = n.rest + np.abs(value) * d.rest + np.abs(rate) * (np.abs(d.slope) + d.rest)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Expanded(value, rate, np.where(room > 0, left / room, np.inf) * (1 + 1e-9))


def _taylor(c: ComplexArray, z: FloatArray, slope: ComplexArray, bent: FloatArray) -> Expanded:
    """A polynomial at z + slope t + rest; higher terms and rounding in the bound."""
    far = np.abs(slope) + bent
    derived, terms = np.polynomial.Polynomial(c), list[Any]()
    for m in range(len(c)):
        terms.append(derived(z) / math.factorial(m))
        derived = derived.deriv()
    first = terms[1] if len(terms) > 1 else 0 * terms[0]
    rest = np.abs(first) * bent + sum(np.abs(x) * far ** (m + 2) for m, x in enumerate(terms[2:]))
    rounding = 1e-13 * np.polynomial.polynomial.polyval(np.abs(z) + far, np.abs(c))
    return Expanded(np.asarray(terms[0], dtype=complex), first * slope, rest * (1 + 1e-12) + rounding)


def weight_of(weight: Any, where: str) -> Weight:
    """W as a record. Raises InputError for anything but a positive number or a stable, proper W(s)."""
    expected = "a number above zero, or a transfer function"
    if is_number(weight):
        if not float(weight) > 0:
            raise InputError(where, "weight", describe(weight), expected)
        return Weight(np.array([float(weight)]), np.ones(1))
    if type(weight).__name__ == "StateSpace":
        import control

        weight = control.ss2tf(weight)
    try:
        single = np.shape(weight.num)[:2] == (1, 1) or (len(weight.num), len(weight.num[0])) == (1, 1)
        num, den = (np.asarray(c[0][0], dtype=float) for c in (weight.num, weight.den))
        with np.errstate(all="ignore"):
            stable, continuous = bool((weight.poles().real < 0).all()), not weight.dt
    except (AttributeError, TypeError, ValueError, IndexError, np.linalg.LinAlgError):
        raise InputError(where, "weight", describe(weight), expected) from None
    if not single:
        raise InputError(where, "weight", "several inputs or outputs", "one of each")
    num, den = np.trim_zeros(num, "f"), np.trim_zeros(den, "f")
    known = len(num) and np.isfinite([*num, *den]).all()
    if not (known and stable and continuous and len(num) <= len(den)):
        raise InputError(where, "weight", "not stable, not proper or discrete", "a stable, proper one in s")
    return Weight(np.concatenate([np.zeros(len(den) - len(num)), num])[::-1], den[::-1])


At = Literal["sensors", "forces"]
Channels = int | tuple[int, ...]
MAX_BLOCKS = 4  # blocks: 2^4 polynomials


@display
@dataclass(frozen=True, eq=False)
class Dynamic:
    """Unmodelled dynamics: Delta stable, of largest singular value `|Delta(jw)| <= |W(jw)|` in the modelled set.

    In a sampled loop Delta acts on samples, of readings or of held commands: a discrete-time system with
    `|Delta(e^jwT)| <= |W(jw)|` up to the Nyquist frequency. Aliases of a continuous Delta between hold and sampler are
    not covered; they are small when Delta is small above that frequency.

    weight : W, a number or a control.TransferFunction in s; of kind "additive" in units of the sensor over those of the
        force
    kind : "multiplicative" (a gain 1 + Delta), "feedback" (1 / (1 - Delta)) or "additive" (P + Delta)
    at : "sensors" or "forces", where a multiplicative or feedback block acts
    channel : counted from 0; several of them, as a tuple, share one full block; of an additive block (sensors, forces)
    shares : of a multiplicative or feedback block, the share of W by which each of its channels may deviate, above 0:
        Delta = diag(shares) Delta', |Delta'| <= |W|; (): all of it

    >>> import control, malta
    >>> W = control.tf([1 / 500, 0.1], [1 / 5000, 1])  # 10 %, from 50 rad/s on more
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> found = malta.dynamic_margin(motor, [[-2.0]], {}, malta.proof.Dynamic(W))
    >>> f"{found.lower:.1f}"  # |T| = 2 / 3 and |W| = 0.1 at w = 0
    '15.0'
    """

    weight: Any
    kind: Literal["multiplicative", "feedback", "additive"] = "multiplicative"
    at: At = "sensors"
    channel: Channels | tuple[Channels, Channels] = 0
    shares: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Block:
    """A block of a proof: w enters at `rows`, z is read at `columns`; unit: size of the probes of its entries; shares:
    by which each entry of w enters, (): 1."""

    kind: Literal["multiplicative", "feedback", "additive", "compliance", "effort"]
    at: At
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    weight: Weight
    unit: float = 0.5
    shares: tuple[float, ...] = ()

    @property
    def entering(self) -> FloatArray:
        """By how much each entry of w enters."""
        return np.array(self.shares) if self.shares else np.ones(len(self.rows))

    @property
    def full(self) -> bool:
        return len(self.rows) > 1 or len(self.columns) > 1

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Row and column of each entry within the block."""
        return [(i, j) for i in range(len(self.rows)) for j in range(len(self.columns))]


def shape_of(system: UncertainSystem) -> tuple[int, int]:
    """The numbers of sensors and forces."""
    return system.matrices.size1_out(2), system.matrices.size2_out(1)


def blocks_of(system: UncertainSystem, declared: Any, where: str) -> list[Block]:
    """The blocks of one or several declared dynamics; where: the function that an error names.

    Raises InputError for invalid weights, kinds and channels.
    """
    several = [declared] if isinstance(declared, Dynamic) else declared
    if not isinstance(several, (list, tuple)) or not all(isinstance(d, Dynamic) for d in several):
        found = ", ".join(type(d).__name__ for d in several) if isinstance(several, (list, tuple)) else ""
        raise InputError(
            where, "dynamics", found or type(declared).__name__, "malta.proof.Dynamic, one or a list"
        )
    return [_block_of(system, d, where) for d in several]


def _block_of(system: UncertainSystem, dynamic: Dynamic, where: str) -> Block:
    weight = weight_of(dynamic.weight, where)
    if dynamic.kind == "additive":
        both = dynamic.channel
        if not isinstance(both, tuple) or len(both) != 2:
            raise InputError(where, "channel", repr(both), "(sensors, forces) of an additive block")
        rows, columns = (
            channels_of(c, k, name, where) for c, k, name in zip(both, shape_of(system), _NAMES, strict=True)
        )
        return Block("additive", "sensors", rows, columns, weight)
    if dynamic.kind not in ("multiplicative", "feedback") or dynamic.at not in _NAMES:
        expected = "multiplicative, feedback or additive; sensors or forces"
        raise InputError(where, "kind, at", f"{dynamic.kind}, {dynamic.at}", expected)
    count = shape_of(system)[_NAMES.index(dynamic.at)]
    channels = channels_of(dynamic.channel, count, dynamic.at, where)
    shares = tuple(float(share) for share in dynamic.shares)
    if shares and not (len(shares) == len(channels) and all(0 < share < math.inf for share in shares)):
        raise InputError(
            where, "shares", repr(dynamic.shares), f"{len(channels)} numbers above 0, of the channels"
        )
    if len(shares) == 1:
        weight, shares = replace(weight, num=shares[0] * weight.num), ()
    return Block(dynamic.kind, dynamic.at, channels, channels, weight, shares=shares)


_NAMES = ("sensors", "forces")


def channels_of(channel: Any, count: int, name: str, where: str) -> tuple[int, ...]:
    """One channel or several as a tuple. Raises InputError."""
    found = channel if isinstance(channel, tuple) else (channel,)
    known = all(isinstance(c, Integral) and not isinstance(c, bool) and 0 <= int(c) < count for c in found)
    if not found or not known:
        range_of = f"0, {name} are counted from 0" if count == 1 else f"{name} from 0 to {count - 1}"
        raise InputError(where, "channel", repr(channel), range_of)
    if len(set(found)) < len(found):
        raise InputError(where, "channel", repr(channel), f"each of the {name} once")
    return tuple(int(c) for c in found)


def check_blocks(blocks: Sequence[Block], where: str) -> None:
    """Raise InputError for more blocks, or more full ones, than a proof supports."""
    full = sum(b.full for b in blocks)
    if len(blocks) > MAX_BLOCKS or full > 1:
        found = f"{len(blocks)} complex blocks, {full} of them full"
        raise InputError(where, "dynamics", found, f"at most {MAX_BLOCKS}, at most one of them full")


# the plant with the entries of blocks as parameters


def probe(
    system: UncertainSystem, law: Compensator, blocks: Sequence[Block]
) -> tuple[UncertainSystem, Compensator]:
    """The loop with one more parameter for each entry of each block, zero at the nominal; blocks act in their order.

    A compliance or an effort is the last block.
    """
    count = sum(len(b.entries) for b in blocks)
    p, d = ca.SX.sym("p", len(system.names)), ca.SX.sym("d", count)
    made = [ca.SX(M) for M in system.matrices.call([p])]
    m, q = made[1].shape[1], made[2].shape[0]
    if len(made) < 4:
        made.append(ca.SX(q, m))
    wiring, k = _Wiring(made, law, ca.SX.eye(q), ca.SX(q, m), ca.SX.eye(m)), 0
    for b in blocks:
        delta = ca.SX(len(b.rows), len(b.columns))
        for i, j in b.entries:
            delta[i, j] = d[k]
            k += 1
        wiring = wiring.join(b, delta)
    behind = any(b.kind in ("additive", "compliance", "effort") for b in blocks)
    if behind and law.lag is not None:
        wiring = wiring.with_lags()
    matrices, law = wiring.close()
    f = ca.Function("probed", [ca.vertcat(p, d)], [ca.cse(M) for M in matrices])
    names = (*system.names, *(f"Delta {i + 1}" for i in range(count)))
    limits = (*system.limits, *[(-np.inf, np.inf)] * count) if system.limits else ()
    nominal = np.concatenate([system.nominal, np.zeros(count)])
    return UncertainSystem(names, nominal, f, limits, system.sample_time, system.approximate), law


@dataclass(frozen=True, eq=False)
class _Wiring:
    """Which signals blocks join: y = G (C x + D F h u) + H h u, forces F h u on the plant; h is lag, hold and delay."""

    made: list[ca.SX]  # A, B, C, D, and E where there is one
    law: Compensator
    G: ca.SX  # sensors x sensors
    H: ca.SX  # sensors x forces
    F: ca.SX  # forces x forces
    last: tuple[Block, ca.SX] | None = None  # compliance or effort
    lags: int = 0  # the last states: h u

    def join(self, b: Block, delta: ca.SX) -> _Wiring:
        if b.kind in ("compliance", "effort"):
            return replace(self, last=(b, delta))
        if b.kind == "additive":
            return replace(self, H=_add(self.H, b, delta))
        gain = _add(ca.SX.eye((self.G if b.at == "sensors" else self.F).shape[0]), b, delta)
        if b.at == "forces":
            return replace(self, F=gain @ self.F)
        return replace(self, G=gain @ self.G, H=gain @ self.H)

    def with_lags(self) -> _Wiring:
        """Turn lags into states, so that they act on commands alone and not on the signals of blocks."""
        A, B, C, D, *E = self.made
        n, m = B.shape
        rate = float(self.law.lag or 0.0)
        A = ca.blockcat([[A, B @ self.F], [ca.SX(m, n), -rate * ca.SX.eye(m)]])
        made = [A, ca.vertcat(B, ca.SX(m, m)), ca.horzcat(C, ca.SX(C.shape[0], m)), D]
        made += [ca.diagcat(e, ca.SX.eye(m)) for e in E]
        return replace(self, made=made, law=replace(self.law, lag=None), lags=m)

    def close(self) -> tuple[list[ca.SX], Compensator]:
        """A, B, C, D, perhaps E, and the law; a last D of zeros is left out."""
        A, B, C, D, *E = self.made
        n, m, q = A.shape[0], B.shape[1], C.shape[0]
        drive, read, through, direct = B @ self.F, C, self.G @ D @ self.F + self.H, D @ self.F
        C = self.G @ C
        if self.lags:
            rate = -A[n - 1, n - 1]
            drive = ca.vertcat(ca.SX(n - m, m), rate * ca.SX.eye(m))
            C[:, n - m :] = through
            read[:, n - m :] = direct
            through, direct = ca.SX(q, m), ca.SX(q, m)
        law, rows = self.law, ca.horzcat(through)
        if self.last is not None:
            b, delta = self.last
            i, j, k = list(b.rows), list(b.columns), len(b.columns)
            if b.kind == "compliance":
                push = D[:, i] @ delta
                drive = ca.horzcat(drive, B[:, i] @ delta)
                C = ca.vertcat(C, read[j, :])
                rows = ca.blockcat([[through, self.G @ push], [direct[j, :], push[j, :]]])
                law = _widen(law, outputs=k, reads=np.eye(k))
            else:
                drive = ca.horzcat(drive, ca.SX(n, k))
                rows = ca.horzcat(through, _add(ca.SX(q, k), replace(b, columns=tuple(range(k))), delta))
                law = _widen(law, echoes=j)
        if rows.nnz() or E:
            return [A, drive, C, rows, *E], law
        return [A, drive, C], law


def _add(matrix: ca.SX, b: Block, delta: ca.SX) -> ca.SX:
    """Add a block's entries to a matrix at its rows and columns."""
    found = ca.SX(matrix)
    for i, j in b.entries:
        found[b.rows[i], b.columns[j]] += float(b.entering[i]) * delta[i, j]
    return found


def _widen(
    law: Compensator, outputs: int = 0, reads: FloatArray | None = None, echoes: Sequence[int] = ()
) -> Compensator:
    """A law that passes further readings on as further inputs, or repeats some of its commands."""
    A, B, C, D = law.A, law.B, law.C, law.D
    if echoes:
        return replace(law, C=np.vstack([C, C[list(echoes)]]), D=np.vstack([D, D[list(echoes)]]))
    assert reads is not None
    m, q = D.shape
    D = np.block([[D, np.zeros((m, outputs))], [np.zeros((outputs, q)), reads]])
    return replace(
        law, B=np.hstack([B, np.zeros((len(A), outputs))]), C=np.vstack([C, np.zeros((outputs, len(A)))]), D=D
    )

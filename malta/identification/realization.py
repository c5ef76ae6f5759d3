"""A linear model of any machine from its logs alone: without equations, parameters or the law.

At a line w of the excitation a log has Fourier coefficients V of what goes in and Y of what comes out, and

    Y = e^(-i w delay) G V,   G = C (p - A)^-1 B       p = (z - 1) / T,  z = e^(i w T);  p = i w without a sample time

With s = p / (1 + p T / 2) over the highest line, powers of q = (1 + s) / (1 - s) lie on the unit circle. Stacked,

    [Y; q Y; q^2 Y; ...] = O X + Gamma [V; q V; q^2 V; ...]

and what V does not explain of the left side has the columns of O, whose shift is A (McKelvey, Akcay and Ljung, IEEE
Trans. Automatic Control 41(7), 1996). So a line may excite any inputs, and A may be unstable. B is linear then; A, B, C
and the delay are refined to the likeliest ones, with the noise between the lines that V and Y have together. Under a
law this is the indirect method: the excitation is the instrument, and what the law makes of noise biases nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import logm
from scipy.optimize import least_squares

from malta.arguments import describe, is_number
from malta.arrays import ComplexArray, FloatArray, readonly
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.identification.frequency_response import FrequencyResponse
from malta.identification.log import Log
from malta.identification.spectra import coefficients_of
from malta.linear.system import System
from malta.model.linear.machine import linear_machine
from malta.model.plant import Plant
from malta.model.signals import Signal

ROWS = 10  # states at least, among which singular values tell the order
COLUMN_SHARE = 0.7  # of the numbers of all lines, that stacked inputs and outputs may fill
LEAST_POWER = 1e-10  # of stacked noise in any direction, as a share of a line's
MIN_GAP = 7.0  # between singular values, which tells an order
MIN_MOTION = 1e-6  # of the inputs, least of any direction beside the largest
QUIET_SHARE = 1e-6  # of an output, least noise that its lines are taken to have
MAX_VALUE = 1e100  # of a response, whose square is a number
RESPONSE_ERROR = 0.01  # of a response without noise, beside which its lines are weighed
MAX_STEPS = 100  # of a refinement
STEP_GAIN = 1e-6  # of chi2: a step that gains less is the last one
MAX_TURN = 3.1  # rad a sample: a pole beyond has no continuous one
MAX_CONDITION = 1e6  # of outputs and their rates, which are states below it
MAX_MISS = 0.2  # of the response on fresh data, that the model may miss beside noise


class Lines(NamedTuple):
    """What a record has at its lines: inputs, outputs, and the covariance of both by noise."""

    source: str
    group: str  # of the inputs in a log
    sample_time: float  # s; 0: continuous
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    w: FloatArray  # k, rad/s
    V: ComplexArray  # k x m
    Y: ComplexArray  # k x p
    noise: ComplexArray  # k x (p + m) x (p + m), outputs first; of a response 1 % of each value

    @property
    def p(self) -> ComplexArray:
        """(z - 1) / T, or i w."""
        T = self.sample_time
        return np.asarray(np.expm1(1j * self.w * T) / T if T else 1j * self.w)

    def residuals(self, G: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """e = Y - G V, k x p; its covariance by noise, k x p x p; and the likeliest V without noise, k x m."""
        p = G.shape[1]
        row = np.concatenate([np.tile(np.eye(p), (len(G), 1, 1)), -G], axis=2).conj().transpose(0, 2, 1)
        e, both = self.Y - np.einsum("kpm,km->kp", G, self.V), self.noise @ row
        C = row.conj().transpose(0, 2, 1) @ both
        return e, C, self.V - (both[:, p:] @ np.linalg.solve(C, e[..., None]))[..., 0]


class DelayedModel(NamedTuple):
    """e^(-i w delay) C (p - A)^-1 B."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    delay: float

    def response(self, lines: Lines) -> ComplexArray:
        """k x p x m."""
        late = np.exp(-1j * lines.w * self.delay)[:, None, None]
        return np.asarray(late * (self.C @ _resolvents(self.A, lines.p) @ self.B))


@display
@dataclass(frozen=True, eq=False)
class Realization:
    """A linear model that was realized from a record.

    lines : the record at the lines of its excitation, with its source, inputs and outputs
    system : from inputs to outputs without the delay, SI; sampled, unless the record was a continuous response
    delay : of the outputs behind the inputs, s; the hold of a sampled system is not in it
    singular_values : of the stacked outputs without what inputs explain, over those of noise; as many stand out as
        there are states

    >>> import malta
    >>> import numpy as np
    >>> from malta.identification import FrequencyResponse
    >>> w = np.geomspace(10, 1000, 30)
    >>> found = malta.realize(FrequencyResponse("P", w, 2 / ((1j * w) ** 2 - 1e4)))
    >>> found.plant.name, round(found.fit["y"], 6)
    ('realized', 100.0)
    """

    lines: Lines
    system: System
    delay: float
    singular_values: FloatArray

    @property
    def order(self) -> int:
        """The number of states."""
        return len(self.system.A)

    @property
    def gap(self) -> float:
        """The singular value of the last state over the next one, or over 1, which noise has."""
        s, n = self.singular_values, self.order
        return float(s[n - 1] / s[n : n + 1].max(initial=1.0))

    @cached_property
    def poles(self) -> ComplexArray:
        """Of the model, rad/s, by their real parts; those above 0 are unstable."""
        found, T = self.system.poles, self.system.dt
        return np.sort_complex(found if T is None else np.log(found.astype(complex)) / T)

    def response(self, w: FloatArray) -> ComplexArray:
        """The response with its delay, outputs by inputs: k x p x m.

        w : k frequencies, rad/s
        """
        w, T = np.asarray(w, dtype=float), self.system.dt
        s = 1j * w if T is None else np.exp(1j * w * T)
        return np.asarray(self.system.response(s) * np.exp(-1j * w * self.delay)[:, None, None])

    def responses(self) -> dict[str, FrequencyResponse]:
        """The responses at the lines, by name: "P x1/fx_B1" from the input fx_B1 to the output x1."""
        w = np.unique(self.lines.w)
        names = [f"P {out.name}/{into.name}" for out in self.lines.outputs for into in self.lines.inputs]
        G = self.response(w).reshape(len(w), -1).T
        return {name: FrequencyResponse(name, w, g) for name, g in zip(names, G, strict=True)}

    @cached_property
    def _residuals(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        return self.lines.residuals(self.response(self.lines.w))

    @property
    def fit(self) -> dict[str, float]:
        """By output, 100 (1 - |Y - G V| / |Y|) at the lines, %."""
        missed = np.linalg.norm(self._residuals[0], axis=0) / np.linalg.norm(self.lines.Y, axis=0)
        names = [s.name for s in self.lines.outputs]
        return dict(zip(names, (100 * (1 - missed)).tolist(), strict=True))

    @property
    def chi2(self) -> float:
        """The mean square of the residuals in standard deviations: 1 where noise alone is left."""
        e, C, _ = self._residuals
        return float((e.conj() * np.linalg.solve(C, e[..., None])[..., 0]).real.mean())

    @property
    def refusal(self) -> str:
        """Why the model does not hold for the record of its lines; "": it does."""
        e, C, _ = self._residuals
        beside = (np.abs(e) ** 2 - np.einsum("kpp->kp", C).real).sum(axis=0)
        miss = np.sqrt(np.maximum(beside, 0.0)) / np.linalg.norm(self.lines.Y, axis=0)
        k = int(miss.argmax())
        if miss[k] <= MAX_MISS:
            return ""
        found = f"{100 * miss[k]:.3g} % of {self.lines.outputs[k].name} on {self.lines.source} beside noise"
        return f"the model misses {found}, at most {100 * MAX_MISS:g} % are asked"

    def validate(self, record: Any) -> Realization:
        """The same model with the lines of another record: how well it predicts what it has not seen.

        record : as `malta.realize` takes it, with the same signals

        Raises InputError and CheckError as `malta.realize`.
        """
        return replace(self, lines=_require_same(self.lines, _lines_of(record, self.lines.group)))

    @cached_property
    def plant(self) -> Plant:
        """The model as a machine x' = A x + B u, y = C x with the delay as its computation time.

        States are the outputs and their rates, where these determine the state well. One parameter, `gain`,
        multiplies all inputs: a robust margin may ask for it. Raises CheckError for a sampled system that no continuous
        one has under a hold.
        """
        A, B, C, _ = self.system
        n, m, p, T = len(A), B.shape[1], len(C), self.system.dt
        if T is not None:
            if (np.abs(np.angle(np.linalg.eigvals(A))) > MAX_TURN).any():
                raise CheckError(f"{self.lines.source}: a pole at half the sampling rate: name another order")
            held = logm(np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])).real / T
            A, B = held[:n, :n], held[:n, n:]
        rates = np.vstack([C, C @ A])[:n]
        size = np.linalg.norm(rates, axis=1, keepdims=True)
        if len(rates) == n and np.linalg.cond(rates / size) < MAX_CONDITION:
            A, B, C = rates @ np.linalg.solve(rates.T, A.T).T, rates @ B, np.linalg.solve(rates.T, C.T).T
            A[: max(n - p, 0)], C[:n] = np.eye(n)[p:], np.eye(n)[:p]
        return linear_machine(
            A, 0 * B, C, name="realized", inputs=self.lines.inputs, outputs=self.lines.outputs, nominal={"gain": 1.0},
            terms={"gain": (None, B)}, computation_time=self.delay,
        )  # fmt: skip

    @property
    def description(self) -> Description:
        """Its states, delay and unstable poles, and how well it fits the record of its lines."""
        unstable = " ".join(f"{one:.4g}" for one in self.poles.real if one > 0)
        rows = (
            ("states", f"{self.order}; singular values fall {self.gap:.3g} times there"),
            ("delay", quantity(self.delay, "s")),
            ("unstable", f"poles of {unstable} rad/s" if unstable else "no pole"),
            ("fit [%]", ", ".join(f"{name} {value:.2f}" for name, value in self.fit.items())),
            ("chi2", f"{self.chi2:.3g}"),
        )
        return Description(f"Linear model on {self.lines.source!r}", rows)


def realize(
    source: Any, order: int | None = None, *, inputs: str = "v", delay: float | None = None
) -> Realization:
    """Realize a linear model from what a record or a response shows of a machine: no equations are needed.

        y = e^(-s delay) C (p - A)^-1 B u          see `malta.identification.realization`

    The machine may be unstable and under any law. Of a log only the lines of its periodic excitation count, so that
    feedback does not bias the model: what noise moves beside them is left out, and what falls on them fades with the
    length of the log. Nothing is known of frequencies beyond the lines.

    source : a Log, or a list of some of one machine, with a periodic excitation of all inputs; a FrequencyResponse,
        which is continuous; or a control.FrequencyResponseData, which may have a sample time
    order : states; None: where the singular values have their largest gap
    inputs : of a log, "v": commands, or "i": measured currents
    delay : of the outputs behind the inputs, s; None: sought, 0 at least

    Returns a Realization: its `plant` is for `malta.lqg` and `malta.loop`, its `system` for python-control.

    Raises InputError for signals that are missing, an order beyond the lines, and what is no record. Raises CheckError
    for logs that tell nothing, inputs that do not move independently, and singular values without a gap.

    >>> import malta
    >>> import numpy as np
    >>> from malta.identification import FrequencyResponse
    >>> w = np.geomspace(10, 1000, 30)
    >>> found = malta.realize(FrequencyResponse("P", w, 2 / ((1j * w) ** 2 - 1e4)))
    >>> found.order, found.poles.real.round(3).tolist()
    (2, [-100.0, 100.0])
    """
    lines = _lines_of(source, inputs)
    own, unit, sizes = _in_band_units(lines)
    p, m = map(len, sizes)
    asked = order if isinstance(order, int) else 0
    rows = min(-(-max(ROWS, 3 * p, asked) // p) + 1, int(COLUMN_SHARE * 2 * len(own.w) / (p + m)))
    most = max(0, (rows - 1) * p)
    if most < 1 or (order is not None and not (type(order) is int and 1 <= order <= most)):
        wanted = f"1 to {most}, or more lines than {len(own.w)}" if most else f"more lines than {len(own.w)}"
        raise InputError("realize", "order", describe(order), wanted)
    if delay is not None and not (is_number(delay) and delay >= 0):
        raise InputError("realize", "delay", describe(delay), "a time of 0 s or more")
    s, space = _output_space(own, rows)
    gaps = (s / np.maximum(np.append(s[1:], 0.0), 1.0))[:most]
    n = order or int(gaps.argmax()) + 1
    if order is None and gaps[n - 1] < MIN_GAP:
        found = " ".join(f"{one:.3g}" for one in s[:most])
        raise CheckError(f"{lines.source}: singular values {found} have no gap that tells an order: name one")
    model = _best_model(own, space[:, :n], None if delay is None else delay * unit)
    A, B, C, T = model.A * unit, model.B * unit / sizes[1], model.C * sizes[0][:, None], lines.sample_time
    names = (tuple(one.name for one in signals) for signals in (lines.inputs, lines.outputs))
    A, B = (np.eye(n) + T * A, T * B) if T else (A, B)
    system = System(A, B, C, np.zeros((p, m)), None, T or None, (), *names).balanced
    return Realization(lines, system, model.delay / unit, readonly(s))


def _lines_of(source: Any, group: str) -> Lines:
    """The lines of a record or a response. Raises InputError and CheckError as `realize`."""
    if isinstance(source, FrequencyResponse):
        one = Signal("u", "1"), Signal("y", source.unit or "1")
        return _lines_of_response(source.name, 0.0, one[:1], one[1:], source.w, source.values[:, None, None])
    if all(hasattr(source, name) for name in ("omega", "frdata", "input_labels")):
        ins, outs = (tuple(Signal(n, "1") for n in of) for of in (source.input_labels, source.output_labels))
        T = 0.0 if source.dt in (None, True) else float(source.dt)
        return _lines_of_response("FRD", T, ins, outs, source.omega, np.moveaxis(source.frdata, 2, 0))
    logs = [source] if isinstance(source, Log) else list(source) if isinstance(source, list | tuple) else []
    if not logs or not all(isinstance(log, Log) for log in logs):
        raise InputError("realize", "source", describe(source), "logs, a FrequencyResponse or a control.FRD")
    first, *others = [_lines_of_log(log, group) for log in logs]
    parts = [first, *(_require_same(first, other) for other in others)]
    name = ", ".join(part.source for part in parts)
    w, V, Y, noise = (np.concatenate(table) for table in zip(*(part[5:] for part in parts), strict=True))
    return first._replace(source=name, w=w, V=V, Y=Y, noise=noise)


def _require_same(first: Lines, other: Lines) -> Lines:
    """The other record. Raises InputError for another sample time or other signals than the first one has."""
    if not np.isclose(other.sample_time, first.sample_time, rtol=1e-3) or other[3:5] != first[3:5]:
        raise InputError(other.source, "", "other signals or another sample time", f"those of {first.source}")
    return other


def _lines_of_log(log: Log, group: str) -> Lines:
    for one in ("y", group):
        if one not in ("y", "v", "i") or not log.names(one):
            raise InputError(
                log.source, "inputs", f"no columns of {describe(one)}", "v (commands) or i (currents)"
            )
    sent = log.columns.get("excitation", np.zeros((log.samples, 0)))
    w, _, (Y, V), noise = coefficients_of(log, sent, [log.columns["y"], log.columns[group]])
    ins, outs = (tuple(Signal(s.name, s.unit) for s in log.signals[one]) for one in (group, "y"))
    return Lines(log.source, group, log.sample_time, ins, outs, w, V, Y, noise)


def _lines_of_response(
    name: str, T: float, ins: tuple[Signal, ...], outs: tuple[Signal, ...], w: FloatArray, G: ComplexArray
) -> Lines:
    """A line for each input at each frequency, weighed by the size of what it moves."""
    w, G = np.asarray(w, dtype=float), np.asarray(G, dtype=complex)
    rising = len(w) == len(G) and (np.diff(w, prepend=0.0) > 0).all() and not (T and (w >= np.pi / T).any())
    if not rising or not (np.abs(G) < MAX_VALUE).all():
        expected = "finite values at rising frequencies, above 0 and below half of the sampling rate"
        raise InputError("realize", name, "frequencies or values out of range", expected)
    k, p, m = G.shape
    Y, V = G.transpose(0, 2, 1).reshape(k * m, p), np.tile(np.eye(m, dtype=complex), (k, 1))
    size = RESPONSE_ERROR * np.maximum(np.abs(Y), 1e-3 * np.abs(Y).max(axis=0))
    noise = np.zeros((k * m, p + m, p + m), dtype=complex)
    noise[:, range(p), range(p)] = size**2
    return Lines(name, "v", T, ins, outs, np.repeat(w, m), V, Y, noise)


def _in_band_units(lines: Lines) -> tuple[Lines, float, list[FloatArray]]:
    """The lines with frequencies over that of the highest and signals over their size; these, outputs first.

    Raises CheckError for inputs that do not move independently of each other, and an output that does not move.
    """
    p, m = lines.Y.shape[1], lines.V.shape[1]
    sizes = [np.sqrt((np.abs(table) ** 2).mean(axis=0)) for table in (lines.Y, lines.V)]
    moved = np.linalg.svd(lines.V / np.maximum(sizes[1], 1e-300), compute_uv=False)
    if len(moved) < m or moved[-1] <= MIN_MOTION * moved[0] or not sizes[0].all():
        found = "inputs do not move independently of each other, or an output not at all"
        raise CheckError(f"{lines.source}: {found}")
    unit, units = float(np.abs(lines.p).max()), np.concatenate(sizes)
    noise = lines.noise / np.outer(units, units)
    noise[:, range(p), range(p)] += QUIET_SHARE**2
    scaled = lines._replace(
        sample_time=lines.sample_time * unit, w=lines.w / unit, V=lines.V / sizes[1], Y=lines.Y / sizes[0],
        noise=noise,
    )  # fmt: skip
    return scaled, unit, sizes


def _output_space(lines: Lines, rows: int) -> tuple[FloatArray, FloatArray]:
    """Singular values and directions of `rows` stacked outputs without what the inputs explain, beside their noise."""
    p, half = lines.Y.shape[1], lines.sample_time / 2
    q = (1 + (1 + half) * lines.p) / (1 - (1 - half) * lines.p)
    weight = 1 / np.sqrt(np.einsum("kpp->k", lines.noise[:, :p, :p]).real)
    powers = q[:, None] ** np.arange(rows)
    V, Y = (
        np.einsum("k,kr,km->rmk", weight, powers, table).reshape(-1, len(q)) for table in (lines.V, lines.Y)
    )
    both = np.vstack([V, Y])
    R = np.asarray(np.linalg.qr(np.hstack([both.real, both.imag]).T, mode="r")).T
    noise = (powers.T @ powers.conj()).real + LEAST_POWER * len(q) * np.eye(rows)
    L = np.kron(np.linalg.cholesky(noise), np.eye(p))
    directions, s, _ = np.linalg.svd(np.linalg.solve(L, R[len(V) :, len(V) :]))
    return s, L @ directions


def _resolvents(A: FloatArray, p: ComplexArray) -> ComplexArray:
    return np.asarray(np.linalg.inv(p[:, None, None] * np.eye(len(A)) - A))


def _first_model(lines: Lines, space: FloatArray, delay: float) -> DelayedModel:
    """A and C by the shift of the stacked outputs, B by least squares."""
    p, n, m, half = lines.Y.shape[1], space.shape[1], lines.V.shape[1], lines.sample_time / 2
    F = np.linalg.lstsq(space[:-p], space[p:], rcond=None)[0]
    back = np.linalg.inv((1 - half) * F + (1 + half) * np.eye(n))
    powers = np.hstack([np.linalg.matrix_power(F, k) for k in range(len(space) // p)])
    blocks = np.hstack(np.split(space, len(space) // p))
    A, C = (F - np.eye(n)) @ back, np.linalg.lstsq(powers.T, blocks.T, rcond=None)[0].T @ back
    W = np.linalg.inv(np.linalg.cholesky(lines.noise[:, :p, :p]))
    V = lines.V * np.exp(-1j * lines.w * delay)[:, None]
    M = np.einsum("kpn,km->kpnm", W @ C @ _resolvents(A, lines.p), V).reshape(-1, n * m)
    r = np.einsum("kpq,kq->kp", W, lines.Y).ravel()
    B = np.linalg.lstsq(np.vstack([M.real, M.imag]), np.concatenate([r.real, r.imag]), rcond=None)[0]
    even = System(A, B.reshape(n, m), C, np.zeros((p, m))).balanced
    return DelayedModel(even.A, even.B, even.C, delay)


def _white(lines: Lines, model: DelayedModel) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Residuals in standard deviations, real parts first; the weights that make them so; and V without noise."""
    e, C, V = lines.residuals(model.response(lines))
    W = np.linalg.inv(np.linalg.cholesky(C))
    white = np.einsum("kpq,kq->kp", W, e).ravel()
    return np.concatenate([white.real, white.imag]), W, V


def _best_model(lines: Lines, space: FloatArray, delay: float | None) -> DelayedModel:
    """The likeliest model; without a delay sought from none, and from one of a radian at the highest line."""
    found = []
    for start in (0.0, 1 / float(lines.w.max())) if delay is None else (delay,):
        one = _likeliest(lines, _first_model(lines, space, start), free=delay is None)
        if one.delay < 0:
            one = _likeliest(lines, _first_model(lines, space, 0.0), free=False)
        found.append(one)
    return min(found, key=lambda model: float((_white(lines, model)[0] ** 2).sum()))


def _likeliest(lines: Lines, model: DelayedModel, *, free: bool) -> DelayedModel:
    """The likeliest model, with inputs and outputs as noisy as they are; with a free delay that too.

    It minimizes e' C^-1 e, e = Y - G V, in which noise of V counts in C (Pintelon and Schoukens, ch. 8). The slopes of
    this sum follow from those of G times the likeliest V without noise: under a law that is what the excitation makes.
    """
    shapes = [M.shape for M in model[:3]]
    ends = np.cumsum([rows * columns for rows, columns in shapes])

    def model_of(theta: FloatArray) -> DelayedModel:
        A, B, C = (part.reshape(shape) for part, shape in zip(np.split(theta, ends)[:3], shapes, strict=True))
        return DelayedModel(A, B, C, float(theta[-1]) if free else model.delay)

    start = np.concatenate([*(M.ravel() for M in model[:3]), [model.delay][: int(free)]])

    def residuals(theta: FloatArray) -> FloatArray:
        return _white(lines, model_of(theta))[0]

    def slopes(theta: FloatArray) -> FloatArray:
        return _slopes(lines, model_of(theta), free=free)

    found = least_squares(residuals, start, slopes, max_nfev=MAX_STEPS, ftol=STEP_GAIN)
    return model_of(found.x)


def _slopes(lines: Lines, model: DelayedModel, *, free: bool) -> FloatArray:
    """The slopes of -W G V, real parts first, in the entries of A, B and C, and in the delay."""
    A, B, C, delay = model
    _, W, V = _white(lines, model)
    V = V * np.exp(-1j * lines.w * delay)[:, None]
    R, k = _resolvents(A, lines.p), len(lines.w)
    x, left = np.einsum("kij,jm,km->ki", R, B, V), W @ C @ R
    pairs = ((left, x), (left, V), (W, x))
    parts = [np.einsum("kpi,kj->kpij", a, b).reshape(k * len(C), -1) for a, b in pairs]
    late = np.einsum("k,kpi,ki->kp", -1j * lines.w, W @ C, x).reshape(-1, 1)
    J = -np.hstack([*parts, late] if free else parts)
    return np.vstack([J.real, J.imag])

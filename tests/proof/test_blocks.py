"""Complex blocks of every kind: published gains, determinants by another route, random blocks, systems with D and E."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import control
import numpy as np
import pytest
from along_travel import at_place
from hypothesis import given, settings, strategies as st

import malta
from malta.errors import InputError
from malta.linear.open_loops import responses
from malta.proof import Dynamic
from malta.proof.blocks import Block, probe, weight_of
from malta.proof.blocks.transfer import LoopSignals, mu_bound, performance, transfer

ONE = weight_of(1.0, "")


def law_of(A: Any, B: Any, C: Any, D: Any, **more: Any) -> malta.proof.Compensator:
    a, b, c, d = (np.array(M, dtype=float) for M in (A, B, C, D))
    return malta.proof.Compensator(a, b, c, d, **more)


def pid(Kp: float, Ki: float, Kd: float, Tf: float) -> control.TransferFunction:
    return -(control.tf([Kp], [1]) + control.tf([Ki], [1, 0]) + control.tf([Kd, 0], [Tf, 1]))


# published


def test_the_worst_case_gain_of_an_integrator_with_additive_dynamics() -> None:
    """MATLAB's page of wcgain: 1/s + Delta, |Delta| <= 0.4, pid(2, 0, -0.04, 0.02): |S| in 5.1036 .. 5.1140."""
    s = malta.uncertain(lambda a: ([[a]], [[1]], [[1]]), {"a": 0.0})
    C = -(control.tf([2], [1]) + control.tf([-0.04, 0], [0.02, 1]))
    m = malta.worst_case_gain(s, C, {}, dynamics=[Dynamic(0.4, "additive", channel=(0, 0))], tolerance=1e-3)
    assert m.upper is not None
    assert 5.1036 <= m.lower <= m.upper <= 5.1140
    w = np.geomspace(1, 100, 400_001)  # one loop: |S_0| / (1 - 0.4 |C S_0|)
    K = 2 - 0.04j * w / (0.02j * w + 1)
    S = 1 / np.abs(1 + K / (1j * w))
    assert m.lower == pytest.approx(float((S / (1 - 0.4 * np.abs(K) * S)).max()), rel=1e-7)


def satellite() -> tuple[malta.proof.UncertainSystem, malta.proof.Compensator]:
    """A spinning satellite (Doyle; Skogestad and Postlethwaite, section 3.7): T = [[1, 10], [-10, 1]] / (s + 1)."""
    s = malta.uncertain(lambda a: ([[0, a], [-a, 0]], np.eye(2), [[1, 10], [-10, 1]]), {"a": 10.0})
    return s, law_of(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), -np.eye(2))


@pytest.mark.parametrize("at", ["sensors", "forces"])
def test_a_full_block_of_the_satellite(at: Any) -> None:
    """The largest singular value of T is sqrt(101), at w = 0: lost at its reciprocal."""
    s, F = satellite()
    m = malta.dynamic_margin(s, F, {}, Dynamic(1.0, at=at, channel=(0, 1)))
    assert m.upper == pytest.approx(1 / math.sqrt(101), rel=1e-6)
    assert m.lower is not None
    assert 0.998 * m.upper <= m.lower <= m.upper
    T = malta.worst_case_gain(s, F, {}, of="complementary", at=at, channel=None)
    assert T.upper is not None
    assert T.lower == pytest.approx(math.sqrt(101), rel=1e-6)
    assert T.lower <= T.upper <= 1.004 * T.lower


def test_two_blocks_of_the_satellite_are_no_better() -> None:
    """Diagonal dynamics reach the same sqrt(101): the real e_1 = -e_2 = 1 / sqrt(101) is one of them."""
    s, F = satellite()
    each = [Dynamic(1.0, channel=0), Dynamic(1.0, channel=1)]
    m = malta.dynamic_margin(s, F, {}, each)
    assert m.upper == pytest.approx(1 / math.sqrt(101), rel=1e-6)
    assert m.lower is not None
    assert 0.998 * m.upper <= m.lower <= m.upper


# identities


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([None, 0.05]), st.sampled_from([None, 30.0]), st.booleans())
def test_the_blocks_close_the_loop_as_m_says(
    seed: int, T: float | None, lag: float | None, direct: bool
) -> None:
    """det(1 - M Delta) by frequency responses is the ratio of the return differences with and without the blocks."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(3, 3)) - 3 * np.eye(3), rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    D = 0.2 * rng.normal(size=(2, 2))
    s = malta.uncertain(lambda k: (A * k, B, C, D) if direct else (A * k, B, C), {"k": 1.0})
    F = law_of(np.eye(2) * (-2 if T is None else 0.6), rng.normal(size=(2, 2)) * 0.3, rng.normal(size=(2, 2)),
               rng.normal(size=(2, 2)) * 0.2, sample_time=T, lag=lag)  # fmt: skip
    kinds = [("multiplicative", "sensors", 0, 0), ("feedback", "forces", 1, 1), ("additive", "sensors", 1, 0)]
    last = rng.choice(["compliance", "effort", "multiplicative", "feedback"])
    kinds.append((str(last), "sensors", 1, 1 if last in ("multiplicative", "feedback") else 0))
    blocks = [Block(kind, at, (i,), (j,), ONE) for kind, at, i, j in kinds]  # type: ignore[arg-type]
    d = rng.normal(size=4) * 0.3
    back = np.array([b.kind == "feedback" for b in blocks])
    entries = np.where(back, d / (1 - d), d)  # a gain 1 + entry = 1 / (1 - d)
    w, p = np.array([0.3, 2.0, 20.0]), np.array([1.1])
    wide, law = probe(s, F, blocks)

    def difference(entries: np.ndarray[Any, Any]) -> Any:
        r = responses(wide, law, np.append(p, entries), w)
        return np.linalg.det(np.eye(r.G_y.shape[1]) - r.G_y @ r.F)

    ratio = difference(entries) / difference(0 * entries) * np.prod(1 - d[back])
    M = transfer(LoopSignals(responses(s, F, p, w)), blocks)
    assert ratio == pytest.approx(np.linalg.det(np.eye(4) - M @ np.diag(d)), rel=1e-9)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_bounds_of_mu_are_reached_by_their_delta(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shapes = [[(1, 1), (1, 1)], [(1, 1), (1, 1), (1, 1)], [(1, 1), (2, 3)], [(2, 2)]][seed % 4]
    blocks = [Block("additive", "sensors", tuple(range(r)), tuple(range(c)), ONE) for r, c in shapes]
    rows, columns = (sum(s[k] for s in shapes) for k in (0, 1))
    M = rng.normal(size=(5, columns, rows)) + 1j * rng.normal(size=(5, columns, rows))
    mu, delta = mu_bound(M, blocks)
    for one, size, d in zip(M, mu, delta, strict=True):
        assert np.linalg.norm(d, 2) == pytest.approx(1, rel=1e-9)
        assert np.abs(np.linalg.eigvals(one @ d)).max() == pytest.approx(size, rel=1e-6)
        assert size <= np.linalg.norm(one, 2) * (1 + 1e-9)
    if len(shapes) == 2:
        scaled = M / (1.5 * mu[:, None, None])
        gain = performance(scaled, blocks)
        a, b = scaled.copy(), scaled.copy()
        a[:, shapes[0][1] :] /= (1.001 * gain)[:, None, None]
        b[:, shapes[0][1] :] /= (0.999 * gain)[:, None, None]
        assert (mu_bound(a, blocks)[0] < 1).all()
        assert (mu_bound(b, blocks)[0] > 1 - 1e-9).all()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.booleans(), st.sampled_from([None, 1e-3, 0.7]))
def test_expansions_hold_the_weight(seed: int, inverse: bool, T: float | None) -> None:
    """W at random frequencies of random cells, against W_0 + W_1 t and its bound; narrow cells leave little out."""
    rng = np.random.default_rng(seed)
    zeros, poles = -(10.0 ** rng.uniform(-3, 3, 2)), -(10.0 ** rng.uniform(-3, 3, 2))
    W = control.zpk(zeros, poles, 1.0)
    weight = weight_of(control.tf(W), "")
    scale, low = int(rng.integers(-8, 12)), float(10 ** rng.uniform(-2, 1))
    high = low * (1 + 10 ** rng.uniform(-4, -1))
    found = weight.on(np.array([[float(inverse), low, high]]), scale, T)
    t = rng.uniform(-1, 1, 50)
    x = (low + high) / 2 + (high - low) / 2 * t
    v = 2.0**scale / x if inverse else 2.0**scale * x
    w = v if T is None else 2 * np.arctan(v) / T
    exact = W(1j * w)
    assert (np.abs(exact - found.value - found.slope * t) <= found.rest + 1e-12 * np.abs(exact)).all()
    assert found.rest[0] <= 60 * (high / low - 1) ** 2 * np.abs(exact).max() + 1e-9
    assert weight.at(w) == pytest.approx(np.abs(exact), rel=1e-9)


# closed forms and random blocks


def test_compliance_and_effort_of_a_mass_in_closed_form() -> None:
    """m x'' = u + d, u = -k x - c x': compliance 1 / (m s^2 + c s + k), effort -(k, c) m s^2 / (m s^2 + c s + k)."""
    k, c, m, share = 4.0, 0.5, 2.0, 0.3
    s = malta.uncertain(lambda m: ([[0, 1], [0, 0]], [[0], [1 / m]], np.eye(2)), {"m": m})
    F = law_of(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), [[-k, -c]])
    found = malta.worst_case_gain(s, F, {"m": share}, of="compliance", channel=(0, 0), tolerance=1e-3)
    heavy = m * (1 + share)
    expected = 1 / (c * math.sqrt(k / heavy - (c / heavy) ** 2 / 4))
    assert found.lower == pytest.approx(expected, rel=1e-8)
    assert found.upper is not None
    assert expected <= found.upper <= 1.002 * expected
    assert found.witness == pytest.approx({"m": heavy})
    both = malta.worst_case_gain(s, F, {"m": share}, of="effort", channel=(0, (0, 1)), tolerance=1e-3)
    w = np.geomspace(0.1, 100, 40_001)
    size = max(
        float((np.hypot(k, c) * M * w**2 / np.abs(k - M * w**2 + 1j * c * w)).max())
        for M in np.linspace(m * (1 - share), heavy, 61)
    )
    assert both.upper is not None
    assert size * (1 - 1e-9) <= both.upper <= 1.003 * size
    assert both.lower == pytest.approx(size, rel=1e-4)


@pytest.mark.slow
def test_compliance_of_the_flagship_in_its_travel() -> None:
    """Axial compliance of the sampled loop, by frequency responses of 60 machines."""
    from malta import gains
    from malta.margins.travel import travel_loops
    from malta.model.plants import plant_of

    c = gains.read("design/gains/robust.json")
    plant = plant_of(c.parameters)
    ((s, law),), over = travel_loops(plant, c, ("m", "K_A"), "lag")  # whose inputs are forces
    m = malta.worst_case_gain(s, law, {"m": 0.2, "K_A": 0.2}, over, of="compliance", channel=(4, 4))
    assert m.upper is not None
    assert m.lower <= m.upper <= 1.02 * m.lower
    rng, w, worst = np.random.default_rng(5), np.geomspace(1, 3000, 300), 0.0
    block = Block("compliance", "sensors", (4,), (4,), ONE)
    for _ in range(60):
        shares = 0.2 * np.clip(rng.uniform(-2, 2, 3), -1, 1)[:2]
        p = at_place(s, shares, float(rng.uniform(-plant.stroke.travel, plant.stroke.travel)))
        worst = max(worst, float(np.abs(transfer(LoopSignals(responses(s, law, p, w)), [block])).max()))
    assert 0.9 * m.lower < worst <= m.upper


@pytest.mark.slow
def test_several_blocks_beside_parameters() -> None:
    """No random machine and no Delta within the proven set comes to det(1 - M Delta) = 0; the witness does."""
    s = malta.uncertain(lambda k: ([[0, 1], [-k, -1.8]], [[0], [18]], [[1, 0]]), {"k": 10.0})
    W = control.tf([0.4, 0.2], [0.1, 1])
    every = [Dynamic(W), Dynamic(0.2, "feedback", at="forces"), Dynamic(0.002, "additive", channel=(0, 0))]
    F = pid(2.3, 3, 0.38, 0.001)
    m = malta.dynamic_margin(s, F, {"k": 0.4}, every)
    assert m.lower is not None
    assert m.witness is not None
    assert m.frequency is not None
    assert 0.998 * m.upper <= m.lower <= m.upper
    from malta.proof.blocks import blocks_of
    from malta.proof.robust import law_of as converted

    law, blocks = converted(s, F), blocks_of(s, every, "")

    def mu(p: np.ndarray[Any, Any], w: np.ndarray[Any, Any]) -> Any:
        sizes = np.array([b.weight.at(w) for b in blocks]).T
        return mu_bound(transfer(LoopSignals(responses(s, law, p, w)), blocks) * sizes[:, :, None], blocks)[0]

    w = np.geomspace(0.1, 1e4, 800)
    for k in 10 + 4 * m.lower * np.linspace(-1, 1, 11):
        assert (mu(np.array([k]), w) * m.lower < 1).all()
    at = mu(np.array([m.witness["k"]]), np.array([m.frequency]))
    assert float(at[0]) * m.upper == pytest.approx(1, rel=1e-6)


@pytest.mark.slow_for("direct", "discrete")
@pytest.mark.parametrize("kind", ["direct", "descriptor", "discrete"])
def test_gains_of_systems_beyond_a_b_c(kind: str) -> None:
    """S of y = P u, u = -0.4 y, on a grid of parameters and frequencies by the transfer function itself."""
    ks, K = np.linspace(0.5, 1.5, 41), 0.4
    w = np.geomspace(1e-3, math.pi if kind == "discrete" else 1e4, 4001)
    if kind == "direct":
        s = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]], [[-k]]), {"k": 1.0})
        P = [k / (1j * w + 1) - k for k in ks]
    elif kind == "descriptor":
        A, B, C, D = [[0, 1], [-1, -0.4]], [[0], [1]], [[1, 0]], [[0]]
        s = malta.uncertain(lambda k: (A, B, C, D, [[1, 0], [0, k]]), {"k": 1.0})
        P = [1 / (-k * w**2 + 0.4j * w + 1) for k in ks]
    else:
        s = malta.uncertain(lambda k: ([[0.9 * k - 0.2]], [[1.0]], [[1.0]]), {"k": 0.8}, sample_time=1.0)
        ks = np.linspace(0.4, 1.2, 41)
        P = [1 / (np.exp(1j * w) - (0.9 * k - 0.2)) for k in ks]
    expected = max(float(np.abs(1 / (1 + K * p)).max()) for p in P)
    m = malta.worst_case_gain(s, [[-K]], {"k": 0.5}, tolerance=1e-3)
    assert m.upper is not None
    assert m.lower == pytest.approx(expected, rel=2e-3)
    assert expected * (1 - 1e-9) <= m.upper <= 1.003 * expected
    d = malta.dynamic_margin(s, [[-K]], {"k": 0.5}, Dynamic(0.3))
    assert d.lower is not None
    assert 0.99 * d.upper <= d.lower <= d.upper


@pytest.mark.slow
def test_the_nominal_loss_is_found_in_any_box() -> None:
    """Sensors whose gain peaks at the nominal k: parameters that move only help, and the loss is the nominal one."""
    s = malta.uncertain(
        lambda k: ([[0, 1], [-1, -0.2]], [[0], [1]], [[1 / (1 + 25 * (k - 1) * (k - 1)), 0]]), {"k": 1.0}
    )
    alone = malta.dynamic_margin(s, [[-0.5]], {}, Dynamic(0.5))
    for sides in ((0.8, 1.2), (0.95, 1.9), (0.1, 1.05)):
        m = malta.dynamic_margin(s, [[-0.5]], {"k": sides}, Dynamic(0.5))
        assert m.upper == pytest.approx(alone.upper, rel=1e-6)
        assert m.lower is not None
        assert 0.99 * m.upper <= m.lower <= m.upper


@pytest.mark.slow
def test_a_block_that_nothing_passes_at_the_nominal() -> None:
    """T = 2 k / (s + 1 + 2 k): 0.5 t |T| = 1 at w = 0 and k = -t, where t^2 + 2 t = 1; nothing at the nominal k = 0."""
    s = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 0.0})
    m = malta.dynamic_margin(s, [[-2.0]], {"k": (-1.0, 1.0)}, Dynamic(0.5))
    exact = math.sqrt(2) - 1
    assert m.upper == pytest.approx(exact, rel=1e-6)
    assert m.lower is not None
    assert 0.99 * exact <= m.lower <= exact * (1 + 1e-9)


def test_a_gain_of_nothing_is_proven_small() -> None:
    s = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    for of, channel in (("complementary", 0), ("effort", (0, 0))):
        m = malta.worst_case_gain(s, [[0.0]], {"k": 0.5}, of=of, channel=channel)  # type: ignore[arg-type]
        assert m.lower == 0
        assert m.upper is not None
        assert m.upper <= 1e-6


@pytest.mark.parametrize(
    "weight",
    [np.float64(0.5), np.float32(0.5), np.int64(1), 1, control.ss([[-2.0]], [[1.0]], [[1.0]], [[0.1]])],
)
def test_weights_of_every_kind(weight: Any) -> None:
    s = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    m = malta.dynamic_margin(s, [[-2.0]], {}, Dynamic(weight))
    size = (
        weight if not isinstance(weight, control.StateSpace) else 0.6
    )  # at w = 0, where T = 2 / 3 is largest
    assert m.upper == pytest.approx(1.5 / float(size), rel=1e-6)


def test_a_pole_at_zero_and_a_single_block_of_dynamics() -> None:
    """Deadbeat: nothing warns. |T| = 0.5 / |z|, and S with 20 % of dynamics at most 1.5 / (1 - 0.1)."""
    s = malta.uncertain(lambda k: ([[0.5]], [[k]], [[1.0]]), {"k": 1.0}, sample_time=0.1)
    m = malta.dynamic_margin(s, [[-0.5]], {}, Dynamic(0.2))
    assert m.upper == pytest.approx(10, rel=1e-9)
    g = malta.worst_case_gain(s, [[-0.5]], {}, dynamics=Dynamic(0.2), tolerance=1e-3)
    assert g.upper is not None
    assert g.lower == pytest.approx(1.5 / 0.9, rel=1e-6)
    assert g.upper < 1.005 * g.lower


@pytest.mark.slow
def test_the_time_is_kept() -> None:
    """A loop of six states and six parameters with three blocks, sampled with lag and delay, within the time asked."""
    rng = np.random.default_rng(0)
    A, B, C = rng.normal(size=(6, 6)) - 4 * np.eye(6), rng.normal(size=(6, 2)), rng.normal(size=(2, 6))

    def of(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any) -> Any:
        return A * a - np.diag([b, c, d, e, f, 1]), B, C

    s = malta.uncertain(of, dict.fromkeys("abcdef", 1.0))
    F = law_of(0.5 * np.eye(2), 0.1 * np.eye(2), 0.1 * np.eye(2), -0.1 * np.eye(2),
               sample_time=0.05, lag=30.0, delay=1)  # fmt: skip
    blocks = [Dynamic(0.1), Dynamic(0.1, channel=1), Dynamic(0.1, at="forces", channel=(0, 1))]
    begun = clock.process_time()
    m = malta.dynamic_margin(s, F, dict.fromkeys("abcdef", 0.1), blocks, time=1.0)
    assert clock.process_time() - begun < 6
    assert m.lower is None or m.lower <= m.upper


@pytest.mark.parametrize(
    ("blocks", "says"),
    [
        ([], "at least one"),
        (None, "malta.proof.Dynamic, one or a list"),
        ([Dynamic(control.tf([[[1], [5]], [[5], [5]]], [[[1], [1]], [[1], [1]]]))], "one of each"),
        ([Dynamic(10**400)], "above zero"),
        ([Dynamic(True)], "a number above zero"),
        ([Dynamic(0.1, channel=True)], "sensors from 0 to 1"),
        ([Dynamic(0.1)] * 5, "at most 4"),
        ([Dynamic(0.1, channel=(0, 1)), Dynamic(0.1, at="forces", channel=(0, 1))], "one of them full"),
        ([Dynamic(0.1, "additive")], "of an additive block"),
        ([Dynamic(0.1, "additive", channel=(0, 2))], "0, forces are counted|forces from 0"),
        ([Dynamic(0.1, channel=(1, 1))], "each of the sensors once"),
        ([Dynamic(0.1, channel=1.0)], "sensors from 0 to 1"),  # type: ignore[arg-type]
        (["much"], "malta.proof.Dynamic, one or a list"),
    ],
)
def test_blocks_that_cannot_be_taken_get_one_sentence(blocks: Any, says: str) -> None:
    s, F = satellite()
    with pytest.raises(InputError, match=says):
        malta.dynamic_margin(s, F, {"a": 0.1}, blocks)


@pytest.mark.parametrize("function", ["dynamic", "gain"])
@pytest.mark.parametrize("more", [{"time": 0}, {"time": -1.0}, {"time": math.nan}, {"time": "a"},
                                  {"tolerance": math.inf}, {"tolerance": None}, {"tolerance": "a"}])  # fmt: skip
def test_time_and_tolerance_are_checked(function: str, more: dict[str, Any]) -> None:
    s, F = satellite()
    asked = malta.dynamic_margin if function == "dynamic" else malta.worst_case_gain
    given: tuple[Any, ...] = (Dynamic(0.1),) if function == "dynamic" else ()
    with pytest.raises(InputError, match="above"):
        asked(s, F, {"a": 0.1}, *given, **more)


@pytest.mark.parametrize(
    "wrong", [{"ranges": {"b": 0.1}}, {"ranges": {"a": "much"}}, {"over": {"b": (1, 2)}}, {"system": None}]
)
def test_messages_name_the_function_that_was_asked(wrong: dict[str, Any]) -> None:
    s, F = satellite()
    given: dict[str, Any] = {"system": s, "compensator": F, "ranges": {"a": 0.1}} | wrong
    with pytest.raises(InputError, match=r"^worst_case_gain: "):
        malta.worst_case_gain(**given)
    with pytest.raises(InputError, match=r"^dynamic_margin: "):
        malta.dynamic_margin(**given, dynamic=Dynamic(0.1))

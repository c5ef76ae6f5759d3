"""Each physical number of each machine, moved by a thousandth of itself, moves figures and flights in proportion.

A figure that jumps, or that stands still for a small move of a number and not for a larger one, is a figure of a
number that was rounded on its way: to whole samples, whole steps, a grid. Numbers that move nothing are named.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import malta
from malta.cli.documents.loops import verify_output
from malta.model.parameters import units_of
from malta.simulation.layout import fidelities

if TYPE_CHECKING:
    from collections.abc import Iterator

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

MOVE = 1e-3  # of a number
FLOOR = 1e-6  # of the largest figure of a kind: less is rounding
SMOOTH = 1e-4  # of a figure: less may be curvature, as beside an extremum
HALVINGS = 6  # of a move, in which a figure that is smooth moves less and less
COUNTS = ("settled_s",)  # figures that count samples, and jump by one

COUNTED = ("latency", "order")  # numbers of things, which machines refuse unless they are whole
Figures = dict[str, tuple["FloatArray", float]]  # each with the size below which it is rounding
Measure = Callable[["Plant", "Controller"], "Figures"]

# Numbers that move no figure and no flight here: limits that nothing meets, contacts and travel, what windings and
# other experiments alone have.
IDLE = {
    "ball/ball": {"I_max", "q_max"},
    "magnet/magnet": {"U_max", "q_max", "s_i"},
    "magnet/with_current": {"U_max", "q_max", "sensed"},
    "plate/plate": {"I_max", "gap"},
    "rotor/rotor": {
        *["A_g", "theta_p", "N", "i_0", "I_max", "c_r", "k_r", "d_r", "mu_r", "e_u", "l_u", "Omega_max"]
    },
    "calibrated": {
        *[
            "I_zz",
            "Psi",
            "V_dc",
            "V_max",
            "I_max",
            "f_pwm",
            "T_cc",
            "pm_cc",
            "z_max",
            "r_max",
            "dp",
            "k_t",
            "d_t",
            "f_clk",
            "t_dead",
        ]
    },
    "halbach_late": {
        *[
            "R",
            "L",
            "V_dc",
            "counts",
            "dV_fine",
            "I_adc",
            "codes",
            "s_adc",
            "dx",
            "F_z",
            "F_max",
            "travel",
            "r_a",
            "r_b",
            "r_c",
        ]
    },
}


def machine_of(name: str) -> tuple[Plant, Controller]:
    if "/" not in name:
        c = malta.gains.read(f"design/gains/{name}.json")
        return malta.plant_of(c.parameters), c
    folder, design = name.split("/")
    spec = malta.read_design(f"examples/{folder}/design/{design}.toml")
    at = spec.plant.at(**dict(spec.operating_point))
    return spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, at))


def numbers_in(document: Any, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(document, dict):
        for key, value in document.items():
            yield from numbers_in(value, f"{path}.{key}")
    elif isinstance(document, list | tuple):
        for k, value in enumerate(document):
            yield from numbers_in(value, f"{path}[{k}]")
    elif isinstance(document, int | float) and not isinstance(document, bool):
        yield path, float(document)


def without_rounding(recovery: list[dict[str, Any]]) -> None:
    """Take out the outputs that a load does not move: what is left of them is rounding."""
    for load in recovery:
        outputs = load["outputs"]
        for key in [
            k
            for k, o in outputs.items()
            if not o["largest"] > FLOOR * max(o["largest"] for o in outputs.values())
        ]:
            del outputs[key]
        parts = {k: o["compliance"] for k, o in outputs.items() if o.get("compliance")}
        most = max((part["peak"] for part in parts.values()), default=0.0)
        for key, part in parts.items():
            if not part["peak"] > FLOOR * most:
                del outputs[key]["compliance"]


def figures_of(plant: Plant, c: Controller) -> Figures:
    """Every figure of `malta verify` without proofs, and flights in every fidelity; poles by sums of their powers."""
    document = verify_output(
        Path("x"), malta.verify(plant, c, None, stages=True, proof=False), []
    ).model_dump()
    without_rounding(document.get("recovery") or [])
    poles = np.array([complex(*pole) for pole in document.pop("poles_rad_per_s")["closed_loop"]])
    z = np.exp(poles * c.sample_time)
    found: Figures = {"poles": (np.array([np.sum(z**k).real for k in range(1, 7)]), FLOOR)}
    numbers = dict(numbers_in(document))
    kinds: dict[str, float] = {}
    for path, value in numbers.items():
        kind = path.rpartition(".")[2]
        kinds[kind] = max(kinds.get(kind, 0.0), abs(value))
    for path, value in numbers.items():
        kind = path.rpartition(".")[2]
        floor = FLOOR * kinds["largest" if kind in ("final", "value") else kind]
        if kind == "settled_s":
            floor = 1.001 * c.sample_time  # it counts samples
        if "frequency" in kind:
            floor *= 100  # where a peak is: it is as flat there as the root of rounding
        found[path] = np.array([value]), floor
    own = plant.actuator.electronics is not None  # it reads and commands in steps
    for fidelity in (f for f in fidelities(plant) if not (own and f == "phase")):
        start = {plant.states[0].name: 1e-5}
        hold = malta.Scenario(
            "hold",
            60 * c.sample_time,
            malta.references.hold,
            start=start,
            fidelity=fidelity,
            noise=1.0,
            seed=3,
        )
        run = malta.simulate(plant, c, hold)
        assert run.verdict.completed
        found[f"flight, {fidelity}"] = run.p.ravel(), FLOOR * np.abs(run.p).max()
    return found


def moved(plant: Plant, name: str, share: float) -> Plant:
    par: Any = plant.parameters
    other: Plant = plant.variant(replace(par, **{name: getattr(par, name) * (1 + share)}))
    return other


def change(one: Figures, two: Figures, path: str) -> float:
    return float(np.abs(two[path][0] - one[path][0]).max())


def is_jump(
    plant: Plant, c: Controller, measure: Measure, name: str, path: str, side: float, most: float
) -> bool:
    """Whether the move of a figure stays as large while the move of the number is halved about it."""
    ends = [0.0, side * MOVE]
    values = [measure(moved(plant, name, share), c) for share in ends]
    for _ in range(HALVINGS):
        middle = sum(ends) / 2
        here = measure(moved(plant, name, middle), c)
        if path not in here:
            return True
        if change(values[0], here, path) > change(here, values[1], path):
            ends, values = [ends[0], middle], [values[0], here]
        else:
            ends, values = [middle, ends[1]], [here, values[1]]
    return change(values[0], values[1], path) > most / 4


def faults(
    plant: Plant, c: Controller, name: str, before: Figures, measure: Measure
) -> tuple[list[str], bool]:
    """Figures that jump as a number moves, and whether any figure moves at all."""
    found, acts = [], False
    for side in (-1.0, 1.0):
        after = measure(moved(plant, name, side * MOVE), c)
        assert {path for path in before if "recovery" not in path} <= after.keys(), name
        suspects = []
        for path, (value, floor) in before.items():
            if path not in after or not np.isfinite(value).all():
                continue
            much = change(before, after, path)
            acts |= bool(much > 0.1 * floor)
            if much > SMOOTH * np.abs(value).max() + floor and not path.endswith(COUNTS):
                suspects.append((much, path))
        near = measure(moved(plant, name, side * MOVE / 10), c) if suspects else {}
        for much, path in suspects:
            little = change(before, near, path) if path in near else math.inf
            if not 0.03 * much < little < 0.3 * much and is_jump(plant, c, measure, name, path, side, much):
                found.append(f"{path} jumps by {much:.3g} as {name} moves by {side * MOVE:+g} of itself")
    return found, acts


def physical(plant: Plant) -> list[str]:
    """The numbers that may move; those of things are refused."""
    names = [n for n in units_of(plant.parameters) if getattr(plant.parameters, n)]
    for name in set(names) & set(COUNTED):
        with pytest.raises(malta.InputError, match=f"{name}: found"):
            moved(plant, name, MOVE)
    return [name for name in names if name not in COUNTED]


def loop_figures(plant: Plant, c: Controller) -> Figures:
    """Poles, by sums of their powers, and loop gains of the sampled loop."""
    loop = malta.loop(plant, c)
    z = np.exp(loop.poles * c.sample_time)
    L = loop.sampled.loop_gain(np.geomspace(1e-3, 0.9, 8) * math.pi / c.sample_time).ravel()
    return {
        "poles": (np.array([np.sum(z**k).real for k in range(1, 7)]), FLOOR),
        "loop gain": (np.concatenate([L.real, L.imag]), FLOOR * float(np.abs(L).max())),
    }


@pytest.mark.slow
def test_each_number_of_the_planar_machine_moves_its_loop_in_proportion() -> None:
    plant, c = machine_of("planar_pid")
    before, acting = loop_figures(plant, c), set[str]()
    for name in physical(plant):
        found, acts = faults(plant, c, name, before, loop_figures)
        assert not found
        acting |= {name} if acts else set()
    assert {"m", "tau_n", "B_r", "T_d"} <= acting


@pytest.mark.parametrize("name", ["m", "T_d"])
def test_a_number_moves_the_loop_in_proportion(name: str) -> None:
    plant, c = machine_of("ball/ball")
    found, acts = faults(plant, c, name, loop_figures(plant, c), loop_figures)
    assert not found
    assert acts


@pytest.mark.slow
@pytest.mark.parametrize("which", IDLE)
def test_each_number_moves_figures_and_flights_in_proportion(which: str) -> None:
    plant, c = machine_of(which)
    before, idle = figures_of(plant, c), set[str]()
    for name in physical(plant):
        found, acts = faults(plant, c, name, before, figures_of)
        assert not found
        idle |= set() if acts else {name}
    assert idle == IDLE[which]


@pytest.mark.slow
def test_each_number_moves_the_proven_margin_in_proportion() -> None:
    """To what the search leaves between the bounds, a thousandth."""
    plant, c = machine_of("ball/ball")
    box = {"m": 0.05, "C": 0.05}
    before = malta.robust_margin(malta.loop(plant, c), box)
    for name in set(physical(plant)) - IDLE["ball/ball"]:
        for move in (-MOVE, MOVE):
            after = malta.robust_margin(malta.loop(moved(plant, name, move), c), box)
            assert after.lower == pytest.approx(before.lower, rel=20 * MOVE), name

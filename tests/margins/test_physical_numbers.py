"""Each physical number of each machine, moved by a thousandth of itself, moves figures and flights in proportion.

A figure that jumps, or that stands still for a small move of a number and not for a larger one, is a figure of a
number that was rounded on its way: to whole samples, whole steps, a grid. Numbers that move nothing are named.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import malta
from malta.cli.documents.loops import verify_output
from malta.model.parameters import units_of
from malta.simulation.layout import fidelities

if TYPE_CHECKING:
    from collections.abc import Iterator

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

MOVE = 1e-3  # of a number; the small move is a tenth of it
FLOOR = 1e-6  # of the largest figure of a kind: less is rounding
SMOOTH = 1e-4  # of a figure: less may be curvature, as beside an extremum

Figures = dict[str, tuple["FloatArray", float]]  # each with the size below which it is rounding

EXAMPLES = [
    "ball/ball",
    "ball/ball_pid",
    "magnet/magnet",
    "magnet/with_current",
    "plate/plate",
    "plate/three_coils",
    "rotor/rotor",
]
SHIPPED = [
    "calibrated",
    "robust_observer",
    "table2",
    "tubular_pid",
    "halbach",
    "halbach_late",
    "planar",
    "planar_pid",
]

# Numbers that move no figure of these: limits that nothing meets, contacts, what other experiments and fidelities have.
IDLE = {"ball": {"I_max", "q_max"}}


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


def figures_of(plant: Plant, c: Controller, *, flights: bool) -> Figures:
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
    for fidelity in (f for f in fidelities(plant) if flights and not (own and f == "phase")):
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


def faults(
    plant: Plant, c: Controller, name: str, before: Figures, *, flights: bool
) -> tuple[list[str], bool]:
    """Figures that do not move in proportion with a number, and whether any moves at all."""
    found, acts = [], False
    for side in (-1.0, 1.0):
        far, near = (
            figures_of(moved(plant, name, side * move), c, flights=flights) for move in (MOVE, MOVE / 10)
        )
        for path, (value, floor) in before.items():
            if not (np.isfinite(value).all() and all(path in other for other in (far, near))):
                continue
            if not value.shape == far[path][0].shape == near[path][0].shape:
                found.append(f"{path}: other numbers of entries")
                continue
            much, little = (np.abs(other[path][0] - value).max() for other in (far, near))
            acts |= bool(much > floor)
            rough = much > SMOOTH * np.abs(value).max() + floor
            if little > 0.3 * much + floor or (rough and little < 0.03 * much):
                found.append(
                    f"{path}: {side * MOVE:+g} of {name} moves it by {much:.2g}, a tenth by {little:.2g}"
                )
    return found, acts


@lru_cache
def start_of(name: str, *, flights: bool) -> tuple[Plant, Controller, Figures]:
    plant, c = machine_of(name)
    return plant, c, figures_of(plant, c, flights=flights)


def physical(name: str) -> list[str]:
    par = machine_of(name)[0].parameters
    return [n for n in units_of(par) if getattr(par, n)]


if __name__ == "__main__":
    import sys

    for which in sys.argv[1:]:
        plant, c, before = start_of(which, flights=True)
        idle = []
        print("==", which, flush=True)
        for name in physical(which):
            try:
                found, acts = faults(plant, c, name, before, flights=True)
            except Exception as e:
                print(name, "ERR", repr(e)[:200], flush=True)
                continue
            if not acts:
                idle.append(name)
            if found:
                print(name, found[:5], len(found), flush=True)
        print("idle", idle, flush=True)

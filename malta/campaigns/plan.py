"""Plans: one scenario on machines that are drawn from a box of parameters.

A plan decides every run. Machine, errors of the sensors and noise of run i do not depend on the workers, on the order
of the runs, or on the other runs of its block. The manifest of a plan lists everything that the runs depend on.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args
from zipimport import zipimporter

import numpy as np
from numpy.typing import NDArray

from malta.arguments import describe as describe_value
from malta.arrays import FloatArray, readonly
from malta.display import display
from malta.errors import InputError
from malta.files import read_file, version
from malta.gains.contents import uncertainty_of
from malta.gains.encodings import decode
from malta.model.fingerprint import fingerprint
from malta.model.machines import module_of
from malta.model.parameters import differences, shape_parameters, twins_of, units_of, values_of
from malta.model.parts import parts_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.engine.batch import functions_text
from malta.simulation.experiments import PlannedRun
from malta.simulation.experiments.catalogue import cases_of
from malta.simulation.readings import GAMMA, keys, mix
from malta.simulation.scenario import Scenario
from malta.synthesis.controller import Controller, given_law

if TYPE_CHECKING:
    from malta.firmware.program import Precision

# Points of a design in the unit box, any consecutive ones of them without the others.
#
# A campaign of a hundred million runs draws its machines block by block, on several computers: no point may need a
# table of all. A Latin hypercube needs, for each dimension, a random permutation of its samples. Here that
# permutation is a Feistel network on the pairs (l, r) of the numbers l + a r, 0 <= l < a, 0 <= r < b, with a b >= n,
# whose rounds
#
#     l <- (l + F(r)) mod a    and    r <- (r + F(l)) mod b
#
# can each be undone, so that the network permutes the numbers below a b. A number that comes out as n or more goes
# through it again, until it is below n: what is left permutes the numbers below n. F is SplitMix64 of a key.
#
# Sources: M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21(2), 1979 (Latin hypercubes); J. Black, P.
# Rogaway, Ciphers with arbitrary finite domains, CT-RSA 2002 (networks on a b >= n, and the way back below n); I. M.
# Sobol, 1967, and S. Joe, F. Y. Kuo, SIAM J. Sci. Comput. 30, 2008 (direction numbers, those of
# scipy.stats.qmc.Sobol).


ROUNDS = 24  # so many that all 5040 permutations of 7 numbers come equally often; pairs are mixed after a few
JITTER = 22  # bits of a place in its stratum: 30 bits of strata, these and the half fill the 53 of a number
DIGITS = 30  # bits of a coordinate of a Sobol point


def latin_hypercube(seed: int, samples: int, dimensions: int, first: int, count: int) -> FloatArray:
    """Points first ... first + count - 1 of a Latin hypercube of `samples` points, count x dimensions.

    In each dimension every stratum [k/n, (k+1)/n) has one of the n = `samples` points, at a random place in it.

    >>> sorted((latin_hypercube(0, 4, 1, 0, 4)[:, 0] * 4).astype(int).tolist())
    [0, 1, 2, 3]
    """
    runs = np.arange(first, first + count, dtype=np.uint64)
    # Indices below 0: runs have the others, for their noise.
    streams = keys(seed, -1 - np.arange(2 * dimensions)).reshape(dimensions, 2)
    columns = []
    for permuting, placing in streams:
        stratum = permute(runs, samples, permuting).astype(float)
        place = mix(placing + runs * np.uint64(GAMMA)) >> np.uint64(64 - JITTER)
        columns.append((stratum + (place.astype(float) + 0.5) / 2**JITTER) / samples)
    return np.stack(columns, axis=1)


def permute(
    numbers: NDArray[np.uint64], size: int, key: np.uint64 | NDArray[np.uint64]
) -> NDArray[np.uint64]:
    """Where a permutation of 0 ... size - 1 takes some of these numbers.

    key : chooses the permutation: one of all numbers, or one of each
    """
    a = math.isqrt(size - 1) + 1
    a += a % 2  # rounds of an odd a and an odd b would be even permutations, and make no others
    b = -(-size // a)
    found = _through_network(numbers, np.uint64(a), np.uint64(b), key)
    while (outside := found >= size).any():
        own = key[outside] if isinstance(key, np.ndarray) else key
        found[outside] = _through_network(found[outside], np.uint64(a), np.uint64(b), own)
    return found


def _through_network(
    numbers: NDArray[np.uint64], a: np.uint64, b: np.uint64, key: np.uint64 | NDArray[np.uint64]
) -> NDArray[np.uint64]:
    right, left = np.divmod(numbers, a)
    steps = np.arange(1, ROUNDS + 1, dtype=np.uint64) * np.uint64(GAMMA)
    each = mix(np.add.outer(steps, key))
    for one, other in zip(each[::2], each[1::2], strict=True):
        left = (left + mix(one + right * np.uint64(GAMMA)) % a) % a
        right = (right + mix(other + left * np.uint64(GAMMA)) % b) % b
    return np.asarray(left + a * right)


def sobol(seed: int, samples: int, dimensions: int, first: int, count: int) -> FloatArray:
    """Points first ... first + count - 1 of scipy's scrambled Sobol sequence, count x dimensions; to the bit.

    Point n is that of 0, xor the direction numbers of the ones in n xor n // 2, the Gray code of n.
    """
    start, directions = _directions(seed, max(samples - 1, 1).bit_length(), dimensions)
    runs = np.arange(first, first + count, dtype=np.uint64)
    gray = runs ^ (runs >> np.uint64(1))
    points = np.tile(start, (count, 1))
    for bit, direction in enumerate(directions):
        points ^= (
            np.where((gray >> np.uint64(bit)) & np.uint64(1), np.uint64(1), np.uint64(0))[:, None] * direction
        )
    return np.asarray(points / 2.0**DIGITS)


@lru_cache(maxsize=8)
def _directions(seed: int, bits: int, dimensions: int) -> tuple[NDArray[np.uint64], list[NDArray[np.uint64]]]:
    """Point 0 and the direction numbers of the first 2**bits points, as whole numbers below 2**DIGITS.

    The Gray code of 2**(k + 1) - 1 is 2**k: that point differs from point 0 by direction k alone.
    """
    from scipy.stats import qmc  # half a second to import

    sequence = qmc.Sobol(dimensions, rng=seed, bits=DIGITS)
    start, at, directions = _whole(sequence.random(1)), 1, []
    for bit in range(bits):
        sequence.fast_forward(2 ** (bit + 1) - 1 - at)
        at = 2 ** (bit + 1)
        directions.append(_whole(sequence.random(1)) ^ start)
    return start, directions


def _whole(points: FloatArray) -> NDArray[np.uint64]:
    return np.asarray(points[0] * 2.0**DIGITS).astype(np.uint64)


# Hashes by which a campaign recognizes its own runs: of a record's content, and of the revision of engine and law.
#
# Runs of two revisions differ, so a folder keeps the runs of one revision only.


# Packages whose modules decide a run.
PACKAGES = ("model", "synthesis", "simulation", "simulation/engine", "simulation/experiments")


@lru_cache(maxsize=8)
def revision_of(plant: Plant, controller: Controller, scenario: Scenario) -> dict[str, str]:
    """The revision of engine and law that decides the runs of a scenario: three hashes, each sha256.

    engine : of the modules of malta that simulate a run, with the C text of the engine
    machine : of the modules of the machine's model and of its experiments
    law : of the functions of a control period as the engine compiles them: machine, controller and digest
    """
    record, model = type(plant.parameters).__module__, module_of(plant.parameters).__name__
    own, printed = parts_of("experiments", plant.name)
    of_paper = scenario.name in getattr(printed, "EXPERIMENTS", ())
    parts = [part.__name__ for part in (own, printed if of_paper else None) if part is not None]
    modules = dict.fromkeys([model, record, *parts])
    return {
        "engine": _engine_sha256(),
        "machine": _sha256(part for name in modules for part in _module_parts(name)),
        "law": _sha256([functions_text(plant, controller, scenario).encode()]),
    }


@cache
def _engine_sha256() -> str:
    """sha256 of the names and texts of the modules of PACKAGES, and of the engine's C text."""
    return _sha256(_package_parts(PACKAGES))


@cache
def firmware_sha256() -> str:
    """The same of the modules that write the exported C, and of its templates."""
    return _sha256(_package_parts(("firmware", "firmware/templates")))


def _package_parts(packages: tuple[str, ...]) -> list[bytes]:
    """The names and texts of the modules and C files of packages."""
    parts: list[bytes] = []
    for package in packages:
        for file in sorted(files("malta").joinpath(package).iterdir(), key=lambda file: file.name):
            if file.name.endswith((".py", ".pyc", ".c", ".h")):
                parts += [f"{package}/{file.name}".encode(), file.read_bytes()]
    return parts


def _module_parts(name: str) -> list[bytes]:
    """The name of a module and the texts of its files, those of its whole folder for a package.

    The name alone where a module has no file, as in a notebook, and for a script: `law` covers their models.
    """
    module = sys.modules.get(name)
    found = getattr(module, "__file__", None)
    if name == "__main__" or module is None or found is None:
        return [name.encode()]
    path = Path(found)
    if isinstance(module.__loader__, zipimporter):  # of the whole folder, for a module as well
        beside = sorted(files(str(module.__package__)).iterdir(), key=lambda file: file.name)
        return [name.encode(), *(file.read_bytes() for file in beside if file.is_file())]
    paths = sorted(path.parent.glob(f"*{path.suffix}")) if path.stem == "__init__" else [path]
    return [name.encode(), *(read_file(p, "module of a machine", Path.read_bytes) for p in paths)]


def _sha256(parts: Iterable[bytes]) -> str:
    """sha256 of parts, each with its length."""
    marks = hashlib.sha256()
    for part in parts:
        marks.update(f"{len(part)}:".encode() + part)
    return marks.hexdigest()


SCHEMA, VERSION = "malta-campaign", 1
Sampler = Literal["latin-hypercube", "sobol"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
Law = Literal["own", "c", "c-float"]
PRECISIONS: dict[Law, Precision] = {"c": "double", "c-float": "float"}
DRAWING = 2  # how samplers make points of a seed, see plan.py; a folder of another version has other machines


@display
@dataclass(frozen=True, eq=False)
class Plan:
    """The plan of a campaign: a controller, a scenario, and the box from which the machines are drawn.

    Values are uniform in the box. Twins, parameters that a machine declares equal (I_xx and I_yy), stay equal. Plans
    with equal manifests have equal runs, on any number of workers.

    controller : the controller of all runs
    scenario : an experiment that the machine has for campaigns, as "stroke", "hold" or "disturbance"
    spread : half width of the box by parameter, as a share of the value in the middle (0.1: +-10 %); of a
        difference or an offset, as dK_A, in its own SI unit
    sensor_spread : half width by error of a sensor, SI
    samples : number of runs
    seed : of the machines and of the noise
    sampler : "latin-hypercube" or "sobol" (scrambled)
    parameters : of the machine in the middle of the box; None: those that the controller was designed for
    case : label of one of the scenario's cases; None: the first
    options : of the scenario, SI, as {"duration": 0.1}; noise is 1 (sensors as built) unless it is given
    law : "own", or "c" and "c-float": the exported C runs, in double or single precision

    Raises InputError for an unknown scenario, case, option, parameter or error of a sensor, and for a spread outside 0
    to 1. It also refuses a scenario that changes the machine during the run.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plan = malta.campaigns.Plan(
    ...     controller, spread={"m": 0.1, "K_A": 0.05}, samples=200, seed=1
    ... )
    >>> plan.scenario, dict(plan.options), plan.plant.name
    ('stroke', {'noise': 1.0}, 'tubular')
    """

    controller: Controller
    scenario: str = "stroke"
    spread: Mapping[str, float] = field(default_factory=dict)
    sensor_spread: Mapping[str, float] = field(default_factory=dict)
    samples: int = 10_000
    seed: int = 0
    sampler: Sampler = "latin-hypercube"
    parameters: Any = None
    case: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    law: Law = "own"

    def __post_init__(self) -> None:
        machine = (
            given_law("campaign", self.controller).parameters if self.parameters is None else self.parameters
        )
        units = units_of(machine)
        order = [name for name in units if name in self.spread]
        errors = [signal.name for signal in plant_of(machine).sensors.errors]
        for name, value in {
            "parameters": machine,
            "options": {"noise": 1.0} | dict(self.options),
            "spread": {name: _share("spread", name, self.spread[name]) for name in order}
            | {name: value for name, value in self.spread.items() if name not in units},
            "sensor_spread": {
                name: _share("sensor_spread", name, v) for name, v in sorted(self.sensor_spread.items())
            },
        }.items():
            object.__setattr__(self, name, value)
        _check_counts(self)
        _check_spread(self, units)
        for name, value in self.sensor_spread.items():
            if name not in errors:
                raise InputError(
                    "campaign", f"sensor {name}", "an unknown sensor error", "one of " + " ".join(errors)
                )
            if not (math.isfinite(value) and value >= 0):
                raise InputError("campaign", f"sensor {name}", f"{value:g}", "a finite spread of 0 or more")
        planned_run(self)

    @property
    def plant(self) -> Plant:
        """The machine in the middle of the box."""
        return plant_of(self.parameters)

    @property
    def manifest(self) -> dict[str, Any]:
        """The plan as plain tables, SI. Plans with equal manifests have equal runs."""
        return _manifest(self)

    @property
    def identity(self) -> str:
        """sha256 of the manifest."""
        return _identity(self)


def box_of(
    gains: str | Path, published: Mapping[str, Any] | None = None, option: str = "--spread"
) -> dict[str, float]:
    """The uncertain parameters of a gain file with their spreads, else those that the machine's paper names.

    Raises InputError where neither names any.
    """
    own = uncertainty_of(decode(Path(gains)), published)
    if not own:
        raise InputError(
            gains, "verification.robust", "no uncertain parameters", f"them, or {option} NAME=10%"
        )
    return own


def _check_counts(plan: Plan) -> None:
    """InputError for numbers out of range, an unknown sampler, or options that the plan itself decides."""
    for name, least in (("samples", 1), ("seed", 0)):
        value = getattr(plan, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise InputError("campaign", name, repr(value), f"a whole number of at least {least}")
    if plan.samples > MAX_RUNS:
        raise InputError("campaign", "samples", str(plan.samples), f"at most {MAX_RUNS}")
    if plan.law not in get_args(Law):
        raise InputError("campaign", "controller", repr(plan.law), "one of " + ", ".join(get_args(Law)))
    if plan.sampler not in SAMPLERS:
        raise InputError("campaign", "sampler", repr(plan.sampler), "one of " + ", ".join(SAMPLERS))
    for name in ("seed", "run", "engine"):
        if name in plan.options:
            raise InputError(
                "campaign", f"options: {name}", repr(plan.options[name]), "none: the plan has its own"
            )


MAX_RUNS = 1_000_000_000  # runs: below 2**30, so that a place in a stratum of the design has some bits too


def _check_spread(plan: Plan, units: Mapping[str, str]) -> None:
    """InputError for a spread of no parameter, of an unknown one, out of range, or different for twins."""
    if not plan.spread and not plan.sensor_spread:
        raise InputError("campaign", "spread", "nothing", "a parameter that varies, by 0 % if need be")
    for name, share in plan.spread.items():
        where = f"spread {name}"
        if name not in units:
            raise InputError("campaign", where, "an unknown parameter", "one of " + " ".join(units))
        own = name in differences(plan.parameters)
        if own and not (math.isfinite(share) and share >= 0):
            raise InputError("campaign", where, f"{share:g}", "a finite spread of 0 or more")
        if not (own or 0 <= share < 1):
            raise InputError("campaign", where, f"{100 * share:g} %", "from 0 % to less than 100 %")
        if name in shape_parameters(plan.parameters):
            raise InputError(
                "campaign", where, "another one for each run", "one for all: it shapes the functions"
            )
        if share and not (own or getattr(plan.parameters, name)):
            raise InputError(
                "campaign", where, f"{name} = 0", "a parameter other than 0: spreads are relative"
            )
    for name, twin in twins_of(plan.parameters).items():
        given = {plan.spread[k] for k in (name, twin) if k in plan.spread}
        if len(given) > 1:
            raise InputError(
                "campaign", f"spread {name}", f"another one than {twin}'s", "one: they stay equal"
            )


def _manifest(plan: Plan) -> dict[str, Any]:
    tables = {
        "schema": SCHEMA,
        "version": VERSION,
        "malta": version(),
        "revision": revision_of(plan.plant, plan.controller, planned_run(plan).scenario),
        "gains": {"name": plan.controller.name, "sha256": fingerprint(plan.controller)},
        "machine": {
            "name": plan.plant.name,
            "preset": plan.parameters.preset,
            "parameters": values_of(plan.parameters),
            "sha256": fingerprint(plan.parameters),  # of matrices too, which are no parameters with a unit
        },
        "scenario": {"name": plan.scenario, "case": planned_run(plan).label, "options": dict(plan.options)},
        "spread": dict(plan.spread),
        "sensor_spread": dict(plan.sensor_spread),
        "samples": plan.samples,
        "seed": plan.seed,
        "sampler": plan.sampler,
        "sampler_version": DRAWING,
    }
    if plan.law != "own":
        tables |= {"controller": {"law": plan.law, "sha256": firmware_sha256()}}
    content: dict[str, Any] = _use_integers(json.loads(_compact_json(tables)))
    return content


@lru_cache(maxsize=8)
def _identity(plan: Plan) -> str:
    return hashlib.sha256(_compact_json(plan.manifest)).hexdigest()


def _use_integers(value: Any) -> Any:
    """The same tables with integers in place of whole floats: noise 1 and noise 1.0 are the same plan."""
    if isinstance(value, dict):
        return {key: _use_integers(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_use_integers(entry) for entry in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _compact_json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, default=float).encode()


@lru_cache(maxsize=8)
def planned_run(plan: Plan) -> PlannedRun:
    """The case that a plan simulates: its label, its scenario with the plan's seed, its figures of merit.

    Raises InputError for an unknown case, and where every case needs an estimator outside the controller.
    """
    cases = cases_of(plan.scenario, plan.plant, plan.controller, **plan.options)
    able = {case.label: case for case in cases if case.scenario.estimator == "steady-state"}
    if not able:
        found = cases[0].scenario.estimator
        raise InputError("campaign", "estimator", repr(found), "steady-state: the one inside the controller")
    label = next(iter(able)) if plan.case is None else plan.case
    if label not in able:
        raise InputError("campaign", f"{plan.scenario}: case", repr(label), "one of " + ", ".join(able))
    scenario = replace(able[label].scenario, seed=plan.seed)
    if plan.sensor_spread:  # added to the errors that the scenario's sensors have
        scenario = replace(scenario, sensor_errors=dict(scenario.sensor_errors or {}))
    return able[label]._replace(scenario=scenario)


def half_width(plan: Plan, name: str) -> float:
    """How far a varied value goes to either side of its middle, SI."""
    if name not in plan.spread:
        return plan.sensor_spread[name]
    middle = 1.0 if name in differences(plan.parameters) else getattr(plan.parameters, name)
    return float(middle * plan.spread[name])


class Machines(NamedTuple):
    """Consecutive machines of a plan: a value for each run."""

    changes: Mapping[str, FloatArray]  # parameters
    sensor_errors: Mapping[str, FloatArray]
    names: tuple[str, ...]  # of the independent values, parameters first; twins follow
    values: FloatArray  # runs x names, SI


def varied_names(plan: Plan) -> tuple[str, ...]:
    """Names of the values that a plan varies independently: parameters, then errors of the sensors. Twins follow."""
    twins = twins_of(plan.parameters)
    own = {name for name, twin in twins.items() if name in plan.spread and twin in plan.spread}
    return (*(name for name in plan.spread if name not in own), *plan.sensor_spread)


def middle_of(plan: Plan, name: str) -> float:
    """The middle of a varied value, SI."""
    return float(getattr(plan.parameters, name)) if name in plan.spread else 0.0


def draw_machines(plan: Plan, first: int = 0, count: int | None = None) -> Machines:
    """Draw the `count` machines of a plan from run `first` on; None: all that follow.

    The machine of a run is the same, whichever others are drawn with it.
    """
    draw = latin_hypercube if plan.sampler == "latin-hypercube" else sobol
    count = plan.samples - first if count is None else count
    return machines_at(plan, draw(plan.seed, plan.samples, len(varied_names(plan)), first, count))


def varying_columns(plan: Plan) -> list[int]:
    """Places among varied_names(plan) of the values that vary: a spread of 0 is none."""
    return [k for k, name in enumerate(varied_names(plan)) if half_width(plan, name)]


def machines_at(plan: Plan, points: FloatArray) -> Machines:
    """The machines at points of the unit box, runs x varied_names(plan): 0.5 is the middle of the plan's box."""
    names = varied_names(plan)
    middle = np.array([middle_of(plan, name) for name in names])
    half = np.array([half_width(plan, name) for name in names])
    return machines_of(plan, middle + (2 * points - 1) * half)


def machines_in_box(plan: Plan, shares: FloatArray) -> Machines:
    """The machines at points of the box of what varies, runs x varying_columns(plan); the rest is in its middle."""
    points = np.full((len(shares), len(varied_names(plan))), 0.5)
    points[:, varying_columns(plan)] = shares
    return machines_at(plan, points)


def machines_of(plan: Plan, values: FloatArray) -> Machines:
    """The machines with these values, runs x varied_names(plan), SI; twins follow."""
    names = varied_names(plan)
    count = len(names) - len(plan.sensor_spread)
    changes = dict(zip(names[:count], values.T, strict=False))
    pairs = [*twins_of(plan.parameters).items()]
    for name, twin in [*pairs, *((twin, name) for name, twin in pairs)]:
        if twin in changes and name not in changes:
            changes[name] = changes[twin]
    errors = dict(zip(plan.sensor_spread, values.T[count:], strict=True))
    return Machines(changes, errors, names, readonly(values))


def _share(field: str, name: str, value: Any) -> float:
    """A share or a size. Raises InputError for an interval: a spread counts either way."""
    try:
        return float(value)
    except (TypeError, ValueError):
        expected = "one number, which counts either way"
        raise InputError("campaign", f"{field} {name}", describe_value(value), expected) from None

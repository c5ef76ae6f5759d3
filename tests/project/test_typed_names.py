"""Every name that a user types is asked for when it is typed wrong: "did you mean", from the list that it is of."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple, get_args

import pytest
from typer.testing import CliRunner

import malta
from malta.campaigns.limits import EVENTS, merits_of
from malta.campaigns.plan import SAMPLERS, Law
from malta.campaigns.run import campaign
from malta.cli import main as cli
from malta.cli.documents.published import ALL_SCHEMAS
from malta.cli.options import SCENARIO_FIELDS
from malta.cli.report import KINDS
from malta.firmware.fmu import PARTS, PLATFORMS, platforms_named
from malta.model.machines import machine, machine_names
from malta.model.parameters import units_of
from malta.simulation.engine.engines import EngineChoice
from malta.simulation.experiments.catalogue import experiments_of, option_of, options_of
from malta.simulation.layout import FIDELITIES
from malta.simulation.references import PROFILES
from malta.simulation.scenario import ESTIMATORS, FEEDFORWARDS, Fault, FaultKind
from malta.synthesis.design_tables import DesignFile
from malta.synthesis.requirements import requirements_for
from malta.synthesis.spec import Discretization
from malta.units import to_si

GAINS = "design/gains/robust.json"
SPEC, CONTROLLER = malta.read_design("design/robust.toml"), malta.gains.read(GAINS)
PLANT = SPEC.plant
PARAMETERS = list(units_of(SPEC.parameters))
STATES, FORCES, SENSORS, LOADS = (
    [signal.name for signal in signals]
    for signals in (PLANT.design_states, PLANT.inputs, PLANT.outputs, PLANT.disturbances)
)
REQUIREMENTS = [name for name, one in requirements_for(PLANT).items() if "LQG" in one.laws]
METRE = {"value": 1.0, "unit": "m"}
SENSOR_ERRORS = [error.name for error in PLANT.sensors.errors]
LOG = malta.identification.log_of(
    malta.simulate(PLANT, CONTROLLER, malta.Scenario("still", 0.001, malta.references.hold))
)


class Names(NamedTuple):
    """Names of a kind, and what reads one of them."""

    kind: str
    names: Iterable[str]
    read: Callable[[Any], Any]  # of a text that no signature admits


def _design(entry: str, value: Any = 1.0) -> Callable[[str], Any]:
    """Reads a design file with a value at an entry; NAME in either stands for the name."""

    def read(name: str) -> Any:
        filled = eval(repr(value).replace("NAME", name))
        return malta.read_design("design/robust.toml", entries={entry.replace("NAME", name): filled})

    return read


def _line(text: str) -> Callable[[str], Any]:
    """Runs a command line; NAME stands for the name."""

    def run(name: str) -> Any:
        done = CliRunner().invoke(cli.app, [word.replace("NAME", name) for word in text.split()])
        assert done.exit_code
        raise RuntimeError(done.stderr or done.exception)

    return run


def _plan(**given: Any) -> Any:
    options: dict[str, Any] = {"spread": {"m": 0.1}, "samples": 8}
    return campaign(malta.campaigns.Plan(CONTROLLER, **options | given))


PLAN = malta.campaigns.Plan(CONTROLLER, spread={"m": 0.1})
LISTS = (
    Names("entry of a design file", DesignFile.model_fields, _design("NAME")),
    Names("weight of a state", STATES, _design("weights.state.NAME")),
    Names("weight of a force", FORCES, _design("weights.input.NAME")),
    Names("base of a state", STATES, _design("bases.state.NAME", METRE)),
    Names("noise of a sensor", SENSORS, _design("noise.sensor.NAME", METRE)),
    Names("state of the operating point", STATES, _design("operating_point.NAME", METRE)),
    Names("uncertain parameter", PARAMETERS, _design("uncertainty.NAME", 0.1)),
    Names("requirement", REQUIREMENTS, _design("specification.NAME")),
    Names("published table", ["table_II.state", "table_II"], _design("weights.state", {"published": "NAME"})),
    Names("load", LOADS, _design("specification.recovery.F_x.load.NAME", METRE)),
    Names("output of a recovery", SENSORS, _design("specification.recovery.F_x.outputs", ["NAME"])),
    Names("table of a search", ["bases.state"], _design("search.numbers.tilt.vary", ["NAME.x"])),
    Names("entry of a search", STATES, _design("search.numbers.tilt.vary", ["bases.state.NAME"])),
    Names("discretization", get_args(Discretization), _design("discretization", "NAME")),
    Names("unit of length", ["mm", "um", "nm"], lambda name: to_si(1, name, "m", "f", "x")),
    Names("unit of torque", ["N m", "mN m", "N mm"], lambda name: to_si(1, name, "N m", "f", "x")),
    Names("preset", ["table1"], lambda name: malta.read("data/tubular.toml", preset=name)),
    Names("machine", machine_names(), machine),
    Names("parameter", PARAMETERS, lambda name: malta.loop(PLANT, CONTROLLER, parameters={name: 1.0})),
    Names("place", STATES, lambda name: PLANT.at(**{name: 0.0})),
    Names("scenario", experiments_of(PLANT), lambda name: malta.experiment(name, PLANT, CONTROLLER)),
    Names("option of a scenario", options_of("stroke", PLANT), lambda name: option_of("stroke", PLANT, name)),
    Names("profile", PROFILES, lambda name: malta.references.stroke(PLANT, 0, 5e-3, 0.02, 0.05, name)),
    Names("engine", get_args(EngineChoice), lambda name: malta.simulate(PLANT, CONTROLLER, _hold(), engine=name)),
    Names("fidelity", FIDELITIES, lambda name: _hold(fidelity=name)),
    Names("estimator", ESTIMATORS, lambda name: _hold(estimator=name)),
    Names("feedforward", FEEDFORWARDS, lambda name: _hold(feedforward=name)),
    Names("fault", get_args(FaultKind), lambda name: _hold(faults=(Fault(name, 0.0, what="x1"),))),
    Names("sensor of a fault", SENSORS, lambda name: _fly(faults=(Fault("stuck sensor", 0.0, what=name),))),
    Names("changed parameter", PARAMETERS, lambda name: _fly(changes=((0.005, {name: 1.0}),))),
    Names("sensor error", SENSOR_ERRORS, lambda name: _fly(sensor_errors={name: 1.0})),
    Names("law of a campaign", get_args(Law), lambda name: _plan(law=name)),
    Names("sampler", SAMPLERS, lambda name: _plan(sampler=name)),
    Names("spread", PARAMETERS, lambda name: _plan(spread={name: 0.1})),
    Names("limit", [*EVENTS, *merits_of(PLAN)], lambda name: malta.campaigns.limit_of(PLAN, name, 1e-3)),
    Names("platform", [one.name for one in PLATFORMS], lambda name: platforms_named([name])),
    Names("column of a log", SENSORS, lambda name: LOG.table("y", [name])),
    Names("parameter that is learned", ["K_D"], lambda name: malta.learn(CONTROLLER, LOG, parameter=name)),
    Names("parameter that is measured", PARAMETERS, lambda name: _measured(name)),
    Names("command", ["design", "campaign", "commission"], _line("NAME")),
    Names("--option", SCENARIO_FIELDS, _line(f"simulate {GAINS} --option NAME=1")),
    Names("--set", PARAMETERS, _line(f"simulate {GAINS} --set NAME=1")),
    Names("--set of a design", ["bases", "delay", "m"], _line("design design/robust.toml --set NAME=1")),
    Names("--sensor", SENSOR_ERRORS, _line(f"simulate {GAINS} --sensor NAME=1um")),
    Names("--spread", PARAMETERS, _line(f"campaign {GAINS} --spread NAME=1%")),
    Names("--study", ["rare", "sensitivity", "tolerances"], _line(f"campaign {GAINS} --study NAME")),
    Names("--uncertain", PARAMETERS, _line(f"verify {GAINS} --uncertain NAME=1%")),
    Names("--parameter", PARAMETERS, _line(f"plot {GAINS} rootlocus --parameter NAME")),
    Names("--channel", SENSORS, _line(f"plot {GAINS} step --channel NAME")),
    Names("--at", ["sensors", "forces"], _line(f"plot {GAINS} bode --at NAME")),
    Names("figure", KINDS, _line(f"plot {GAINS} NAME")),
    Names("--part", PARTS, _line(f"export {GAINS} --part NAME --to fmu")),
    Names("--to", ["c", "fmu"], _line(f"export {GAINS} --to NAME")),
    Names("schema", ALL_SCHEMAS, _line("schema NAME")),
    Names("gain file", ["robust", "table2"], _line("simulate design/gains/NAME.json")),
    Names("design file", ["robust", "table2"], _line("design design/NAME.toml")),
)  # fmt: skip


def _hold(**given: Any) -> malta.Scenario:
    return replace(malta.Scenario("still", 0.01, malta.references.hold), **given)


def _fly(**given: Any) -> Any:
    return malta.simulate(PLANT, CONTROLLER, _hold(**given))


def _measured(name: str) -> Any:
    return malta.measure(CONTROLLER, LOG, uncertainty={name: 0.1})


@pytest.mark.parametrize("names", LISTS, ids=[one.kind for one in LISTS])
def test_a_name_that_is_typed_wrong_is_asked_for(names: Names) -> None:
    known = list(names.names)
    for name in [known[0], known[len(known) // 2], known[-1]]:
        typed = name[0] + name
        with pytest.raises(Exception, match=re.escape(name)) as caught:
            names.read(typed)
        assert re.search(rf"[Dd]id you mean '?[\w./]*{re.escape(name)}", str(caught.value))

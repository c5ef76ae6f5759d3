"""The noise of a machine's sensors as the [noise] of a design file: currents with the mover out, positions at rest.

After Sec. IV-A of MALTA's paper: the noise of the position sensors is that of a record at rest; that of the process is
made by the current sensors, whose noise in a record with 1 A dc through the phases goes through the transformation (16)
of the phases into axes and the force constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.identification.calibration import Interval95, at_rest
from malta.identification.log import Log, require_currents
from malta.identification.response import axes_of
from malta.model.equilibrium import trim
from malta.model.places import outputs_at
from malta.model.plant import Plant

SAMPLES = 20_000  # of a simulated log: they tell a standard deviation to 1 %


def process_noise(plant: Plant, log: Log) -> dict[str, Interval95]:
    """The standard deviation of the force of each input that noise of the measured currents makes in a sample.

        f_k = J i_k  with  J = df / di,     of phases  J = df / di_axes T(x)^+

    Noise that several currents have in common counts as the record has it, and so does what closed current loops make
    of that of their sensors.

    plant : the machine, whose forces and transformation are taken where it is held
    log : with constant currents, the mover out or clamped: of all phases, or of axes or coils

    Returns the estimates by input; {} of a log without currents.

    Raises InputError for a current that the machine has not, CheckError for a log that is too short.

    >>> import dataclasses, malta, numpy as np
    >>> from malta.identification.noise import dc_log, process_noise
    >>> par = dataclasses.replace(malta.read("data/tubular.toml"), s_i=13.8e-3)
    >>> plant = malta.plant_of(par)
    >>> found = process_noise(plant, dc_log(plant, "robust", 5e-5, seed=0))
    >>> share = found["fx_B1"].value / par.K_B / par.s_i  # of (16): 2/3
    >>> bool(abs(share - 2 / 3) < 0.01)
    True
    """
    if not log.names("i"):
        return {}
    forces = log.columns["i"] @ _slopes(plant, log).T
    table = replace(log, columns={"v": forces}, signals={"v": plant.inputs})
    return {name: deviation for name, (_, deviation) in at_rest(table, "v", still=True).items()}


def _slopes(plant: Plant, log: Log) -> FloatArray:
    """How the forces follow the currents of a log where the machine is held, inputs x currents."""
    point, measured, drive = trim(plant), log.names("i"), plant.actuator.windings
    x, phases = ca.DM(point.x), [] if drive is None else [s.name for s in drive.phases]
    known = phases if phases and measured == phases else [s.name for s in axes_of(plant)]
    require_currents(log, known)
    i = ca.SX.sym("i", len(known))
    if drive is None:
        at = plant.actuator.currents(ca.DM(outputs_at(plant, point.x)), ca.DM(point.v))
        force = plant.actuator.forces(x, i)
    else:
        force, at = drive.force(drive.to_axes(x) @ i if known == phases else i), ca.DM.zeros(len(known))
    slope = ca.Function("slope", [i], [ca.densify(ca.jacobian(ca.vertcat(force), i))])
    return np.asarray(np.array(slope(at))[:, [known.index(name) for name in measured]])


def dc_log(plant: Plant, controller: str, sample_time: float, *, seed: int) -> Log:
    """The log of a simulated machine with 1 A dc through its phases: what their sensors read, and nothing else moves.

    plant : the machine, whose drive may have sensors of its currents: without these the log has no currents
    controller : name of the law
    sample_time : s
    seed : of the noise
    """
    random, drive = np.random.default_rng(seed), plant.actuator.windings
    columns = {"y": random.normal(0, np.maximum(plant.sensors.noise, 1e-300), (SAMPLES, len(plant.outputs)))}
    signals = {"y": plant.outputs}
    if drive is not None and drive.sensors is not None:
        sensors = drive.sensors
        noise = sensors.noise * random.normal(size=(SAMPLES, len(drive.phases)))
        i = 1.0 + np.array(sensors.offset) + noise
        columns["i"] = sensors.step * np.round(i / sensors.step) if sensors.step else i
        signals["i"] = drive.phases
    t = sample_time * np.arange(SAMPLES)
    return Log("run noise", plant.name, controller, sample_time, 0.0, t, columns, signals)


def noise_table(process: Mapping[str, Interval95], sensor: Mapping[str, Interval95], sources: str) -> str:
    """The [noise] of a design file, as standard deviations of one sample.

    process : by input, as of `process_noise`
    sensor : by output, as of `malta.identification.calibration.at_rest`
    sources : the logs, for the comment

    >>> from malta.identification.calibration import Interval95
    >>> from malta.identification.noise import noise_table
    >>> print(noise_table({"F": Interval95(0.05, 0.0, "N")}, {"x": Interval95(4e-7, 0.0, "m")}, "day"), end="")
    [noise]                              # of one sample: standard deviations, measured: day
    process = { F = { value = 0.05, unit = "N" } }
    sensor = { x = { value = 4e-07, unit = "m" } }
    """
    rows = [f"[noise]                              # of one sample: standard deviations, measured: {sources}"]
    for kind, values in (("process", process), ("sensor", sensor)):
        entries = (f'{n} = {{ value = {e.value:.5g}, unit = "{e.unit}" }}' for n, e in values.items())
        rows.append(f"{kind} = {{ {', '.join(entries)} }}")
    return "\n".join(rows) + "\n"

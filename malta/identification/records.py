"""Identification from any record of a machine under control, without a periodic excitation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from malta.errors import InputError
from malta.identification.identified import Identified
from malta.identification.identify import (
    Known,
    known_plant,
    known_values,
    machine_of,
    require_identifiable,
    require_machine,
)
from malta.identification.log import Log
from malta.identification.record_fit import fit_record, start_information
from malta.identification.response import (
    ResponseModel,
    acting_parameters,
    candidates,
    deviations,
    require_parameters,
    well_found,
)
from malta.identification.spectra import SIGMA, in_axes, readings, whole
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller, given_law

TOLD_SHARE = 0.5  # of its value: a parameter whose interval is wider is not told


def identify_record(
    controller: Controller,
    log: Log,
    *,
    parameters: Sequence[str] = (),
    known: Mapping[str, Known] | None = None,
    start: Mapping[str, float] | None = None,
    part: tuple[float, float] = (0.0, math.inf),
    robust: bool = False,
) -> Identified:
    """Identify parameters of a machine from any record of it under control, with intervals.

    No excitation is needed that is known or periodic: strokes, loads and noise move the machine. The parameters
    minimize the errors with which a Kalman filter of the nonlinear machine predicts the next readings from the measured
    currents; the noise is found beside them, and the state at the begin is free. Everything else counts as known.

    controller : the gain file that was running; its machine's parameters are where the search starts
    log : with measured currents
    parameters : names of the machine's record or of its sensors' errors; (): those that the log tells to 50 %, but for
        masses and lengths
    known : parameters with values that were weighed or measured otherwise, SI
    start : values from which the search starts, SI
    part : of the log that is used, from and until, s after its begin
    robust : take outliers among the readings for missing

    Returns an Identified, also where its `refusal` says that the model does not explain the record.

    Raises InputError for unknown parameters and another machine's signals, and for a machine whose sensors lag or whose
    states are not (q, q'); CheckError for a record that is too short, or tells a parameter not, alone or beside others.

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> true = plant.variant(dataclasses.replace(plant.parameters, K_D=5.1))
    >>> run = malta.simulate(true, controller, malta.Scenario.stroke(noise=1.0))
    >>> log = malta.identification.log_of(run)
    >>> found = malta.identification.identify_record(controller, log, parameters=["K_D"])
    >>> found.refusal, bool(abs(found.values[0] - 5.1) < 0.02)
    ('', True)
    """
    controller = given_law("identify_record", controller)
    believed = plant_of(controller.parameters)
    values, _ = known_values(believed, known or {})
    plant = known_plant(believed, values, start or {})
    if plant.sensors.late or not plant.second_order:
        found = "sensors that lag" if plant.sensors.late else "states that are not (q, q')"
        raise InputError("identify_record", plant.name, found, "a periodic excitation, for malta identify")
    log = in_axes(log, plant)
    require_machine(controller, plant, log)
    rows = _rows_of(log, part)
    y, i = np.asarray(readings(log, robust=robust))[rows], np.asarray(whole(log, "i"))[rows]
    names = require_parameters(plant, parameters) or candidates(plant)
    names = tuple(name for name in names if name not in values)
    mean = np.nanmean(y, axis=0), i.mean(axis=0)
    model = ResponseModel(plant, names, tuple(log.names("i")), *mean, log.sample_time)
    told = start_information(model, i, y, log.source)
    dropped: dict[str, float] = {}
    if not parameters:
        left, sizes = well_found(told, names, TOLD_SHARE / SIGMA), deviations(told)
        dropped = {n: float(sizes[k]) for k, n in enumerate(names) if k not in left and np.isfinite(sizes[k])}
        model, told = replace(model, names=tuple(names[k] for k in left)), told[np.ix_(left, left)]
    require_identifiable(model, told, log.source)
    fit = fit_record(model, i, y, source=log.source, robust=robust)
    likeliest = fit.predicted.values
    return Identified(
        log=log, plant=machine_of(model, likeliest, fit.covariance, log.source), names=model.names, values=likeliest,
        start=model.start, covariance=fit.covariance,
        held={n: float(getattr(plant.parameters, n)) for n in acting_parameters(plant) if n not in model.names},
        chi2=float((fit.predicted.rms**2).mean()), limit=math.inf, dof=int(np.isfinite(y).sum()) - len(likeliest),
        whiteness=fit.correlation * math.sqrt(len(y)), distortion=0.0,
        by_output=dict(zip((s.name for s in plant.outputs), (fit.predicted.rms**2).tolist(), strict=True)),
        dropped=dropped, record=fit,
    )  # fmt: skip


def _rows_of(log: Log, part: tuple[float, float]) -> slice:
    """The samples of a part of a log. Raises InputError for a part that it has not."""
    begin, end = (min(round(t / log.sample_time), log.samples) if t < math.inf else log.samples for t in part)
    if not 0 <= begin < end:
        length = log.samples * log.sample_time
        raise InputError(log.source, "part", f"{part[0]:g} to {part[1]:g} s", f"a part of its {length:g} s")
    return slice(begin, end)

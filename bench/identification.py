"""`malta identify` beside what a Python user has for a log: scipy's least squares, and a subspace fit.

    scipy.optimize.least_squares    the prediction errors of the same filter, slopes by differences
    N4SID                           past and future of a decimated log projected by QR, order from an SVD (van Overschee
                                    and De Moor, 1996): the unstable pole gives K_A, as the mass is known

How far each is off the machine that was flown is shown beside its time.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import optimize
from scipy.signal import decimate, periodogram
from timing import Result, medians

import malta
from malta.identification import log_of, prediction, read_log, write_log
from malta.identification.identify import identify
from malta.identification.response import ResponseModel
from malta.identification.spectra import noise_of, readings, residuals_of, spectrum_of, straighten, whole

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.identification.log import Log
    from malta.synthesis.controller import Controller

ROOT = Path(__file__).parents[1]
LENGTH = 60  # s of log
SHORT = 6  # s of log, for peers: differences of 19 numbers take two minutes even of that
TRUE = {"K_A": 9000.0, "K_D": 5.0}
NAMES = ("K_A", "K_B", "K_D", "I_xx")
SLOWER = 20  # samples that the subspace fit takes as one
ROWS = 20  # of its Hankel matrices, of outputs and of inputs each


def flown_log(length: int) -> tuple[Controller, Log]:
    """The log of a machine that the gain file does not know, as a bench would write it."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    plant = malta.plant_of(controller.parameters)
    plan = malta.excite(malta.loop(plant, controller), periods=length - 1)
    par: Any = replace(plant.parameters, **TRUE)
    scenario = malta.Scenario.excited(plan.signal, plan.duration, noise=1.0)
    return controller, log_of(malta.simulate(plant.variant(par), controller, scenario))


def squares(controller: Controller, log: Log) -> FloatArray:
    """The same prediction errors in scipy's least squares, from the gain file's parameters on."""
    plant = malta.plant_of(controller.parameters)
    y, i = readings(log, robust=False), whole(log, "i")
    spectrum = spectrum_of(log, y, i)
    mean = spectrum.outputs[0].real, spectrum.currents[0].real
    model = ResponseModel(plant, NAMES, tuple(log.names("i")), *mean, log.sample_time)
    plain = straighten(model, spectrum, model.start)
    noise = noise_of(model, plain, model.start, residuals_of(model, plain, model.start).between)
    linear = prediction._filter(model, model.start, noise, len(y) * model.sample_time)
    search = prediction._Search(model, linear, i, y, prediction.FREEDOM)
    n, half = len(linear.A), len(linear.A) // 2
    first = np.concatenate([np.zeros(half), np.array(model.place[list(plant.controlled)])])
    scale = np.concatenate([model.start, np.ones(half), 1e-6 * np.ones(n)])

    def errors(x: FloatArray) -> FloatArray:
        theta, d, state = np.split(x * scale, [len(NAMES), len(NAMES) + half])
        runs = prediction._fly(search, theta, d, state, len(y))
        return np.concatenate([(run.e / linear.s).ravel() for run in runs])

    begin = np.concatenate([model.start, first]) / scale
    found = optimize.least_squares(errors, begin, x_scale="jac", max_nfev=4)
    return np.asarray((found.x * scale)[: len(NAMES)])


def subspace(log: Log, mass: float) -> float:
    """K_A from the unstable pole sqrt(2 K_A / m) that N4SID finds."""
    y, u = (decimate(whole(log, group), SLOWER, axis=0) for group in ("y", "i"))
    y, u = ((table - table.mean(axis=0)) / table.std(axis=0) for table in (y, u))
    columns = len(y) - 2 * ROWS + 1

    def hankel(table: FloatArray, first: int) -> FloatArray:
        return np.vstack([table[first + k : first + k + columns].T for k in range(ROWS)])

    past = np.vstack([hankel(u, 0), hankel(y, 0)])
    future, wanted = hankel(u, ROWS), hankel(y, ROWS)
    R = np.asarray(np.linalg.qr(np.vstack([future, past, wanted]).T, mode="r")).T
    a, b = len(future), len(future) + len(past)
    U, _, _ = np.linalg.svd(R[b:, a:b])
    p, states = y.shape[1], 2 * y.shape[1]
    G = U[:, :states]
    poles = np.linalg.eigvals(np.linalg.lstsq(G[:-p], G[p:], rcond=None)[0])
    s = np.log(poles.astype(complex)) / (SLOWER * log.sample_time)
    translational = np.sort(s.real)[-2:].mean()  # x and y; alpha and beta are slower
    return float(mass * translational**2 / 2)


def spectra(runs: int) -> list[Result]:
    """A minute of 44 columns: the spectra that identification takes of it, beside numpy.load and scipy.signal."""
    _, log = flown_log(LENGTH)
    y, i = (np.asarray(log.columns[group]) for group in ("y", "i"))

    def ours() -> None:
        read = read_log(path, ("y", "i", "excitation"))
        spectrum_of(read, read.columns["y"], read.columns["i"])

    def theirs() -> None:
        arrays = np.load(path)
        for group in ("y", "i", "excitation"):
            periodogram(arrays[group][-round((LENGTH - 1) / log.sample_time) :], 1 / log.sample_time, axis=0)

    with tempfile.TemporaryDirectory() as folder:
        path = write_log(log, Path(folder) / "log.npz")
        own, other = medians(ours, theirs, runs=runs, what="spectra of a log")
    columns = y.shape[1] + i.shape[1]
    return [
        Result(
            f"spectra of {columns} signals, {LENGTH} s",
            own,
            "numpy.load, scipy.signal",
            other,
            "at least 0.5",
        )
    ]


def identification(runs: int) -> list[Result]:
    """Logs of ten signals at 20 kHz under excitation: parameters of a machine with other K_A and K_D."""
    controller, long = flown_log(LENGTH)
    _, log = flown_log(SHORT)
    found: dict[str, float] = {}

    def ours(of: Log, key: str) -> None:
        found[key] = identify(controller, of, parameters=NAMES).values[0]

    def theirs() -> None:
        found["squares"] = squares(controller, log)[0]

    def by_subspace() -> None:
        found["subspace"] = subspace(log, malta.plant_of(controller.parameters).stroke.mass)

    minute, own, other, third = medians(
        lambda: ours(long, "minute"),
        lambda: ours(log, "short"),
        theirs,
        by_subspace,
        runs=runs,
        what="identification",
    )
    off = {name: 100 * abs(value / TRUE["K_A"] - 1) for name, value in found.items()}
    peers = "scipy.least_squares, same prediction errors", "N4SID by SVD, decimated"
    return [
        Result(f"identify, {LENGTH} s of log", minute, "asked for", 10.0, "at least 1"),
        Result(f"identify, {SHORT} s of log", own, peers[0], other, "at least 1"),
        Result("the same", own, peers[1], third, ""),
        Result("K_A is off by [%]", off["short"], peers[0], off["squares"], "", ""),
        Result("the same", off["short"], peers[1], off["subspace"], "", ""),
        Result(f"the same, {LENGTH} s of log", off["minute"], peers[1], off["subspace"], "", ""),
    ]

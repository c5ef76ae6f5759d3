"""Frequency responses in and out: python-control's FRD, and .csv as network and dynamic signal analysers have it.

A file has a column of frequencies and pairs of columns, real and imaginary part, or magnitude and phase:

    frequency [Hz], S x1 re, S x1 im             as malta writes it
    Frequency (Hz), Magnitude (dB), Phase (deg)  as an analyser may
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.arrays import readonly
from malta.errors import CheckError, InputError
from malta.files import require_suffix
from malta.identification.measure import (
    MAX_MODEL_ERROR,
    MAX_TUBE_ERROR,
    Measurement,
    loop_curves,
    machines_of,
)
from malta.identification.readers.text import text_log
from malta.loops.loop import loop
from malta.model.plants import plant_of
from malta.synthesis.controller import given_law
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.identification.identified import Identified
    from malta.synthesis.controller import Controller

MAX_RESPONSE_ERROR = 0.05  # of the predicted magnitude, by which a response without bands may miss its tube
MAX_RESPONSE_ROWS = 1_000_000
FREQUENCIES = {"hz": 2 * np.pi, "khz": 2e3 * np.pi, "mhz": 2e6 * np.pi, "rad/s": 1.0}  # rad/s of a unit
FREQUENCY_NAME = re.compile(r"(?:freq\w*|f|omega|w)$", re.IGNORECASE)
PARTS = {
    "re": r"re|real(?: part)?",
    "im": r"im|imag(?:inary)?(?: part)?",
    "size": r"mag(?:nitude)?|gain|abs|amplitude|amp",
    "phase": r"phase|ph|angle|arg",
}


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A response of one signal to another at some frequencies.

    name : as "S x1", "T x1", "L x1" or "SP x1/fx_B1"; of another file what its columns are called
    w : k frequencies, rad/s, rising
    values : complex, SI
    unit : of the values; "": none is named

    >>> import numpy as np
    >>> from malta.identification import FrequencyResponse
    >>> found = FrequencyResponse("L y", np.array([1.0, 10.0]), np.array([2.0, 0.1j]))
    >>> found.to_control().omega.tolist()
    [1.0, 10.0]
    """

    name: str
    w: FloatArray
    values: ComplexArray
    unit: str = ""

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=complex)
        values.flags.writeable = False
        object.__setattr__(self, "w", readonly(self.w))
        object.__setattr__(self, "values", values)

    def to_control(self) -> Any:
        """The response as a control.FrequencyResponseData (FRD)."""
        import control  # imports matplotlib and takes a second: only where it is used

        return control.frd(self.values[None, None, :], self.w, name=re.sub(r"\W", "_", self.name))


def responses_of(found: Measurement | Identified) -> dict[str, FrequencyResponse]:
    """The responses of a loop by name: S, T and L of each sensor, and SP from each force.

    found : as measured, from `malta.measure`; or an identified machine: those of its loop at the lines of its log

    Returns a dict: "S x1", "T x1", "L x1", "SP x1/fx_B1" and the others, each a FrequencyResponse.

    Raises CheckError for a machine whose log tells no S.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> plan = malta.excite(
    ...     malta.loop(plant, controller), period=0.5, periods=4, band=(4, 400)
    ... )
    >>> excited = malta.Scenario.excited(plan.signal, plan.duration)
    >>> run = malta.simulate(plant, controller, excited)
    >>> measured = malta.measure(controller, malta.identification.log_of(run))
    >>> found = malta.identification.responses_of(measured)
    >>> len(found), found["S x1"].to_control().ninputs
    (40, 1)
    """
    measured, which = found, "measured"
    if not isinstance(measured, Measurement):
        if measured.loop is None:
            raise CheckError(f"{measured.log.source}: tells no S: there are no lines for responses")
        measured, which = measured.loop.measured, "predicted"
    curves = {}
    for i, sensor in enumerate(measured.sensors):
        for kind in ("S", "T", "L"):
            curves[f"{kind} {sensor}"] = getattr(getattr(measured, kind), which)[:, i]
        for j, force in enumerate(measured.forces):
            curves[f"SP {sensor}/{force}"] = getattr(measured.compliance, which)[:, i, j]
    return {name: FrequencyResponse(name, measured.w, values) for name, values in curves.items()}


def write_responses(responses: Mapping[str, FrequencyResponse], path: str | Path) -> Path:
    """Write responses at the same frequencies as .csv: frequency [Hz], and real and imaginary part of each.

    responses : by name, as of `malta.identification.responses_of`
    path : of the file

    Returns the path. Raises InputError for another suffix, for none, and for responses at different frequencies.

    >>> import os, tempfile
    >>> import numpy as np
    >>> from malta.identification import FrequencyResponse, write_responses
    >>> one = FrequencyResponse("S y", np.array([1.0, 10.0]), np.array([0.1j, 1.2]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_responses({"S y": one}, os.path.join(folder, "one.csv"))
    ...     text = path.read_text()
    >>> text.splitlines()[0]
    'frequency [Hz],S y re,S y im'
    """
    path, each = require_suffix(Path(path), ".csv"), list(responses.values())
    if not each or any(not np.array_equal(one.w, each[0].w) for one in each):
        raise InputError("write_responses", "", "no or different frequencies", "responses at the same ones")
    heads = ["frequency [Hz]", *(f"{one.name} {part}" for one in each for part in ("re", "im"))]
    parts = [part for one in each for part in (one.values.real, one.values.imag)]
    rows = np.column_stack([each[0].w / (2 * np.pi), *parts]).tolist()
    text = "\n".join([",".join(heads), *(",".join(f"{x:.12g}" for x in row) for row in rows)])
    replace_files({path: f"{text}\n".encode()})
    return path


def read_response(path: str | Path, name: str = "") -> FrequencyResponse:
    """Read a response from a table of text: a column of frequencies, and a pair of columns.

    Separators, decimal commas, encodings and headers are those that logs may have. Frequencies are in Hz, or in the
    unit of their column; magnitudes in dB where their column says so; phases in degrees, or in rad where theirs does.

    path : of the file
    name : of the response, where the file has several: what its two columns have in common, as "S x1"; a single one is
        read whatever it is called

    Returns a FrequencyResponse. Raises InputError, in one sentence, for a file without such columns or numbers.

    >>> import os, tempfile
    >>> from malta.identification import read_response
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "analyser.csv")
    ...     with open(path, "w") as file:
    ...         lines = "Frequency (Hz),Mag (dB),Phase (deg)", "10,0,-90", "20,-20,-180"
    ...         _ = file.write("\\n".join(lines) + "\\n")
    ...     found = read_response(path)
    >>> abs(found.values).round(3).tolist()
    [1.0, 0.1]
    """
    path = Path(path)
    raw = text_log(path)
    pairs: dict[str, dict[str, int]] = {}
    at = -1
    for k, column in enumerate(raw.columns):
        if at < 0 and (FREQUENCY_NAME.match(column.name) or column.unit.lower() in FREQUENCIES):
            at = k
        elif found := _part_of(column.name):
            pairs.setdefault(found[0], {}).setdefault(found[1], k)
    whole = {
        key: own for key, own in pairs.items() if {"re", "im"} <= set(own) or {"size", "phase"} <= set(own)
    }
    heads = ", ".join(column.heading for column in raw.columns[:8])
    if at < 0:
        raise InputError(path, "", f"columns {heads}", "one of frequencies, as frequency [Hz]")
    if not whole:
        raise InputError(path, "", f"columns {heads}", "a pair of re and im, or of magnitude and phase")
    known = " ".join(repr(key) for key in list(whole)[:8])
    if name not in whole and len(whole) > 1:
        raise InputError(
            path, "response", repr(name) if name else f"{len(whole)} responses", f"one of {known}"
        )
    chosen = name if name in whole else next(iter(whole))
    own = whole[chosen]
    first, second = ("re", "im") if {"re", "im"} <= set(own) else ("size", "phase")
    f, a, b = raw.load([at, own[first], own[second]])
    unit = raw.columns[at].unit.lower() or "hz"
    if unit not in FREQUENCIES:
        raise InputError(path, raw.columns[at].name, f"unit {unit!r}", "Hz, kHz, MHz or rad/s")
    w = FREQUENCIES[unit] * f
    _require_numbers(path, w, a, b)
    values = a + 1j * b
    if first == "size":
        units = [raw.columns[own[part]].unit.lower() for part in ("size", "phase")]
        with np.errstate(over="ignore"):  # refused below
            size = 10 ** (a / 20) if units[0].startswith("db") else a
        _require_numbers(path, w, size, b)
        values = size * np.exp(1j * (b if units[1].startswith("rad") else np.radians(b)))
    return FrequencyResponse(chosen, w, values)


def _part_of(heading: str) -> tuple[str, str] | None:
    """What the columns of a pair have in common, and which part a column is; None for another column."""
    for part, words in PARTS.items():
        if found := re.fullmatch(rf"(?:(.*?)[\s._:-]+)?(?:{words})", heading.strip(), re.IGNORECASE):
            return (found[1] or "").strip(), part
    return None


def _require_numbers(path: Path, w: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Raise InputError for what is no response at rising frequencies."""
    if not 2 <= len(w) <= MAX_RESPONSE_ROWS:
        raise InputError(path, "", f"{len(w)} rows", f"2 to {MAX_RESPONSE_ROWS} frequencies")
    bad = np.flatnonzero(~np.isfinite([w, a, b]).all(axis=0))
    if len(bad):
        raise InputError(path, f"row {bad[0] + 1} of numbers", "a value that is no finite number", "numbers")
    late = np.flatnonzero(np.diff(w, prepend=0.0) <= 0)
    if len(late):
        raise InputError(
            path, f"row {late[0] + 1} of numbers", "a frequency that does not rise", "rising ones above 0"
        )


@dataclass(frozen=True, eq=False)
class ResponseComparison:
    """A response beside that of the gain file's machine and law, over an uncertainty.

    response : as it was read
    of : which one it is, as "S x1"
    predicted : complex, of the machine itself
    low, high : least and largest predicted magnitude of `machines` of the box: sampled, not proven
    """

    response: FrequencyResponse
    of: str
    predicted: ComplexArray
    low: FloatArray
    high: FloatArray
    machines: int

    @property
    def outside(self) -> FloatArray:
        """By how much of the predicted magnitude the response is outside of the tube, at each frequency."""
        size, width = np.abs(self.response.values), self.high - self.low
        room = np.where(width > 0, MAX_TUBE_ERROR * width, MAX_MODEL_ERROR * self.high)
        off = np.maximum(np.maximum(self.low - size, size - self.high) - room, 0.0)
        return np.asarray(off / np.maximum(np.abs(self.predicted), 1e-300))

    @property
    def error(self) -> FloatArray:
        """|measured - predicted| over |predicted|, at each frequency."""
        size = np.maximum(np.abs(self.predicted), 1e-300)
        return np.asarray(np.abs(self.response.values - self.predicted) / size)

    @property
    def refusal(self) -> str:
        """Why the response is not as predicted; "": it is."""
        k = int(self.outside.argmax())
        if self.outside[k] <= MAX_RESPONSE_ERROR:
            turned = np.abs(self.response.values + self.predicted) < np.abs(
                self.response.values - self.predicted
            )
            if turned.mean() > 0.9:
                return f"{self.of} has the other sign: L is -P F, and S from an error of the reading to the reading"
            return ""
        return (
            f"|{self.of}| at {self.response.w[k] / (2 * np.pi):.4g} Hz is {abs(self.response.values[k]):.3g}, "
            f"predicted {self.low[k]:.3g} to {self.high[k]:.3g}"
        )


def compare_response(
    controller: Controller,
    response: FrequencyResponse,
    of: str = "",
    *,
    parameters: Any = None,
    uncertainty: Mapping[str, float] | None = None,
    seed: int = 0,
) -> ResponseComparison:
    """Compare a response that an analyser measured with that of the machine under its law.

    controller : the gain file that was running
    response : as read from a file
    of : "S SENSOR", "T SENSOR", "L SENSOR", "SP SENSOR/FORCE" or, of the machine alone from commands to readings,
        "P SENSOR/FORCE"; "": as the response is called
    parameters : of the machine that is predicted; None: those of the controller
    uncertainty : by parameter: half width of the box as a share; None or {}: none
    seed : of the sampled machines

    Returns a ResponseComparison, also where its `refusal` says that the response is not as predicted.

    Raises InputError for a name that the loop has not, and for frequencies above half of the sampling rate.

    >>> import malta
    >>> import numpy as np
    >>> from malta.identification import FrequencyResponse, compare_response
    >>> controller = malta.gains.read("design/gains/tubular_pid.json")
    >>> flat = FrequencyResponse("S x1", np.array([100.0, 1000.0]), np.ones(2))
    >>> compare_response(controller, flat).refusal.startswith("|S x1| at")
    True
    """
    controller = given_law("compare_response", controller)
    plant, of = plant_of(controller.parameters if parameters is None else parameters), of or response.name
    own, highest = loop(plant, controller), np.pi / controller.sample_time
    names = _places([s.name for s in plant.outputs], [s.name for s in plant.inputs])
    if of not in names:
        raise InputError(
            "compare_response", "of", repr(of), "one of " + " ".join(repr(name) for name in names)
        )
    if response.w[-1] >= highest:
        found = f"{response.w[-1] / (2 * np.pi):.4g} Hz"
        raise InputError(
            "compare_response", response.name, found, f"frequencies below {highest / (2 * np.pi):.4g} Hz"
        )
    kind, channel = names[of]
    machines = machines_of(own, dict(uncertainty or {}), seed)
    whole: Any = (slice(None), *channel)
    values = np.array([loop_curves(one, response.w)[kind][whole] for one in machines])
    sizes = np.abs(values)
    return ResponseComparison(response, of, values[0], sizes.min(axis=0), sizes.max(axis=0), len(machines))


def _places(sensors: Sequence[str], forces: Sequence[str]) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Where each response stands among those of `loop_curves`."""
    found: dict[str, tuple[int, tuple[int, ...]]] = {
        f"{kind} {sensor}": (k, (i,)) for k, kind in enumerate("STL") for i, sensor in enumerate(sensors)
    }
    return found | {
        f"{kind} {sensor}/{force}": (k, (i, j))
        for k, kind in ((3, "SP"), (4, "P"))
        for i, sensor in enumerate(sensors)
        for j, force in enumerate(forces)
    }

"""The tables of a gain file, as pydantic checks them, with the meaning, the unit and the shape of each entry.

Sizes: n0 mechanical states, n states with stored forces and disturbances, m forces, p measurements, c coils, g
positions of the stroke, or places of a schedule.
Checks that need the machine or the shapes of other entries stand in contents.py.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, StrictInt, StrictStr

from malta.model.signals import Coordinates
from malta.synthesis.controller import Tracks
from malta.tables import Finite, Positive, Quantity, Record, entry

Vector = list[Finite]
Matrix = list[list[Finite]]


def _rows(value: Any) -> Any:
    """Signals as the binary files hold them, two columns, back to a list of rows."""
    if isinstance(value, dict) and set(value) == {"name", "unit"}:
        names, units = value["name"], value["unit"]
        if isinstance(names, list) and isinstance(units, list) and len(names) == len(units):
            return [{"name": n, "unit": u} for n, u in zip(names, units, strict=True)]
    return value


class SignalRow(Record):
    """A signal of the machine or of the controller."""

    name: StrictStr = entry("name of the signal")
    unit: StrictStr = entry("its SI unit")


class SignalColumns(Record):
    """Signals as .npz and .mat hold them: two lists of equal length."""

    name: list[StrictStr] = entry("names of the signals")
    unit: list[StrictStr] = entry("their SI units")


Signals = Annotated[
    list[SignalRow], BeforeValidator(_rows, json_schema_input_type=list[SignalRow] | SignalColumns)
]


class DesignTable(Record):
    """The design file that the gains come from."""

    name: StrictStr = entry("name of the design, a plain file name")
    spec_sha256: StrictStr = entry("sha256 of all that shapes the design in its file")


class Matrices(Record):
    """A linear model, or what one parameter adds to it."""

    A: Matrix = entry("state matrix", shape="n0 x n0")
    B: Matrix = entry("input matrix", shape="n0 x m")
    C: Matrix = entry("output matrix", shape="p x n0")


class ParameterLimits(Record):
    """The limits of a parameter, exclusive."""

    above: Finite | None = entry("lower limit; null: none", "SI")
    below: Finite | None = entry("upper limit; null: none", "SI")


class LinearTable(Record):
    """A machine from plain matrices, as `malta.linear_machine` takes them."""

    states: Signals = entry("states", shape="n0")
    inputs: Signals = entry("inputs", shape="m")
    outputs: Signals = entry("outputs", shape="p")
    matrices: Matrices = entry("matrices of the nominal machine")
    terms: dict[StrictStr, Matrices] | None = entry("matrices by parameter; null without parameters")
    formulas: dict[StrictStr, StrictStr] | None = entry(
        'formulas of the parameters, added to entries: "A_2_1" is row 2, column 1 of A', default=None
    )
    parameter_limits: dict[StrictStr, ParameterLimits] | None = entry("limits of parameters", default=None)
    limit: Vector | None = entry("limits of the outputs", "m", shape="p")
    noise: Vector = entry("noise of one sample of each output, rms, SI", shape="p")
    dead_time: Finite = entry("from a reading to its force, half a sample of hold included", "s")
    computation_time: Finite = entry("from a reading to its new force", "s", default=0.0)
    range: Vector | None = entry(
        "largest reading of each output either way, SI; 0: not declared", shape="p", default=None
    )


class PlantTable(Record):
    """The machine that the gains are for."""

    name: StrictStr = entry('name of the machine; "linear" of a machine from plain matrices')
    preset: StrictStr = entry("preset of the data file; name of a machine from plain matrices")
    parameters: dict[StrictStr, Quantity] | None = entry(
        "parameters by name, SI, without those that have their defaults; null without parameters"
    )
    linear: LinearTable | None = entry("the matrices of a machine from plain matrices", default=None)


class Law(Record):
    """What the control law takes; version 2."""

    tracks: Tracks = entry("signals that the control law takes: estimated states, or errors of outputs")
    coordinates: Coordinates = entry(
        "of cost.integral and noise.process: signals, or positions q and their accelerations",
        default="signals",
    )
    pause: Vector | None = entry(
        "rates of the references above which sums of errors wait; 0: never", "m/s", shape="p", default=None
    )
    braking: Vector | None = entry(
        "errors of positions beyond which an axis brakes at a constant rate, and its sum of errors waits; 0: never",
        "m, rad",
        shape="p",
        default=None,
    )
    references: Matrix | None = entry(
        "limits of references: positions, speeds, accelerations; 0: those of the machine",
        "SI",
        shape="3 x p",
        default=None,
    )
    fraction: Annotated[Finite, Field(ge=0, lt=1)] = entry(
        "of a sample, for which the oldest stored force acts; 0: for all of it", "samples", default=0.0
    )


class OperatingPointTable(Record):
    """Where the machine was linearized."""

    x: Vector = entry("mechanical states, SI", shape="n0")
    u: Vector = entry("forces", "N, N m", shape="m")


class SignalTable(Record):
    """Names and units, in the order of the matrices."""

    states: Signals = entry(
        "mechanical states, forces behind the lag, stored forces, disturbances; of a law of errors its own",
        shape="n",
    )
    forces: Signals = entry("commanded forces and torques", shape="m")
    measurements: Signals = entry("measured positions", shape="p")


class ModelTable(Record):
    """The design model."""

    A: Matrix = entry("continuous, mechanical states", shape="n0 x n0")
    B: Matrix = entry("continuous", shape="n0 x m")
    C: Matrix = entry("continuous", shape="p x n0")
    Ad: Matrix = entry("sampled, with stored forces and disturbances", shape="n x n")
    Bd: Matrix = entry("sampled", shape="n x m")
    Cd: Matrix = entry("sampled", shape="p x n")


class GainsTable(Record):
    """The gains of the control law."""

    K: Matrix = entry("of the states", shape="m x n")
    Ki: Matrix = entry("of the sums of errors", shape="m x p")
    L: Matrix = entry("of the filter, filter form", shape="n x p")


class ScheduledLawTable(Record):
    """The matrices of a scheduled law at places of an output, those of one place below those of another; version 2."""

    variable: StrictStr = entry("output whose reference chooses the matrices, linear between places")
    places: Vector = entry("rising places of the output", "SI", shape="g")
    Ad: Matrix = entry("as in model", shape="g n x n")
    Bd: Matrix = entry("as in model", shape="g n x m")
    Cd: Matrix = entry("as in model", shape="g p x n")
    K: Matrix = entry("as in gains", shape="g m x n")
    Ki: Matrix = entry("as in gains", shape="g m x p")
    L: Matrix = entry("as in gains", shape="g n x p")


class RegulatorCostTable(Record):
    """Diagonals of Q, R and Q_i, which the regulator minimizes, SI."""

    state: Vector = entry("of the mechanical states, at least 0", shape="n0")
    input: Vector = entry("of the forces, above 0", shape="m")
    integral: Vector = entry("of the integrals of errors, at least 0", shape="p, or n0/2 in positions")


class FilterNoiseTable(Record):
    """Variances that the filter was designed for, of one sample."""

    process: Vector = entry(
        "of the forces; in positions of their accelerations, m^2/s^4", "N^2", shape="m, or n0/2 in positions"
    )
    sensor: Vector = entry("of the readings", "m^2", shape="p")
    drift: Vector | None = entry("of the steps of observed disturbances; null: none", "N^2", shape="m")
    correlation: Vector | None = entry(
        "of the noise of each position with the acceleration before, between -1 and 1",
        "1",
        shape="n0/2",
        default=None,
    )


class FeedforwardTable(Record):
    """What is added to the forces for a reference."""

    inertia: Vector = entry("mass or moment of inertia of each force", "kg, kg m^2", shape="m")
    speed: Matrix = entry("forces by rate of each measurement", "N s/m", shape="m x p")
    rate: Matrix | None = entry("rates of the states by rate of each measurement", shape="n0/2 x p")
    z_grid: Vector = entry("rising positions of the stroke", "m", shape="g")
    v0: Matrix = entry("forces that hold the machine at these positions", "N, N m", shape="g x m")
    position: Matrix | None = entry(
        "forces by position of the reference", "N/m", shape="m x n0/2", default=None
    )


class CurrentLoopTable(Record):
    """PI controllers of the currents."""

    Kp: Positive = entry("proportional gain", "V/A")
    Ki: Positive = entry("integral gain", "V/(A s)")
    sample_time: Positive = entry("sample time of the loop", "s")


class CommutationTable(Record):
    """Currents that are commutated for where the machine will be; version 2."""

    lead: Positive = entry("time ahead: currents are for y + lead p*'", "s")
    pull: Matrix = entry("change of the forces with the position at constant currents", "N/m", shape="m x p")


class LimitsTable(Record):
    """Largest values, either way."""

    current: Vector | None = entry("of each coil; null: no limit", "A", shape="c")
    voltage: Vector | None = entry("of each coil; null: no limit", "V", shape="c")
    force: Vector | None = entry("of each force, which bounds v0 too; null: no limit", "N, N m", shape="m")


class PolesTable(Record):
    """Poles as rows [real part, imaginary part]."""

    open_loop: Matrix = entry("of the machine", "rad/s")
    regulator: Matrix | None = entry("of the regulator; null of a PID", "rad/s")
    filter: Matrix | None = entry("of the filter; null of a PID", "rad/s")
    closed_loop: Matrix = entry("of the loop", "rad/s")


class Robust(Record):
    """The margin over the travel, in multiples of the uncertainty."""

    uncertainty: dict[StrictStr, Finite] = entry("half width of the box by parameter, relative", "1")
    lower: Finite | None = entry("proven margin; null: nothing proven", "1")
    upper: Finite | None = entry("margin at which the witness is unstable; null: no witness", "1")
    witness: dict[StrictStr, Finite] | None = entry("parameters that destabilize, SI; null: none found")


class Verification(Record):
    """What `malta verify` found when the file was written."""

    poles: PolesTable = entry("poles")
    bandwidth: dict[StrictStr, Finite] = entry("bandwidth by its definition", "rad/s")
    peak_sensitivity: dict[StrictStr, Finite] = entry("largest |S| by measurement", "1")
    robust: Robust | None = entry("robust margin; null: none was asked for")


class Provenance(Record):
    """Versions of what computed the gains."""

    malta: StrictStr = entry("version of malta")
    python: StrictStr = entry("version of Python")
    numpy: StrictStr = entry("version of NumPy")
    scipy: StrictStr = entry("version of SciPy")
    control: StrictStr = entry("version of python-control")
    casadi: StrictStr = entry("version of CasADi")


class GainFile(Record):
    """The document that a gain file holds."""

    schema_: Literal["malta-gains"] = entry("kind of the file", alias="schema")
    version: StrictInt = entry("1; 2 of a file with a table law")
    design: DesignTable = entry("the design file that the gains come from")
    plant: PlantTable = entry("the machine that the gains are for")
    operating_point: OperatingPointTable = entry("where the machine was linearized")
    sample_time: Positive = entry("control period", "s")
    law: Law | None = entry("what the control law takes; version 2", default=None)
    signals: SignalTable = entry("names and units, in the order of the matrices")
    model: ModelTable = entry("the design model")
    gains: GainsTable = entry("the gains of the control law")
    cost: RegulatorCostTable | None = entry("weights of the regulator; null of a PID")
    noise: FilterNoiseTable | None = entry("variances of the filter; null of a PID")
    feedforward: FeedforwardTable = entry("what is added to the forces for a reference")
    current_loop: CurrentLoopTable | None = entry(
        "PI controllers of the currents; null: currents follow at once"
    )
    commutation: CommutationTable | None = entry("commutation ahead; version 2", default=None)
    schedule: ScheduledLawTable | None = entry(
        "matrices at places of an output; model and gains are those at the operating point; version 2",
        default=None,
    )
    limits: LimitsTable = entry("largest values, either way")
    verification: Verification = entry("poles, bandwidth, peaks and margin")
    provenance: Provenance = entry("versions of what computed the gains")
    sha256: StrictStr = entry("sha256 of the rest as compact JSON with sorted keys")

    @property
    def uncertainty(self) -> dict[str, float]:
        """The uncertain parameters that the file names; none where it names none."""
        return {} if self.verification.robust is None else dict(self.verification.robust.uncertainty)

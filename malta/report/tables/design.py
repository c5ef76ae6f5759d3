"""The page of a design, and its tables: poles, bandwidths, peak sensitivity, loads, requirements, the front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from malta.bound import at_least, at_most
from malta.display import RADIANS, frequency
from malta.loops.time_domain import SHARE, Recovery, furthest
from malta.margins.loop_report import BANDWIDTHS, ZONES, LoopReport, zone
from malta.margins.outcome import Outcome
from malta.model.linearize import LinearModel
from malta.model.parameters import box_words
from malta.model.printed import published_value
from malta.report.figures.drawing import UNITS, Published, front_lines, number, published_in_unit
from malta.report.tables import COLOURS, Paragraph, add_row, new_table
from malta.report.tables.experiments import experiment_table
from malta.synthesis.requirements import Trade, requirements_for
from malta.units import FINE_UNITS, in_unit

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.model.plant import Plant
    from malta.simulation.experiments import Experiment
    from malta.synthesis.spec import Spec
    from malta.tuning.tune import TuningResult


def design_page(
    spec: Spec, model: LinearModel, margins: LoopReport, flown: Experiment, published: Published | None
) -> Group:
    """Make the page of a design for a terminal: its loop, its margins, and the machine's main experiment.

    spec : the design, from `malta.read_design`
    model : the machine's linear model
    margins : from `malta.verify`
    flown : the experiment that is the machine's main job, from `malta.experiment`
    published : figures of the machine's paper, from `malta.model.read_published`; None: none

    Returns a rich Group, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> margins = malta.verify(model, controller)
    >>> page = malta.report.design_page(spec, model, margins, push, None)
    >>> for line in page.renderables[:2]:
    ...     rich.print(line)
    ball: LQG with integral action
    ball, preset data, sampled-data, 5 kHz, delay 1 in the design model
    """
    from malta.synthesis.lqg import continuous_poles  # here: it loads what makes designs

    made = f"{spec.discretization}, {_rate_text(spec.sample_time)}, delay {spec.delay:g} in the design model"
    made += ", with the lag of the current loops" if spec.current_lag else ""
    if spec.pid is not None:
        made = f"PID, {_rate_text(spec.sample_time)}"
    if spec.structure is not None:
        made = f"elements of a given structure, {_rate_text(spec.sample_time)}"
    made += ", commutated for the predicted place" if spec.commutation == "predicted" else ""
    return Group(
        Paragraph(f"{spec.name}: {spec.summary}", style="bold"),
        Paragraph(f"{model.plant.name}, preset {spec.parameters.preset}, {made}"),
        "",
        poles_table(model, published),
        loop_poles_table(margins, continuous_poles(model, spec.weights) if spec.kind == "LQG" else None),
        bandwidth_table(margins, published),
        sensitivity_table(margins),
        *([] if margins.robust is None else [_margin_text(margins)]),
        experiment_table(flown, published),
    )


def _margin_text(margins: LoopReport) -> Paragraph:
    box = box_words(margins.uncertainty, margins.plant.parameters)
    assert margins.robust is not None
    where = margins.places_covered
    if margins.covers_travel:
        where = where.replace("the travel", "the whole travel")
    return Paragraph(f"{f'Parametric margin {where}'.rstrip()} ({box}): {margins.robust}\n")


def _rate_text(Ts: float) -> str:
    return f"{1e-3 / Ts:g} kHz" if Ts <= 1e-3 else f"a sample every {Ts * 1e3:g} ms"


def poles_table(model: LinearModel, published: Published | None) -> Table:
    """Tabulate open-loop poles by mode; beside them the paper's Table I, which holds at the middle of the travel.

    A damped plant has no pairs of opposite poles: all its poles are listed.

    model : the machine's linear model
    published : figures of the machine's paper, from `malta.model.read_published`; None: none

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> model = malta.linearize(plant, plant.at())
    >>> printed = malta.model.read_published("data/tubular.toml")
    >>> rich.print(malta.report.poles_table(model, printed))
    Open-loop poles [rad/s]
    <BLANKLINE>
     mode              x        y      z    alpha     beta
     ─────────────────────────────────────────────────────
     ours, ±      218.92   218.92   0.00   157.53   157.53
     Table I, ±   218.92   218.92   0.00   157.53   157.53
    <BLANKLINE>
    """
    n = len(model.A) // 2
    if np.any(model.A[n:, n:]):
        table = new_table("Open-loop poles [rad/s]", "of", "poles")
        poles = np.linalg.eigvals(model.A).astype(complex)
        add_row(table, "machine", _pole_text(np.where(np.abs(poles) < 1e-9 * np.abs(poles).max(), 0, poles)))
        return table
    names, squares = _modes(model)
    table = new_table("Open-loop poles [rad/s]", "mode", *names)
    add_row(table, "ours, ±", *(f"{math.sqrt(abs(s)):.2f}{'j' if s < 0 else ''}" for s in squares))
    at_centre = not np.any(model.operating_point.x)
    if publishes(published, "table_I", "poles") and at_centre:
        printed = [published_value(published, f"table_I.poles.{name}") for name in names]
        digits = published["table_I"]["digits"]
        add_row(table, "Table I, ±", *(f"{value:.{digits}f}" for value in printed))
    return table


def publishes(published: Published | None, table: str, key: str) -> TypeGuard[Published]:
    """Whether a file of published figures has this table and this key in it."""
    return published is not None and key in published.get(table, {})


def loop_poles_table(margins: LoopReport, continuous: Mapping[str, ComplexArray] | None = None) -> Table:
    """Tabulate poles of the continuous design, if given, and of the sampled loop as ln(lambda) / Ts, rad/s.

    margins : from `malta.verify`
    continuous : poles by the name of their row, rad/s; None: none

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> rich.print(malta.report.loop_poles_table(malta.verify(model, controller)))
    Poles [rad/s]; of sampled systems ln(lambda) / Ts
    <BLANKLINE>
     of                           poles
     ──────────────────────────────────────────────────────────────────
     sampled regulator            -518.6  -98.37  -19.61
     sampled Kalman filter        -507.3±492.9j
     closed loop of the machine   -567.1±588.7j  -391.9  -95.23  -20.05
    <BLANKLINE>
    """
    table = new_table("Poles [rad/s]; of sampled systems ln(lambda) / Ts", "of", "poles")
    for what, poles in (continuous or {}).items():
        add_row(table, what, _pole_text(poles))
    for what, key in (
        ("sampled regulator", "regulator"),
        ("sampled Kalman filter", "filter"),
        ("closed loop of the machine", "closed_loop"),
    ):
        if (found := getattr(margins.poles, key)).size:
            add_row(table, what, _pole_text(found))
    return table


def bandwidth_table(margins: LoopReport, published: Published | None) -> Table:
    """Tabulate the bandwidth by each definition; a paper may print one figure without saying which it is.

    margins : from `malta.verify`
    published : figures of the machine's paper, from `malta.model.read_published`; None: none

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> rich.print(malta.report.bandwidth_table(malta.verify(model, controller), None))
    Bandwidth by definition
    <BLANKLINE>
     definition                              rad/s       Hz
     ──────────────────────────────────────────────────────
     last -3 dB of sigma_max(T)              652.3   103.82
     first -3 dB of sigma_min(T)             652.3   103.82
     last 0 dB of sigma_max(L)               290.8    46.29
     regulator's fastest natural frequency   247.4    39.37
     regulator's slowest natural frequency   247.4    39.37
    <BLANKLINE>
    """
    table = new_table("Bandwidth by definition", "definition", "rad/s", "Hz")
    for key, meaning in BANDWIDTHS.items():
        if key not in margins.bandwidth:  # a machine or a law without natural frequencies
            continue
        value = margins.bandwidth[key]
        add_row(table, meaning, f"{value:.1f}", f"{value / (2 * math.pi):.2f}")
    if publishes(published, "position_controller", "bandwidth"):
        value = published_in_unit(published, "position_controller.bandwidth", "rad/s")
        add_row(
            table, "published, without a definition", f"about {value:.0f}", f"{value / (2 * math.pi):.0f}"
        )
    return table


def sensitivity_table(margins: LoopReport) -> Table:
    """Tabulate peak sensitivities at each sensor with their ISO 14839-3 zones, for each stage of the analysis.

    margins : from `malta.verify`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> rich.print(malta.report.sensitivity_table(malta.verify(model, controller)))
    Peak sensitivity (ISO 14839-3 zone of the worst: A < 3, B < 4, C < 5)
    <BLANKLINE>
     loop                 y   zone   sigma_max   at rad/s (Hz)
     ─────────────────────────────────────────────────────────
     sampled           1.71      A        1.71      542 (86.3)
     + current loops   1.71      A        1.71      542 (86.3)
     machine           1.57      A        1.57      584 (93.0)
    <BLANKLINE>
    """
    sensors = [k for k in margins.peak_sensitivity if k != "sigma_max"]
    limits = ", ".join(f"{name} < {limit:g}" for limit, name in ZONES if math.isfinite(limit))
    units = {signal.unit for signal in margins.controller.measurements}
    scaled = "" if len(units) == 1 else "; sigma_max: each reading in its noise, else its range"
    table = new_table(
        f"Peak sensitivity (ISO 14839-3 zone of the worst: {limits}{scaled})",
        "loop",
        *sensors,
        "zone",
        "sigma_max",
        f"at {RADIANS}",
    )
    for stage in margins.stages:
        peaks = [stage.peak_sensitivity[s] for s in sensors]
        add_row(
            table,
            stage.name,
            *(f"{peak:.2f}" for peak in peaks),
            zone(max(peaks)),
            f"{stage.peak_sensitivity['sigma_max']:.2f}",
            frequency(stage.peak_frequency, 3),
        )
    return table


def _modes(model: LinearModel) -> tuple[list[str], FloatArray]:
    """Squares of the poles +-s of an undamped plant, each named by the position that takes part most in its mode."""
    from scipy import sparse  # here, as it loads with all graphs

    names = [s.name for s in model.plant.design_states[: len(model.stiffness)]]
    squares, shapes = np.linalg.eig(model.stiffness)
    participation = np.abs(shapes * np.linalg.inv(shapes).T)  # of position i in mode j, free of units
    above_zero = sparse.csr_array(1 + participation)  # entries of zero would be no candidates
    _, mode = sparse.csgraph.min_weight_full_bipartite_matching(above_zero, maximize=True)
    found = squares.real[mode]
    return names, np.where(np.abs(found) < 1e-12 * np.abs(found).max(initial=0.0), 0.0, found)


def _pole_text(poles: ComplexArray) -> str:
    """Poles in one line: a conjugate pair once, a repeated pole with its multiplicity."""
    counted: dict[str, int] = {}
    for pole in poles:
        if pole.imag < -1e-6 * abs(pole):
            continue
        real = f"{pole.real:.4g}"
        text = f"{real}±{pole.imag:.4g}j" if pole.imag > 1e-6 * abs(pole) else real
        counted[text] = counted.get(text, 0) + 1
    return "  ".join(text if count == 1 else f"{text} (x{count})" for text, count in counted.items())


# The table of constant loads from outside: how far they move a machine, and how fast it comes back.


def recovery_table(found: Sequence[Recovery], plant: Plant) -> Table:
    """Tabulate the output that each load moves furthest: largest deviation, what is left, settling, compliance.

    The peak over frequency is the amplitude of the output under a load of this amplitude. No load of this amplitude
    moves it further than the column of any load says.

    found : from `malta.loops.recovery`
    plant : the machine

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.loops.recovery(spec.plant, controller)
    >>> rich.print(malta.report.recovery_table(found, spec.plant))
    A constant load from outside, and the output that it moves furthest
    <BLANKLINE>
                                       left    left     1 %
                      moves     any   after   after   after     peak      at rad/s
     load    output      by    load   0.1 s   0.3 s     [s]   over w          (Hz)
     ─────────────────────────────────────────────────────────────────────────────
     1 N w   y [µm]   343.4   686.9   94.98   1.722   0.266    430.5   42.8 (6.82)
    <BLANKLINE>
    """
    units = {s.name: s.unit for s in plant.disturbances}
    after = [f"left after {t:g} s" for t in (found[0].after if found else ())]
    heads = (
        "load",
        "output",
        "moves by",
        "any load",
        *after,
        f"{100 * SHARE:g} % after [s]",
        "peak over w",
        f"at {RADIANS}",
    )
    table = new_table("A constant load from outside, and the output that it moves furthest", *heads)
    table.columns[1].justify = "left"
    for recovered, d in furthest(found):
        load = ", ".join(f"{size:g} {units[name]} {name}" for name, size in recovered.load.items())
        fine = FINE_UNITS.get(d.unit, d.unit)
        # Below a millionth of the largest nothing is left.
        left = (value if value > 1e-6 * d.largest else 0.0 for value in d.left)
        any_waveform = at_most(in_unit(d.any_waveform, fine)).text()
        moved, *rest = [number(in_unit(value, fine)) for value in (d.largest, *left)]
        settled = "never" if math.isinf(d.settled) else f"{d.settled:.3g}"
        peak = number(in_unit(d.compliance, fine))
        add_row(
            table,
            load,
            f"{d.output} [{fine}]",
            moved,
            any_waveform,
            *rest,
            settled,
            peak,
            frequency(d.frequency, 3),
        )
    return table


# Tables of what was tuned, and of what is asked for.


def requirements_table(requirements: Sequence[Outcome]) -> Table:
    """Tabulate the requirements of a design: the limit, the value found, and their ratio.

    requirements : of a Tuned, from `malta.tune`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> from malta.margins.outcome import Outcome
    >>> margin = Outcome("margin", 3.0, 3.6, "1", "proven over the travel", at_least=True)
    >>> rich.print(malta.report.requirements_table([margin]))
    Requirements
    <BLANKLINE>
                                           of the
     requirement      asked      found     limit                             from
     ────────────────────────────────────────────────────────────────────────────
     margin        >= 300 %   360.00 %   83.34 %   holds   proven over the travel
    <BLANKLINE>
    """
    table = new_table("Requirements", "requirement", "asked", "found", "of the limit", "", "from")
    for r in requirements:
        verdict = "" if r.asked is None else "FAILS" if r.verdict == "fails" else r.verdict
        cells = [Text(cell) for cell in (r.words, r.asked_text, r.found_text, r.nearness, verdict, r.how)]
        cells[4].style = COLOURS[r.verdict]
        table.add_row(*cells)
    return table


def _front_columns(tuned: TuningResult) -> dict[str, tuple[str, float, str]]:
    """Columns of the front by figure: heading, factor from SI to the unit shown, unit."""
    names = dict.fromkeys(name for one in tuned.front for name in one.figures)
    columns = {"margin": ("margin, proven", 1.0, "%")}
    sides: tuple[tuple[Trade, str], ...] = (("force", ""), ("motion", " motion"))
    for trade, what in sides:
        for name, label, scale, unit in front_lines(tuned.spec.plant, names, trade):
            columns[name] = (f"{label}{what}", scale, f"{unit} rms")
    for name, r in requirements_for(tuned.spec.plant).items():
        if name in names and r.heading and not r.trade:
            columns[name] = (r.heading, *UNITS.get(r.unit, (1.0, "")))
    return columns


def front_rows(tuned: TuningResult) -> tuple[list[str], list[list[str]]]:
    """The Pareto front as headings and cells: a row for each trial, the chosen one with a star."""
    columns = _front_columns(tuned)
    shown = [name for name in columns if any(name in one.figures for one in tuned.front)]
    heads = [f"{columns[k][0]} [{columns[k][2]}]".removesuffix(" []") for k in shown]
    rows = [
        [_front_cell(k, one.figures[k] * columns[k][1]) if k in one.figures else "" for k in shown]
        + ["*" if one.values == tuned.trial.values else ""]
        for one in tuned.front
    ]
    return [*heads, ""], rows


def _front_cell(name: str, value: float) -> str:
    """A figure in the unit of its column: a proven margin is cut, others are rounded."""
    return at_least(value).percent(unit="") if name == "margin" else f"{value:.4g}"


def front_table(tuned: TuningResult) -> Table:
    """Tabulate the Pareto front of margin, force noise and motion, in the order of margins.

    tuned : from `malta.tune`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import TuningResult
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = TuningResult(spec, front[1], (), front, trials=120)  # of malta.tune
    >>> rich.print(malta.report.front_table(tuned))
    What the margin costs (* chosen)
    <BLANKLINE>
     margin, proven [%]   f [N rms]   y motion [µm rms]
     ──────────────────────────────────────────────────────
     328.00                  0.0122               0.523
     363.00                  0.0414               0.501   *
    <BLANKLINE>
    """
    heads, rows = front_rows(tuned)
    table = new_table("What the margin costs (* chosen)", *heads)
    for row in rows:
        add_row(table, *row)
    return table


def front_markdown(tuned: TuningResult) -> str:
    """Write the Pareto front as a Markdown table.

    tuned : from `malta.tune`

    Returns the text.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import TuningResult
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = TuningResult(spec, front[1], (), front, trials=120)  # of malta.tune
    >>> print(malta.report.front_markdown(tuned))
    | margin, proven [%] | f [N rms] | y motion [um rms] |  |
    | ---: | ---: | ---: | ---: |
    | 328.00 | 0.0122 | 0.523 |  |
    | 363.00 | 0.0414 | 0.501 | * |
    <BLANKLINE>
    """
    heads, rows = front_rows(tuned)
    lines = ["| " + " | ".join(row) + " |" for row in (heads, ["---:"] * len(heads), *rows)]
    return "\n".join([*lines, ""])

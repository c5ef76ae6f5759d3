"""Further claims of the paper on MALTA: rule of thumb for bandwidths, means at rest, braking resistor, releases."""

from __future__ import annotations

import math
from functools import lru_cache, partial

from malta.machines.tubular.evidence import Evidence, link_rise, mean_at_rest
from malta.report.ledger import Row, bandwidth
from malta.simulation.catalogue import experiment
from malta.simulation.compiled import compiler


def unstable_pole(e: Evidence) -> float:
    """The largest unstable pole of the design model, rad/s."""
    return float(e.model.sys.poles().real.max())


def bandwidth_over_pole(definition: str, e: Evidence) -> float:
    """The bandwidth by one of the definitions in BANDWIDTHS over the largest unstable pole."""
    return bandwidth(definition, e) / unstable_pole(e)


def braking_power(e: Evidence) -> float:
    """Mechanical power, W, at the published speed and the force limit of the thrust; no losses, as in the paper."""
    actuator = e.model.plant.actuator
    return actuator.force_limit[e.model.plant.thrust_input] * e.braked


def braking_resistance(e: Evidence) -> float:
    """The largest resistance, ohm, that takes the braking power at the link voltage after the published rise."""
    return (e.spec.plant.drive.link_voltage + link_rise(e)) ** 2 / braking_power(e)


def capacitance_beside_brake(e: Evidence) -> float:
    """The capacitance, F, in which the energy of one control period makes the published rise.

    C ((V + rise)^2 - V^2) / 2 = P Ts: the resistor is switched on at the sample after the link rises above V.
    """
    V, rise = e.spec.plant.drive.link_voltage, link_rise(e)
    return 2 * braking_power(e) * e.controller.sample_time / ((V + rise) ** 2 - V**2)


@lru_cache(maxsize=8)  # several rows need it; records of evidence compare by identity
def _captured(e: Evidence) -> dict[str, float]:
    """Figures of merit of the experiment capture, SI, with the smallest maps; none without a C compiler."""
    if compiler() is None:
        return {}
    found = experiment("capture", e.spec.plant, e.controller, points=3)
    return {merit.label: merit.value for merit in found.merits}


def captured(label: str, e: Evidence) -> float:
    """A figure of merit of the experiment capture, SI; NaN without a C compiler."""
    return _captured(e).get(label, math.nan)


OWN_BANDWIDTH = "the paper's own 400 rad/s is 1.83 times its 218.92"
NO_STIFFNESS = "loops of plain SI weights have next to no stiffness of their own"

RULE_OF_THUMB: tuple[Row, ...] = tuple(
    Row(
        f"bandwidth over unstable pole: {text}",
        "1",
        "{:.2f}",
        partial(bandwidth_over_pole, definition),
        "position_controller.bandwidth_over_pole",
        "at least",
        OWN_BANDWIDTH,
        why,
    )
    for definition, text, why in (
        ("sigma_max_T", "last −3 dB of σ_max(T)", NO_STIFFNESS),
        (
            "crossover_max",
            "last 0 dB of σ_max(L)",
            "a rule of thumb: less costs peak sensitivity, not stability",
        ),
    )
)
BRAKE: tuple[Row, ...] = (
    Row(
        "braking resistor: largest resistance",
        "ohm",
        "{:.2f}",
        braking_resistance,
        note="takes 5 m/s at the force limit with the rise above; no losses",
    ),
    Row(
        "braking resistor: capacitance beside it",
        "mF",
        "{:.2f}",
        capacitance_beside_brake,
        "dc_link.capacitance",
        "at most",
        "“a lower value”: that of one control period until it is switched",
    ),
)
FUTURE = "released at rest, attraction linear; the paper leaves these “stability limits” to future work"
CAPTURE: tuple[Row, ...] = (
    *(
        Row(
            f"released aside, {text}: furthest that returns",
            unit,
            "{:.2f}",
            partial(captured, f"{ray}: furthest start that returns"),
            note=FUTURE,
        )
        for ray, text, unit in (
            ("x", "along x", "mm"),
            ("y down", "downwards", "mm"),
            ("beta", "tilted", "mrad"),
        )
    ),
    Row(
        "released downwards: share of what 5 A allow at best",
        "percent",
        "{:.1f}",
        partial(captured, "y down: their ratio"),
        note="the bound of the unstable modes' integrals; the rise of the currents takes the rest",
    ),
    Row(
        "released anywhere inside the touchdown bearings: share that returns",
        "percent",
        "{:.1f}",
        partial(captured, "starts inside the clearance that return"),
        note="1024 starts, evenly spread over all five positions",
    ),
)
MEANS: tuple[Row, ...] = tuple(
    Row(
        f"at rest, mean of {name} measured",
        "um",
        "{:.2f}",
        partial(mean_at_rest, name),
        published="rest.mean",
        relation="at most",
        note="its size, rms over 16 seeds: a mean of 2000 samples is chance; Table III prints up to 0.07 radially, "
        "0.52 along z",
        why=NO_STIFFNESS,
    )
    for name in ("x1", "y1", "x2", "y2", "z")
)

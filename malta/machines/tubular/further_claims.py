"""Further claims of the paper on MALTA: the rule of thumb for bandwidths, means at rest, the braking resistor."""

from __future__ import annotations

from functools import partial

from malta.machines.tubular.evidence import Evidence, link_rise
from malta.report.ledger import Row, bandwidth, merit


def unstable_pole(e: Evidence) -> float:
    """The largest unstable pole of the design model, rad/s."""
    return float(e.model.sys.poles().real.max())


def bandwidth_over_pole(definition: str, e: Evidence) -> float:
    """The bandwidth by one of the definitions in BANDWIDTHS over the largest unstable pole."""
    return bandwidth(definition, e) / unstable_pole(e)


def mean_at_rest(name: str, e: Evidence) -> float:
    """Size of the mean of an output's measurements at rest, m."""
    return abs(merit("hold", f"measured {name}, mean", e))


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
MEANS: tuple[Row, ...] = tuple(
    Row(
        f"at rest, mean of {name} measured",
        "um",
        "{:.2f}",
        partial(mean_at_rest, name),
        "rest.mean",
        "at most",
        "its size: a mean of 2000 samples is chance; Table III prints up to 0.07 radially, 0.52 along z",
        NO_STIFFNESS,
    )
    for name in ("x1", "y1", "x2", "y2", "z")
)

"""Options of the electronics in an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from malta.machines.halbach import electronics
from malta.machines.halbach.electronics import Options, Pwm


def electronics_options(
    pwm: Pwm, adc_noise: bool, adc_steps: bool, mean_of: int, current_loops: bool
) -> Options | None:
    """A record of the electronics; None for those of the paper, as fidelity "force" takes none."""
    found = Options(pwm, adc_steps, adc_noise, mean_of, current_loops)
    return None if found == electronics.REAL else found


def campaign_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a campaign's scenario: fidelity "force" by default, electronics if their options differ."""
    given = dict(options)
    own = [given.pop(name) for name in ("pwm", "adc_noise", "adc_steps", "mean_of", "current_loops")]
    return {"fidelity": "force", "electronics": electronics_options(*own)} | given

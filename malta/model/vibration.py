"""What standards and builders of sites ask of vibration, by name: shares of a clearance, and how far a floor shakes."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from malta.errors import require_known
from malta.files import shipped_path
from malta.tables import load_toml
from malta.units import to_si

CLEARANCE_PRESETS = ("api617", "iso14839_2_a", "iso14839_2_b", "iso14839_2_c")


class VibrationPreset(NamedTuple):
    """A bound of vibration, of the use of each clearance or of a floor."""

    title: str
    clearance: float  # largest share; 1: nothing is said of clearances
    velocity: float  # m/s, rms of a floor in each band of a third of an octave; 0: nothing is said of a floor
    source: str


def vibration_preset(name: str, caller: str = "vibration_preset") -> VibrationPreset:
    """Read a bound of vibration by name: data/published/vibration.toml, where each has its source.

    name : api617, iso14839_2_a to c, of clearances; workshop, office, vc_a to vc_e, of floors
    caller : whom a refusal names

    Returns its title, `clearance` (the largest share that may be used; 1: not bounded), `velocity` (m/s, rms of a floor
    in each band of a third of an octave; 0: no floor) and source.

    Raises InputError for an unknown name.

    >>> import malta
    >>> floor = malta.model.vibration_preset("vc_c")
    >>> f"{floor.title}: {1e6 * floor.velocity:g} um/s"
    'VC-C: 12.5 um/s'
    """
    known = _presets()
    require_known([name], known, caller, "")
    return known[name]


@lru_cache(maxsize=1)
def _presets() -> dict[str, VibrationPreset]:
    path, found = shipped_path("data", "published", "vibration.toml"), {}
    for name, one in load_toml(path).items():
        kind, unit = ("clearance", "1") if "clearance" in one else ("velocity", "m/s")
        value = to_si(one[kind]["value"], one[kind]["unit"], unit, path, name)
        numbers = (value, 0.0) if kind == "clearance" else (1.0, value)
        found[name] = VibrationPreset(one["title"], *numbers, one[kind]["source"])
    return found

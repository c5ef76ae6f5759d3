"""Uncertainties in words, and the parameters that scatter about 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields

from malta.display import quantity
from malta.model.parameters import Parameters


def differences(record: type[Parameters] | Parameters) -> dict[str, str]:
    """The SI units of the parameters that scatter about 0, by name: those of either sign with the default 0.

    Such a parameter is a difference or an offset. How far it varies is given in its own unit, not as a share of 0.
    """
    units = {}
    for f in fields(record):
        if "unit" in f.metadata and f.default is not MISSING and f.default == 0:
            above, least = f.metadata["above"], f.metadata["at_least"]
            if all(limit is None or limit < 0 for limit in (above, least)):
                units[f.name] = f.metadata["unit"]
    return units


def box_words(box: Mapping[str, float], parameters: Parameters | None = None) -> str:
    """An uncertainty in words: parameters with their half ranges, those of one half range together; "" of none.

    box : shares of the parameters; of differences and offsets half ranges in SI
    parameters : of the machine, which tell the two apart; None: all are shares

    >>> box_words({"m": 0.2, "K_A": 0.2, "R": 0.05})
    'm K_A ±20 %, R ±5 %'
    """
    units = {} if parameters is None else differences(parameters)
    together: dict[str, list[str]] = {}
    for name, half in box.items():
        size = quantity(half, units[name]) if name in units else f"{100 * half:.4g} %"
        together.setdefault(size, []).append(name)
    return ", ".join(f"{' '.join(names)} ±{size}" for size, names in together.items())

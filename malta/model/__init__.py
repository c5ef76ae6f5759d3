"""Machines as records: parameters, plants in CasADi, rigid bodies, linearization, signals and units."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.model.coils import Allocation as Allocation, allocation as allocation
    from malta.model.data import published as published
    from malta.model.linearize import LinearModel as LinearModel
    from malta.model.parameters import check_parameters as check_parameters, si as si
    from malta.model.plant import (
        Actuator as Actuator,
        OperatingPoint as OperatingPoint,
        Plant as Plant,
        Signal as Signal,
    )
    from malta.model.signals import InverseCheck as InverseCheck, LateSensors as LateSensors
    from malta.units import in_unit as in_unit

_NAMES = {
    "malta.model.coils": "Allocation allocation",
    "malta.model.data": "published",
    "malta.model.linearize": "LinearModel",
    "malta.model.parameters": "check_parameters si",
    "malta.model.plant": "Actuator OperatingPoint Plant Signal",
    "malta.model.signals": "InverseCheck LateSensors",
    "malta.units": "in_unit",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

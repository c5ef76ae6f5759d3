"""Machines as records: parameters, plants in CasADi, rigid bodies, linearization, signals and units."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.model.actuator import Actuator as Actuator
    from malta.model.coils import Allocation as Allocation, allocation as allocation
    from malta.model.contacts import Contacts as Contacts
    from malta.model.inverse import InverseCheck as InverseCheck
    from malta.model.linearize import LinearModel as LinearModel
    from malta.model.parameters import check_parameters as check_parameters, si as si
    from malta.model.plant import OperatingPoint as OperatingPoint, Plant as Plant, Signal as Signal
    from malta.model.printed import read_published as read_published
    from malta.model.sensors import Sensors as Sensors
    from malta.model.stroke import Stroke as Stroke
    from malta.model.vibration import vibration_preset as vibration_preset
    from malta.units import in_unit as in_unit

_NAMES = {
    "malta.model.actuator": "Actuator",
    "malta.model.coils": "Allocation allocation",
    "malta.model.contacts": "Contacts",
    "malta.model.inverse": "InverseCheck",
    "malta.model.linearize": "LinearModel",
    "malta.model.parameters": "check_parameters si",
    "malta.model.plant": "OperatingPoint Plant Signal",
    "malta.model.printed": "read_published",
    "malta.model.sensors": "Sensors",
    "malta.model.stroke": "Stroke",
    "malta.model.vibration": "vibration_preset",
    "malta.units": "in_unit",
}
__all__, __getattr__, __dir__ = contents(
    __name__, _NAMES, {"LateSensors": "malta.model.Sensors", "published": "malta.model.read_published"}
)

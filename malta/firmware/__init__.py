"""Firmware: the control law as C that computes the same bits on every processor, its tests, and FMUs."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.firmware.flight import engine_of_c as engine_of_c
    from malta.firmware.pil import Replay as Replay, replay_on_target as replay_on_target
    from malta.firmware.reentry import recoverable as recoverable
    from malta.firmware.reference_limits import limit_reference as limit_reference

_NAMES = {
    "malta.firmware.flight": "engine_of_c",
    "malta.firmware.pil": "Replay replay_on_target",
    "malta.firmware.reentry": "recoverable",
    "malta.firmware.reference_limits": "limit_reference",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

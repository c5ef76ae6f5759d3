"""Firmware: the control law as C that computes the same bits on every processor, its tests, and FMUs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.firmware.flight import engine_of_c as engine_of_c
    from malta.firmware.pil import Replay as Replay
    from malta.firmware.pil import replay_on_target as replay_on_target

__all__, __getattr__, __dir__ = contents(__name__, __file__)

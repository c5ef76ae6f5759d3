"""What `malta verify` reports of a design: margins over the travel, stage by stage; poles, peaks and bandwidths."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.margins.loop_report import LoopReport as LoopReport
    from malta.margins.scheduled_loops import schedule_rate as schedule_rate

__all__, __getattr__, __dir__ = contents(__name__, __file__)

"""What `malta verify` reports of a design: margins over the travel, stage by stage; poles, peaks and bandwidths."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.margins.load_sizes import load_limits as load_limits
    from malta.margins.loop_report import LoopReport as LoopReport
    from malta.margins.schedule_rates import schedule_rate as schedule_rate

_NAMES = {
    "malta.margins.load_sizes": "load_limits",
    "malta.margins.loop_report": "LoopReport",
    "malta.margins.schedule_rates": "schedule_rate",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

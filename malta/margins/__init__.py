"""What `malta verify` reports of a design: margins over the travel, stage by stage; poles, peaks and bandwidths."""

from malta.margins.loop_report import LoopReport as LoopReport
from malta.margins.schedule_rates import schedule_rate as schedule_rate

"""Campaigns: one scenario on thousands of machines, or on a hundred million.

plan -> store -> result -> summary -> run, with dask.py for a cluster: all figures, or a summary of any number of runs
limits -> rare, studies: rare events, sensitivities and tolerances on the box of a plan
"""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.campaigns.limits import limit_of as limit_of
    from malta.campaigns.plan import Plan as Plan
    from malta.campaigns.rare import rare_event as rare_event
    from malta.campaigns.result import Campaign as Campaign
    from malta.campaigns.run import summarize as summarize
    from malta.campaigns.studies import sensitivity as sensitivity, tolerances as tolerances
    from malta.campaigns.summary import Summary as Summary

_NAMES = {
    "malta.campaigns.limits": "limit_of",
    "malta.campaigns.plan": "Plan",
    "malta.campaigns.rare": "rare_event",
    "malta.campaigns.result": "Campaign",
    "malta.campaigns.run": "summarize",
    "malta.campaigns.studies": "sensitivity tolerances",
    "malta.campaigns.summary": "Summary",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

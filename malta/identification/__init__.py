"""From the bench back to the design: logs, excitation, parameters with intervals, and what a stroke teaches."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.identification.convergence import contraction as contraction
    from malta.identification.dump import ExactReplay as ExactReplay, replay_dump as replay_dump
    from malta.identification.excite import ExcitationPlan as ExcitationPlan
    from malta.identification.frequency_response import (
        FrequencyResponse as FrequencyResponse,
        compare_response as compare_response,
        read_response as read_response,
        responses_of as responses_of,
        write_responses as write_responses,
    )
    from malta.identification.identified import Identified as Identified
    from malta.identification.identify import weigh as weigh
    from malta.identification.learn import Learned as Learned, LearnedV0 as LearnedV0, learn_v0 as learn_v0
    from malta.identification.log import Log as Log, log_of as log_of
    from malta.identification.log_files import read_log as read_log, write_log as write_log
    from malta.identification.measure import (
        Measurement as Measurement,
        MeasurementPlan as MeasurementPlan,
        plan_measurement as plan_measurement,
    )
    from malta.identification.realization import Realization as Realization
    from malta.identification.record_fit import RecordFit as RecordFit
    from malta.identification.records import identify_record as identify_record
    from malta.identification.replay import LawReplay as LawReplay, replay_law as replay_law
    from malta.identification.strokes import (
        LearnedStrokes as LearnedStrokes,
        learn_strokes as learn_strokes,
        next_stroke as next_stroke,
    )
    from malta.identification.windings import Windings as Windings, identify_windings as identify_windings

_NAMES = {
    "malta.identification.convergence": "contraction",
    "malta.identification.dump": "ExactReplay replay_dump",
    "malta.identification.excite": "ExcitationPlan",
    "malta.identification.frequency_response": "FrequencyResponse compare_response read_response responses_of "
    "write_responses",
    "malta.identification.identified": "Identified",
    "malta.identification.identify": "weigh",
    "malta.identification.learn": "Learned LearnedV0 learn_v0",
    "malta.identification.log": "Log log_of",
    "malta.identification.log_files": "read_log write_log",
    "malta.identification.measure": "Measurement MeasurementPlan plan_measurement",
    "malta.identification.realization": "Realization",
    "malta.identification.record_fit": "RecordFit",
    "malta.identification.records": "identify_record",
    "malta.identification.replay": "LawReplay replay_law",
    "malta.identification.strokes": "LearnedStrokes learn_strokes next_stroke",
    "malta.identification.windings": "Windings identify_windings",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

"""The loop of a machine and its law, and everything linear that is asked of it.

loop, sampled_loops   machine x law x operating point x parameters, over one sample
linear_loops          any loop as matrices; systems of python-control
classical             disk, delay, gain and phase margins, one channel at a time too
curves, locus         responses, poles, zeros; root loci
time_domain           answers to references and loads, and what noise leaves at rest
"""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.loops.curves import LoopCurves as LoopCurves, loop_curves as loop_curves
    from malta.loops.floors import floor_motion as floor_motion
    from malta.loops.linear_loops import LoopSystems as LoopSystems, loop_systems as loop_systems
    from malta.loops.loop import Loop as Loop
    from malta.loops.noise import NoisePeaks as NoisePeaks, noise_peaks as noise_peaks
    from malta.loops.time_domain import Recovery as Recovery, recovery as recovery

_NAMES = {
    "malta.loops.curves": "LoopCurves loop_curves",
    "malta.loops.floors": "floor_motion",
    "malta.loops.linear_loops": "LoopSystems loop_systems",
    "malta.loops.loop": "Loop",
    "malta.loops.noise": "NoisePeaks noise_peaks",
    "malta.loops.time_domain": "Recovery recovery",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

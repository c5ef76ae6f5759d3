"""Plots that a control engineer expects of any loop; numbers are those of malta/loops/curves.py."""

from malta.report.plots.diagram import block_diagram as block_diagram
from malta.report.plots.frequency import (
    bode as bode,
    gang_of_four as gang_of_four,
    sensitivity_curves as sensitivity_curves,
    sigma as sigma,
)
from malta.report.plots.plane import pzmap as pzmap, root_locus as root_locus
from malta.report.plots.polar import margin_map as margin_map, nichols as nichols, nyquist as nyquist
from malta.report.plots.supervisor_states import statechart as statechart
from malta.report.plots.time import load_response as load_response, step as step

"""Plots that a control engineer expects of any loop; numbers are those of malta/loops/curves.py."""

from malta.report.plots.frequency import bode as bode
from malta.report.plots.frequency import gang_of_four as gang_of_four
from malta.report.plots.frequency import sensitivity_curves as sensitivity_curves
from malta.report.plots.frequency import sigma as sigma
from malta.report.plots.plane import pzmap as pzmap
from malta.report.plots.plane import root_locus as root_locus
from malta.report.plots.polar import margin_map as margin_map
from malta.report.plots.polar import nichols as nichols
from malta.report.plots.polar import nyquist as nyquist
from malta.report.plots.time import load_response as load_response
from malta.report.plots.time import step as step

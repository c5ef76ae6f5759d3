"""What a page shows of a log: its signals small; of an excited loop S as measured, and the machine as identified."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING

from malta.display import micro, quantity
from malta.errors import CheckError, InputError
from malta.identification.survey import SOUND_LOG
from malta.report.figures import identified_figure, measured_figure, strips_figure
from malta.report.page.sections import Illustration, Item

if TYPE_CHECKING:
    from malta.identification.log import Log
    from malta.synthesis.controller import Controller


def log_items(controller: Controller, log: Log, box: Mapping[str, float]) -> Iterator[Item]:
    """The signals of a log by their units; of one under a periodic excitation also the loop and the machine in it.

    controller : under which it was recorded
    box : parameter -> share, either way, of the tube about predicted curves

    What is refused is said in its sentence.
    """
    from malta.identification.identify import identify
    from malta.identification.measure import measure

    findings = "; ".join(log.survey.findings) or SOUND_LOG
    yield Illustration(
        partial(strips_figure, log),
        f"{log.source}: {log.samples} samples of {micro(quantity(log.sample_time, 's'))}; {findings}. A line goes "
        "through the least and the largest value of each stretch.",
    )
    if not (log.period and log.names("excitation")):
        return
    try:
        measured = measure(controller, log, uncertainty=box)
        yield Illustration(
            partial(measured_figure, measured),
            "The loop as measured, bars of 95 %, over the loop as predicted; grey: the tube of the uncertainty.",
        )
        found = identify(controller, log)
        if found.explanation is not None:
            yield Illustration(
                partial(identified_figure, found),
                "Responses at the excited lines, measured and explained; what is left beside the noise; |S| of the "
                "identified machine as predicted and measured.",
            )
        yield f"malta identify: {found.verdict}."
    except (InputError, CheckError) as error:
        yield str(error)

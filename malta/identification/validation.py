"""An identified machine on a second log, which it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from malta.identification.checks import LoopCheck, check_loop
from malta.identification.explanation import excess_share, residual_shares
from malta.identification.response import ResponseModel
from malta.identification.signal_checks import require_signals
from malta.identification.spectra import (
    between_neighbours,
    in_axes,
    readings,
    require_log,
    spectrum_of,
    whole,
)
from malta.model.plants import plant_of

if TYPE_CHECKING:
    from malta.identification.identified import Identified
    from malta.identification.log import Log
    from malta.synthesis.controller import Controller

MIN_EXPLAINED = 0.98  # of the response at the lines of a second log


class Validation(NamedTuple):
    """An identified machine on a second log, which it has not seen.

    source : the log
    explained : by output: share of the response at the lines that it predicts, beside noise
    loop : its loop beside S as this log has it; None: the log tells no S
    """

    source: str
    explained: Mapping[str, float]
    loop: LoopCheck | None

    @property
    def refusal(self) -> str:
        """Why the machine is not that of the second log; "": it is."""
        worst = min(self.explained, key=lambda name: self.explained[name])
        if self.explained[worst] < MIN_EXPLAINED:
            least = f"{100 * self.explained[worst]:.4g} % of {worst}, at least {100 * MIN_EXPLAINED:g} % are asked"
            return f"on {self.source} the identified machine explains {least}"
        return "" if self.loop is None else self.loop.refusal

    @property
    def verdict(self) -> str:
        """What the second log says, in a sentence."""
        shares = ", ".join(f"{name} {100 * share:.4g} %" for name, share in self.explained.items())
        measured = "" if self.loop is None else f"; |S| within {100 * self.loop.error:.2g} % beside its band"
        return f"predicted at the lines: {shares}{measured}"


def validate(controller: Controller, found: Identified, log: Log) -> Validation:
    """Validate an identified machine on a second log under an excitation: its response, and its S.

    controller : the gain file that was running
    found : the identified machine; imperfections of its bench that explained the first log are those of the second one
    log : that was not identified from

    Raises InputError and CheckError as `malta.identify` does.
    """
    plant, e = found.plant, found.explanation
    log = in_axes(log, plant)
    require_log(log, plant.name, controller.sample_time)
    require_signals(controller, plant_of(controller.parameters), log)
    s = spectrum_of(log, between_neighbours(readings(log, robust=False)), whole(log, "i"))
    mean, currents = (s.outputs[0].real, s.currents[0].real), tuple(log.names("i"))
    model, theta = ResponseModel(plant, found.names, currents, *mean, log.sample_time), found.values
    if e is not None and found.chi2 > found.limit:
        model, theta = replace(model, names=e.names, bench=e.bench), e.x
    _, left, noise = residual_shares(model, s, theta)
    shares = (1 - excess_share(left, noise)).tolist()
    explained = dict(zip([o.name for o in plant.outputs], shares, strict=True))
    return Validation(log.source, explained, check_loop(controller, plant, log))

"""What a certificate claims, for a terminal: of which loop, and in which box. Digits are cut towards less."""

from __future__ import annotations

from rich.table import Table

from malta.bound import at_least, at_most
from malta.checker.file import StabilityClaim, double, inside
from malta.report.tables import add_row, new_table

DIGITS = 7  # of the ends of an interval
LOOPS = {"lag": "current loops, if any, as first-order lags", "pi": "the PI current loops of the gain file"}


def claim_text(claim: StabilityClaim) -> str:
    """The loop that a certificate names: machine, law, stage and sample time."""
    T = "continuous" if claim.sample_time is None else f"sampled every {double(claim.sample_time):g} s"
    if claim.origin is None:
        return f"Claim: of matrices alone, {T}"
    o = claim.origin
    text = f"Claim: {o.machine}, preset {o.preset}; law {o.law}, sha256 {o.sha256[:12]}..., {T}"
    text += f"; with {LOOPS[o.current_loops]}"
    if claim.places is not None:
        at = ", ".join(f"{double(x):g}" for x in claim.places.at)
        text += f"; at {claim.places.name} = {at} {claim.places.unit}, not between them"
    return text


def claim_share(claim: StabilityClaim) -> str:
    """The multiple of the uncertainty that is claimed, in percent, cut."""
    return at_least(double(claim.lower)).percent()


def claim_table(claim: StabilityClaim) -> Table:
    """The box of a certificate: each parameter with its nominal value and its interval at the claim, cut inwards."""
    table = new_table(f"The box at {claim_share(claim)}", "parameter", "nominal", "from", "to", "unit")
    for p in claim.parameters:
        low, high = inside(*p.interval)
        ends = [at_most(low).text(DIGITS), at_least(high).text(DIGITS)]
        if not float(ends[0]) <= double(p.nominal) <= float(ends[1]):  # narrower than the digits
            ends = [repr(low), repr(high)]
        add_row(table, p.name, f"{double(p.nominal):.{DIGITS}g}", *ends, p.unit or "")
    return table

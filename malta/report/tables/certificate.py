"""What a certificate claims, for a terminal: of which loop, and in which box. Digits are cut towards less."""

from __future__ import annotations

from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from typing import TYPE_CHECKING, Any

from rich.table import Table

from malta.proof.certificate.checked_file import double
from malta.report.tables.parts import add_row, new_table

if TYPE_CHECKING:
    from malta.proof.certificate.checked_file import Claim

DIGITS = 7  # of the ends of an interval
LOOPS = {"lag": "current loops, if any, as first-order lags", "pi": "the PI current loops of the gain file"}


def claim_text(claim: Claim) -> str:
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


def claim_share(claim: Claim) -> str:
    """The multiple of the uncertainty that is claimed, in percent, cut."""
    lower = double(claim.lower)
    near = round(100_000 * lower)
    return f"{(near if near / 100_000 <= lower else near - 1) / 1000:.3f} %"


def claim_table(claim: Claim) -> Table:
    """The box of a certificate: each parameter with its nominal value and its interval at the claim, cut inwards."""
    table = new_table(f"The box at {claim_share(claim)}", "parameter", "nominal", "from", "to", "unit")
    for p in claim.parameters:
        low, high = _cut(p.interval[0], ROUND_CEILING), _cut(p.interval[1], ROUND_FLOOR)
        ends = [f"{x:.{DIGITS}g}" for x in (low, high)]
        if not low <= double(p.nominal) <= high:  # narrower than the digits
            ends = [repr(double(x)) for x in p.interval]
        add_row(table, p.name, f"{double(p.nominal):.{DIGITS}g}", *ends, p.unit or "")
    return table


def _cut(x: Any, towards: str) -> float:
    """An end with some digits: the nearest number, unless that is beyond the end."""
    end = double(x)
    near = float(f"{end:.{DIGITS}g}")
    within = near >= end if towards == ROUND_CEILING else near <= end
    return near if within else float(Context(prec=DIGITS, rounding=towards).create_decimal(end))

"""The ledger of a machine's paper as a record: every number that it publishes, ours for each design, and a verdict.

The distribution malta-papers computes it; how, its module `malta_papers.ledger` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from malta.model.parts import require_ledger

if TYPE_CHECKING:
    from malta.simulation.experiments import Progress
    from malta.synthesis.spec import Spec

Word = Literal["reproduced", "near", "kept", "input", "differs", "partly", "beside", "ours", "other"]


class LedgerClaim(NamedTuple):
    """A line of the ledger."""

    subject: str
    published: str
    ours: tuple[str, ...]  # for each design
    verdict: str  # with notes and reasons
    word: Word  # the verdict in one


@dataclass(frozen=True)
class Ledger:
    """All claims of the paper on a machine, for some designs."""

    machine: str
    source: str  # the paper
    designs: tuple[str, ...]
    claims: tuple[LedgerClaim, ...]
    reproducing: tuple[str, ...] = ()  # those of the designs that are meant to reproduce the paper
    left: int = 0  # claims that there was no time for

    @property
    def title(self) -> str:
        """The machine and its paper."""
        return f"{self.machine}, {self.source}"

    def markdown(self) -> str:
        """The table as the pages of claims show it."""
        header = ["claim", "published", *(f"`{name}`" for name in self.designs), "verdict"]
        rows = [[c.subject, c.published, *c.ours, c.verdict] for c in self.claims]
        lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
        return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]]) + "\n"


def ledger(specs: Sequence[Spec], published: Mapping[str, Any], progress: Progress | None = None) -> Ledger:
    """Compute every claim of the paper on a machine for some designs of it.

    A verdict follows from the numbers: "reproduced", "within x %", "not reproduced" with the reason, and others.

    specs : designs of one machine, from `malta.read_design`
    published : what the paper prints, from `malta.model.read_published`
    progress : called with the share of the work that is done, 0 to 1

    Returns a Ledger: for each claim the paper's figure, that of each design, and the verdict.

    Raises InputError for designs of another machine, of one without claims, when the published figures lack one, and
    where malta-papers is not installed.

    >>> import malta
    >>> spec = malta.read_design("design/halbach_pid.toml")
    >>> found = malta.ledger([spec], malta.model.read_published("data/halbach.toml"))
    >>> pitch = found.claims[0]
    >>> found.designs, pitch.subject, pitch.published, pitch.ours
    (('halbach_pid',), 'pitch, 2π/k [mm]', '29.778', ('29.778',))
    """
    found: Ledger = require_ledger().compute_ledger(specs, published, progress)
    return found

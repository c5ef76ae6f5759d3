"""`python -m checker CERTIFICATE`: 0: it holds; 1: it does not; 2: the file is no certificate."""

from __future__ import annotations

import sys

from .check import CertificateVerdict, check
from .file import StabilityClaim, Unreadable, double


def main(arguments: list[str]) -> int:
    """Print the claim, what was shown and what was not; returns the exit code."""
    if len(arguments) != 1:
        print("usage: python -m checker CERTIFICATE", file=sys.stderr)
        return 2
    try:
        found = check(arguments[0])
    except Unreadable as error:
        print(error, file=sys.stderr)
        return 2
    print(*_lines(found), sep="\n")
    print(*found.failures, sep="\n", end="\n" if found.failures else "", file=sys.stderr)
    return 0 if found.ok else 1


def _lines(found: CertificateVerdict) -> list[str]:
    """The claim with its box, the groups, the verdict."""
    box = [
        f"{p.name} in [{double(p.interval[0])!r}, {double(p.interval[1])!r}] {p.unit or ''}".rstrip()
        for p in found.stated.parameters
    ]
    verdict = "holds" if found.ok else "does not hold"
    return [_subject(found.stated), *box, *found.groups, f"stable in {found.claim!r} of the box: {verdict}"]


def _subject(claim: StabilityClaim) -> str:
    """Whose loops these are said to be."""
    origin, T = claim.origin, claim.sample_time
    whose = "matrices of no machine" if origin is None else f"{origin.machine}, law {origin.law}"
    where = "" if claim.places is None else f", at {len(claim.places.at)} places of {claim.places.name}"
    return f"{whose}, {'continuous' if T is None else f'sampled every {double(T)!r} s'}{where}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

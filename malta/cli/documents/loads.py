"""The document of `malta loads`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from malta.cli.documents.loops import DocumentPart, Files, Name, Number, Shares
from malta.margins.load_sizes import COVERED, LEFT_OUT

if TYPE_CHECKING:
    from malta.loops.loop import Loop
    from malta.margins.load_sizes import LoadLimit


class SignalReach(DocumentPart):
    """How far a signal goes at most."""

    name: str
    value: float
    unit: str


class NamedShare(DocumentPart):
    """A share of a clearance, or of a limit."""

    name: str
    share: float


class SizeCourse(DocumentPart):
    """The share of a clearance that is used at most, over the size of a load."""

    sizes: list[float]
    used: list[float]
    linear_sizes: list[float]
    linear_used: list[float]


class LoadLimitPart(DocumentPart):
    """How large a load may be, whatever its waveform; SI, sizes in `unit`."""

    load: str
    unit: str
    proven: Number = Field(description="largest size that is proven; null: nothing is")
    beyond: Number = Field(description="a larger size that is not proven; null: nothing is proven")
    ends: str = Field(description="what may happen at `beyond`, or why nothing is proven")
    linear_touches: Number = Field(
        description="from which size on the linear loop touches; null: never, or not known"
    )
    linear_contact: str = Field(description='what it touches; "": nothing, or not known')
    outputs: list[SignalReach] = Field(description="how far each output goes at most at `proven`")
    clearances: list[NamedShare] = Field(description="the largest use of each at `proven`")
    forces: list[NamedShare] = Field(
        description="of each command, the largest share of its limit at `proven`"
    )
    course: SizeCourse | None = Field(
        description="of loads that are drawn; null: of others, or nothing is drawn"
    )


class LinearReach(DocumentPart):
    """How far a signal of the linear loop goes at most, SI; on a floor rms."""

    by: str = Field(description="along which load the floor shakes, or of what a request is")
    signal: str
    value: float
    unit: str


class LoadsOutput(DocumentPart):
    """What `malta loads --json` prints."""

    kind: Literal["malta-loads-output"] = Field(default="malta-loads-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    design: str
    files: Files
    covered: str = Field(description="what it is proven of")
    left_out: str = Field(description="of the machine")
    uncertainty: Shares
    noise: float = Field(description="errors of readings are at most so many times their rms")
    aside: list[SignalReach] = Field(description="states that the law leaves alone, at most")
    clearance: float = Field(default=1.0, description="share of a clearance that may be used")
    loads: list[LoadLimitPart]
    linear: list[LinearReach] = Field(default=[], description="with a floor or requests, and no loads then")


def loads_output(
    gains: Path, loop: Loop, found: Sequence[LoadLimit], box: Mapping[str, float], files: Sequence[Path]
) -> LoadsOutput:
    """The document of the limits of loads."""
    return LoadsOutput(
        gains=str(gains),
        design=loop.controller.name,
        files=[str(file) for file in files],
        covered=COVERED,
        left_out=LEFT_OUT,
        uncertainty=dict(box),
        noise=found[0].safe.noise,
        clearance=found[0].safe.clearance,
        aside=_reaches(next((one.safe.aside for one in found if one.safe.limit is not None), {})),
        loads=[_limit_part(one) for one in found],
    )


def linear_output(
    gains: Path, name: str, what: str, found: Sequence[tuple[str, str, float, str]]
) -> LoadsOutput:
    """The document of what is of the linear loop alone, under a floor or requests."""
    reaches = [LinearReach(by=by, signal=signal, value=x, unit=unit) for by, signal, x, unit in found]
    return LoadsOutput(
        gains=str(gains), design=name, files=[], covered=f"{what}; of the linear loop at rest, at samples",
        left_out="noise", uncertainty={}, noise=0.0, aside=[], loads=[], linear=reaches,
    )  # fmt: skip


def _reaches(signals: Mapping[str, tuple[float, str]]) -> list[SignalReach]:
    return [SignalReach(name=name, value=value, unit=unit) for name, (value, unit) in signals.items()]


def _shares(shares: Mapping[str, float]) -> list[NamedShare]:
    return [NamedShare(name=name, share=share) for name, share in shares.items()]


def _limit_part(found: LoadLimit) -> LoadLimitPart:
    safe, course = found.safe, found.course
    drawn = None if course is None else SizeCourse(
        sizes=course.sizes.tolist(), used=course.used.tolist(),
        linear_sizes=course.linear[0].tolist(), linear_used=course.linear[1].tolist(),
    )  # fmt: skip
    return LoadLimitPart(
        load=safe.disturbance,
        unit=safe.unit,
        proven=safe.limit,
        beyond=None if safe.limit is None else safe.beyond,
        ends=safe.ends,
        linear_touches=found.touches,
        linear_contact=found.contact if math.isfinite(found.touches) else "",
        outputs=_reaches(safe.outputs),
        clearances=_shares(safe.used),
        forces=_shares(safe.forces),
        course=drawn,
    )

"""How large each load on a machine may be: the size that is proven, what ends it, where the linear loop touches."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from malta.arguments import describe
from malta.arrays import FloatArray, readonly
from malta.bound import Bound, at_least
from malta.display import Description, display, quantity
from malta.errors import InputError
from malta.linear.expressions import NotAnalytic
from malta.loops.loop import Loop
from malta.loops.waveforms import largest_load, used_clearances
from malta.margins.safe_loads import ASIDE, CALLER, NOISE, Load, SafeLoad, answers, bounds_under
from malta.margins.surroundings import Surroundings
from malta.processes import on_one_thread
from malta.proof.margin import Ranges
from malta.proof.polynomial.enclosure import Unproven
from malta.work import WorkUp, is_stopped

COURSE_SHARES = (0.0, 0.5, 0.8, 1.0)  # of the largest proven load, at which its use of clearance is drawn
COVERED = "the nonlinear machine from rest, with forces as fidelity=force flies them"
LEFT_OUT = "induced voltages, voltage limits and the DC link"


@dataclass(frozen=True, eq=False)
class LoadCourse:
    """The largest share of a clearance that is used under any waveform of a load, over its size.

    sizes, used : of the nonlinear machine, proven: SI, and shares
    linear : sizes and shares of the linear loop
    """

    sizes: FloatArray
    used: FloatArray
    linear: tuple[FloatArray, FloatArray]


@display
@dataclass(frozen=True, eq=False)
class LoadLimit:
    """How large a load may be, whatever its waveform.

    safe : what is proven of the nonlinear machine, a SafeLoad
    touches : from which size on some waveform of it makes the linear loop touch, or use more of a clearance than is
        allowed, SI; infinite: none; NaN: not computed
    contact : what is touched then
    course : a LoadCourse, where it was asked for and anything is proven
    """

    safe: SafeLoad
    touches: float = math.nan
    contact: str = ""
    course: LoadCourse | None = field(default=None, repr=False)

    @property
    def proven(self) -> Bound:
        """The largest size that is proven, as it is shown."""
        return at_least(self.safe.limit)

    @property
    def furthest(self) -> tuple[str, float] | None:
        """The contact of whose clearance most is used, and the share; None without contacts, or without a proof."""
        return max(self.safe.used.items(), key=lambda one: one[1]) if self.safe.used else None

    @property
    def description(self) -> Description:
        """What is proven, and where the linear loop touches."""
        own = self.safe.description
        if not math.isfinite(self.touches):
            return own
        reaches = "touches" if self.safe.clearance == 1 else "uses more"
        touches = f"{reaches} from {quantity(self.touches, self.safe.unit)} on: {self.contact}"
        return Description(own.title, (*own.rows[:1], ("linear loop", touches), *own.rows[1:]))


@on_one_thread
def load_limits(
    loop: Loop,
    loads: Sequence[Load | Sequence[Load]] | None = None,
    ranges: Ranges | None = None,
    *,
    noise: float = NOISE,
    aside: float | Mapping[str, float] = ASIDE,
    courses: bool = False,
    clearance: float = 1.0,
) -> tuple[LoadLimit, ...]:
    """Prove how large each load on a machine may be, and look where the linear loop touches.

    loop : from `malta.loop`
    loads : each as of `malta.safe_load`; None: each of the machine's disturbances
    ranges, noise, aside, clearance : as of `malta.safe_load`; the linear loop is nominal
    courses : whether the use of clearance over the size is asked for, of the first load of each unit that is proven

    Returns a LoadLimit for each load. Where the time is up, nothing is known of those that are left.

    Raises InputError for a machine on which no load acts from outside, and as `malta.safe_load`.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/structured.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> (found,) = malta.margins.load_limits(loop, ["F_x"])
    >>> f"proven {found.proven.text(3)} N, linear touch at {found.touches:.3g} N"
    'proven 17.1 N, linear touch at 42.6 N'
    """
    if not isinstance(loop, Loop):
        raise InputError(CALLER, "loop", describe(loop), "a Loop, from malta.loop")
    plant = loop.plant
    asked = [s.name for s in plant.disturbances] if loads is None else loads
    if not asked:
        where = (plant.name, "disturbances") if loads is None else (CALLER, "loads")
        raise InputError(*where, "none", "a load, a force that acts from outside")
    found, drawn = list[LoadLimit](), set[str]()
    proofs = answers(loop, asked, ranges, noise=noise, aside=aside, clearance=clearance)
    for load, (safe, near) in zip(asked, proofs, strict=True):
        single = isinstance(load, str | Mapping) and loop.stable and not is_stopped()
        touches, contact = (math.nan, "")
        if single and plant.contacts.names:
            touches, contact = largest_load(loop, load, clearance)  # type: ignore[arg-type]
        course = None
        if courses and single and near is not None and safe.used and safe.unit not in drawn:
            course = _course(loop, load, safe, near, touches)  # type: ignore[arg-type]
            drawn.add(safe.unit)
        found.append(LoadLimit(safe, touches, contact, course))
    return tuple(found)


def _course(loop: Loop, load: Load, safe: SafeLoad, near: Surroundings, touches: float) -> LoadCourse:
    """The use of clearance over the size of a load, up to what is proven, and of the linear loop beyond."""
    sizes, used = list[float](), list[float]()
    for share in COURSE_SHARES[:-1]:
        try:
            _, own = bounds_under(near, share * (safe.limit or 0.0))
        except (Unproven, NotAnalytic, WorkUp):  # a search from a smaller set may end elsewhere
            continue
        sizes.append(share * (safe.limit or 0.0))
        used.append(float(own.max()))
    sizes.append(safe.limit or 0.0)
    used.append(max(safe.used.values()))
    end = touches if math.isfinite(touches) else 1.5 * (safe.limit or 0.0)
    line = np.linspace(0.0, min(end, 4 * (safe.limit or 0.0)), 9)
    linear = used_clearances(loop, load, line).max(axis=1)
    return LoadCourse(readonly(np.array(sizes)), readonly(np.array(used)), (readonly(line), readonly(linear)))

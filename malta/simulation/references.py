"""References: outputs that a machine shall follow, with their derivatives.

A reference is a function of time (s, shape (k,)) that returns p*, its first and its second derivative, each k x p in
the order of the plant's outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.parts import attribute_of
from malta.model.plant import Plant

Profile = Literal["logistic", "quintic"]
"""The courses of a stroke: "logistic" or "quintic".

>>> import malta
>>> from typing import get_args
>>> get_args(malta.references.Profile)
('logistic', 'quintic')
"""
RISE = 20e-3  # s, of machines without a RISE of their own
"""The rise of a stroke, s, 10-90 %, of machines without one of their own.

>>> import malta
>>> malta.references.RISE
0.02
"""


class Motion(NamedTuple):
    """Reference outputs and their derivatives at k times.

    p : p*, k x p, m
    dp : p*', k x p, m/s
    ddp : p*'', k x p, m/s2

    >>> import malta
    >>> import numpy as np
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> motion = malta.references.hold(plant, z=1e-3)(np.array([0.0, 0.1]))
    >>> motion.p.shape, motion.p[:, -1].tolist(), float(motion.dp.max())
    ((2, 5), [0.001, 0.001], 0.0)
    """

    p: FloatArray
    dp: FloatArray
    ddp: FloatArray


Reference = Callable[[FloatArray], Motion]
"""A function of time (s, shape (k,)) that returns the Motion at these times.

>>> import malta
>>> import numpy as np
>>> def ramp(t):  # 1 mm/s
...     zeros = np.zeros((len(t), 1))
...     return malta.references.Motion(1e-3 * t[:, None], zeros + 1e-3, zeros)
>>> scenario = malta.Scenario("ramp", 0.1, lambda plant: ramp)
>>> scenario.reference(None)(np.array([0.0, 0.1])).p.tolist()
[[0.0], [0.0001]]
"""


def logistic(
    t: Any, rise: Any, tanh: Callable[[Any], Any] = np.tanh
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate the logistic function s = 1 / (1 + e^(-k t)), centred at t = 0, with its derivatives.

    t : s
    rise : s, from 10 to 90 %: k = 2 ln 9 / rise
    tanh : of numpy, or CasADi's for expressions

    Returns s (1), s' (1/s) and s'' (1/s2).

    >>> import malta
    >>> import numpy as np
    >>> t = np.array([-10e-3, 0.0, 10e-3])
    >>> s, ds, dds = malta.references.logistic(t, rise=20e-3)
    >>> s.round(3).tolist(), f"{ds[1]:.1f}"
    ([0.1, 0.5, 0.9], '54.9')
    """
    k = 2 * math.log(9) / rise
    s = 0.5 * (1 + tanh(k * t / 2))  # 1 / (1 + e^(-k t)) without overflow
    ds = k * s * (1 - s)
    return s, ds, k * ds * (1 - 2 * s)


def quintic(
    t: Any, rise: Any, clip: Callable[[Any, Any, Any], Any] = np.clip
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate s = 10 u^3 - 15 u^4 + 6 u^5, u from 0 to 1, centred at t = 0, with its derivatives; at rest outside.

    t : s
    rise : s, from 10 to 90 %; the whole move takes QUINTIC_DURATION times `rise`
    clip : of numpy, or one for expressions

    Returns s (1), s' (1/s) and s'' (1/s2).

    >>> import malta
    >>> import numpy as np
    >>> t = np.array([-10e-3, 0.0, 10e-3, 1.0])
    >>> s, ds, dds = malta.references.quintic(t, rise=20e-3)
    >>> s.round(3).tolist(), f"{ds[1]:.1f}"
    ([0.1, 0.5, 0.9, 1.0], '47.5')
    """
    T = QUINTIC_DURATION * rise
    u = clip(t / T + 0.5, 0, 1)
    return (
        u**3 * (10 + u * (6 * u - 15)),
        30 * (u * (1 - u)) ** 2 / T,
        60 * u * (1 - u) * (1 - 2 * u) / T**2,
    )


QUINTIC_DURATION = 1 / (1 - 2 * 0.24663645328846656)  # 10 u^3 - 15 u^4 + 6 u^5 = 0.1 at u = 0.2466
"""The duration of a quintic move over its rise: 10 u^3 - 15 u^4 + 6 u^5 = 0.1 at u = 0.2466.

>>> import malta
>>> f"{malta.references.QUINTIC_DURATION:.4f}"
'1.9734'
"""

PROFILES: dict[str, Callable[[Any, Any], tuple[FloatArray, FloatArray, FloatArray]]] = {
    "logistic": logistic,
    "quintic": quintic,
}
"""The functions of the courses of a stroke, by name.

>>> import malta
>>> sorted(malta.references.PROFILES)
['logistic', 'quintic']
"""


def stroke(
    plant: Plant, start: float, end: float, rise: float | None, centre: float, profile: Profile = "logistic"
) -> Reference:
    """Make the reference of a move of the stroke axis; the other outputs stay at zero.

    plant : the machine, with a stroke
    start : m
    end : m
    rise : s, 10-90 %; None: the machine's own, RISE of its experiments, or 20 ms
    centre : s, when the move is half-way
    profile : "logistic" or "quintic"

    Returns a Reference.

    Raises InputError for an unknown profile, a rise out of range, and positions beyond the travel.

    >>> import malta
    >>> import numpy as np
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> move = malta.references.stroke(plant, -5e-3, 5e-3, 20e-3, 50e-3, "quintic")
    >>> (1e3 * move(np.array([0.0, 0.05, 0.06, 0.1])).p[:, -1]).round(3).tolist()  # mm
    [-5.0, 0.0, 4.0, 5.0]
    """
    if profile not in PROFILES:
        raise InputError("stroke", "profile", repr(profile), "one of " + ", ".join(PROFILES))
    if rise is None:
        rise = float(attribute_of(plant, "experiments", "RISE", RISE))
    check_rise(rise)
    axis = plant.stroke_output
    for name, value in (("start", start), ("end", end)):
        if not abs(value) <= plant.stroke.travel:
            raise InputError(
                "stroke", name, f"{value} m", f"a position within the travel of +-{plant.stroke.travel} m"
            )

    def at(t: FloatArray) -> Motion:
        scales = PROFILES[profile](np.asarray(t) - centre, rise)
        motion = [np.zeros((len(s), len(plant.outputs))) for s in scales]
        for column, s, offset in zip(motion, scales, (start, 0.0, 0.0), strict=True):
            column[:, axis] = offset + (end - start) * s
        return Motion(*motion)

    return at


def check_rise(rise: float) -> None:
    """Check that a move may have a rise.

    rise : s, 10-90 %

    Raises InputError for a rise outside 1e-6 to 1e6 s.

    >>> import malta
    >>> malta.references.check_rise(20e-3)
    """
    if not 1e-6 <= rise <= 1e6:
        raise InputError("stroke", "rise", f"{rise} s", "a time from 1e-6 to 1e6 s")


def hold(plant: Plant, **outputs: float) -> Reference:
    """Make a reference of constant outputs; those without a value stay at zero.

    plant : the machine
    outputs : by name, SI

    Returns a Reference.

    Raises InputError for unknown names.

    >>> import malta
    >>> from functools import partial
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> reference = partial(malta.references.hold, x1=1e-6, x2=1e-6)
    >>> aside = malta.Scenario("aside", 20e-3, reference)
    >>> run = malta.simulate(malta.plant_of(controller.parameters), controller, aside)
    >>> f"{1e6 * run.reference[0, 0]:.0f} um"
    '1 um'
    """
    names = [s.name for s in plant.outputs]
    for name in outputs:
        if name not in names:
            raise InputError("hold", name, "an unknown output", "one of " + " ".join(names))
    p = np.array([outputs.get(name, 0.0) for name in names])

    def at(t: FloatArray) -> Motion:
        zeros = np.zeros((len(t), len(p)))
        return Motion(zeros + p, zeros, zeros)

    return at


def circle(plant: Plant, radius: float, frequency: float) -> Reference:
    """Make a reference of a circle of the first two outputs; the others stay at zero.

    plant : the machine
    radius : m
    frequency : Hz

    Returns a Reference.

    >>> import malta
    >>> import numpy as np
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> motion = malta.references.circle(plant, 10e-6, 50.0)(np.array([0.0, 5e-3]))
    >>> (1e6 * motion.p[:, :2]).round(3).tolist()  # um
    [[10.0, 0.0], [0.0, 10.0]]
    """
    w = 2 * math.pi * frequency

    def at(t: FloatArray) -> Motion:
        c, s = np.cos(w * np.asarray(t)), np.sin(w * np.asarray(t))
        motion = [np.zeros((len(c), len(plant.outputs))) for _ in range(3)]
        for columns, (along_x, along_y) in zip(
            motion, ((c, s), (-w * s, w * c), (-(w**2) * c, -(w**2) * s)), strict=True
        ):
            columns[:, 0], columns[:, 1] = radius * along_x, radius * along_y
        return Motion(*motion)

    return at

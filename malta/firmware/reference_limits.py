"""References as the exported supervisor makes them of requests: within the limits, and stopped before the way ends."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.firmware.flight import compile_files
from malta.firmware.signals import deepest_target
from malta.firmware.sources import head_context, render
from malta.firmware.supervised_flight import supervised_texts
from malta.simulation.references import Motion, Reference
from malta.synthesis.controller import Controller

MOST_SAMPLES = 10_000_000


def limit_reference(c: Controller, reference: Reference) -> Reference:
    """The reference that the exported supervisor follows in operation where `reference` is requested, for simulations.

    It is computed by the C of the supervisor itself, so it is the same to the bit. It begins with the first request, or
    at rest there if that is beyond the limits. A request that its predecessor leads to within the limits of p, p', p'',
    and from which it can still stop, is used as it is. Any other one, as places whose rates are zero, is approached in
    the shortest time.

    c : of a gain file, with the limits
    reference : times -> p*, p*', p*'' as they are requested; rates that are not those of the places are not used

    Returns a function of times, s, which are taken to the nearest sample; requests begin with the first of them.

    Raises InputError without a C compiler, and for times that are no finite numbers or too far apart.

    >>> import numpy as np
    >>> import malta
    >>> c = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(c.parameters)
    >>> def request(t):  # 10 mm at once, as a PLC may ask
    ...     held = malta.references.hold(plant, z=0.01)(t)
    ...     return held._replace(p=held.p * (t > 0)[:, None])
    >>> limited = malta.firmware.limit_reference(c, request)
    >>> motion = limited(np.arange(0, 0.04, c.sample_time))
    >>> bool(np.ptp(motion.p[:, 4]) == 0.01), float(np.abs(motion.ddp).max().round(1))
    (True, 108.3)
    """
    Ts = c.sample_time

    def motion(t: FloatArray) -> Motion:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        if not np.isfinite(times).all() or (count := round(np.ptp(times) / Ts) + 1) > MOST_SAMPLES:
            raise InputError(
                "limit_reference", "t", "other times", f"finite ones, at most {MOST_SAMPLES} samples"
            )
        asked = reference(times.min() + Ts * np.arange(count))
        rows = np.ascontiguousarray(np.stack([asked.p, asked.dp, asked.ddp], axis=1), dtype=float)
        found = np.empty_like(rows)
        pointers = (a.ctypes.data_as(ctypes.c_void_p) for a in (rows, found))
        _library(c).own_limit_references(count, *pointers)
        kept = found[np.round((times - times.min()) / Ts).astype(int)]
        return Motion(kept[:, 0], kept[:, 1], kept[:, 2])

    return motion


@lru_cache(maxsize=16)
def _library(c: Controller) -> Any:
    """The supervisor with its controller, and what lets it follow requests alone."""
    t = deepest_target(c)
    own = render("reference_limits.c", head_context(t, "own"))
    return compile_files(["#include <stddef.h>\n", *supervised_texts(t, "own"), own])

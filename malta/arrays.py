"""What everybody speaks: arrays of floats and of complex numbers, and records that nobody changes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complexfloating[Any, Any]]


def readonly(array: ArrayLike) -> FloatArray:
    """A read-only copy as floats; a read-only array of floats is returned unchanged."""
    if isinstance(array, np.ndarray) and array.dtype == float and not array.flags.writeable:
        return array
    copy = np.array(array, dtype=float)
    copy.flags.writeable = False
    return copy

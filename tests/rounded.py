"""A plugin of pytest, `-p rounded`: linear algebra as a kernel rounds that nobody has, by some units of each number.

What numpy and scipy solve is moved by last digits that follow from its own bits. So equal numbers stay equal, matrices
symmetric and poles in pairs, zeros stay zero, and the same question has the same answer, as with every real kernel.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import scipy.linalg

EPS = float(np.finfo(float).eps)
MIXED = np.uint64(0x9E3779B97F4A7C15)  # the golden ratio times 2^64: spreads neighbouring bits
NUMPY = "solve lstsq inv pinv eig eigvals eigh eigvalsh svd qr cholesky det"
SCIPY = (
    "solve lstsq inv pinv eig eigvals eigh eigvalsh svd svdvals qr cholesky expm schur solve_triangular solve_banded "
    "solve_continuous_are solve_discrete_are solve_continuous_lyapunov solve_discrete_lyapunov null_space"
)


def _moved(x: Any) -> Any:
    """Numbers, each times 1 + k EPS with a whole k from -4 to 4 of its own bits."""
    bits = np.ascontiguousarray(np.abs(x)).view(np.uint64)
    k = ((bits * MIXED) >> np.uint64(61)).astype(float) - 3.5
    return x * (1 + EPS * k.round())


def rounded(x: Any) -> Any:
    """An answer of a solver: its floating-point arrays and numbers moved, whatever they are in."""
    if isinstance(x, tuple):
        parts = [rounded(part) for part in x]
        return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)
    array = np.asarray(x)
    whole = np.atleast_1d(array)
    if array.dtype == np.float64:
        found = _moved(whole)
    elif array.dtype == np.complex128:
        found = _moved(whole.real) + 1j * _moved(whole.imag)
    else:
        return x
    found = found.reshape(array.shape)
    return found if isinstance(x, np.ndarray) else found[()]


def _rounding(solver: Any) -> Any:
    @functools.wraps(solver)
    def solve(*of: Any, **options: Any) -> Any:
        return rounded(solver(*of, **options))

    return solve


for module, names in ((np.linalg, NUMPY), (scipy.linalg, SCIPY)):
    for name in names.split():
        setattr(module, name, _rounding(getattr(module, name)))

"""Algebraic equations of a descriptor system: zero rows of E, solved for the states of its zero columns.

    E_1 x_1' = A_11 x_1 + A_12 x_2 + B_1 u
           0 = A_21 x_1 + A_22 x_2 + B_2 u        x_2 = -A_22^-1 (A_21 x_1 + B_2 u)

The zero rows and columns are read from the expressions. The finite poles do not change.
"""

from __future__ import annotations

import casadi as ca

from malta.errors import InputError
from malta.proof.arguments import plural


def eliminate_algebraic(matrices: list[ca.SX]) -> list[ca.SX]:
    """A, B, C, D, E without algebraic states; unchanged when E has no zero row.

    Raises InputError when the equations do not determine these states: E has more zero rows than zero columns or fewer,
    or A_22 is singular (an index above one).
    """
    if len(matrices) < 5:
        return matrices
    A, B, C, D, E = matrices
    n = E.shape[0]
    E = ca.sparsify(E)
    rows, columns = set(E.sparsity().row()), {j for j in range(n) if E[:, j].nnz()}
    algebraic, free = sorted(set(range(n)) - rows), sorted(set(range(n)) - columns)
    if not algebraic and not free:
        return matrices
    found = f"{plural(len(algebraic), 'row')} and {plural(len(free), 'column')} of zeros"
    if len(algebraic) != len(free):
        raise InputError(
            "uncertain", "E", found, "as many of one as of the other: algebraic states of index 1"
        )
    own, x = sorted(rows), sorted(columns)
    inner = A[algebraic, free]
    if ca.sprank(ca.sparsify(inner)) < len(free) or ca.sparsify(ca.simplify(ca.det(inner))).nnz() == 0:
        raise InputError("uncertain", "E", found, "equations that give their states: A_22 not singular")
    inverse = -ca.inv_minor(inner)
    from_x, from_u = inverse @ A[algebraic, x], inverse @ B[algebraic, :]
    return [
        A[own, x] + A[own, free] @ from_x,
        B[own, :] + A[own, free] @ from_u,
        C[:, x] + C[:, free] @ from_x,
        D + C[:, free] @ from_u,
        E[own, x],
    ]

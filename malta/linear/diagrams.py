"""Block diagrams of systems: in parallel, in feedback, as a fractional transform, and by the names of their signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from malta.errors import InputError, require_known
from malta.linear.interconnection import append, connect
from malta.linear.system import System


def parallel(*systems: System) -> System:
    """Systems with the same inputs, their outputs added: y = (G1 + G2 + ...) u. Raises InputError for others.

    >>> import numpy as np
    >>> from malta.linear.diagrams import parallel
    >>> from malta.linear.interconnection import gain
    >>> parallel(gain(np.eye(1)), gain(2 * np.eye(1))).D.item()
    3.0
    """
    p, m = systems[0].D.shape
    for k, one in enumerate(systems, 1):
        if one.D.shape != (p, m):
            raise InputError("parallel", f"system {k}", f"shape {one.D.shape}", f"{(p, m)}, as the first")
    count, both = len(systems), append(*systems)
    found = connect(
        both, np.zeros((count * m, count * p)), np.tile(np.eye(m), (count, 1)), np.tile(np.eye(p), count)
    )
    return replace(found, inputs=systems[0].inputs, outputs=systems[0].outputs)


def feedback(system: System, law: System, sign: int = -1) -> System:
    """Close a loop: y = G (u + sign K y), as control.feedback does. Raises InputError for shapes that do not fit.

    >>> import numpy as np
    >>> from malta.linear.diagrams import feedback
    >>> from malta.linear.interconnection import gain
    >>> feedback(gain(np.eye(1)), gain(3 * np.eye(1))).D.round(9).item()
    0.25
    """
    (p, m), shape = system.D.shape, law.D.shape
    if shape != (m, p):
        raise InputError("feedback", "law", f"shape {shape}", f"{(m, p)}, from y to u")
    M = np.zeros((m + p, p + m))
    M[:m, p:], M[m:, :p] = sign * np.eye(m), np.eye(p)
    found = connect(append(system, law), M, np.eye(m + p, m), np.eye(p, p + m), "feedback")
    return replace(found, inputs=system.inputs, outputs=system.outputs)


def lft(system: System, law: System) -> System:
    """Close the last outputs y of a system by a law, u = K y, its last inputs: the lower linear fractional transform.

    Raises InputError for a law of more signals than the system has.

    >>> import numpy as np
    >>> from malta.linear.diagrams import lft
    >>> from malta.linear.interconnection import gain
    >>> P = gain(np.array([[1.0, 2.0], [3.0, 0.5]]))
    >>> lft(P, gain(np.eye(1))).D.round(9).item()  # 1 + 2 (1 - 0.5)^-1 3
    13.0
    """
    (p, m), (u, y) = system.D.shape, law.D.shape
    if u > m or y > p:
        raise InputError("lft", "law", f"shape {law.D.shape}", f"at most {(m, p)}")
    M = np.zeros((m + y, p + u))
    M[m - u : m, p:], M[m:, p - y : p] = np.eye(u), np.eye(y)
    found = connect(append(system, law), M, np.eye(m + y, m - u), np.eye(p - y, p + u), "lft")
    return replace(found, inputs=system.inputs[: m - u], outputs=system.outputs[: p - y])


def interconnect(systems: Sequence[System], inputs: Sequence[str], outputs: Sequence[str]) -> System:
    """Connect systems by the names of their signals, as control.interconnect does.

    An input of a system takes the output of its name and the outer input of its name, added where both exist.

    Raises InputError for names that fit no signal, for two outputs of one name, and for inputs that nothing feeds.

    >>> import numpy as np
    >>> from dataclasses import replace
    >>> from malta.linear.diagrams import interconnect
    >>> from malta.linear.interconnection import gain
    >>> error = replace(gain(np.array([[1.0, -1.0]])), inputs=("r", "y"), outputs=("e",))
    >>> plant = replace(gain(4 * np.eye(1)), inputs=("e",), outputs=("y",))
    >>> interconnect([error, plant], ["r"], ["y"]).D.round(9).item()
    0.8
    """
    caller = "interconnect"
    taken, given = ([name for one in systems for name in getattr(one, f)] for f in ("inputs", "outputs"))
    for field, names, known in (("inputs", inputs, taken), ("outputs", outputs, given)):
        require_known(names, known, caller, field)
    if len(set(given)) < len(given):
        raise InputError(caller, "systems", f"outputs {' '.join(given)}", "outputs with names that differ")
    for name in taken:
        if name not in given and name not in inputs:
            found = f"an input {name!r} that nothing feeds"
            raise InputError(caller, "systems", found, "an output or an input of its name")
    M, N, P = (
        np.array([[float(a == b) for b in columns] for a in rows]).reshape(len(rows), len(columns))
        for rows, columns in ((taken, given), (taken, inputs), (outputs, given))
    )
    return replace(connect(append(*systems), M, N, P, caller), inputs=tuple(inputs), outputs=tuple(outputs))

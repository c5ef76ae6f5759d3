"""A linear system in parameters by name, of a machine or of whatever a user has: `malta.uncertain`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from malta.errors import require_known
from malta.linear.systems import from_source
from malta.linear.uncertain import UncertainSystem
from malta.loops.parametric_plants import of_plant
from malta.model.plant import Plant


def uncertain(source: Any, names: Any, **options: Any) -> UncertainSystem:
    """Make a linear system that depends on parameters by name.

        E(p) x' = A(p) x + B(p) u,  y = C(p) x + D(p) u

    source : a Plant, which is linearized with these parameters and read by its sensors; a function of the parameters
        by name (or of one array p), of numpy and CasADi operations, that returns A, B, C, or with D, or with D and E; a
        casadi.Function of p; or matrices A0, B0, C0[, D0[, E0]]
    names : of a Plant the names of its parameters; else their nominal values by name, SI
    options : of a Plant `at`, the states that are not zero, and `late`, False for readings before the lags of its
        sensors; of the others `terms`, the factors of each parameter beside matrices, as {"k": (A1, B1, C1)}; `limits`
        (above, below) of parameters; `sample_time` (s) of matrices that give x+ in place of x'

    Returns an UncertainSystem. Of a Plant its forces act as a law commands them, behind its lag; `malta.loop` has the
    current loops with their windings, and the currents that are held over a sample while the machine moves.

    Raises InputError for unknown options, and for names, shapes and values that do not fit.

    >>> import malta
    >>> def motor(J, b):
    ...     return [[0, 1], [0, -b / J]], [[0], [1 / J]], [[1, 0]]
    >>> system = malta.uncertain(motor, {"J": 2e-3, "b": 0.1})
    >>> system.names
    ('J', 'b')
    """
    made: Callable[..., UncertainSystem] = from_source
    if isinstance(source, Plant):  # its readings come behind the lags of its sensors, as those of its loop
        made, options = of_plant, {"late": not options.get("states"), **options}
    known = [q.name for q in inspect.signature(made).parameters.values() if q.kind is q.KEYWORD_ONLY]
    require_known(options, known, "uncertain", found="an unknown option")
    return made(source, names, **options)

"""A machine from plain matrices: its parameters, their formulas, and its plant."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.model.linear.formulas import value_of as value_of
    from malta.model.linear.machine import (
        formula as formula,
        linear_machine as linear_machine,
        plant as plant,
    )
    from malta.model.linear.parameters import (
        LinearSystem as LinearSystem,
        is_linear as is_linear,
        record_of as record_of,
    )

_NAMES = {
    "malta.model.linear.formulas": "value_of",
    "malta.model.linear.machine": "formula linear_machine plant",
    "malta.model.linear.parameters": "LinearSystem is_linear record_of",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)

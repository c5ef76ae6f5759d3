"""The contacts of a plant: surfaces that the mover may touch, and the bearings that catch it there."""

from __future__ import annotations

from dataclasses import dataclass

from malta.model.signals import DEFAULT, CasadiFn


@dataclass(frozen=True, eq=False)
class Contacts:
    """The surfaces that the mover may touch, and what carries it there.

    names : of the surfaces
    contact : x -> used share of each clearance; 1 at contact; default: none
    cushioned : of each contact: whether a touchdown bearing carries it; default: none is
    bearing : x -> w of the touchdown bearings, zero without contact; default: zero

    >>> import malta
    >>> malta.read_design("examples/ball/design/ball.toml").plant.contacts.names
    ('stop',)
    """

    names: tuple[str, ...] = ()
    contact: CasadiFn = DEFAULT
    cushioned: tuple[bool, ...] = ()
    bearing: CasadiFn = DEFAULT

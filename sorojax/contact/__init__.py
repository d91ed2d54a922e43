"""Contact with implicit shapes: gaps, pressures and forces at points."""

from sorojax._arguments import check_package as _check_package
from sorojax.contact.friction import (
    AbstractFriction,
    Coulomb,
    DirectionalCoulomb,
    SpringSlider,
)
from sorojax.contact.law import LinePenalty, Penalty

__all__ = [
    "AbstractFriction",
    "SpringSlider",
    "Coulomb",
    "DirectionalCoulomb",
    "LinePenalty",
    "Penalty",
]

_check_package(__name__)

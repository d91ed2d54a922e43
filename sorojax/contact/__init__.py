"""Contact with implicit shapes: gaps, pressures and forces at points."""

from sorojax._arguments import check_package as _check_package
from sorojax.contact.broadphase import clearance as clearance, far as far
from sorojax.contact.facet import Contacts as Contacts, contacts as contacts, gaps as gaps
from sorojax.contact.friction import (
    AbstractFriction as AbstractFriction,
    Coulomb as Coulomb,
    Grip as Grip,
    SpringSlider as SpringSlider,
    no_grip as no_grip,
)
from sorojax.contact.law import LinePenalty as LinePenalty, Penalty as Penalty
from sorojax.contact.swept import crosses as crosses, passes as passes

_check_package(__name__)

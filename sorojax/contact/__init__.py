"""Contact with implicit shapes: gaps, pressures and forces at points."""

from sorojax._arguments import check_package as _check_package
from sorojax.contact.broadphase import clearance as clearance, far as far
from sorojax.contact.friction import Coulomb as Coulomb, Grip as Grip, no_grip as no_grip
from sorojax.contact.line import LinePenalty as LinePenalty
from sorojax.contact.penalty import Penalty as Penalty
from sorojax.contact.points import (
    Contacts as Contacts,
    contacts as contacts,
    gaps as gaps,
)
from sorojax.contact.swept import crosses as crosses, passes as passes

_check_package(__name__)

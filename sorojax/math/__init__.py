"""Mathematics: groups, quadrature, small solves, steppers, sparse systems."""

import importlib
from typing import TYPE_CHECKING, Any

from sorojax._arguments import check_package as _check_package, public as _public

if TYPE_CHECKING:
    from sorojax.math.ode.contact_midpoint import ContactMidpoint
    from sorojax.math.ode.steppers import DormandPrince, GeneralisedAlpha, RungeKutta4

__all__ = [
    "ContactMidpoint",
    "DormandPrince",
    "GeneralisedAlpha",
    "RungeKutta4",
]

_check_package(__name__)
_STEPPERS = {
    "ContactMidpoint": "contact_midpoint",
    "DormandPrince": "steppers",
    "GeneralisedAlpha": "steppers",
    "RungeKutta4": "steppers",
}


def __getattr__(name: str) -> Any:
    """The steppers load diffrax, which shapes and bodies do without."""
    if name in _STEPPERS:
        value = getattr(importlib.import_module(f"sorojax.math.ode.{_STEPPERS[name]}"), name)
        return _public(__name__, name, value)
    raise AttributeError(f"module 'sorojax.math' has no attribute {name!r}")

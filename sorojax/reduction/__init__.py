"""From finite elements to rods: backbone strains, POD modes, identified laws."""

from sorojax._arguments import check_package as _check_package
from sorojax.reduction.backbone import (
    AbstractCurve,
    Backbone,
    Curve,
    Line,
    strain_along,
)
from sorojax.reduction.damping import ConstantDamping, identify_damping
from sorojax.reduction.identify import (
    PressureMap,
    condensed_stiffness,
    identify,
    mean_section,
    offset_weight,
)
from sorojax.reduction.pod import (
    captured_energy,
    coordinates,
    pod_basis,
)

__all__ = [
    "AbstractCurve",
    "Backbone",
    "ConstantDamping",
    "Curve",
    "Line",
    "PressureMap",
    "captured_energy",
    "condensed_stiffness",
    "coordinates",
    "identify",
    "identify_damping",
    "mean_section",
    "offset_weight",
    "pod_basis",
    "strain_along",
]

_check_package(__name__)

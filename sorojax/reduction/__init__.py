"""From finite elements to rods: backbone strains, POD modes, identified laws."""

from sorojax._arguments import check_package as _check_package
from sorojax.reduction.backbone import (
    AbstractCurve as AbstractCurve,
    Backbone as Backbone,
    Curve as Curve,
    Line as Line,
    strain_along as strain_along,
)
from sorojax.reduction.identify import (
    ConstantDamping as ConstantDamping,
    DampingFit as DampingFit,
    Fit as Fit,
    OffsetWeight as OffsetWeight,
    PressureMap as PressureMap,
    condensed_stiffness as condensed_stiffness,
    identify as identify,
    identify_damping as identify_damping,
    mean_section as mean_section,
    offset_weight as offset_weight,
)
from sorojax.reduction.pod import (
    captured_energy as captured_energy,
    coordinates as coordinates,
    pod_basis as pod_basis,
)

_check_package(__name__)

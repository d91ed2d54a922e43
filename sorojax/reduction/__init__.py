"""From finite elements to rods: backbone strains, POD modes, identified laws."""

from sorojax._arguments import check_package as _check_package
from sorojax.reduction.backbone import (
    Backbone as Backbone,
    strain_along as strain_along,
)
from sorojax.reduction.curve import (
    AbstractCurve as AbstractCurve,
    Curve as Curve,
    Line as Line,
)
from sorojax.reduction.identify import (
    ConstantDamping as ConstantDamping,
    DampingFit as DampingFit,
    Fit as Fit,
    PressureMap as PressureMap,
    condensed_stiffness as condensed_stiffness,
    identify as identify,
    identify_damping as identify_damping,
)
from sorojax.reduction.pod import (
    captured_energy as captured_energy,
    coordinates as coordinates,
    pod_basis as pod_basis,
)
from sorojax.reduction.section import (
    OffsetWeight as OffsetWeight,
    mean_section as mean_section,
    offset_weight as offset_weight,
)

_check_package(__name__)

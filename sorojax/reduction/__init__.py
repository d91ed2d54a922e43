"""From finite elements to rods: backbone strains, POD modes, identified laws."""

from sorojax.reduction.backbone import (
    AbstractCurve as AbstractCurve,
    Backbone as Backbone,
    Line as Line,
    strain_along as strain_along,
)
from sorojax.reduction.identify import (
    Fit as Fit,
    PressureMap as PressureMap,
    identify as identify,
    mean_section as mean_section,
)
from sorojax.reduction.pod import (
    captured_energy as captured_energy,
    coordinates as coordinates,
    pod_basis as pod_basis,
)

"""Design loops: densities, optimisers, and the loop that joins them."""

from sorojax.design.filters import (
    ConeFilter as ConeFilter,
    HelmholtzFilter as HelmholtzFilter,
    cone_filter as cone_filter,
    greyness as greyness,
    heaviside_projection as heaviside_projection,
    helmholtz_filter as helmholtz_filter,
    sensitivity_filtered as sensitivity_filtered,
)
from sorojax.design.linear import (
    Linear as Linear,
    compliance as compliance,
    displacement as displacement,
    linear as linear,
)
from sorojax.design.minimise import (
    Optimised as Optimised,
    Step as Step,
    minimise as minimise,
)
from sorojax.design.mma import (
    GCMMA as GCMMA,
    MMA as MMA,
    MMAState as MMAState,
    Values as Values,
)
from sorojax.design.optimality import OptimalityCriteria as OptimalityCriteria
from sorojax.design.simp import Ramp as Ramp, Simp as Simp

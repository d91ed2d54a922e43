"""Design loops: densities, optimisers, and the loop that joins them."""

from sorojax._arguments import check_package as _check_package
from sorojax.design.calibration.calibrate import (
    CalibrationStep as CalibrationStep,
    calibrate as calibrate,
)
from sorojax.design.calibration.calibration import (
    Calibration as Calibration,
    Check as Check,
    Combination as Combination,
    Experiment as Experiment,
    checked as checked,
    unseen as unseen,
)
from sorojax.design.density.filters import (
    ConeFilter as ConeFilter,
    HelmholtzFilter as HelmholtzFilter,
    cone_filter as cone_filter,
    greyness as greyness,
    heaviside_projection as heaviside_projection,
    helmholtz_filter as helmholtz_filter,
    sensitivity_filtered as sensitivity_filtered,
)
from sorojax.design.density.layout import (
    Layout as Layout,
    Mirrored as Mirrored,
    Ramp as Ramp,
    Repeated as Repeated,
    Simp as Simp,
    layout as layout,
)
from sorojax.design.density.linear import (
    Linear as Linear,
    compliance as compliance,
    displacement as displacement,
    linear as linear,
)
from sorojax.design.density.pressure import (
    Darcy as Darcy,
    Flood as Flood,
    VoidPressure as VoidPressure,
    darcy as darcy,
    flood as flood,
    flooded as flooded,
    void_pressure as void_pressure,
)
from sorojax.design.density.void import (
    InterpolatedEnergy as InterpolatedEnergy,
    interpolated_energy as interpolated_energy,
)
from sorojax.design.field import SplineField as SplineField
from sorojax.design.objectives import (
    Follower as Follower,
    displacement_along as displacement_along,
    graded as graded,
    mechanism as mechanism,
    path_error as path_error,
    replaced_load as replaced_load,
    rotation as rotation,
    settled as settled,
    work_of_loads as work_of_loads,
)
from sorojax.design.optimise.base import (
    AbstractOptimiser as AbstractOptimiser,
    Values as Values,
)
from sorojax.design.optimise.minimise import (
    History as History,
    Optimised as Optimised,
    Step as Step,
    minimise as minimise,
)
from sorojax.design.optimise.mma import (
    GCMMA as GCMMA,
    MMA as MMA,
    MMAState as MMAState,
)
from sorojax.design.optimise.optimality import OptimalityCriteria as OptimalityCriteria
from sorojax.design.optimise.shape_loop import (
    OptimisedShape as OptimisedShape,
    ShapeStep as ShapeStep,
    minimise_shape as minimise_shape,
)
from sorojax.design.part import (
    Mirror as Mirror,
    Part as Part,
    PartReport as PartReport,
    Repeat as Repeat,
    part as part,
    reanalysed as reanalysed,
    solid as solid,
)
from sorojax.design.pneunet import (
    PneuNetCell as PneuNetCell,
    optimise_pneunet as optimise_pneunet,
    pneunet_cell as pneunet_cell,
)

_check_package(__name__)

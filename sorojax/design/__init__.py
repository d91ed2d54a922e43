"""Design loops: densities, optimisers, and the loop that joins them."""

from sorojax._arguments import check_package as _check_package
from sorojax.design.calibrate import (
    CalibrationStep as CalibrationStep,
    calibrate as calibrate,
)
from sorojax.design.calibration import (
    Calibration as Calibration,
    Check as Check,
    Combination as Combination,
    checked as checked,
    unseen as unseen,
)
from sorojax.design.darcy import Darcy as Darcy, darcy as darcy
from sorojax.design.experiment import Experiment as Experiment
from sorojax.design.field import SplineField as SplineField
from sorojax.design.filters import (
    ConeFilter as ConeFilter,
    HelmholtzFilter as HelmholtzFilter,
    cone_filter as cone_filter,
    greyness as greyness,
    heaviside_projection as heaviside_projection,
    helmholtz_filter as helmholtz_filter,
    sensitivity_filtered as sensitivity_filtered,
)
from sorojax.design.flood import Flood as Flood, flood as flood, flooded as flooded
from sorojax.design.history import History as History
from sorojax.design.layout import Layout as Layout, layout as layout
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
from sorojax.design.objectives import (
    Follower as Follower,
    displacement_along as displacement_along,
    graded as graded,
    mechanism as mechanism,
    path_error as path_error,
    replaced_load as replaced_load,
    rotation as rotation,
    work_of_loads as work_of_loads,
)
from sorojax.design.optimality import OptimalityCriteria as OptimalityCriteria
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
from sorojax.design.settle import settled as settled
from sorojax.design.shape_loop import (
    OptimisedShape as OptimisedShape,
    ShapeStep as ShapeStep,
    minimise_shape as minimise_shape,
)
from sorojax.design.simp import Ramp as Ramp, Simp as Simp
from sorojax.design.symmetry import Mirrored as Mirrored, Repeated as Repeated
from sorojax.design.void import (
    InterpolatedEnergy as InterpolatedEnergy,
    interpolated_energy as interpolated_energy,
)
from sorojax.design.void_pressure import (
    VoidPressure as VoidPressure,
    void_pressure as void_pressure,
)

_check_package(__name__)

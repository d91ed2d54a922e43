"""Design loops: densities, optimisers, and the loop that joins them."""

from sorojax._arguments import check_package as _check_package
from sorojax.design.calibration.calibrate import calibrate
from sorojax.design.calibration.calibration import Experiment, unidentifiable, validate
from sorojax.design.closed_loop import drawing_to_loop
from sorojax.design.density.filters import (
    cone_filter,
    greyness,
    heaviside_projection,
    helmholtz_filter,
    sensitivity_filtered,
)
from sorojax.design.density.layout import Mirrored, Ramp, Repeated, Simp, layout
from sorojax.design.density.linear import compliance, displacement, linear
from sorojax.design.density.pressure import darcy, flood, void_pressure
from sorojax.design.density.void import interpolated_energy
from sorojax.design.field import SplineField
from sorojax.design.objectives import (
    Follower,
    displacement_along,
    graded,
    mechanism,
    path_error,
    relax_to_minimum,
    replaced_load,
    rotation,
    work_of_loads,
)
from sorojax.design.optimise.base import AbstractOptimiser, Values
from sorojax.design.optimise.minimise import History, minimise
from sorojax.design.optimise.mma import GCMMA, MMA
from sorojax.design.optimise.optimality import OptimalityCriteria
from sorojax.design.optimise.shape_loop import minimise_shape
from sorojax.design.part import Mirror, Part, Repeat, part, reanalyse, solid
from sorojax.design.pneunet import optimise_pneunet, pneunet_cell
from sorojax.design.uncertainty import Propagated, propagate_covariance

__all__ = [
    "AbstractOptimiser",
    "GCMMA",
    "MMA",
    "Experiment",
    "Follower",
    "History",
    "Mirror",
    "Mirrored",
    "OptimalityCriteria",
    "Part",
    "Propagated",
    "Ramp",
    "Repeat",
    "Repeated",
    "Simp",
    "SplineField",
    "Values",
    "calibrate",
    "compliance",
    "cone_filter",
    "darcy",
    "displacement",
    "displacement_along",
    "drawing_to_loop",
    "flood",
    "graded",
    "greyness",
    "heaviside_projection",
    "helmholtz_filter",
    "interpolated_energy",
    "layout",
    "linear",
    "mechanism",
    "minimise",
    "minimise_shape",
    "optimise_pneunet",
    "part",
    "path_error",
    "pneunet_cell",
    "propagate_covariance",
    "reanalyse",
    "relax_to_minimum",
    "replaced_load",
    "rotation",
    "sensitivity_filtered",
    "solid",
    "unidentifiable",
    "validate",
    "void_pressure",
    "work_of_loads",
]

_check_package(__name__)

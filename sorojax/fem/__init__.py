"""Hyperelastic finite elements: problem, equilibrium, path, stresses."""

from sorojax.fem.energy_form import (
    potential_energy as potential_energy,
    residual as residual,
)
from sorojax.fem.follow import Stats as Stats
from sorojax.fem.formulation import (
    ConstantPressure as ConstantPressure,
    Displacement as Displacement,
    LinearPressure as LinearPressure,
)
from sorojax.fem.kinematics import (
    Axisymmetric as Axisymmetric,
    PlaneStrain as PlaneStrain,
    PlaneStress as PlaneStress,
    Solid as Solid,
)
from sorojax.fem.loads import (
    Force as Force,
    Gravity as Gravity,
    Pressure as Pressure,
    Traction as Traction,
)
from sorojax.fem.newton import Newton as Newton
from sorojax.fem.problem import Problem as Problem, problem as problem
from sorojax.fem.solve import (
    ConvergenceError as ConvergenceError,
    Path as Path,
    Solution as Solution,
    solve as solve,
    solve_path as solve_path,
    with_load as with_load,
)
from sorojax.fem.space import Space as Space, space as space
from sorojax.fem.stress import (
    cauchy_stress as cauchy_stress,
    deformation_gradient as deformation_gradient,
    enclosed_volume as enclosed_volume,
    nodal_average as nodal_average,
    principal_stresses as principal_stresses,
    reaction_force as reaction_force,
    von_mises_stress as von_mises_stress,
)
from sorojax.fem.supports import Fixed as Fixed, Prescribed as Prescribed
from sorojax.math.status import Status as Status

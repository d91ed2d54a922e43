"""Hyperelastic finite elements: problem, equilibrium, path, stresses."""

from sorojax.fem.energy_form import (
    potential_energy as potential_energy,
    residual as residual,
)
from sorojax.fem.kinematics import PlaneStrain as PlaneStrain
from sorojax.fem.loads import (
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
    Status as Status,
    solve as solve,
    solve_path as solve_path,
)
from sorojax.fem.space import Space as Space, space as space
from sorojax.fem.supports import Fixed as Fixed, Prescribed as Prescribed

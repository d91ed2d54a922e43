"""Hyperelastic finite elements: problem, equilibrium, path, stresses."""

from sorojax._arguments import check_package as _check_package
from sorojax.fem.buckling import (
    CriticalLoads as CriticalLoads,
    critical_loads as critical_loads,
    with_imperfection as with_imperfection,
)
from sorojax.fem.cavity import (
    AbstractContents as AbstractContents,
    Gas as Gas,
    Liquid as Liquid,
)
from sorojax.fem.contact_load import Contact as Contact
from sorojax.fem.contact_steps import (
    advanced as advanced,
    contact_state as contact_state,
    overlap as overlap,
    solve_contact as solve_contact,
    updated as updated,
)
from sorojax.fem.contact_switching import Switching as Switching, switching as switching
from sorojax.fem.continuation import (
    Continuation as Continuation,
    continuation as continuation,
)
from sorojax.fem.critical import CriticalPoint as CriticalPoint
from sorojax.fem.damping import KelvinVoigt as KelvinVoigt, Rayleigh as Rayleigh
from sorojax.fem.dynamics import MotionError as MotionError, simulate as simulate
from sorojax.fem.dynamics_host import MotionStats as MotionStats
from sorojax.fem.dynamics_step import State as State
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
from sorojax.fem.generalised_alpha import (
    EnergyMomentum as EnergyMomentum,
    GeneralisedAlpha as GeneralisedAlpha,
    Newmark as Newmark,
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
from sorojax.fem.mass import (
    lumped_mass as lumped_mass,
    mass_matrix as mass_matrix,
    total_mass as total_mass,
)
from sorojax.fem.modal import (
    Modes as Modes,
    eigenmodes as eigenmodes,
    expand as expand,
    modal_coordinates as modal_coordinates,
    modal_force as modal_force,
    tangent_modes as tangent_modes,
)
from sorojax.fem.motion import (
    Energies as Energies,
    Motion as Motion,
    momentum as momentum,
)
from sorojax.fem.newton import Newton as Newton
from sorojax.fem.problem import Problem as Problem, problem as problem
from sorojax.fem.recovery import (
    Patches as Patches,
    nodal_stress as nodal_stress,
    patches as patches,
    sample_points as sample_points,
    strain_energy as strain_energy,
)
from sorojax.fem.rigid import Rigid as Rigid, rigid as rigid
from sorojax.fem.self_contact import SelfContact as SelfContact
from sorojax.fem.solve import (
    ConvergenceError as ConvergenceError,
    Path as Path,
    Solution as Solution,
    solve as solve,
    solve_path as solve_path,
    with_load as with_load,
)
from sorojax.fem.solve_volume import (
    CavitySolution as CavitySolution,
    VolumePath as VolumePath,
    solve_volume as solve_volume,
    volume_path as volume_path,
)
from sorojax.fem.space import Space as Space, space as space
from sorojax.fem.spring import Foundation as Foundation, Spring as Spring
from sorojax.fem.step_state import StepState as StepState
from sorojax.fem.stress import (
    cauchy_stress as cauchy_stress,
    deformation_gradient as deformation_gradient,
    enclosed_volume as enclosed_volume,
    nodal_average as nodal_average,
    principal_stresses as principal_stresses,
    reaction_force as reaction_force,
    von_mises_stress as von_mises_stress,
)
from sorojax.fem.supports import (
    Fixed as Fixed,
    Prescribed as Prescribed,
    Rotated as Rotated,
    rotated as rotated,
)
from sorojax.fem.tendon import (
    Cable as Cable,
    Route as Route,
    Tendon as Tendon,
    route as route,
    tendon_length as tendon_length,
    tension as tension,
)
from sorojax.fem.torque import Torque as Torque, mean_rotation as mean_rotation
from sorojax.math.sparse import ConjugateGradient as ConjugateGradient
from sorojax.math.status import Status as Status

_check_package(__name__)

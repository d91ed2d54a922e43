"""Hyperelastic finite elements: problem, equilibrium, path, stresses."""

from sorojax._arguments import check_package as _check_package
from sorojax.fem.assembly.space import (
    ConstantPressure as ConstantPressure,
    Displacement as Displacement,
    LinearPressure as LinearPressure,
    Space as Space,
    space as space,
)
from sorojax.fem.contact.obstacle import Contact as Contact
from sorojax.fem.contact.self_contact import SelfContact as SelfContact
from sorojax.fem.contact.statics import (
    advanced as advanced,
    contact_state as contact_state,
    overlap as overlap,
    solve_contact as solve_contact,
    updated as updated,
)
from sorojax.fem.contact.switching import Switching as Switching, switching as switching
from sorojax.fem.dynamics.damping import (
    KelvinVoigt as KelvinVoigt,
    Rayleigh as Rayleigh,
    lumped_mass as lumped_mass,
    mass_matrix as mass_matrix,
    total_mass as total_mass,
)
from sorojax.fem.dynamics.host import MotionStats as MotionStats
from sorojax.fem.dynamics.methods import (
    EnergyMomentum as EnergyMomentum,
    GeneralisedAlpha as GeneralisedAlpha,
    Newmark as Newmark,
)
from sorojax.fem.dynamics.motion import (
    Energies as Energies,
    Motion as Motion,
    momentum as momentum,
)
from sorojax.fem.dynamics.simulate import MotionError as MotionError, simulate as simulate
from sorojax.fem.dynamics.step import State as State, StepState as StepState
from sorojax.fem.equilibrium.load_stepping import Stats as Stats
from sorojax.fem.equilibrium.newton import Newton as Newton
from sorojax.fem.equilibrium.solve import (
    ConvergenceError as ConvergenceError,
    Path as Path,
    Solution as Solution,
    solve as solve,
    solve_path as solve_path,
    with_load as with_load,
)
from sorojax.fem.equilibrium.volume import (
    AbstractContents as AbstractContents,
    CavitySolution as CavitySolution,
    Gas as Gas,
    Liquid as Liquid,
    VolumePath as VolumePath,
    solve_volume as solve_volume,
    volume_path as volume_path,
)
from sorojax.fem.kinematics import (
    Axisymmetric as Axisymmetric,
    PlaneStrain as PlaneStrain,
    PlaneStress as PlaneStress,
    Solid as Solid,
)
from sorojax.fem.loads.loads import (
    Force as Force,
    Gravity as Gravity,
    Pressure as Pressure,
    Torque as Torque,
    Traction as Traction,
    mean_rotation as mean_rotation,
)
from sorojax.fem.loads.rigid import Rigid as Rigid, rigid as rigid
from sorojax.fem.loads.springs import (
    Cable as Cable,
    Foundation as Foundation,
    Route as Route,
    Spring as Spring,
    Tendon as Tendon,
    route as route,
    tendon_length as tendon_length,
    tension as tension,
)
from sorojax.fem.problem import (
    Problem as Problem,
    potential_energy as potential_energy,
    problem as problem,
    residual as residual,
)
from sorojax.fem.stability.buckling import (
    CriticalLoads as CriticalLoads,
    critical_loads as critical_loads,
    with_imperfection as with_imperfection,
)
from sorojax.fem.stability.continuation import (
    Continuation as Continuation,
    CriticalPoint as CriticalPoint,
    continuation as continuation,
)
from sorojax.fem.stability.modal import (
    Modes as Modes,
    eigenmodes as eigenmodes,
    expand as expand,
    modal_coordinates as modal_coordinates,
    modal_force as modal_force,
    tangent_modes as tangent_modes,
)
from sorojax.fem.stress import (
    Patches as Patches,
    cauchy_stress as cauchy_stress,
    deformation_gradient as deformation_gradient,
    enclosed_volume as enclosed_volume,
    nodal_average as nodal_average,
    nodal_stress as nodal_stress,
    patches as patches,
    principal_stresses as principal_stresses,
    reaction_force as reaction_force,
    sample_points as sample_points,
    strain_energy as strain_energy,
    von_mises_stress as von_mises_stress,
)
from sorojax.fem.supports import (
    Fixed as Fixed,
    Prescribed as Prescribed,
    Rotated as Rotated,
    rotated as rotated,
)
from sorojax.math.linalg.sparse import ConjugateGradient as ConjugateGradient
from sorojax.math.status import Status as Status

_check_package(__name__)

"""Hyperelastic finite elements: problem, equilibrium, path, stresses."""

from sorojax._arguments import check_package as _check_package
from sorojax.fem.assembly.space import ConstantPressure, Displacement, LinearPressure, space
from sorojax.fem.contact.obstacle import Contact
from sorojax.fem.contact.self_contact import SelfContact
from sorojax.fem.contact.statics import (
    contact_state,
    overlap,
    solve_contact,
    update_contact_pairs,
    update_friction,
)
from sorojax.fem.contact.switching import contact_switching
from sorojax.fem.crossings import self_crossings
from sorojax.fem.dynamics.damping import (
    KelvinVoigt,
    Rayleigh,
    lumped_mass,
    mass_matrix,
    total_mass,
)
from sorojax.fem.dynamics.methods import EnergyMomentum, GeneralisedAlpha, Newmark
from sorojax.fem.dynamics.simulate import MotionError, simulate
from sorojax.fem.dynamics.step import State
from sorojax.fem.dynamics.trajectory import Trajectory, momentum
from sorojax.fem.embedded.bonded import BondedRod, bonded_rod
from sorojax.fem.embedded.results import RodForces, rod_forces
from sorojax.fem.embedded.rods import EmbeddedRod, embedded_rod
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.equilibrium.solve import (
    ConvergenceError,
    Solution,
    solve,
    solve_path,
    with_load,
)
from sorojax.fem.equilibrium.volume import (
    AbstractContents,
    Gas,
    Liquid,
    solve_volume,
    volume_path,
)
from sorojax.fem.kinematics import Axisymmetric, PlaneStrain, PlaneStress, Solid
from sorojax.fem.loads.glue import Glue, glue
from sorojax.fem.loads.loads import Force, Gravity, Pressure, Torque, Traction, mean_rotation
from sorojax.fem.loads.rigid import rigid
from sorojax.fem.loads.springs import (
    Cable,
    Foundation,
    Spring,
    Tendon,
    route,
    tendon_length,
    tension,
)
from sorojax.fem.problem import Problem, potential_energy, problem, residual
from sorojax.fem.reactions import Reaction, reaction_force, reaction_history, reactions
from sorojax.fem.stability.buckling import critical_loads, with_imperfection
from sorojax.fem.stability.continuation import continuation
from sorojax.fem.stability.modal import (
    eigenmodes,
    modal_coordinates,
    modal_displacement,
    modal_force,
    tangent_modes,
)
from sorojax.fem.stress import (
    cauchy_stress,
    deformation_gradient,
    enclosed_volume,
    nodal_average,
    nodal_stress,
    patches,
    principal_stresses,
    sample_points,
    strain_energy,
    von_mises_stress,
)
from sorojax.fem.supports import Carried, Fixed, Prescribed, Rotated, rotated
from sorojax.math.linalg.sparse import ConjugateGradient

__all__ = [
    "AbstractContents",
    "Axisymmetric",
    "BondedRod",
    "Cable",
    "Carried",
    "ConjugateGradient",
    "ConstantPressure",
    "Contact",
    "ConvergenceError",
    "Displacement",
    "EmbeddedRod",
    "EnergyMomentum",
    "Fixed",
    "Force",
    "Foundation",
    "Gas",
    "GeneralisedAlpha",
    "Glue",
    "Gravity",
    "KelvinVoigt",
    "LinearPressure",
    "Liquid",
    "MotionError",
    "Newmark",
    "Newton",
    "PlaneStrain",
    "PlaneStress",
    "Prescribed",
    "Pressure",
    "Problem",
    "Rayleigh",
    "RodForces",
    "Reaction",
    "Rotated",
    "SelfContact",
    "Solid",
    "Solution",
    "Spring",
    "State",
    "Tendon",
    "Torque",
    "Traction",
    "Trajectory",
    "bonded_rod",
    "cauchy_stress",
    "contact_state",
    "contact_switching",
    "continuation",
    "critical_loads",
    "deformation_gradient",
    "eigenmodes",
    "embedded_rod",
    "enclosed_volume",
    "glue",
    "lumped_mass",
    "mass_matrix",
    "mean_rotation",
    "modal_coordinates",
    "modal_displacement",
    "modal_force",
    "momentum",
    "nodal_average",
    "nodal_stress",
    "overlap",
    "patches",
    "potential_energy",
    "principal_stresses",
    "problem",
    "reaction_force",
    "reaction_history",
    "reactions",
    "residual",
    "rigid",
    "rod_forces",
    "rotated",
    "route",
    "sample_points",
    "self_crossings",
    "simulate",
    "solve",
    "solve_contact",
    "solve_path",
    "solve_volume",
    "space",
    "strain_energy",
    "tangent_modes",
    "tendon_length",
    "tension",
    "total_mass",
    "update_contact_pairs",
    "update_friction",
    "volume_path",
    "von_mises_stress",
    "with_imperfection",
    "with_load",
]

_check_package(__name__)

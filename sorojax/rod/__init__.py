"""Rods: strain-parameterised Cosserat model, planar and spatial."""

from sorojax.rod.basis import (
    AbstractModes as AbstractModes,
    Chebyshev as Chebyshev,
    Legendre as Legendre,
    SampledModes as SampledModes,
    StrainBasis as StrainBasis,
    chebyshev as chebyshev,
    columns as columns,
    constant as constant,
    legendre as legendre,
)
from sorojax.rod.dynamics import (
    acceleration as acceleration,
    bias_force as bias_force,
    coriolis_force as coriolis_force,
    damping_matrix as damping_matrix,
    elastic_force as elastic_force,
    forward_dynamics as forward_dynamics,
    gravity_force as gravity_force,
    inverse_dynamics as inverse_dynamics,
    kinetic_energy as kinetic_energy,
    mass_matrix as mass_matrix,
    potential_energy as potential_energy,
    stiffness_matrix as stiffness_matrix,
)
from sorojax.rod.forces import (
    AbstractChamber as AbstractChamber,
    AbstractDamping as AbstractDamping,
    AbstractElastic as AbstractElastic,
    AbstractForce as AbstractForce,
    AbstractPressureMap as AbstractPressureMap,
    Damping as Damping,
    Gravity as Gravity,
    LinearElastic as LinearElastic,
    Pressurised as Pressurised,
    TipWrench as TipWrench,
    total_force as total_force,
)
from sorojax.rod.kinematics import (
    forward_kinematics as forward_kinematics,
    inertia as inertia,
    jacobian as jacobian,
    motion as motion,
    strain as strain,
    tip_angle as tip_angle,
    tip_pose as tip_pose,
)
from sorojax.rod.motion import (
    Motion as Motion,
    Operators as Operators,
    operators as operators,
)
from sorojax.rod.rod import (
    Elastic as Elastic,
    Rod as Rod,
    elastic as elastic,
    rod as rod,
    strain_names as strain_names,
)
from sorojax.rod.rollout import (
    Rollout as Rollout,
    rollout as rollout,
    second_order as second_order,
)
from sorojax.rod.section import (
    Section as Section,
    circle as circle,
    rectangle as rectangle,
)
from sorojax.rod.statics import (
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
)

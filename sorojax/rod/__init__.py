"""Rods: strain-parameterised Cosserat model, planar and spatial."""

from sorojax._arguments import check_package as _check_package
from sorojax.rod.contact.links import LinkContact as LinkContact, LinkObstacle as LinkObstacle
from sorojax.rod.contact.obstacle import (
    AbstractContact as AbstractContact,
    ObstacleContact as ObstacleContact,
    contact_energy as contact_energy,
    penetration as penetration,
)
from sorojax.rod.contact.rods import (
    HeldRod as HeldRod,
    RodContact as RodContact,
    SelfContact as SelfContact,
)
from sorojax.rod.dynamics.dynamics import (
    acceleration as acceleration,
    bias_force as bias_force,
    coriolis_force as coriolis_force,
    coriolis_matrix as coriolis_matrix,
    damping_matrix as damping_matrix,
    elastic_force as elastic_force,
    forward_dynamics as forward_dynamics,
    gravity_force as gravity_force,
    inverse_dynamics as inverse_dynamics,
    kinetic_energy as kinetic_energy,
    mass_matrix as mass_matrix,
    momentum as momentum,
    potential_energy as potential_energy,
    stiffness_matrix as stiffness_matrix,
    vector_field as vector_field,
)
from sorojax.rod.dynamics.fields import Base as Base, Motion as Motion, Operators as Operators
from sorojax.rod.dynamics.kinematics import (
    forward_kinematics as forward_kinematics,
    jacobian as jacobian,
    jacobian_rate_product as jacobian_rate_product,
    strain as strain,
    tip_angle as tip_angle,
    tip_pose as tip_pose,
)
from sorojax.rod.dynamics.points import Points as Points, points as points
from sorojax.rod.dynamics.rollout import (
    Rollout as Rollout,
    rollout as rollout,
    second_order as second_order,
)
from sorojax.rod.dynamics.tree import (
    AssemblyMotion as AssemblyMotion,
    AssemblyOperators as AssemblyOperators,
    part_motion as part_motion,
)
from sorojax.rod.forces.forces import (
    AbstractChamber as AbstractChamber,
    AbstractDamping as AbstractDamping,
    AbstractElastic as AbstractElastic,
    AbstractForce as AbstractForce,
    AbstractPressureMap as AbstractPressureMap,
    Damping as Damping,
    EnergyLaw as EnergyLaw,
    Gravity as Gravity,
    LinearElastic as LinearElastic,
    Pressurised as Pressurised,
    SectionLaw as SectionLaw,
    TipWrench as TipWrench,
    section_law as section_law,
)
from sorojax.rod.forces.loads import (
    AbstractPairForce as AbstractPairForce,
    Between as Between,
    JointEffort as JointEffort,
    On as On,
    Varying as Varying,
    total_force as total_force,
)
from sorojax.rod.forces.routing import (
    AbstractRoute as AbstractRoute,
    Converging as Converging,
    Helical as Helical,
    Routed as Routed,
    Straight as Straight,
    thread_lengths as thread_lengths,
    thread_rates as thread_rates,
)
from sorojax.rod.forces.tendons import (
    Actuation as Actuation,
    Tendons as Tendons,
    ThreadChambers as ThreadChambers,
    thread_chambers as thread_chambers,
)
from sorojax.rod.forces.wrench import (
    Buoyancy as Buoyancy,
    Drag as Drag,
    LineWrench as LineWrench,
    PointWrench as PointWrench,
)
from sorojax.rod.model.assembly import (
    Assembly as Assembly,
    Part as Part,
    assembly as assembly,
    num_coordinates as num_coordinates,
    num_dof as num_dof,
    rest as rest,
    serial as serial,
    slices as slices,
)
from sorojax.rod.model.basis import (
    AbstractModes as AbstractModes,
    StrainBasis as StrainBasis,
    columns as columns,
)
from sorojax.rod.model.joint import (
    AbstractJoint as AbstractJoint,
    Fixed as Fixed,
    Free as Free,
    Prismatic as Prismatic,
    Revolute as Revolute,
    Screw as Screw,
)
from sorojax.rod.model.link import Link as Link
from sorojax.rod.model.model import (
    inertia as inertia,
    motion as motion,
    operators as operators,
)
from sorojax.rod.model.modes import (
    BSpline as BSpline,
    Combined as Combined,
    Functions as Functions,
    SampledModes as SampledModes,
    bspline as bspline,
    fitted as fitted,
    functions as functions,
    orthonormalise as orthonormalise,
)
from sorojax.rod.model.polynomials import (
    Bernstein as Bernstein,
    Chebyshev as Chebyshev,
    Fourier as Fourier,
    Legendre as Legendre,
    Piecewise as Piecewise,
    bernstein as bernstein,
    chebyshev as chebyshev,
    constant as constant,
    fourier as fourier,
    legendre as legendre,
    piecewise as piecewise,
    piecewise_constant as piecewise_constant,
    piecewise_linear as piecewise_linear,
)
from sorojax.rod.model.rod import (
    Elastic as Elastic,
    Rod as Rod,
    elastic as elastic,
    rod as rod,
    strain_names as strain_names,
)
from sorojax.rod.model.section import Section as Section, scaled as scaled, taper as taper
from sorojax.rod.model.section_shapes import (
    circle as circle,
    ellipse as ellipse,
    from_mesh as from_mesh,
    from_shape as from_shape,
    rectangle as rectangle,
    ring as ring,
    squircle as squircle,
)
from sorojax.rod.statics.equilibrium import (
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
)
from sorojax.rod.statics.inverse_kinematics import (
    Reached as Reached,
    inverse_kinematics as inverse_kinematics,
)
from sorojax.rod.statics.path import (
    ArcPath as ArcPath,
    EquilibriumPath as EquilibriumPath,
    arc_length_path as arc_length_path,
    equilibrium_path as equilibrium_path,
)
from sorojax.rod.statics.targets import (
    AbstractTarget as AbstractTarget,
    Clear as Clear,
    Direction as Direction,
    OnSurface as OnSurface,
    Pose as Pose,
    Position as Position,
)

_check_package(__name__)

"""Rods: strain-parameterised Cosserat model, planar and spatial."""

from sorojax._arguments import check_package as _check_package
from sorojax.rod.assembly import (
    Assembly as Assembly,
    Part as Part,
    assembly as assembly,
    num_coordinates as num_coordinates,
    num_dof as num_dof,
    rest as rest,
    serial as serial,
    slices as slices,
)
from sorojax.rod.basis import (
    AbstractModes as AbstractModes,
    StrainBasis as StrainBasis,
    columns as columns,
)
from sorojax.rod.combined_modes import (
    Combined as Combined,
    fitted as fitted,
    orthonormalise as orthonormalise,
)
from sorojax.rod.contact_force import (
    AbstractContact as AbstractContact,
    ObstacleContact as ObstacleContact,
    contact_energy as contact_energy,
    penetration as penetration,
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
    mass_matrix as mass_matrix,
    stiffness_matrix as stiffness_matrix,
    vector_field as vector_field,
)
from sorojax.rod.energy import (
    coriolis_matrix as coriolis_matrix,
    kinetic_energy as kinetic_energy,
    momentum as momentum,
    potential_energy as potential_energy,
)
from sorojax.rod.fluid import (
    Buoyancy as Buoyancy,
    Drag as Drag,
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
)
from sorojax.rod.given_modes import (
    Functions as Functions,
    SampledModes as SampledModes,
    functions as functions,
)
from sorojax.rod.inverse_kinematics import (
    Reached as Reached,
    inverse_kinematics as inverse_kinematics,
)
from sorojax.rod.joint import (
    AbstractJoint as AbstractJoint,
    Fixed as Fixed,
    Free as Free,
    Prismatic as Prismatic,
    Revolute as Revolute,
)
from sorojax.rod.kinematics import (
    forward_kinematics as forward_kinematics,
    jacobian as jacobian,
    jacobian_rate_product as jacobian_rate_product,
    strain as strain,
    tip_angle as tip_angle,
    tip_pose as tip_pose,
)
from sorojax.rod.link import (
    Link as Link,
)
from sorojax.rod.link_contact import (
    LinkContact as LinkContact,
    LinkObstacle as LinkObstacle,
)
from sorojax.rod.loads import (
    AbstractPairForce as AbstractPairForce,
    Between as Between,
    JointEffort as JointEffort,
    On as On,
    total_force as total_force,
)
from sorojax.rod.model import (
    inertia as inertia,
    motion as motion,
    operators as operators,
)
from sorojax.rod.motion import (
    Base as Base,
    Motion as Motion,
    Operators as Operators,
)
from sorojax.rod.piecewise_modes import (
    Piecewise as Piecewise,
    piecewise as piecewise,
    piecewise_constant as piecewise_constant,
    piecewise_linear as piecewise_linear,
)
from sorojax.rod.points import (
    Points as Points,
    points as points,
)
from sorojax.rod.polynomial_modes import (
    Bernstein as Bernstein,
    Chebyshev as Chebyshev,
    Fourier as Fourier,
    Legendre as Legendre,
    bernstein as bernstein,
    chebyshev as chebyshev,
    constant as constant,
    fourier as fourier,
    legendre as legendre,
)
from sorojax.rod.rod import (
    Elastic as Elastic,
    Rod as Rod,
    elastic as elastic,
    rod as rod,
    strain_names as strain_names,
)
from sorojax.rod.rod_contact import (
    HeldRod as HeldRod,
    RodContact as RodContact,
)
from sorojax.rod.rollout import (
    Rollout as Rollout,
    rollout as rollout,
    second_order as second_order,
)
from sorojax.rod.routing import (
    AbstractRoute as AbstractRoute,
    Converging as Converging,
    Helical as Helical,
    Routed as Routed,
    Straight as Straight,
    thread_lengths as thread_lengths,
    thread_rates as thread_rates,
)
from sorojax.rod.screw import Screw as Screw
from sorojax.rod.section import (
    Section as Section,
    scaled as scaled,
    taper as taper,
)
from sorojax.rod.section_law import (
    EnergyLaw as EnergyLaw,
    SectionLaw as SectionLaw,
    section_law as section_law,
)
from sorojax.rod.section_shapes import (
    circle as circle,
    ellipse as ellipse,
    from_mesh as from_mesh,
    from_shape as from_shape,
    rectangle as rectangle,
    ring as ring,
    squircle as squircle,
)
from sorojax.rod.self_contact import (
    SelfContact as SelfContact,
)
from sorojax.rod.spline_modes import (
    BSpline as BSpline,
    bspline as bspline,
)
from sorojax.rod.static_arc import (
    ArcPath as ArcPath,
    arc_length_path as arc_length_path,
)
from sorojax.rod.static_path import (
    EquilibriumPath as EquilibriumPath,
    equilibrium_path as equilibrium_path,
)
from sorojax.rod.statics import (
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
)
from sorojax.rod.targets import (
    AbstractTarget as AbstractTarget,
    Clear as Clear,
    Direction as Direction,
    OnSurface as OnSurface,
    Pose as Pose,
    Position as Position,
)
from sorojax.rod.tendons import (
    Actuation as Actuation,
    Tendons as Tendons,
    ThreadChambers as ThreadChambers,
    thread_chambers as thread_chambers,
)
from sorojax.rod.tree import (
    AssemblyMotion as AssemblyMotion,
    AssemblyOperators as AssemblyOperators,
    part_motion as part_motion,
)
from sorojax.rod.varying import (
    Varying as Varying,
)
from sorojax.rod.wrench import (
    LineWrench as LineWrench,
    PointWrench as PointWrench,
)

_check_package(__name__)

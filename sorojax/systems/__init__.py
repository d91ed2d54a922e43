"""Systems: blocks with ports, networks of them, and their simulation."""

from sorojax._arguments import check_package as _check_package
from sorojax.math.ode.explicit import (
    RungeKutta4 as RungeKutta4,
    SemiImplicitEuler as SemiImplicitEuler,
    Tsit5 as Tsit5,
)
from sorojax.math.ode.generalised_alpha import GeneralisedAlpha as GeneralisedAlpha
from sorojax.math.ode.rosenbrock import Rodas4 as Rodas4, Rosenbrock2 as Rosenbrock2
from sorojax.systems.blocks.algebra import (
    AbstractReference as AbstractReference,
    Constant as Constant,
    Function as Function,
    Lag as Lag,
    Sensor as Sensor,
    Sine as Sine,
    SmoothRamp as SmoothRamp,
    Source as Source,
    Step as Step,
    Waypoints as Waypoints,
    gain as gain,
    sum_of as sum_of,
)
from sorojax.systems.blocks.block import (
    AbstractBlock as AbstractBlock,
    Input as Input,
    Output as Output,
    Stack as Stack,
    stack as stack,
)
from sorojax.systems.blocks.fem_body import FemBody as FemBody
from sorojax.systems.blocks.fluidic import (
    Regulator as Regulator,
    Reservoir as Reservoir,
    Valve as Valve,
)
from sorojax.systems.blocks.modal_body import (
    Basis as Basis,
    ModalBody as ModalBody,
    displacement as displacement,
    modal_basis as modal_basis,
    reduced as reduced,
)
from sorojax.systems.blocks.rigid_body import RigidBody as RigidBody, Touch as Touch
from sorojax.systems.blocks.rod_body import (
    AssemblyBody as AssemblyBody,
    RodBody as RodBody,
    body_motion as body_motion,
)
from sorojax.systems.control.controller import (
    PID as PID,
    AbstractController as AbstractController,
    PIDMemory as PIDMemory,
)
from sorojax.systems.control.model_control import (
    CartesianImpedance as CartesianImpedance,
    Compensation as Compensation,
    ComputedTorque as ComputedTorque,
    ControlForce as ControlForce,
    EnergyShaping as EnergyShaping,
    FeedForward as FeedForward,
    Followed as Followed,
    TipSpring as TipSpring,
    followed as followed,
)
from sorojax.systems.control.shape_estimate import (
    Filtered as Filtered,
    Markers as Markers,
    Shape as Shape,
    ShapeFilter as ShapeFilter,
    estimate_shape as estimate_shape,
    start_filter as start_filter,
    update_filter as update_filter,
)
from sorojax.systems.integrate.batch import simulate_batch as simulate_batch
from sorojax.systems.integrate.coupled import Coupled as Coupled
from sorojax.systems.integrate.event import Event as Event, Happened as Happened
from sorojax.systems.integrate.partitioned import Parted as Parted, partitioned as partitioned
from sorojax.systems.integrate.sampled import (
    Sampled as Sampled,
    simulate_sampled as simulate_sampled,
)
from sorojax.systems.integrate.simulate import (
    Trajectory as Trajectory,
    last_state as last_state,
    simulate as simulate,
    state_at as state_at,
)
from sorojax.systems.network import (
    Network as Network,
    as_term as as_term,
    outputs as outputs,
)
from sorojax.systems.touching import Touching as Touching, touching as touching

_check_package(__name__)

"""Systems: blocks with ports, networks of them, and their simulation."""

from sorojax._arguments import check_package as _check_package
from sorojax.math.ode.explicit import RungeKutta4, SemiImplicitEuler, Tsit5
from sorojax.math.ode.generalised_alpha import GeneralisedAlpha
from sorojax.math.ode.rosenbrock import Rodas4, Rosenbrock2
from sorojax.systems.blocks.block import (
    AbstractBlock,
    AbstractReference,
    Constant,
    Function,
    Input,
    Lag,
    Output,
    Sensor,
    Sine,
    SmoothRamp,
    Source,
    Stack,
    Step,
    Waypoints,
    gain,
    stack,
    sum_of,
)
from sorojax.systems.blocks.carrying_body import CarryingBody
from sorojax.systems.blocks.fem_body import FemBody
from sorojax.systems.blocks.fluidic import Regulator, Reservoir, Valve
from sorojax.systems.blocks.modal_basis import displacement, modal_basis
from sorojax.systems.blocks.modal_body import modal_body
from sorojax.systems.blocks.rigid_body import RigidBody, Touch
from sorojax.systems.blocks.rod_body import AssemblyBody, RodBody, body_motion
from sorojax.systems.blocks.sampled_body import SampledBody, sampled_body
from sorojax.systems.contact_history import contact_history
from sorojax.systems.control.controller import PID, AbstractController
from sorojax.systems.control.model_control import (
    CartesianImpedance,
    Compensation,
    ComputedTorque,
    ControlForce,
    EnergyShaping,
    FeedForward,
    TipSpring,
    tracking,
)
from sorojax.systems.control.shape_estimate import (
    Markers,
    ShapeFilter,
    estimate_shape,
    start_filter,
    update_filter,
)
from sorojax.systems.integrate.batch import simulate_batch
from sorojax.systems.integrate.coupled import Coupled
from sorojax.systems.integrate.integrate import Event
from sorojax.systems.integrate.partitioned import partitioned
from sorojax.systems.integrate.sampled import Sampled, simulate_sampled
from sorojax.systems.integrate.simulate import Trajectory, last_state, simulate, state_at
from sorojax.systems.integrate.staggered import Staggered
from sorojax.systems.network import Network, as_term, outputs

__all__ = [
    "PID",
    "AbstractBlock",
    "AbstractController",
    "AbstractReference",
    "AssemblyBody",
    "CarryingBody",
    "CartesianImpedance",
    "Compensation",
    "ComputedTorque",
    "Constant",
    "ControlForce",
    "Coupled",
    "EnergyShaping",
    "Event",
    "FeedForward",
    "FemBody",
    "Function",
    "GeneralisedAlpha",
    "Input",
    "Lag",
    "Markers",
    "Network",
    "Output",
    "Regulator",
    "Reservoir",
    "RigidBody",
    "RodBody",
    "Rodas4",
    "Rosenbrock2",
    "RungeKutta4",
    "Sampled",
    "SampledBody",
    "SemiImplicitEuler",
    "Sensor",
    "ShapeFilter",
    "Sine",
    "SmoothRamp",
    "Source",
    "Stack",
    "Staggered",
    "Step",
    "TipSpring",
    "Touch",
    "Trajectory",
    "Tsit5",
    "Valve",
    "Waypoints",
    "as_term",
    "body_motion",
    "contact_history",
    "displacement",
    "estimate_shape",
    "gain",
    "last_state",
    "modal_basis",
    "modal_body",
    "outputs",
    "partitioned",
    "sampled_body",
    "simulate",
    "simulate_batch",
    "simulate_sampled",
    "stack",
    "start_filter",
    "state_at",
    "sum_of",
    "tracking",
    "update_filter",
]

_check_package(__name__)

"""Systems: blocks with ports, networks of them, and their simulation."""

from sorojax._arguments import check_package as _check_package
from sorojax.math.alpha import GeneralisedAlpha as GeneralisedAlpha
from sorojax.math.explicit import (
    RungeKutta4 as RungeKutta4,
    SemiImplicitEuler as SemiImplicitEuler,
    Tsit5 as Tsit5,
)
from sorojax.math.linearly_implicit import Rosenbrock2 as Rosenbrock2
from sorojax.math.rosenbrock import Rodas4 as Rodas4
from sorojax.systems.algebra import (
    Function as Function,
    Lag as Lag,
    Sensor as Sensor,
    gain as gain,
    sum_of as sum_of,
)
from sorojax.systems.assembly_body import AssemblyBody as AssemblyBody
from sorojax.systems.batch import simulate_batch as simulate_batch
from sorojax.systems.block import (
    AbstractBlock as AbstractBlock,
    Input as Input,
    Output as Output,
)
from sorojax.systems.control_force import ControlForce as ControlForce
from sorojax.systems.controller import (
    PID as PID,
    AbstractController as AbstractController,
    PIDMemory as PIDMemory,
)
from sorojax.systems.coupled import Coupled as Coupled
from sorojax.systems.event import Event as Event, Happened as Happened
from sorojax.systems.fem_body import FemBody as FemBody
from sorojax.systems.fluidic import Regulator as Regulator, Reservoir as Reservoir
from sorojax.systems.followed import Followed as Followed, followed as followed
from sorojax.systems.modal_basis import Basis as Basis, modal_basis as modal_basis
from sorojax.systems.modal_body import (
    ModalBody as ModalBody,
    displacement as displacement,
    reduced as reduced,
)
from sorojax.systems.model_control import (
    CartesianImpedance as CartesianImpedance,
    Compensation as Compensation,
    ComputedTorque as ComputedTorque,
    EnergyShaping as EnergyShaping,
    FeedForward as FeedForward,
    TipSpring as TipSpring,
)
from sorojax.systems.network import (
    Network as Network,
    as_term as as_term,
    outputs as outputs,
)
from sorojax.systems.partitioned import Parted as Parted, partitioned as partitioned
from sorojax.systems.rigid_body import RigidBody as RigidBody, Touch as Touch
from sorojax.systems.rod_body import RodBody as RodBody, body_motion as body_motion
from sorojax.systems.sampled import (
    Sampled as Sampled,
    simulate_sampled as simulate_sampled,
)
from sorojax.systems.shape_estimate import (
    Markers as Markers,
    Shape as Shape,
    estimate_shape as estimate_shape,
)
from sorojax.systems.shape_filter import (
    Filtered as Filtered,
    ShapeFilter as ShapeFilter,
    start_filter as start_filter,
    update_filter as update_filter,
)
from sorojax.systems.simulate import (
    Trajectory as Trajectory,
    last_state as last_state,
    simulate as simulate,
    state_at as state_at,
)
from sorojax.systems.source import (
    AbstractReference as AbstractReference,
    Constant as Constant,
    Sine as Sine,
    SmoothRamp as SmoothRamp,
    Source as Source,
    Step as Step,
)
from sorojax.systems.stack import Stack as Stack, stack as stack
from sorojax.systems.touching import Touching as Touching, touching as touching
from sorojax.systems.valve import Valve as Valve
from sorojax.systems.waypoints import Waypoints as Waypoints

_check_package(__name__)

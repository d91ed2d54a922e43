"""Systems: blocks with ports, networks of them, and their simulation."""

from sorojax.systems.assembly_body import AssemblyBody as AssemblyBody
from sorojax.systems.block import (
    AbstractBlock as AbstractBlock,
    Input as Input,
    Output as Output,
)
from sorojax.systems.controller import (
    PID as PID,
    AbstractController as AbstractController,
    PIDMemory as PIDMemory,
)
from sorojax.systems.fluidic import Regulator as Regulator, Reservoir as Reservoir
from sorojax.systems.network import (
    Network as Network,
    as_term as as_term,
    outputs as outputs,
)
from sorojax.systems.rod_body import RodBody as RodBody, body_motion as body_motion
from sorojax.systems.sampled import simulate_sampled as simulate_sampled
from sorojax.systems.simulate import Trajectory as Trajectory, simulate as simulate
from sorojax.systems.source import (
    AbstractReference as AbstractReference,
    Constant as Constant,
    Sine as Sine,
    SmoothRamp as SmoothRamp,
    Source as Source,
    Step as Step,
)

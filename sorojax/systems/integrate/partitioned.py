"""Networks whose body touches things: the body is moved by a stepper made for contact, all
other blocks by a method of first order, in turns."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.math.compiled import Split
from sorojax.math.ode.contact_midpoint import ContactMidpoint
from sorojax.math.ode.explicit import AbstractMethod
from sorojax.math.ode.rosenbrock import Rosenbrock2
from sorojax.math.ode.steppers import AbstractStepper, Kinematic
from sorojax.rod.dynamics.rollout import second_order
from sorojax.systems.blocks.block import Signals
from sorojax.systems.blocks.rod_body import AssemblyBody
from sorojax.systems.network import Network, inputs_of, rates_of


class PartitionedState(NamedTuple):
    """A network at one moment.

    Attributes:
        state: Of the network.
        acceleration: Of the body, mean of the step before.
        time: [s].
        gained: Energy that steps in contact gained by themselves [J].
        resolved: Whether every step so far could be taken; where not, this is the moment
            before that step.
    """

    state: Any
    acceleration: Float[Array, " dof"]
    time: Float[Array, ""]
    gained: Float[Array, ""]
    resolved: Bool[Array, ""]


Move = Callable[[PartitionedState, Signals], PartitionedState]


def partitioned(
    network: Network,
    period: float,
    *,
    body: str = "body",
    substeps: int = 1,
    stepper: AbstractStepper | None = None,
    method: AbstractMethod | None = None,
) -> tuple[Move, PartitionedState]:
    """`move(parted, inputs) -> parted`, compiled, which advances by `period`, and the start.

    In every step the body moves under the signals that the other blocks had, then they move
    under those that the body has now: of order 1 in the step, and stable like a symplectic
    step where gas and body swing together. Contacts may be as stiff as the stepper bears; a
    step that goes through something however it is cut is not taken, nor any after it.

    Args:
        network: With one `AssemblyBody`.
        period: Of every call [s].
        body: Name of the block.
        substeps: Steps in one call.
        stepper: `ContactMidpoint()` if omitted.
        method: For the other blocks; `Rosenbrock2(refresh=True)` if omitted.

    Returns:
        `move`, and the state to start from.

    Raises:
        ValueError: If the network has no such body.
    """
    if not isinstance(network.blocks.get(body), AssemblyBody):
        raise ValueError(
            f"partitioned: `{body}` is no AssemblyBody, need the name of one among "
            f"{', '.join(network.blocks)}. Pass body=."
        )
    _check.positive("partitioned", "period", period, "s", "5 ms is period=5e-3.")
    stepper = ContactMidpoint() if stepper is None else stepper
    method = Rosenbrock2(refresh=True) if method is None else method
    h = real(period / substeps)
    fixed, state = Split((network, h, stepper, method)), network.initial_state()
    still, zero = jnp.zeros_like(state[body]["v"]), jnp.zeros_like(h)
    start = PartitionedState(state, still, zero, zero, jnp.array(True))

    def move(parted: PartitionedState, inputs: Signals) -> PartitionedState:
        given = {name: jnp.asarray(value, h.dtype) for name, value in inputs.items()}
        return _move(fixed, parted, given, body, substeps)

    return move, start


@once
def _move(
    fixed: Split, parted: PartitionedState, inputs, name: str, count: int
) -> PartitionedState:
    network, h, stepper, method = fixed.whole()

    def one(_, now: PartitionedState) -> PartitionedState:
        body = network.blocks[name]
        own = inputs_of(network, now.time, now.state, inputs, (name,))[name]
        q, v, memory = (now.state[name].get(key) for key in ("q", "v", "memory"))
        problem = second_order(body.assembly, q, body.acting(own), memory)
        begun = Kinematic(q, v, now.acceleration, now.gained, now.resolved, memory)
        new = stepper.step(problem, now.time, h, begun)
        kept = {} if new.memory is None else {"memory": new.memory}
        state = now.state | {name: {"q": new.q, "v": new.v} | kept}
        state = others_moved(network, now.time, state, inputs, h, method, (name,))
        if new.resolved is None or new.gained is None:  # without contact
            return PartitionedState(state, new.a, now.time + h, now.gained, now.resolved)
        moved = PartitionedState(state, new.a, now.time + h, new.gained, new.resolved)
        held = now._replace(resolved=new.resolved)
        return jax.tree.map(lambda a, b: jnp.where(new.resolved, a, b), moved, held)

    return jax.lax.fori_loop(0, count, one, parted)


def others_moved(network, t, state, inputs, h, method: AbstractMethod, bodies: tuple[str, ...]):
    """The state after a step of all blocks but the `bodies`, which stay."""
    names = tuple(name for name in network.blocks if name not in bodies)

    def field(t, part):
        return rates_of(network, t, state | part, inputs, names)

    part = {name: state[name] for name in names}
    if not jax.tree.leaves(part):
        return state
    moved = method.advance(field, t, part, h, method.begin(field, t, part, h))
    return state | moved.y

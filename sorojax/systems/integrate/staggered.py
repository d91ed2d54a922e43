"""The method for networks with reduced bodies that touch things: these by steps made for
contact, all other blocks after them."""

from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.ode.explicit import AbstractMethod, MethodStep
from sorojax.math.ode.rosenbrock import Rosenbrock2
from sorojax.systems.blocks.modal_body import ModalBody
from sorojax.systems.integrate.march import Rate
from sorojax.systems.integrate.modal_step import first_acceleration, modal_step
from sorojax.systems.integrate.partitioned import others_moved
from sorojax.systems.network import Network, at_time, inputs_of


class Staggered(AbstractMethod):
    """Fixed steps of networks whose reduced bodies touch things.

    In every step the bodies of `sampled_body` or `modal_body` with contact move by
    generalised-alpha under the signals that the other blocks had, then these move under those
    that the bodies have now: of order 1 in the step where they depend on each other. Springs
    of friction go on from step to step, so bodies that hold do not creep. A step whose forces
    do not balance ends the run as `Status.not_converged`.

    Differentiable, forward and in reverse: one linear equation per step, at its solution.

    Attributes:
        rho_inf: What an oscillation much faster than the step keeps of its size in one step.
        rest: Method of all other blocks; `Rosenbrock2(refresh=True)` if omitted.
        passes: Of Newton's method in a step at most.

    Reference:
        Farhat, Lesoinne, Two efficient staggered algorithms for the serial and parallel
        solution of three-dimensional nonlinear transient aeroelastic problems, Comput.
        Methods Appl. Mech. Engrg. 182, 2000, for the order of things in a step.
    """

    rho_inf: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    rest: AbstractMethod = eqx.field(default_factory=lambda: Rosenbrock2(refresh=True))
    passes: int = eqx.field(static=True, default=40)
    num_order: ClassVar[int] = 1
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    @property
    def carries(self) -> bool:
        return True

    def begin(self, field, t, y, h) -> dict[str, Array]:
        network, inputs, names = _network(field)
        own = inputs_of(network, t, y, at_time(inputs, t), names)
        return {
            name: first_acceleration(_body(network, name), own[name], y[name]) for name in names
        }

    def advance(self, field, t, y, h, memory):
        network, inputs, names = _network(field)
        within = t + h / (1 + self.rho_inf)  # where forces act
        own = inputs_of(network, within, y, at_time(inputs, within), names)
        state, accelerations, resolved = dict(y), {}, jnp.array(True)
        for name in names:
            known = _body(network, name), own[name], y[name], memory[name], h
            moved = modal_step(*known, self.rho_inf, self.passes)
            state[name], accelerations[name] = moved.state, moved.acceleration
            resolved = resolved & moved.resolved
        given = at_time(inputs, t)
        state = others_moved(network, t, state, given, h, self.rest, names)
        start = y, memory
        state, memory = jax.tree.map(
            lambda a, b: jnp.where(resolved, a, b), (state, accelerations), start
        )
        return MethodStep(state, None, memory, {}, resolved)


def touching_bodies(block: Any) -> tuple[str, ...]:
    """Names of the reduced bodies of a network that touch things."""
    blocks = block.blocks if isinstance(block, Network) else {}
    return tuple(n for n, one in blocks.items() if isinstance(one, ModalBody) and one.contacts)


def _network(field) -> tuple[Network, dict[str, Any], tuple[str, ...]]:
    block = field.block if isinstance(field, Rate) else None
    names = touching_bodies(block)
    if not isinstance(block, Network) or not names:
        raise ValueError(
            "Staggered: got no network with a reduced body in contact, need one, in fixed "
            "steps. Call simulate(network, duration, step=...), with the bodies in the network "
            "itself."
        )
    return block, dict(field.inputs), names


def _body(network: Network, name: str) -> ModalBody:
    block = network.blocks[name]
    assert isinstance(block, ModalBody)
    return block

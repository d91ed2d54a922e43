"""Algebraic loops: torn wires, and the root find that makes them consistent."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from sorojax.systems.schedule import Blocks, Wires, loop_of

Signals = dict[str, Array]


def torn_wires(blocks: Blocks, wires: Wires) -> tuple[str, ...]:
    """Wired inputs to cut, one per loop, so that the rest can be evaluated in order."""
    left = dict(wires)
    torn: list[str] = []
    while loop := loop_of(blocks, left):
        name = min(entry for entry in loop if entry in left)
        del left[name]
        torn.append(name)
    return tuple(torn)


def consistent(propagate: Callable[[Signals], Signals], guess: Signals) -> Signals:
    """Values of torn inputs that equal what `propagate` makes of them.

    One step solves loops that are linear; derivatives follow from the implicit function
    theorem. Where no root is found the values are NaN, which ends a simulation.
    """

    def residual(values, _):
        return jax.tree.map(lambda a, b: a - b, propagate(values), values)

    solver = optx.Newton(rtol=1e-12, atol=1e-12)
    found = optx.root_find(residual, solver, guess, max_steps=50, throw=False)
    good = found.result == optx.RESULTS.successful
    return jax.tree.map(lambda x: jnp.where(good, x, jnp.full_like(x, jnp.nan)), found.value)

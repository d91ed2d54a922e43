"""The planar or the spatial equations, as the group of a rod asks."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax.rod import planar, spatial
from sorojax.rod.motion import Motion, Operators, operators
from sorojax.rod.rod import Rod

_KERNEL = {2: planar, 3: spatial}


def rod_motion(
    rod: Rod,
    q: Float[Array, " dof"],
    v: Float[Array, " dof"] | None = None,
    constants: Operators | None = None,
) -> Motion:
    """The fields of a rod clamped at the origin."""
    do = f"The rod has {rod.basis.num_dof} coordinates, ordered as its basis."
    _check.shape("rod", "q", q, (rod.basis.num_dof,), do)
    constants = operators(rod) if constants is None else constants
    v = jnp.zeros_like(q) if v is None else v
    return _KERNEL[rod.group.space_dim].motion(rod, constants, q, v)


def rod_inertia(moment: Motion) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force of a moment."""
    return _KERNEL[moment.rod.group.space_dim].inertia(moment)


def bias_rates(moment: Motion) -> tuple[Float[Array, "quad rot"], Float[Array, "quad dim"]]:
    """d/ds of the accelerations at zero coordinate acceleration, angular and linear."""
    return _KERNEL[moment.rod.group.space_dim].bias_rates(moment)

"""What a contact remembers from step to step: friction, and overlap that is let out.

Pressure and normal of friction are those at the start of the step, which keeps the tangent
symmetric. Over an impact the friction impulse is the coefficient times the normal one where the
normal pressure is that at the ends of steps (`rho_inf` up to 1/2); beyond, where steps do not
resolve the impact, it may differ.
"""

import dataclasses
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.contact import Grip, far, gaps
from sorojax.fem.curved import blockwise

if TYPE_CHECKING:
    from sorojax.fem.contact_load import Contact
    from sorojax.fem.problem import Problem

Nodal = Float[Array, "nodes dim"]

_DEEP = 50.0  # times the smoothing: overlap under pressures of E / 20


def released(
    load: "Contact", problem: "Problem", u: Nodal, step: Float[Array, ""]
) -> "Contact":
    """`load` for a step from `u`: overlap far beyond what contacts carry is not felt when a
    motion begins, and let out at the velocity of release."""
    assert load.sunk is not None and load.fresh is not None
    assert load.release_velocity is not None and load.smoothing is not None
    zero, depth = jnp.zeros_like(load.sunk), _DEEP * load.smoothing

    def found():
        gap = gaps(load.obstacle, load.points_of(problem, u), load.value)
        return jnp.where(gap < -depth, gap, zero)

    left = jnp.minimum(load.sunk + load.release_velocity * step, zero)
    sunk = jax.lax.cond(load.fresh > 0, found, lambda: left)
    fresh = jnp.zeros_like(load.fresh)
    return eqx.tree_at(lambda load: (load.sunk, load.fresh), load, (sunk, fresh))


def gripped(
    load: "Contact",
    problem: "Problem",
    u: Nodal,
    back: Nodal,
    rate: Float[Array, ""],
    step: Float[Array, ""],
) -> "Contact":
    """`load` for the step from `u`, in which points move at `rate * (x - back)`, relative to
    an obstacle that has moved from its last place to `value` within `step` [s]."""
    friction = load.friction_law
    assert load.grip is not None and load.place is not None
    start = load.points_of(problem, u) - load.place[None, None]
    anchor = start - friction.stretch(load.grip, start)
    pressure, normal = _felt(load, start)
    drag = friction.coefficient * pressure * rate / friction.velocity
    still = rate <= 0
    speed = (load.value - load.place) / jnp.where(still, 1.0, step)
    lead = jnp.where(still, jnp.zeros_like(speed), speed / jnp.where(still, 1.0, rate))
    away = load.points_of(problem, back) + (lead - load.value)[None, None]
    grip = Grip(anchor, pressure, normal, drag, away)
    return eqx.tree_at(lambda load: (load.grip, load.place), load, (grip, load.value))


def _felt(
    load: "Contact", points: Float[Array, "facets quad dim"]
) -> tuple[Float[Array, "facets quad"], Float[Array, "facets quad dim"]]:
    """Pressure and normal at points in the frame of the obstacle, zero where a block of
    facets is far from it."""
    law, shift = load.law, load.shift()
    reach = None if shift is None else jnp.max(shift)

    def felt(points, row):
        gap, slope = jax.vmap(jax.value_and_grad(lambda x: gaps(load.obstacle, x)))(points)
        size = jnp.sqrt(jnp.sum(slope**2, axis=-1, keepdims=True))
        normal = slope / jnp.where(size > 0, size, jnp.ones_like(size))
        pressure = law.pressure(gap if shift is None else gap - shift[row])
        return jnp.concatenate([pressure[:, None], normal], axis=1)

    def idle(points, _):
        return far(load.obstacle, points, reach)

    num, quad, dim = points.shape
    found = blockwise(jax.vmap(felt), idle, points, jnp.arange(num), (quad, dim + 1))
    return found[..., 0], found[..., 1:]


@eqx.filter_jit
def settled(load: "Contact", problem: "Problem", u: Nodal) -> "Contact":
    """`load` after an equilibrium `u`, ready for the next one."""
    zero = jnp.zeros((), u.dtype)
    made = gripped(load, problem, u, u, zero, zero)
    return dataclasses.replace(made, began=load.began, share=jnp.ones_like(zero))

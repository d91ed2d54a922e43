"""The point of one centre line that is closest to each point of another."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.quadrature import integration_rows
from sorojax.rod.motion import Motion
from sorojax.rod.points import points

_NEWTON = 2
_STEEPEST = 0.2  # least curvature of the distance that a Newton step may lean on


def closest(
    motion: Motion,
    candidates: np.ndarray,
    to: Float[Array, "points dim"],
    allowed: Array | np.ndarray | None = None,
    low: Array | float = 0.0,
    high: Array | float = 1.0,
) -> Float[Array, " points"]:
    """Arc length s in [0, 1] of the point of `motion` closest to each point of `to`.

    A search over `candidates` starts a Newton iteration on the smooth centre line. Its last
    step carries the derivative of the minimiser, so the distance is as smooth as the rod.

    Args:
        motion: The rod to search.
        candidates: Places in [0, 1] at which the search starts.
        to: Points [m].
        allowed: Which candidates each point may take, (points, candidates).
        low, high: Limits of s, one number or one per point.
    """
    fixed = jax.tree.map(_held, motion)
    square = _squares(jax.lax.stop_gradient(to), points(fixed, candidates).position)
    if allowed is not None:
        square = jnp.where(jnp.asarray(allowed), square, jnp.inf)
    dtype = to.dtype
    s = jnp.asarray(candidates, dtype)[jnp.argmin(square, axis=1)]
    low, high = (jnp.broadcast_to(jnp.asarray(x, dtype), s.shape) for x in (low, high))
    for _ in range(_NEWTON):
        s = _improve(fixed, jax.lax.stop_gradient(to), s, low, high)
    return _improve(motion, to, jax.lax.stop_gradient(s), low, high)


def _held(leaf):
    return jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf


def _squares(to: Array, curve: Array) -> Float[Array, "points candidates"]:
    total = jnp.zeros((to.shape[0], curve.shape[0]), to.dtype)
    for axis in range(to.shape[1]):
        total = total + (to[:, None, axis] - curve[None, :, axis]) ** 2
    return total


def _improve(motion: Motion, to: Array, s: Array, low: Array, high: Array) -> Array:
    """One Newton step on half the square of the distance."""

    def path(s):
        rows = integration_rows(motion.rod.quadrature, s)
        place = motion.rod.length * (rows @ motion.tangent)
        return place if motion.base is None else place + motion.base.position[None]

    def slope(s):
        return jax.jvp(path, (s,), (jnp.ones_like(s),))

    (place, first), (_, second) = jax.jvp(slope, (s,), (jnp.ones_like(s),))
    away = to - place
    speed = jnp.sum(first**2, axis=1)
    bend = speed - jnp.sum(away * second, axis=1)
    bend = jnp.where(bend > _STEEPEST * speed, bend, _STEEPEST * speed)
    return jnp.clip(s + jnp.sum(away * first, axis=1) / bend, low, high)

"""What holds at the answer of inverse kinematics, from which its derivative follows."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sorojax.rod.model import Model
from sorojax.rod.reaching import (
    OBSTACLE_WEIGHT,
    Tasks,
    all_rows,
    bound_to,
    scaled_metric,
)
from sorojax.rod.tangent import increments, squared


def conditions(model: Model, tasks: Tasks, at, q: Array, push):
    """What vanishes at the answer: the downhill force of all tasks that no bound holds,
    and the gaps of the bounds that do."""
    here = at(q)
    down = here.error @ here.jacobian
    hold = jax.lax.stop_gradient(here)
    _, rows_now = all_rows(hold, push)
    scaled, tiny = scaled_metric(tasks, rows_now.T @ rows_now)
    if here.pull is not None:
        share = tiny * jnp.trace(scaled) / jnp.trace(tasks.metric)
        down = down + jax.lax.stop_gradient(share) * here.pull
    closed = None
    if push is not None:
        assert here.gap is not None and here.change is not None and hold.gap is not None
        down = down + OBSTACLE_WEIGHT * push @ here.change
        active = jax.lax.stop_gradient(push) - OBSTACLE_WEIGHT * hold.gap > 0
        closed = jnp.where(active, -OBSTACLE_WEIGHT * here.gap, push)
    own = increments(model, q)
    if tasks.limits is not None:
        low, high = tasks.limits
        stiff = jax.lax.stop_gradient(jnp.trace(scaled) / scaled.shape[0])
        lower, upper = bound_to(jax.lax.stop_gradient(tasks.limits), own, down)
        down = jnp.where(lower, stiff * (low - own), down)
        down = jnp.where(upper, stiff * (high - own), down)
    return squared(model, q, -down), closed


def smallest_change(linear, right: Array, tasks: Tasks, size: int) -> Array:
    """The smallest change of q that the conditions ask for, where they leave freedom."""
    matrix = jax.jacobian(linear)(right)
    if tasks.forces is None:
        place = jnp.arange(right.shape[0]) < size
        metric = jnp.eye(size, dtype=right.dtype)
        if tasks.metric.shape[0] == size:
            metric = tasks.metric
        share = jnp.finfo(right.dtype).eps ** 0.6 / jnp.trace(metric)
        mean = jnp.where(place, jnp.abs(jnp.diag(matrix)), 0.0).sum()
        spread = right.shape[0] - size
        matrix = matrix + jnp.pad(share * mean * metric, (0, spread))
    return jnp.linalg.solve(matrix, right)

"""What holds at the answer of inverse kinematics, from which its derivative follows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.rod.model import Model
from sorojax.rod.reaching import (
    OBSTACLE_WEIGHT,
    Rows,
    Tasks,
    all_rows,
    bound_to,
    scaled_metric,
)
from sorojax.rod.tangent import increments, squared


class Ends(NamedTuple):
    """What inverse kinematics finds.

    Attributes:
        q: Coordinates.
        push: Multipliers of the bounds, if there are any.
        balance: Errors that balance the pull of the forces, where there are forces, in
            units of what counts as nothing: as errors they are lost where rounding is
            larger, and with them how the targets bend against the pull.
    """

    q: Float[Array, " coordinates"]
    push: Float[Array, " bounds"] | None
    balance: Float[Array, " rows"] | None


def balanced(model: Model, tasks: Tasks, at, q: Array, push) -> Ends:
    """The ends of a search, with multipliers from the balance of forces."""
    here = at(q)
    if here.pull is None:
        return Ends(q, push, None)
    share, tiny = _share(tasks, here, push)
    multipliers, across = here.error / tiny, here.jacobian
    active = None
    if push is not None:
        active = _active(push, here)
        change = jnp.where(active[:, None], OBSTACLE_WEIGHT * here.change, 0.0)
        multipliers = jnp.concatenate([multipliers, jnp.where(active, push, 0.0) / tiny])
        across = jnp.concatenate([across, change])
    left = multipliers @ across + share * here.pull
    if tasks.limits is not None:
        lower, upper = bound_to(tasks.limits, increments(model, q), left)
        free = jnp.where(lower | upper, jnp.zeros_like(left), jnp.ones_like(left))
        left, across = free * left, free[None] * across
    # Directions that the targets hardly see have no say: out of reach they amplify noise.
    least = float(jnp.finfo(q.dtype).eps) ** 0.3
    multipliers = multipliers - jnp.linalg.lstsq(across.T, left, rcond=least)[0]
    count = here.error.shape[0]
    if push is not None and active is not None:
        exact = jnp.maximum(tiny * multipliers[count:], 0.0)
        push = jnp.where(active, exact, push)
    return Ends(q, push, multipliers[:count])


def conditions(model: Model, tasks: Tasks, at, ends: Ends) -> Ends:
    """What vanishes at the answer: the downhill force of all tasks that no bound holds,
    the gaps of the bounds that do, and errors against their balance."""
    q, push, balance = ends
    here = at(q)
    hold = jax.lax.stop_gradient(here)
    share, tiny = _share(tasks, hold, jax.lax.stop_gradient(push))
    unit, missing = jnp.ones_like(tiny), None
    if balance is None:
        down = here.error @ here.jacobian
    else:
        unit, missing = tiny, here.error - tiny * balance
        down = balance @ here.jacobian + share * here.pull
    closed = None
    if push is not None:
        assert here.change is not None
        down = down + OBSTACLE_WEIGHT / unit * push @ here.change
        active = _active(jax.lax.stop_gradient(push), hold)
        closed = jnp.where(active, -OBSTACLE_WEIGHT * here.gap, push)
    own = increments(model, q)
    if tasks.limits is not None:
        low, high = tasks.limits
        _, rows_now = all_rows(hold, jax.lax.stop_gradient(push))
        stiff = jnp.sum(rows_now**2) / rows_now.shape[1]
        lower, upper = bound_to(jax.lax.stop_gradient(tasks.limits), own, down)
        down = jnp.where(lower, stiff * (low - own), down)
        down = jnp.where(upper, stiff * (high - own), down)
    return Ends(squared(model, q, -down), closed, missing)


def _share(tasks: Tasks, here: Rows, push) -> tuple[Array, Array]:
    """What turns the pull into the units of the errors, and what counts as nothing."""
    _, rows_now = all_rows(here, push)
    scaled, tiny = scaled_metric(tasks, rows_now.T @ rows_now)
    return jnp.trace(scaled) / jnp.trace(tasks.metric), tiny


def _active(push: Array, here: Rows) -> Array:
    assert here.gap is not None
    return push - OBSTACLE_WEIGHT * here.gap > 0


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

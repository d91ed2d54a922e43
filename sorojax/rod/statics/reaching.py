"""Steps of inverse kinematics: damped least squares, its null space, bounds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from sorojax.math.implicit_root import matrix_of
from sorojax.math.linalg.dense import product, solve_symmetric
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.points import points
from sorojax.rod.dynamics.tree import AssemblyState, part_columns, part_motion
from sorojax.rod.forces.loads import Load, relaxed, total_force
from sorojax.rod.model.assembly import increments, index_of
from sorojax.rod.model.link import LinkState
from sorojax.rod.model.model import Model
from sorojax.rod.statics.equilibrium import squared
from sorojax.rod.statics.loops import closing
from sorojax.rod.statics.targets import AbstractTarget, Frames, ObstacleConstraint

_ROUNDING = 16  # units in the last place that a coordinate on its limit may be away
OBSTACLE_WEIGHT = 30.0  # of a bound against a target; sets how fast bounds are met

Limits = tuple[Float[Array, " dof"], Float[Array, " dof"]]


class Tasks(NamedTuple):
    """All that is asked of a model.

    Attributes:
        targets: What to reach.
        obstacles: What to stay clear of.
        forces: Whose equilibrium the null space seeks, or None.
        limits: Bounds of the coordinates, or None.
        metric: Measures increments.
        length: Of the model, to measure errors [m].
    """

    targets: tuple[AbstractTarget, ...]
    obstacles: tuple[ObstacleConstraint, ...]
    forces: tuple[Load, ...] | None
    limits: Limits | None
    metric: Float[Array, "dof dof"]
    length: Float[Array, ""]


class Rows(NamedTuple):
    """The tasks at one place: errors and what rates make up for, gaps and how they change,
    and the downhill force of the secondary task."""

    error: Float[Array, " rows"]
    jacobian: Float[Array, "rows dof"]
    gap: Float[Array, " bounds"] | None
    change: Float[Array, "bounds dof"] | None
    pull: Float[Array, " dof"] | None


def rows(tasks: Tasks, t: Array, moment: RodState | AssemblyState) -> Rows:
    """The tasks at a moment."""
    group = moment.rod.group if isinstance(moment, RodState) else moment.assembly.group
    pairs = [task.errors(group, _frames(moment, task)) for task in tasks.targets]
    if isinstance(moment, AssemblyState) and moment.assembly.closures:
        pairs.append(closing(moment, t, tasks.length))
    gaps = [task.gaps(_frames(moment, task)) for task in tasks.obstacles]
    pull = None if tasks.forces is None else total_force(relaxed(tasks.forces), t, moment)
    error, jacobian = _stacked(pairs)
    gap, change = _stacked(gaps) if gaps else (None, None)
    return Rows(error, jacobian, gap, change, pull)


def all_rows(at: Rows, push: Array | None, ahead: Array | None = None) -> tuple[Array, Array]:
    """Errors with those of the bounds that are active under the multipliers `push`, or
    that the increment `ahead` would break."""
    if at.gap is None or push is None:
        return at.error, at.jacobian
    assert at.change is not None
    over = push - OBSTACLE_WEIGHT * at.gap
    active = over > 0
    if ahead is not None:
        active = active | (over - OBSTACLE_WEIGHT * (at.change @ ahead) > 0)
    change = jnp.where(active[:, None], OBSTACLE_WEIGHT * at.change, 0.0)
    error = jnp.concatenate([at.error, jnp.where(active, over, 0.0)])
    return error, jnp.concatenate([at.jacobian, change])


class IKStep(NamedTuple):
    """An increment, the share that the secondary task has in it, and what it is worth.

    Attributes:
        increment: Of the coordinates, in the rates' dimension.
        size: Of the increment, as the tip moves [m].
        drift: The same of the share in the null space.
        slope: Size of the gradient [m]; zero at the closest place.
        outward: Coordinates at a limit that it would move beyond, or None.
    """

    increment: Float[Array, " dof"]
    size: Float[Array, ""]
    drift: Float[Array, ""]
    slope: Float[Array, ""]
    outward: Bool[Array, " dof"] | None


def step(
    tasks: Tasks, own: Array, at: Rows, push: Array | None, damping, pull_gain, hessian=None
) -> IKStep:
    """One damped least-squares step with the secondary task in the null space.

    Args:
        tasks: What is asked.
        own: Coordinates in the places of their rates.
        at: The tasks there.
        push: Multipliers of the bounds.
        damping: Relative to the mean square of the Jacobian [-].
        pull_gain: Share of the secondary step that is taken [-].
        hessian: Of half the squared error; taken in place of J'J where it is positive.
    """
    first = _step(tasks, own, at, all_rows(at, push), damping, pull_gain, hessian)
    if push is None and tasks.limits is None:
        return first
    # Bounds and limits that the first answer breaks take part in the second.
    active = all_rows(at, push, first.increment)
    if hessian is not None and push is not None:
        _, before = all_rows(at, push)
        hessian = hessian + active[1].T @ active[1] - before.T @ before
    if first.outward is None:
        return _step(tasks, own, at, active, damping, pull_gain, hessian)

    def again(state):
        held, move = state
        held = held | move.outward
        return held, _step(tasks, own, at, active, damping, pull_gain, hessian, held)

    # Each that would move out is held, until none would.
    begin: Any = jnp.zeros_like(first.outward), first
    begin = begin if push is None else again(begin)
    return jax.lax.while_loop(lambda s: jnp.any(s[1].outward & ~s[0]), again, begin)[1]


def _step(
    tasks: Tasks, own: Array, at: Rows, active, damping, pull_gain, hessian, held=None
) -> IKStep:
    error, jacobian = active
    down, square = error @ jacobian, product(jacobian.T, jacobian)
    scaled, tiny = scaled_metric(tasks, square)
    free, share = None, tiny * (jnp.trace(scaled) / jnp.trace(tasks.metric))
    if tasks.limits is not None:
        pulled = down if at.pull is None else down + share * at.pull
        free = _free(tasks.limits, own, pulled)
        free = free if held is None else jnp.where(held, jnp.zeros_like(free), free)
        hessian = None if hessian is None else _held(hessian, free)
        down, square, scaled = free * down, _held(square, free), _held(scaled, free, 1.0)
    damped, pull = square + (damping + tiny) * scaled, None
    drift, along = jnp.zeros((), error.dtype), None
    if at.pull is None:
        increment = solve_symmetric(damped, down)
    else:
        pull = share * at.pull
        pull = pull if free is None else free * pull
        systems = jnp.stack([damped, square + tiny * scaled]), jnp.stack([down, pull])
        increment, along = jax.vmap(solve_symmetric)(*systems)
    if hessian is not None:
        even = (hessian + hessian.T) / 2
        increment = _newton(even + (damping + tiny) * scaled, down, increment)
        if pull is not None and along is not None:
            # Out of reach J'J has a null space that the errors do not have.
            along = _newton(even + tiny * scaled, pull, along)
    if along is not None:
        along = pull_gain * along
        drift, increment = jnp.sqrt(along @ scaled @ along), increment + along
    slope = jnp.sqrt(jnp.abs(down @ solve_symmetric(scaled, down)))
    outward = None
    if tasks.limits is not None:
        low, high = tasks.limits
        outward = jnp.logical_or(*bound_to(tasks.limits, own, increment))
        increment = jnp.clip(increment, low - own, high - own)
    size = jnp.sqrt(increment @ scaled @ increment)
    return IKStep(increment, size, drift, slope, outward)


def _newton(hessian: Array, right: Array, otherwise: Array) -> Array:
    """The solution where the matrix is positive."""
    # Not positive: the factor is not a number.
    found = cho_solve((jnp.linalg.cholesky(hessian), True), right)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, otherwise)


def scaled_metric(tasks: Tasks, square: Float[Array, "dof dof"]) -> tuple[Array, Array]:
    """The metric with the trace of J'J, and the share of it that counts as nothing."""
    tiny = jnp.finfo(square.dtype).eps ** 0.6
    trace = jnp.maximum(jnp.trace(square), tiny**2 * tasks.length**2)
    scaled = trace / jnp.trace(tasks.metric) * tasks.metric
    return scaled, jnp.asarray(tiny, square.dtype)


def pushed(at: Rows, push: Array | None, increment: Array) -> Array | None:
    """Multipliers of the bounds after a step."""
    if at.gap is None or at.change is None or push is None:
        return None
    return jnp.maximum(push - OBSTACLE_WEIGHT * (at.gap + at.change @ increment), 0.0)


def bound_to(limits: Limits, own: Array, down: Array) -> tuple[Array, Array]:
    """Which coordinates rest on their lower and upper limits, but for rounding."""
    low, high = (
        x + way * _ROUNDING * jnp.finfo(own.dtype).eps * jnp.abs(x)
        for x, way in zip(limits, (1, -1), strict=True)
    )
    return (own <= low) & (down < 0), (own >= high) & (down > 0)


def _free(limits: Limits, own: Array, down: Array) -> Float[Array, " dof"]:
    lower, upper = bound_to(limits, own, down)
    return jnp.where(lower | upper, jnp.zeros_like(own), jnp.ones_like(own))


def _held(matrix: Array, free: Array, diagonal: float = 0.0) -> Array:
    """`matrix` for the free coordinates; those held stay where they are."""
    kept = matrix * free[:, None] * free[None, :]
    return kept + jnp.diag((1 - free) * (diagonal * jnp.trace(matrix) / matrix.shape[0]))


def _frames(
    moment: RodState | AssemblyState, task: AbstractTarget | ObstacleConstraint
) -> Frames:
    """The sections of a task."""
    if isinstance(moment, RodState):
        if task.part is not None:
            raise ValueError(
                f"inverse_kinematics: a target names the part `{task.part}`, a single rod has "
                "none. Leave the name out."
            )
        return _sections(moment, task.s)
    if task.part is None:
        raise ValueError(
            f"inverse_kinematics: {type(task).__name__} names no part, need one of "
            f"{', '.join(moment.assembly.names)}. Give part=."
        )
    index = index_of(moment.assembly, task.part)
    frames, columns = _sections(part_motion(moment, index), task.s), part_columns(moment)[index]
    angular, linear = frames.angular_jacobian @ columns, frames.linear_jacobian @ columns
    return Frames(frames.directors, frames.position, angular, linear)


def _sections(moment: RodState | LinkState, s: Array) -> Frames:
    is_link = isinstance(moment, LinkState)
    at: Any = moment.base if is_link else points(moment, s.astype(moment.q.dtype))
    frames = Frames(at.directors, at.position, at.angular_jacobian, at.linear_jacobian)
    if not is_link:
        return frames
    return Frames(*(jnp.broadcast_to(x, (s.shape[0], *x.shape)) for x in frames))


def _stacked(pairs) -> tuple[Array, Array]:
    if len(pairs) == 1:
        return pairs[0]
    return jnp.concatenate([e for e, _ in pairs]), jnp.concatenate([j for _, j in pairs])


# What holds at the answer of inverse kinematics, from which its derivative follows


class Ends(NamedTuple):
    """Unknowns of inverse kinematics.

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
        free = _free(tasks.limits, increments(model, q), left)
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
    """Optimality conditions, zero at the answer: the downhill force of tasks no bound holds,
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
    """Factor from the pull to the units of the errors, and the size that counts as zero."""
    _, rows_now = all_rows(here, push)
    scaled, tiny = scaled_metric(tasks, rows_now.T @ rows_now)
    return jnp.trace(scaled) / jnp.trace(tasks.metric), tiny


def _active(push: Array, here: Rows) -> Array:
    assert here.gap is not None
    return push - OBSTACLE_WEIGHT * here.gap > 0


def smallest_change(linear, right: Array, tasks: Tasks, size: int) -> Array:
    """The smallest change of q that the conditions ask for, where they leave freedom."""
    matrix = matrix_of(linear, right)
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

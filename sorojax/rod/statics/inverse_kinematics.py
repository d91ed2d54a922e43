"""Coordinates at which sections are where they should be.

Reference:
    Caasenbrood, Pogromsky, Nijmeijer, "Sorotoki: a Matlab toolkit for design, modeling,
    and control of soft robots", IEEE Access 12, 2024, eq. 21 to 23, for the problem.
    Nocedal, Wright, Numerical Optimization, 2006, chapters 10 and 17, for the method.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.math.compiled import jit_public
from sorojax.math.implicit_root import implicit_root
from sorojax.math.status import Status
from sorojax.rod.forces.loads import Load
from sorojax.rod.model.assembly import dtype_of, increments, num_dof, retract
from sorojax.rod.model.model import Model, motion, operators
from sorojax.rod.model.rod import Rod
from sorojax.rod.statics import reaching as answer
from sorojax.rod.statics.equilibrium import (
    Solution,
    checked_status,
    first_guess,
    linearised,
    metric,
)
from sorojax.rod.statics.reaching import Rows, Tasks, all_rows, pushed, rows, step
from sorojax.rod.statics.targets import AbstractTarget, ObstacleConstraint

_DAMPING = 1e-3  # at the first step, relative to the mean square of the Jacobian
_DRIFT_ERROR = 0.1  # error that a step in the null space may make, against its length


@jit_public
def inverse_kinematics(
    model: Model,
    targets: AbstractTarget | tuple[AbstractTarget, ...],
    q: Float[Array, " coordinates"] | None = None,
    *,
    obstacles: tuple[ObstacleConstraint, ...] = (),
    limits: Sequence[Numbers] | None = None,
    forces: tuple[Load, ...] | None = None,
    t=0.0,
    accuracy=1e-6,
    iterations: int | None = None,
    max_iterations: int = 200,
) -> Solution:
    """Coordinates that meet the targets, or come as close as the model can.

    Damped least squares (Levenberg-Marquardt). Obstacles and limits are inequality constraints:
    they hold at the answer, and the targets are met as far as they allow. Where the targets
    leave freedom, the step in the null space of their Jacobian seeks the equilibrium under
    `forces`, so that the answer does not depend on the first guess. Closed loops are targets
    too, met where all targets are; the least energy of a parallel robot at a pose, also under
    loads, is found faster by `equilibrium(with_closures(model, goal=Closure(...)))`.
    Differentiable in model, targets, obstacles, limits and forces by the optimality conditions
    at the answer, unless the search was stopped before it converged.

    Args:
        model: The rod or assembly.
        targets: One or more of `Position`, `Pose`, `Direction`, `OnSurface`.
        q: First guess, e.g. the last answer; at rest by default.
        obstacles: Shapes that sections must stay clear of, as `ObstacleConstraint(...)`; none
            by default.
        limits: Lowest and highest coordinates, each a number or one per rate, in the units of
            the coordinates; no limits by default.
        forces: Seek the equilibrium under these in the null space: `()` for least elastic
            energy, which is the default where the targets have fewer components than there are
            rates.
        t: Time at which the forces act [s].
        accuracy: Error at which targets count as met, relative to the length [-].
        iterations: Take exactly this many steps, without tests, as loops in real time need; by
            default as many as convergence takes.
        max_iterations: Limit of the search otherwise.

    Returns:
        Coordinates, how the search ended, the error [m] and the overlap with obstacles [m].
        Nothing is raised where a target is out of reach: `status` is `out_of_reach` then, and
        the coordinates are the closest there are.

    Raises:
        ValueError: If there is no target, shapes do not fit, or the model has no part of a
            target's name.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> reach = rod.inverse_kinematics(finger, rod.Position([80 * mm, 40 * mm]))
        >>> (rod.tip_pose(finger, reach.q)[:2, 2] / mm).round(2).tolist()
        [80.0, 40.0]

    Reference:
        Nocedal and Wright, Numerical Optimization, 2006, chapters 10 and 17; Caasenbrood,
        Pogromsky and Nijmeijer, Sorotoki, IEEE Access 12, 2024, eq. 21 to 23.
    """
    targets = (targets,) if isinstance(targets, AbstractTarget) else tuple(targets)
    if not targets:
        raise ValueError(
            "inverse_kinematics: got no target, need one or more. Give rod.Position, rod.Pose "
            "or another."
        )
    constants, dtype = operators(model), dtype_of(model)
    guess, t = first_guess("inverse_kinematics", model, q), real(t).astype(dtype)
    measure = jax.lax.stop_gradient(metric(model, constants))
    bounds = _limits(model, limits, dtype)
    tasks = Tasks(targets, obstacles, forces, bounds, measure, _length(model))

    def found_rows(tasks: Tasks, q: Array) -> Rows:
        return rows(tasks, t, motion(model, q, constants=constants))

    errors = jax.eval_shape(lambda q: found_rows(tasks, q).error, guess)
    if forces is None and errors.shape[0] < num_dof(model):
        tasks = tasks._replace(forces=())
    at = functools.partial(found_rows, tasks)
    count = sum(task.s.shape[0] for task in obstacles)
    push = jnp.zeros(count, dtype) if obstacles else None
    balance = None if tasks.forces is None else jnp.zeros(errors.shape, dtype)
    begin, whole = ravel_pytree(answer.Ends(guess, push, balance))

    def find(_, begin):
        q, push, _ = whole(begin)
        if iterations is None:
            q, push, done, count = _search(model, tasks, at, q, push, accuracy, max_iterations)
        else:
            q, push, done, count = _fixed(model, tasks, at, q, push, iterations)
        # What comes with a root has a derivative of zero, so it is floating.
        ends, _ = ravel_pytree(answer.balanced(model, tasks, at, q, push))
        return ends, (done.astype(dtype), count.astype(dtype))

    def conditions(x):
        return ravel_pytree(answer.conditions(model, tasks, at, whole(x)))[0]

    def solve(linear, right):
        return answer.smallest_change(linear, right, tasks, guess.shape[0])

    x, (done, count) = implicit_root(conditions, begin, find, solve, has_aux=True)
    found = whole(x).q
    end = at(found)
    error, overlap = jnp.sqrt(end.error @ end.error), _overlap(end, dtype)
    near = jnp.maximum(error, overlap) <= real(accuracy).astype(dtype) * tasks.length
    status = Status.where(done > 0, Status.out_of_reach, Status.not_converged)
    status = Status.where(near, Status.successful, status)
    finite = jnp.all(jnp.isfinite(found)) & jnp.isfinite(error)
    status = Status.where(finite, status, Status.not_finite)
    status = checked_status(status, model, found)
    count = count.astype(jnp.int32)
    return Solution(found, status, count, error=error, overlap=overlap)


def _fixed(model, tasks: Tasks, at, q: Array, push, iterations: int):
    """So many steps, damped by the error that is left."""

    def improve(_, state):
        q, push = state
        here = at(q)
        damping = (here.error @ here.error) / tasks.length**2
        move = step(tasks, increments(model, q), here, push, _DAMPING * damping, 1.0)
        return retract(model, q, move.increment), pushed(here, push, move.increment)

    q, push = jax.lax.fori_loop(0, iterations, improve, (q, push))
    still = step(tasks, increments(model, q), at(q), push, 0.0, 0.0)
    done = still.slope <= _flat(q.dtype) * tasks.length
    return q, push, done, jnp.asarray(iterations)


def _search(model, tasks: Tasks, at, q: Array, push, accuracy, max_iterations: int):
    """Steps that must not raise the error, until the closest place is reached.

    Where they gain less than promised they allow for how the Jacobian turns: out of
    reach an error stays, and steps without it would only creep.
    """
    accuracy = real(accuracy).astype(q.dtype)

    def merit(here: Rows, push):
        error, _ = all_rows(here, push)
        return error @ error

    def straight(q, push, here):
        _, jacobian = all_rows(here, push)
        return jacobian.T @ jacobian

    def curved(q, push, here):
        return linearised(lambda q: -_down(at(q), push), model, q)[1]

    def improve(state):
        q, push, here, damping, growth, gain, bent, _, count = state
        slope = jax.lax.cond(bent, curved, straight, q, push, here)
        move = step(tasks, increments(model, q), here, push, damping, gain, slope)
        new_q = retract(model, q, move.increment)
        new = at(new_q)
        start, value = merit(here, push), merit(new, push)
        promised = start - _promise(here, push, move.increment)
        ratio = (start - value) / jnp.where(promised > 0, promised, start + 1)
        flat = _flat(q.dtype) * tasks.length
        good = (value <= start) | (jnp.sqrt(value) <= _DRIFT_ERROR * move.drift)
        good = good | (value <= flat**2)  # such errors balance the pull, or are rounding
        # What the bounds ask changes with their multipliers, so these follow steps only.
        follow = pushed(here, push, move.increment)
        settled = jnp.asarray(True)
        if push is not None:
            assert follow is not None
            change = jnp.max(jnp.abs(follow - push))
            settled = change <= 1e-6 * jnp.max(follow)
            settled = settled & (_overlap(here, q.dtype) <= accuracy * tasks.length)
        near = value <= (accuracy * tasks.length) ** 2
        whole = move.size + jnp.where(near, (1 / gain - 1) * move.drift, 0.0)
        done = good & settled & (whole <= flat)
        finite = jnp.isfinite(value)
        kept = jax.tree.map(
            lambda a, b: jnp.where(good & finite, a, b), (new_q, follow, new), (q, push, here)
        )
        # Nielsen's rule: it settles where a large error bends the landscape.
        less = jnp.clip(1 - (2 * ratio - 1) ** 3, 0.1, 1.5)
        # Close by the ratio is noise, and damping would bend the balance of multipliers.
        less = jnp.where(near, 0.01, less)
        if tasks.forces is None:
            done = done & (move.slope <= flat)
        else:  # then errors that are next to nothing balance the pull
            is_free = damping <= jnp.finfo(q.dtype).eps ** 0.6
            done = done & jnp.where(near, is_free, move.slope <= flat)
        # A step that is refused for its share in the null space needs less of that alone.
        drifts = ~good & (move.drift > move.size / 2)
        stiffer = jnp.where(drifts, damping, growth * jnp.maximum(damping, 1e-8))
        damping = jnp.where(good, less * damping, stiffer)
        growth = jnp.where(good, 2.0, jnp.where(drifts, growth, 2 * growth))
        gain = jnp.where(good, jnp.minimum(2 * gain, 1.0), gain / 2)
        bent = (ratio < 0.5) | (bent & (value > start / 4))
        return *kept, damping, growth, gain, bent, done, count + 1

    def searching(state):
        damping, done, count = state[3], state[7], state[8]
        return ~done & (count < max_iterations) & (damping < 1e12)

    first = at(q)
    one = jnp.ones((), q.dtype)
    no = jnp.array(False)
    state = (q, push, first, _DAMPING * one, 2 * one, one, no, no, jnp.array(0))
    q, push, *_, done, count = jax.lax.while_loop(searching, improve, state)
    return q, push, done, count


def _down(here: Rows, push) -> Float[Array, " dof"]:
    error, jacobian = all_rows(here, push)
    return error @ jacobian


def _promise(here: Rows, push, increment: Array) -> Float[Array, ""]:
    """Squared error after a step of the linear model."""
    error, jacobian = all_rows(here, push)
    left = error - jacobian @ increment
    return left @ left


def _flat(dtype) -> float:
    """Gradient that counts as none, against the length."""
    return 4 * float(jnp.finfo(dtype).eps) ** 0.6


def _overlap(here: Rows, dtype) -> Float[Array, ""]:
    zero = jnp.zeros((), dtype)
    return zero if here.gap is None else jnp.maximum(zero, -jnp.min(here.gap))


def _length(model: Model) -> Float[Array, ""]:
    """Length of the rods [m], one if there is none."""
    bodies = [model] if isinstance(model, Rod) else [part.body for part in model.parts]
    lengths = [body.length for body in bodies if isinstance(body, Rod)]
    one = jnp.ones((), dtype_of(model))
    return jax.lax.stop_gradient(functools.reduce(jnp.maximum, lengths) if lengths else one)


def _limits(model: Model, limits, dtype):
    if limits is None:
        return None
    where, count = "inverse_kinematics", num_dof(model)
    low, high = (real(x).astype(dtype) for x in limits)
    for name, bound in (("low", low), ("high", high)):
        if bound.ndim > 0:
            do = "Give a number, or one per rate; infinity where there is no limit."
            _check.shape(where, f"limits {name}", bound, (count,), do)
    if _check.is_concrete(low) and _check.is_concrete(high) and bool(jnp.any(low > high)):
        raise ValueError(f"{where}: `limits` are {low} to {high}, need low <= high. Swap them.")
    return jnp.broadcast_to(low, (count,)), jnp.broadcast_to(high, (count,))

"""Equilibria along a curve in coordinates and load: over limit points.

Reference:
    Riks, "An incremental approach to the solution of snapping and buckling problems",
    Int. J. Solids and Structures 15, 1979.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._types import real
from sorojax.math.door import door
from sorojax.math.status import Status
from sorojax.math.told import tell
from sorojax.rod.assembly import dtype_of
from sorojax.rod.loads import total_force
from sorojax.rod.model import Model, motion, operators
from sorojax.rod.static_path import Loading
from sorojax.rod.statics import ended, first_guess, newton, prepare
from sorojax.rod.tangent import increments, linearised, moved, negative_eigenvalues
from sorojax.rod.validity import checked_status

_ITERATIONS = 12
_EASY = 5  # corrections below which the next step is longer


class ArcPath(eqx.Module):
    """A path of equilibria.

    Attributes:
        q: Coordinates; where a step fails the path stops and repeats its last point.
        factor: Load factors.
        negative: Negative eigenvalues of the tangent; 0 is stable under dead loads.
        status: How each step ended.
    """

    q: Float[Array, "steps coordinates"]
    factor: Float[Array, " steps"]
    negative: Int[Array, " steps"]
    status: Status


class _Point(NamedTuple):
    q: Array
    factor: Array
    direction: Array  # of the path: increments, then the factor, of unit length
    length: Array
    alive: Array


@door
def arc_length_path(
    model: Model,
    loading: Loading,
    q: Float[Array, " coordinates"] | None = None,
    *,
    factor=0.0,
    first=0.1,
    steps: int = 50,
    longest=2.0,
    t=0.0,
    tolerance=1e-10,
    max_cuts: int = 10,
    progress: bool = False,
) -> ArcPath:
    """Equilibria one arc length apart, through limit points, where the load turns back.

    Lengths are measured in elastic energy, so that a step of the factor and the answer of
    the rod to it at the start count the same. Steps shrink where the search is hard and
    grow where it is easy. Not differentiable: start `equilibrium` from a point of it.

    Args:
        model: The rod or assembly.
        loading: Takes a factor to the forces.
        q: Where to start the search for the first equilibrium; at rest if omitted.
        factor: Load factor there.
        first: Step of the factor at the start; negative to unload.
        steps: Number of steps.
        longest: Longest step relative to the first.
        t: Time at which the forces act [s].
        tolerance: Distance from equilibrium relative to the first step.
        max_cuts: How often a step may be halved.
        progress: Report progress while running; under `vmap` in one report.
    """
    constants, dtype = operators(model), dtype_of(model)
    factor, first, longest, t = (real(x).astype(dtype) for x in (factor, first, longest, t))
    search = prepare(model, constants, tolerance, 50)

    def residual(q: Array, factor: Array) -> Array:
        return -total_force(loading(factor), t, motion(model, q, constants=constants))

    def tangent(q, factor):
        """Residual, its tangent and its change with the factor."""
        one = jnp.ones_like(factor)
        value, slope = linearised(lambda q: residual(q, factor), model, q)
        return value, slope, jax.jvp(lambda f: residual(q, f), (factor,), (one,))[1]

    start = newton(
        lambda q: residual(q, factor), first_guess("arc_length_path", model, q), search
    )
    _, slope, rate = tangent(start.q, factor)
    answer = -jnp.linalg.solve(slope, rate)
    unit = answer @ search.metric @ answer
    # Lengths squared: increments in energy over `unit`, the factor as it is.
    weights = jnp.pad(search.metric / unit, (0, 1)).at[-1, -1].set(1.0)
    direction = _unit(jnp.append(answer, 1.0), weights) * jnp.sign(first)
    begin = jnp.abs(first) * jnp.sqrt(jnp.asarray(2.0, dtype))

    def correct(point: _Point, length):
        """The equilibrium on the plane across the path at `length`."""
        normal = weights @ point.direction

        def at(shift):
            return moved(model, point.q, shift[:-1]), point.factor + shift[-1]

        def improve(state):
            shift, _, count = state
            value, slope, rate = tangent(*at(shift))
            # The tangent is taken at the shifted place; increments add up to first order.
            matrix = jnp.concatenate([jnp.append(slope, rate[:, None], axis=1), normal[None]])
            gap = jnp.append(value, normal @ shift - length)
            step = -jnp.linalg.solve(matrix, gap)
            return shift + step, jnp.sqrt(step @ weights @ step), count + 1

        def searching(state):
            _, size, count = state
            return (size > search.tolerance * begin) & (count < _ITERATIONS)

        state = (length * point.direction, jnp.inf * begin, jnp.array(0))
        shift, size, count = jax.lax.while_loop(searching, improve, state)
        near = jnp.sqrt(shift @ weights @ shift) < 3 * length  # the same branch
        return *at(shift), (size <= search.tolerance * begin) & near, count

    def advance(point: _Point, share):
        def going(state):
            _, _, length, done, _ = state
            return point.alive & ~done & (length > begin * 0.5**max_cuts)

        def attempt(state):
            _, _, length, _, _ = state
            q, factor, done, count = correct(point, length)
            return q, factor, jnp.where(done, length, length / 2), done, count

        state = (point.q, point.factor, point.length, jnp.array(False), jnp.array(0))
        q, factor, length, done, count = jax.lax.while_loop(going, attempt, state)
        q, factor = jnp.where(done, q, point.q), jnp.where(done, factor, point.factor)
        _, slope, rate = tangent(q, factor)
        border = jnp.concatenate([
            jnp.append(slope, rate[:, None], axis=1), (weights @ point.direction)[None]
        ])  # fmt: skip
        right = jnp.zeros_like(point.direction).at[-1].set(1.0)
        direction = _unit(jnp.linalg.solve(border, right), weights)
        length = jnp.where(count <= _EASY, 1.5 * length, length)
        new = _Point(q, factor, direction, jnp.minimum(length, longest * begin), done)
        negative = negative_eigenvalues(slope, search.metric)
        if progress:
            tell("arc length path", share)
        return new, (q, factor, negative, ended(done, increments(model, q), rate))

    point = _Point(start.q, factor, direction, begin, start.done)
    shares = jnp.linspace(0.0, 1.0, steps + 1, dtype=dtype)[1:]
    _, (q, factors, negative, status) = jax.lax.scan(advance, point, shares)
    status = jax.vmap(lambda x, q: checked_status(x, model, q))(status, q)
    return ArcPath(q, factors, negative, status)


def _unit(vector: Array, weights: Array) -> Array:
    return vector / jnp.sqrt(vector @ weights @ vector)

"""Equilibrium of a rod under its forces."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._types import real
from sorojax.math.door import door
from sorojax.math.status import Status
from sorojax.rod.forces import AbstractForce, total_force
from sorojax.rod.kinematics import motion
from sorojax.rod.motion import operators
from sorojax.rod.rod import Rod

_STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1)


class Equilibrium(eqx.Module):
    """Coordinates at rest, how the search ended, and its number of iterations."""

    q: Float[Array, " dof"]
    status: Status
    num_iterations: Int[Array, ""]


@door
def equilibrium(
    rod: Rod,
    forces: tuple[AbstractForce, ...] = (),
    q: Float[Array, " dof"] | None = None,
    *,
    t=0.0,
    tolerance=1e-10,
    max_iterations: int = 50,
) -> Equilibrium:
    """Coordinates at which the forces vanish; differentiable in rod and forces.

    Newton with a choice of four step lengths, by the elastic energy of the residual; the
    derivative is that of the solution, not of the iterations.

    Args:
        rod: The rod.
        forces: Generalised forces.
        q: First guess; unstrained if omitted.
        t: Time at which the forces act [s].
        tolerance: Size of the last step relative to q, both in elastic energy norm.
        max_iterations: Limit of the search.
    """
    constants, t = operators(rod), real(t)
    guess = jnp.zeros(rod.basis.num_dof, rod.length.dtype) if q is None else q
    metric = jax.lax.stop_gradient(constants.stiffness)

    def residual(q: Array) -> Array:
        return -total_force(forces, t, motion(rod, q, constants=constants))

    def search(residual, guess):
        return _newton(residual, guess, metric, tolerance, max_iterations)

    rest, (done, count) = jax.lax.custom_root(
        residual, guess, search, _solve_tangent, has_aux=True
    )
    status = Status.where(done > 0, Status.successful, Status.not_converged)
    return Equilibrium(rest, status, count.astype(jnp.int32))


def _newton(residual, guess: Array, metric: Array, tolerance, max_iterations) -> Any:
    def size(force):
        return force @ jnp.linalg.solve(metric, force)

    def searching(state):
        _, done, count = state
        return ~done & (count < max_iterations)

    def improve(state):
        q, _, count = state
        step = -jnp.linalg.solve(jax.jacfwd(residual)(q), residual(q))
        lengths = jnp.asarray(_STEP_LENGTHS, q.dtype)
        trials = q[None, :] + lengths[:, None] * step[None, :]
        best = jnp.argmin(jax.vmap(lambda q: size(residual(q)))(trials))
        new = trials[best]
        done = step @ metric @ step <= tolerance**2 * (new @ metric @ new)
        return new, done, count + 1

    begin = (guess, jnp.array(False), jnp.array(0, dtype=jnp.int32))
    q, done, count = jax.lax.while_loop(searching, improve, begin)
    done = done & jnp.all(jnp.isfinite(q))
    # custom_root differentiates its auxiliary output, which must then be floating.
    return q, (done.astype(q.dtype), count.astype(q.dtype))


def _solve_tangent(linear, right: Array) -> Array:
    return jnp.linalg.solve(jax.jacobian(linear)(right), right)

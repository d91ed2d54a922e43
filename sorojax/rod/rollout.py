"""Motion of one rod with a fixed step: the fast path, for known forces."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.status import Status
from sorojax.math.steppers import (
    AbstractStepper,
    GeneralisedAlpha,
    SecondOrder,
    integrate,
    start,
)
from sorojax.rod.forces import (
    AbstractForce,
    damping_matrix,
    tangent_stiffness,
    total_force,
)
from sorojax.rod.kinematics import inertia, motion
from sorojax.rod.motion import operators
from sorojax.rod.rod import Rod


class Rollout(eqx.Module):
    """A motion sampled in time: time [s], coordinates and their rates."""

    time: Float[Array, " time"]
    q: Float[Array, "time dof"]
    v: Float[Array, "time dof"]
    status: Status


def rollout(
    rod: Rod,
    q: Float[Array, " dof"],
    v: Float[Array, " dof"],
    forces: tuple[AbstractForce, ...] = (),
    *,
    step,
    saves: int,
    every: int = 1,
    t=0.0,
    stepper: AbstractStepper | None = None,
    unroll: bool = True,
) -> Rollout:
    """Move the rod from (q, v) by `saves * every` steps.

    Args:
        rod: The rod.
        q: Coordinates at `t`.
        v: Their rates.
        forces: Generalised forces.
        step: Length of one step [s]; 1e-3 to 5e-3 suit soft fingers.
        saves: Number of saved moments after the first.
        every: Steps between two of them.
        t: Start [s].
        stepper: `GeneralisedAlpha()` by default; `RungeKutta4()` or `DormandPrince()`
            for undamped motion at high accuracy.
        unroll: Write the rotation product out: runs faster. Pass False when the rollout
            is differentiated, or it compiles several times slower.
    """
    stepper = GeneralisedAlpha() if stepper is None else stepper
    return _rollout(rod, q, v, forces, real(step), real(t), stepper, saves, every, unroll)


@eqx.filter_jit
def _rollout(rod, q, v, forces, step, t, stepper, saves, every, unroll) -> Rollout:
    problem = second_order(rod, q, forces, unroll=unroll)
    begin = start(problem, t, q, v)
    path = integrate(stepper, problem, begin, t=t, h=step, saves=saves, every=every)
    fine = jnp.all(jnp.isfinite(path.q)) & jnp.all(jnp.isfinite(path.v))
    status = Status.where(fine, Status.successful, Status.not_finite)
    time = t + step * every * jnp.arange(saves + 1, dtype=step.dtype)
    return Rollout(time, path.q, path.v, status)


def second_order(
    rod: Rod,
    q: Float[Array, " dof"],
    forces: tuple[AbstractForce, ...],
    *,
    unroll: bool = False,
) -> SecondOrder:
    """The equations of the rod, with its stiffness at `q` and its damping."""
    constants = operators(rod)

    def equations(t, q, v):
        moment = motion(rod, q, v, constants=constants, unroll=unroll)
        mass, coriolis = inertia(moment)
        return mass, total_force(forces, t, moment) - coriolis

    stiffness = tangent_stiffness(forces, motion(rod, q, constants=constants))
    damping = damping_matrix(forces, constants.stiffness)
    return SecondOrder(equations, stiffness, damping)

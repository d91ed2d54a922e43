"""Motion of a rod or assembly with a fixed step: the fast path, for known forces."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax._display import displayed, number, outcome
from sorojax._jax.trace_state import called_as_outside, is_tracer
from sorojax._types import Numbers, real
from sorojax.math.compiled import chunked_lanes, full_products, jit_trees
from sorojax.math.ode.contact_midpoint import ContactMidpoint
from sorojax.math.ode.held import singular
from sorojax.math.ode.step_control import judged_status
from sorojax.math.ode.steppers import AbstractStepper, GeneralisedAlpha, SecondOrder, integrate
from sorojax.math.status import Status
from sorojax.math.two_programs import two_programs
from sorojax.rod.contact.terms import any_contact, contacts_of
from sorojax.rod.dynamics.closed import (
    CLOSED,
    held_terms,
    reactions_along,
    refuse_contact,
    refuse_open,
)
from sorojax.rod.dynamics.dynamics import Forces
from sorojax.rod.forces.loads import (
    damping_matrix,
    on_model,
    relaxed,
    tangent_stiffness,
    total_force,
)
from sorojax.rod.forces.relaxation import memory_terms
from sorojax.rod.model.assembly import is_flat, rate, retract
from sorojax.rod.model.closure import is_closed
from sorojax.rod.model.model import Model, inertia, motion, operators
from sorojax.rod.statics.equilibrium import checked_status


@displayed
class Trajectory(eqx.Module):
    """A motion sampled in time.

    Attributes:
        time: [s].
        q, v: Coordinates and their rates.
        status: How the run ended.
        memory: What the branches of a `Relaxation` remember, the coordinates at which they are
            free of force, (time, branches, dof); None without branches.
        reactions: By closure the wrench [N m], [N] on the part that it holds, (time, twist), in
            world axes, the moment about the origin of the frame that is held; None without one.
    """

    time: Float[Array, " time"]
    q: Float[Array, "time coordinates"]
    v: Float[Array, "time dof"]
    status: Status
    memory: Any = None  # Float[Array, "time branches dof"], None without branches
    reactions: Any = None  # dict[str, Float[Array, "time twist"]], None without closures

    def _text(self) -> str:
        return (
            f"Trajectory: {self.time.shape[0]} saved moments of {self.q.shape[-1]} "
            f"coordinates, {outcome(self.status)}\n"
            f"  time {number(self.time, 's')}, q {number(self.q)}"
        )


def rollout(
    model: Model,
    q: Float[Array, " coordinates"],
    v: Float[Array, " dof"],
    forces: Forces = (),
    *,
    step: Numbers,
    saves: int,
    every: int = 1,
    t=0.0,
    stepper: AbstractStepper | None = None,
    progress: bool = False,
    check: bool = True,
    memory: Float[Array, "branches dof"] | None = None,
) -> Trajectory:
    """Motion of a rod or assembly by `saves * every` steps of fixed length.

    M(q) q'' + c(q, q') = sum of generalised forces, compiled as one loop. Forces must be known
    functions of time and motion; a rod in a loop with air and controllers is a block of a
    `systems.Network`.

    Closures hold at the end of every step, in coordinates and rates: accelerations and
    reactions solve M a = f + G' lambda with d^2 g/dt^2 = 0, and a projection takes out what the
    step leaves. It runs at the start too, so rates that pull a loop open, or are not those of
    a driven end, change by the least that closes it.

    Args:
        model: The rod or assembly.
        q: Coordinates at `t`; curvature modes in [1/m]. `rod.close_loops` finds some that
            keep the closures.
        v: Their rates, per second.
        forces: Generalised forces beside elasticity; none by default.
        step: Length of one step [s]; 1e-3 to 5e-3 suit soft fingers.
        saves: Number of saved states after the first.
        every: Steps between two of them.
        t: Time of the start [s].
        stepper: `GeneralisedAlpha()` by default, `ContactMidpoint()` if a contact is among
            the forces; `RungeKutta4()` or `DormandPrince()` for undamped motion at high
            accuracy.
        progress: Report progress while running; of rods under `vmap` in one report.
        check: Compute some of the steps again by two of half the length, and end as `unstable`
            where errors add up to the motion: a twentieth of the time of a run of 160 steps
            or more, four half steps of a shorter one. Runs of fewer than 8 steps are
            not judged.
        memory: What the branches of a `Relaxation` remember at `t`, as the last row of
            `memory` of a trajectory to go on from; relaxed at `q` by default.

    Returns:
        Times [s], coordinates, rates, how the run ended, the memory of branches and the
        reactions of closures. Nothing is raised where it fails: check `status`, which is
        `singular` where closures became dependent on the way.

    Raises:
        ValueError: If `saves` is negative or `every` below 1, `memory` has the wrong shape, `q`
            does not keep the closures, or there is contact beside closures.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> path = rod.rollout(finger, jnp.zeros(3), jnp.zeros(3), (rod.Gravity(),),
        ...                    step=2e-3, saves=10)
        >>> print(f"{float(path.time[-1]):.3f} s, {path.q.shape}")
        0.020 s, (11, 3)

    Reference:
        Chung and Hulbert, J. Appl. Mech. 60, 1993, for generalised-alpha; Hairer, Norsett and
        Wanner, Solving Ordinary Differential Equations I, 1993, section II.4, for the check;
        Hairer, Lubich and Wanner, Geometric Numerical Integration, 2006, section IV.4, for
        closures.
    """
    if saves < 0 or every < 1:
        raise ValueError(
            f"rollout: got saves={saves} and every={every}, need 0 and 1 or more. They count "
            "moments and steps."
        )
    if stepper is None:
        stepper = ContactMidpoint() if any_contact(forces) else GeneralisedAlpha()
    if is_closed(model):
        refuse_open("rollout", model, q, t)
        refuse_contact("rollout", forces)
    label = "rollout" if progress else None
    run = _lanes_together if progress else _lanes_apart
    path, too_long = run(
        model, q, v, forces, real(step), real(t), stepper, saves, every, label, check, memory
    )
    if not check:
        return path
    given = jax.tree.map(_without_derivative, (path.status, model, path.q, too_long))
    with called_as_outside(given):
        status = _checked(*given)
    return Trajectory(path.time, path.q, path.v, status, path.memory, path.reactions)


def _without_derivative(x):
    return jax.lax.stop_gradient(x) if is_tracer(x) else x


@functools.partial(jit_trees, kernels=False, optimised=False)
def _checked(status, model, path, too_long) -> Status:
    return checked_status(judged_status(status, too_long), model, path)


@full_products
def _rollout(
    model, q, v, forces, step, t, stepper, saves, every, label, check, memory
) -> tuple[Trajectory, Bool[Array, ""]]:
    step, t, stepper = _like(q, (step, t, stepper))
    problem = second_order(model, q, forces, memory, t)
    path, too_long = integrate(
        stepper, problem, q, v, t=t, h=step, saves=saves, every=every, label=label, judged=check
    )
    fine = jnp.all(jnp.isfinite(path.q)) & jnp.all(jnp.isfinite(path.v))
    status = Status.where(fine, Status.successful, Status.not_finite)
    if path.resolved is not None:
        status = Status.where(jnp.all(path.resolved), status, Status.unresolved)
    time = t + step * every * jnp.arange(saves + 1, dtype=step.dtype)
    reactions = None
    if path.share is not None:
        status = Status.where(singular(path.share), Status.singular, status)
        reactions, off = reactions_along(model, problem, time, path)
        status = Status.where(off > CLOSED, Status.unstable, status)
    return Trajectory(time, path.q, path.v, status, path.memory, reactions), too_long


_lanes_apart = two_programs(_rollout, keeps=True, lanes_apart=True, kernels=True)
_lanes_together = two_programs(_rollout, keeps=True, kernels=True)  # in one report


def _like(q, tree):
    """`tree` with its numbers in the precision of the coordinates."""
    return jax.tree.map(lambda x: x.astype(q.dtype) if eqx.is_inexact_array(x) else x, tree)


@chunked_lanes
def _equations(model, constants, forces, t, q, v):
    """Inertia of the model, and the force that is left to accelerate it."""
    moment = motion(model, q, v, constants=constants)
    mass, coriolis = inertia(moment)
    return mass, total_force(forces, t, moment) - coriolis


def second_order(
    model: Model,
    q: Float[Array, " coordinates"],
    forces: Forces,
    memory: Float[Array, "branches dof"] | None = None,
    t=0.0,
) -> SecondOrder:
    """The equations of the model, with its stiffness at `q` and its damping, its branches
    with what they remember, relaxed at `q` by default, and its closures, which hold at `q` and
    time `t` [s].

    Args:
        model: The rod or assembly.
        q: Coordinates at which stiffness and damping are taken.
        forces: Generalised forces beside elasticity.
        memory: What the branches of a `Relaxation` remember there.
        t: Time [s].

    Returns:
        What a stepper of second order integrates.
    """
    constants = operators(model)
    branches = memory_terms(model, forces, constants, q, memory)
    forces = on_model(relaxed(forces), model)

    def at(q, v):
        return motion(model, q, v, constants=constants)

    # What the equations make on their way would pass through the stores of all loops in
    # reverse mode, in memory and in the compiled program.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def equations(t, q, v):
        return _equations(model, constants, forces, t, q, v)

    stiffness = tangent_stiffness(forces, motion(model, q, constants=constants))
    damping = damping_matrix(forces, model, constants)
    tree: Any = None if is_flat(model) else model
    held = None
    if is_closed(model):
        held = held_terms(model, constants, forces, jnp.asarray(t, q.dtype), q)
    return SecondOrder(
        equations,
        stiffness,
        damping,
        retract=tree and functools.partial(retract, tree),
        rate=tree and functools.partial(rate, tree),
        contact=contacts_of(model, forces, at, inertia),
        memory=branches,
        held=held,
    )

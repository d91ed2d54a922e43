"""Where the derivative of a motion with contact jumps, and how near a motion came to it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax.fem.contact.obstacle import Contact
from sorojax.fem.dynamics.trajectory import Trajectory
from sorojax.fem.problem import body


class ContactSwitching(eqx.Module):
    """Contact states of all points of a motion up to each saved time.

    The slope of friction jumps where a point begins to slide or to hold; that of the pressure
    grows within the smoothing of the contact where a point touches or lets go. Derivatives
    are those of the side that the motion took.

    Attributes:
        gap: Least distance of any point from where its pressure starts [m].
        slip: Least distance of the pull on a pressed point from the limit of friction, over
            that limit; infinite without friction or pressure.
        switched: Whether a point touched, let go, began to slide or to hold since the time
            before.
        near: Whether a point was near to doing so: `slip` within the share that was asked
            for, or `gap` within that share of the smoothing.
    """

    gap: Float[Array, " times"]
    slip: Float[Array, " times"]
    switched: Bool[Array, " times"]
    near: Bool[Array, " times"]


def contact_switching(
    motion: Trajectory, share: float | Float[Array, ""] = 1e-3
) -> ContactSwitching:
    """How near `motion` came to switching points, at its saved times; save every step to see
    all of them. Runs inside `jit`, `grad` (as auxiliary output) and `vmap`.

    Args:
        motion: A motion, from `simulate`.
        share: Of the limit of friction, and of the smoothing of the contact, within which a
            point is near to switching [-].

    Returns:
        Distances from switching, and what switched, at every saved time.

    Raises:
        ValueError: If the motion has no `Contact`.
    """
    if not any(isinstance(load, Contact) for load in motion.problem.loads):
        raise ValueError(
            "fem.contact_switching: got a motion without fem.Contact, need one. Contacts of "
            "bodies with each other have no friction and a smooth pressure."
        )
    return _switching(motion, jnp.asarray(share, motion.displacements.dtype))


@once
def _switching(motion: Trajectory, share) -> ContactSwitching:
    moving, rest = eqx.partition(motion.states.memory, eqx.is_inexact_array)
    problem = body(motion.problem)

    def at(row):
        loads = eqx.combine(row[0], rest)
        found = [_points(load, problem, row[1]) for load in loads if isinstance(load, Contact)]
        return tuple(jnp.concatenate(column) for column in zip(*found, strict=True))

    gap, smooth, slip, touches, slides = jax.lax.map(at, (moving, motion.displacements))
    # the first state has no step behind it
    begins = jnp.zeros((1, touches.shape[1]), bool)
    turned = touches[1:] != touches[:-1]
    turned |= touches[1:] & touches[:-1] & (slides[1:] != slides[:-1])
    turned = jnp.concatenate([begins, turned])
    near = (jnp.abs(gap) < share * smooth) | (slip < share)
    return ContactSwitching(
        jnp.min(jnp.abs(gap), axis=1),
        jnp.min(slip, axis=1),
        jnp.any(turned, axis=1),
        jnp.any(near, axis=1),
    )


def _points(load: Contact, problem, u: Float[Array, "nodes dim"]):
    """Of all points after a step: gap, smoothing, distance from the limit of friction, and
    whether they touch and slide."""
    assert load.began is not None and load.share is not None
    end = load.points_of(problem, u)
    gap = load.gap_of(end, load.shift()).ravel()
    smooth = jnp.broadcast_to(load.law.smoothing, gap.shape)
    if load.grip is None:
        return gap, smooth, jnp.full_like(gap, jnp.inf), gap < 0, jnp.zeros(gap.shape, bool)
    acted = load.acted(problem, u) - load.value[None, None]
    loading = load.slider.loading(load.grip, acted).ravel()
    pressed = load.grip.pressure.ravel() > 0
    slip = jnp.where(pressed, jnp.abs(loading - 1), jnp.inf)
    return gap, smooth, slip, gap < 0, pressed & (loading > 1)

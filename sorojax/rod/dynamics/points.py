"""Points along a rod in motion: where they are, how fast, and forces put on them."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.lie import cross_columns, plane_rotation
from sorojax.math.quadrature import integration_rows
from sorojax.rod.dynamics.fields import Base, RodState, rest_along
from sorojax.rod.dynamics.moving import spin_cross as spin_cross
from sorojax.rod.model.rod import Rod


class Points(eqx.Module):
    """Sections of a moving rod at any arc lengths, in the world frame.

    Fields between the Gauss nodes come from the same spectral integrals as those at the
    nodes. What is not read is never computed.

    Attributes:
        motion: The rod.
        rows: Weights that integrate a field from the base to each point [m].
    """

    motion: RodState
    rows: Float[Array, "points quad"]

    @property
    def position(self) -> Float[Array, "points dim"]:
        """Centres of the sections [m]."""
        return self._beyond(self.motion.tangent, lambda base: base.position)

    @property
    def directors(self) -> Float[Array, "points dim dim"]:
        """Local axes of the sections, as columns."""
        return directors(self)

    @property
    def angular_jacobian(self) -> Float[Array, "points rot dof"]:
        """Angular velocity per rate (planar: about z)."""
        return self._beyond(self.motion.angular_rate, lambda base: base.angular_jacobian)

    @property
    def linear_jacobian(self) -> Float[Array, "points dim dof"]:
        """Velocity of the centres per rate."""
        return self._beyond(self.motion.linear_rate, lambda base: base.linear_jacobian)

    @property
    def velocity(self) -> Float[Array, "points dim"]:
        """Velocity of the centres [m/s]."""
        v = self.motion.v
        return self._beyond(self.motion.linear_rate @ v, lambda base: base.linear_jacobian @ v)

    @property
    def spin(self) -> Float[Array, "points rot"]:
        """Angular velocity of the sections [rad/s]."""
        v = self.motion.v
        return self._beyond(
            self.motion.angular_rate @ v, lambda base: base.angular_jacobian @ v
        )

    def _beyond(self, rate: Array, of_base: Callable[[Base], Array]) -> Array:
        """A field at the points: that of the base and the integral of its rate."""
        path, base = jnp.tensordot(self.rows, rate, 1), self.motion.base
        return path if base is None else path + of_base(base)[None]

    def generalised(
        self,
        force: Float[Array, "points dim"] | None,
        moment: Float[Array, "points rot"] | None = None,
    ) -> Float[Array, " dof"]:
        """Generalised force of forces [N] and moments [N m] on the points.

        No Jacobian of the points is formed: the loads are summed towards the base.
        """
        base, total = self.motion.base, jnp.zeros_like(self.motion.v)
        for load, rate, name in (
            (force, self.motion.linear_rate, "linear_jacobian"),
            (moment, self.motion.angular_rate, "angular_jacobian"),
        ):
            if load is None:
                continue
            beyond = (self.rows.T @ load).reshape(-1)
            total = total + beyond @ rate.reshape(-1, rate.shape[-1])
            if base is not None:
                total = total + jnp.sum(load, axis=0) @ getattr(base, name)
        return total


def points(motion: RodState, s: Float[Array, " points"] | np.ndarray) -> Points:
    """The points of `motion` at `s` in [0, 1]; a NumPy `s` makes constants.

    Args:
        motion: State of the rod, from `motion`.
        s: Places along the rod, in [0, 1].

    Returns:
        Position, velocity, spin, directors and Jacobians at each.
    """
    return Points(motion, from_base(motion.rod, s))


def from_base(rod: Rod, s: Float[Array, " points"] | np.ndarray) -> Float[Array, "points quad"]:
    """Weights that integrate a field from the base of the rod to each `s` [m]."""
    return rod.length * jnp.asarray(integration_rows(rod.quadrature, s), rod.length.dtype)


def nodes(motion: RodState) -> Points:
    """The points of `motion` at its Gauss nodes."""
    return Points(motion, motion.operators.integration)


def curvature(motion: RodState) -> Float[Array, "quad rot"]:
    """Curvature at the Gauss nodes [1/m], world frame (planar: about z)."""
    change = motion.angular_rate @ motion.q
    rest = rest_along(motion.operators)
    if motion.tangent.shape[1] == 2:
        return change + rest[:, :1]
    return change + jnp.sum(motion.directors * rest[:, None, :3], axis=2)


def directors(points: Points) -> Float[Array, "points dim dim"]:
    """Local axes integrated from the base by R' = hat(kappa) R, then made orthonormal."""
    motion, rows = points.motion, points.rows
    dim = motion.tangent.shape[1]
    if dim == 2:
        angle = rows @ curvature(motion)[:, 0]
        turn = plane_rotation(angle)
        return turn if motion.base is None else motion.base.directors[None] @ turn
    slope = cross_columns(curvature(motion)[:, :, None], motion.directors)
    eye = jnp.eye(dim, dtype=motion.q.dtype)
    start = eye if motion.base is None else motion.base.directors
    rotation = start[None] + jnp.tensordot(rows, slope, 1)
    gram = _written_out(jnp.swapaxes(rotation, 1, 2), rotation)
    return _written_out(rotation, 3 * eye[None] - gram) / 2


def _written_out(left: Array, right: Array) -> Array:
    """left @ right of stacks of tiny matrices; as products they are slow."""
    return jnp.sum(left[:, :, :, None] * right[:, None], axis=2)


def own(motion: RodState, values: Float[Array, " dof"]) -> Float[Array, " own"]:
    """The entries of `values` that belong to the strains, not to a moving base."""
    ahead = values.shape[0] - motion.rod.basis.num_dof
    return values if ahead == 0 else values[ahead:]


def from_own(motion: RodState, force: Float[Array, " own"]) -> Float[Array, " dof"]:
    """A generalised force on the strains in all columns of `motion`."""
    ahead = motion.q.shape[0] - force.shape[0]
    return force if ahead == 0 else jnp.pad(force, (ahead, 0))


def safe_norm(vectors: Float[Array, "*points dim"]) -> Float[Array, "*points"]:
    """Length along the last axis, with zero derivative at zero."""
    square = jnp.sum(vectors**2, axis=-1)
    far = square > 0
    return jnp.where(far, jnp.sqrt(jnp.where(far, square, jnp.ones_like(square))), 0.0)


def moment_of(
    arm: Float[Array, "points dim"], force: Float[Array, "points dim"]
) -> Float[Array, "points rot"]:
    """arm x force; in the plane about z."""
    if arm.shape[-1] == 2:
        return (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])[:, None]
    return jnp.cross(arm, force)

"""Where the rod is: strains, poses, Jacobians."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.door import door
from sorojax.math.lie import homogeneous
from sorojax.math.quadrature import integration_rows
from sorojax.rod import planar, spatial
from sorojax.rod.motion import Motion, Operators, operators
from sorojax.rod.rod import Rod, strain_names

_KERNEL = {2: planar, 3: spatial}


def motion(
    rod: Rod,
    q: Float[Array, " dof"],
    v: Float[Array, " dof"] | None = None,
    *,
    constants: Operators | None = None,
    unroll: bool = False,
) -> Motion:
    """The fields of the rod at (q, v), which forces and inertia read.

    Args:
        rod: The rod.
        q: Coordinates.
        v: Their rates; zero if omitted.
        constants: `operators(rod)`, if a loop has them already.
        unroll: Write the rotation product out (see `math.quaternion.prefix_product`).
    """
    do = f"The rod has {rod.basis.num_dof} coordinates, ordered as its basis."
    _check.shape("rod", "q", q, (rod.basis.num_dof,), do)
    constants = operators(rod) if constants is None else constants
    v = jnp.zeros_like(q) if v is None else v
    return _KERNEL[rod.group.space_dim].motion(rod, constants, q, v, unroll)


def inertia(moment: Motion) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force of a moment."""
    return _KERNEL[moment.rod.group.space_dim].inertia(moment)


@door
def strain(rod: Rod, q: Float[Array, " dof"], s=None) -> Float[Array, "points strain"]:
    """Strain of the section: curvatures [1/m], then stretch and shears [-].

    Args:
        rod: The rod.
        q: Coordinates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.
    """
    constants = operators(rod)
    rows = constants.strain_rows if s is None else rod.basis(real(s).astype(q.dtype))
    change = dict(zip(rod.basis.active, rows @ q, strict=True))
    rest = constants.rest_strain
    points = rows.shape[1]
    parts = [
        jnp.broadcast_to(rest[k], (points,)) + change.get(name, jnp.zeros(points, q.dtype))
        for k, name in enumerate(strain_names(rod.group))
    ]
    return jnp.stack(parts, axis=1)


@door
def forward_kinematics(rod: Rod, q: Float[Array, " dof"], s=None) -> Float[Array, "points h h"]:
    """Poses of the sections: local to base frame, positions in m.

    Args:
        rod: The rod; `rod.group` makes the result planar or spatial.
        q: Coordinates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.
    """
    moment = motion(rod, q)
    if s is None:
        return homogeneous(moment.directors, moment.position)
    rows = _rows(rod, s)
    return homogeneous(_directors_at(moment, rows), rows @ moment.tangent)


@door
def tip_pose(rod: Rod, q: Float[Array, " dof"]) -> Float[Array, "h h"]:
    """Pose of the last section: local to base frame, position in m."""
    return forward_kinematics(rod, q, jnp.ones(1, q.dtype))[0]


@door
def jacobian(rod: Rod, q: Float[Array, " dof"], s=None) -> Float[Array, "points twist dof"]:
    """Twists of the sections per coordinate rate, angular velocity first, world frame.

    Args:
        rod: The rod.
        q: Coordinates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.
    """
    moment = motion(rod, q)
    if s is None:
        parts = [moment.angular_jacobian, moment.linear_jacobian]
    else:
        rows = _rows(rod, s)
        rates = (moment.angular_rate, moment.linear_rate)
        parts = [jnp.tensordot(rows, rate, 1) for rate in rates]
    return jnp.concatenate(parts, axis=1)


def tip_angle(moment: Motion) -> Float[Array, ""]:
    """Angle of the last section of a planar rod [rad], continuous past half a turn."""
    if moment.rod.group.space_dim != 2:
        raise ValueError("tip_angle: needs a planar rod, got a spatial one. Use tip_pose.")
    bending = moment.operators.weights @ moment.angular_rate[:, 0] @ moment.q
    return bending + moment.operators.rest_strain[0] * moment.rod.length


def _rows(rod: Rod, s) -> Float[Array, "points quad"]:
    """Integration weights from the base to each s [m]."""
    s = real(s).astype(rod.length.dtype)
    _check.shape("rod", "s", s, (None,), "Give a list of points in [0, 1].")
    return rod.length * integration_rows(rod.nodes, s)


def _directors_at(moment: Motion, rows: Array) -> Float[Array, "points dim dim"]:
    """Directors integrated from the base by R' = R hat(kappa), then made orthonormal."""
    dim = moment.tangent.shape[1]
    constants = moment.operators
    if dim == 2:
        angle = rows @ (moment.angular_rate[:, 0] @ moment.q)
        angle = angle + constants.rest_strain[0] * jnp.sum(rows, axis=1)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        columns = jnp.stack([cosine, sine], 1), jnp.stack([-sine, cosine], 1)
        return jnp.stack(columns, axis=-1)
    # World-frame curvature: the angular rate is linear in q, the rest turns with it.
    curvature = moment.angular_rate @ moment.q
    curvature = curvature + moment.directors @ constants.rest_strain[:3]
    slope = jnp.cross(curvature[:, :, None], moment.directors, axis=1)
    eye = jnp.eye(dim, dtype=moment.q.dtype)[None]
    rotation = eye + jnp.tensordot(rows, slope, 1)
    gram = jnp.swapaxes(rotation, 1, 2) @ rotation
    return rotation @ (3 * eye - gram) / 2

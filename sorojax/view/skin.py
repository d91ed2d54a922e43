"""Planar skinning: points of a body carried along by a rod, for pictures."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.rod import Rod, forward_kinematics

_STATIONS = 101


class Skin(eqx.Module):
    """Points bound to sections of a rod.

    Attributes:
        s: Where along the rod each point is bound, in [0, 1].
        ahead: Distance in front of its section [m]; zero except beyond the ends.
        across: Distance along the normal of its section [m].
        origin: Base of the rod in the frame of the points [m].
        along: Unit vector of the rod at rest in the frame of the points.
    """

    s: Float[Array, " points"]
    ahead: Float[Array, " points"]
    across: Float[Array, " points"]
    origin: Float[Array, "2"]
    along: Float[Array, "2"]


def bind(points: Float[Array, "points 2"], line_start, line_end) -> Skin:
    """Bind points to the straight line that becomes the rod.

    A point behind the start or beyond the end moves rigidly with that end.

    Args:
        points: In the reference configuration, e.g. `mesh.points` [m].
        line_start: Base of the rod [m].
        line_end: Tip of the rod [m].
    """
    points, start, end = real(points), real(line_start), real(line_end)
    _check.shape("bind", "points", points, (None, 2), "Give plane points in metres.")
    _check.shape("bind", "line_start", start, (2,), "Give (x, y) in metres.")
    _check.shape("bind", "line_end", end, (2,), "Give (x, y) in metres.")
    length = jnp.sqrt(jnp.sum((end - start) ** 2))
    _check.positive("bind", "length of the line", length, "m", "Give two different points.")
    along = (end - start) / length
    moved = points - start[None]
    ahead = moved @ along
    inside = jnp.clip(ahead, 0.0, length)
    across = moved @ _normal(along)
    return Skin(inside / length, ahead - inside, across, start, along)


@eqx.filter_jit
def deform(skin: Skin, rod: Rod, q: Float[Array, " dof"]) -> Float[Array, "points 2"]:
    """Where the bound points are at coordinates `q` [m].

    Sections stay flat and keep their size. The rod is evaluated at 101 stations;
    position and angle are linear between them. Map over times with
    `jax.vmap(lambda q: deform(skin, rod, q))(qs)`.
    """
    if rod.group.space_dim != 2:
        raise ValueError(
            f"deform: the rod is in {type(rod.group).__name__}(), need a planar rod. Make it "
            "with SE2()."
        )
    poses = forward_kinematics(rod, q, jnp.linspace(0.0, 1.0, _STATIONS, dtype=q.dtype))
    angle = jnp.unwrap(jnp.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    path = jnp.concatenate([poses[:, :2, 2], angle[:, None]], axis=1)
    x, y, angle = _between_stations(path, skin.s.astype(q.dtype)).T
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x = x + skin.ahead * cosine - skin.across * sine
    y = y + skin.ahead * sine + skin.across * cosine
    axes = jnp.stack([skin.along, _normal(skin.along)])
    return skin.origin[None] + jnp.stack([x, y], axis=1) @ axes


def _between_stations(
    values: Float[Array, "stations columns"], s: Float[Array, " points"]
) -> Float[Array, "points columns"]:
    at = s * (_STATIONS - 1)
    left = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, _STATIONS - 2)
    fraction = (at - left.astype(at.dtype))[:, None]
    return (1 - fraction) * values[left] + fraction * values[left + 1]


def _normal(along: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack([-along[1], along[0]])

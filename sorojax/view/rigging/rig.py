"""Rigs: a model with the surface that it carries, posed by its coordinates."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import integers, real
from sorojax.math.compiled import door
from sorojax.rod import Assembly, Rod, num_coordinates, rest
from sorojax.sdf import Surface
from sorojax.view.rigging.skin import Skin, bind, deform
from sorojax.view.rigging.tube import Outline, own_surface


@displayed
class Rig(eqx.Module):
    """A rod or assembly and a surface bound to it.

    Attributes:
        model: The rod or assembly.
        skin: How the vertices are bound.
        triangles: Rows of vertices, counter-clockwise seen from outside.
    """

    model: Rod | Assembly
    skin: Skin
    triangles: Int[Array, "triangles 3"] = eqx.field(converter=integers)


def rig(
    model: Rod | Assembly,
    surface: Surface | tuple[Any, Any] | None = None,
    q: Float[Any, " coordinates"] | None = None,
    *,
    outline: Outline | dict[str, Outline] | None = None,
    around: int = 24,
    stations: int = 65,
    **options: Any,
) -> Rig:
    """A model with the surface of an STL file or an isosurface, or with its own sections.

    Args:
        model: The rod or assembly.
        surface: Vertices [m] and triangles in the reference configuration; if omitted,
            tubes with the sections of the rods, and ellipsoids with the inertia of links.
        q: Coordinates in the reference configuration; those at rest if omitted.
        outline: Points (points, 2) around the section of the rods in local y and z [m], by
            name of the part if they differ; without a surface an ellipse with the area and
            second moments of the section otherwise.
        around: Points around an ellipse.
        stations: Frames along a rod.
        **options: `base`, `parts` and `blend` of `bind`.

    Raises:
        ValueError: If shapes or names do not fit, or triangles name missing vertices.
    """
    if surface is None:
        base = options.pop("base", None)
        if options:
            raise ValueError(
                f"rig: got {', '.join(sorted(options))} without a `surface`: tubes are bound "
                "to their rods. Leave them out."
            )
        skin, triangles = own_surface(model, q, outline, around, stations, base)
        return Rig(model, skin, triangles)
    vertices, triangles = surface
    triangles = np.asarray(triangles)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.size == 0:
        raise ValueError(
            f"rig: `triangles` have shape {triangles.shape}, need (triangles, 3). Pass what "
            "import_surface or sdf.isosurface gives."
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"rig: triangles use vertices {triangles.min()} to {triangles.max()}, the surface "
            f"has {len(vertices)}. Pass vertices and triangles of one surface."
        )
    skin = bind(vertices, model, q, stations=stations, **options)
    return Rig(model, skin, triangles)


def pose(
    rig: Rig, q: Float[Any, "*frames coordinates"] | None = None
) -> Float[Array, "*frames points dim"]:
    """Vertices of a rig at coordinates `q`, or at each row of `q` [m]; at rest if omitted.

    Together with `rod.inverse_kinematics` a rig follows a hand: pose it with what that
    found.
    """
    q = rest(rig.model) if q is None else real(q)
    count = num_coordinates(rig.model)
    do = f"The model has {count} coordinates."
    if q.ndim == 1:
        _check.shape("pose", "q", q, (count,), do)
        return deform(rig.skin, rig.model, q)
    _check.shape("pose", "q", q, (None, count), do)
    return _poses(rig, q)


@eqx.filter_jit
def _poses(rig: Rig, qs: Float[Array, "frames coordinates"]):
    return jax.lax.map(lambda q: deform(rig.skin, rig.model, q), qs)


@door
def placed(
    points: Float[Array, "points dim"],
    position: Float[Array, "*frames dim"],
    quaternion: Float[Array, "*frames 4"] | None = None,
) -> Float[Array, "*frames points dim"]:
    """Points of a rigid body, in its frame, where the body is [m].

    Args:
        points: In the frame of the body [m].
        position: Of its origin, one or one per frame [m].
        quaternion: Its attitude, scalar first; that of the world if omitted. A network
            gives both as outputs `body.position` and `body.quaternion`.
    """
    points, position = real(points), real(position)
    shift = position[..., None, :]
    points = points.reshape((1,) * (shift.ndim - 2) + points.shape)
    if quaternion is None:
        return points + shift
    quaternion = real(quaternion)[..., None, :]
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    vector, points = jnp.broadcast_arrays(vector, points)
    across = jnp.cross(vector, points)
    # Rodrigues' form for a unit quaternion
    return points + 2 * (scalar * across + jnp.cross(vector, across)) + shift

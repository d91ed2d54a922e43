"""Rigs: a model with the surface that it carries, posed by its coordinates."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._display import displayed
from sorojax._jax.jit import once
from sorojax._types import integers, real
from sorojax.math.compiled import jit_public
from sorojax.math.quadrature import interpolation_rows
from sorojax.rod import Assembly, Link, Rod, num_coordinates, rest
from sorojax.sdf import Surface
from sorojax.view.raster.glyphs import area_of, ball, circle, tube
from sorojax.view.rigging.frames import Held, carry, compiled_table, places
from sorojax.view.rigging.skin import Skin, bind, deform, hold

Outline: TypeAlias = Float[Any, "points 2"]
Triangles = Int[np.ndarray, "triangles 3"]


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

    Returns:
        Model and surface, for `pose`, `show` and `live`.

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
    do = "Pass what import_surface or sdf.isosurface gives."
    _check.shape("rig", "triangles", triangles, (None, 3), do)
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"rig: got {len(triangles)} triangles that must name some of {len(vertices)} "
            "vertices. Pass vertices and triangles of one surface."
        )
    skin = bind(vertices, model, q, stations=stations, **options)
    return Rig(model, skin, triangles)


def pose(
    rig: Rig, q: Float[Any, "*frames coordinates"] | None = None
) -> Float[Array, "*frames points dim"]:
    """Vertices of a rig at coordinates `q`, or at each row of `q` [m]; at rest if omitted.

    Together with `rod.inverse_kinematics` a rig follows a hand: pose it with what that
    found.

    Args:
        rig: From `rig`.
        q: Coordinates, or one row per frame.

    Returns:
        Vertices [m].
    """
    q = rest(rig.model) if q is None else real(q)
    count = num_coordinates(rig.model)
    do = f"The model has {count} coordinates."
    if q.ndim == 1:
        _check.shape("pose", "q", q, (count,), do)
        return deform(rig.skin, rig.model, q)
    _check.shape("pose", "q", q, (None, count), do)
    return _poses(rig, q)


@once
def _poses(rig: Rig, qs: Float[Array, "frames coordinates"]):
    return jax.lax.map(lambda q: deform(rig.skin, rig.model, q), qs)


@jit_public
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


# Surfaces for models that have none: tubes with the sections of rods, ellipsoids of links


def own_surface(
    model: Rod | Assembly,
    q: Float[Any, " coordinates"] | None,
    outline: Outline | dict[str, Outline] | None,
    around: int,
    stations: int,
    base: Float[Array, "h h"] | None,
) -> tuple[Skin, Triangles]:
    """The skin of tubes and ellipsoids in space, and its triangles."""
    q = rest(model) if q is None else real(q)
    table = np.asarray(compiled_table(model, q, stations, 3, base))
    where = places(model, stations)
    bodies = [model] if isinstance(model, Rod) else [part.body for part in model.parts]
    parts = []
    for body, place in zip(bodies, where, strict=True):
        if isinstance(body, Rod):
            own = outline.get(place.name) if isinstance(outline, dict) else outline
            parts.append(_tube(body, own, around, stations))
        else:
            points, triangles = ellipsoid(body, around)
            parts.append((np.zeros(len(points)), points, triangles))
    sizes = [len(s) for s, _, _ in parts]
    s, local, triangles = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    starts = np.cumsum([0, *sizes[:-1]])
    triangles += np.repeat(starts, [len(rows) for _, _, rows in parts])[:, None]
    count = len(s)
    part = np.repeat(np.arange(len(parts)), sizes)
    held = Held(np.arange(count), part, s, np.ones(count), np.ones(count, bool))
    points = _world(table, where, part, s, local)
    return hold(points, table, where, held, base, stations), triangles


def section_axes(rod: Rod, s: Float[np.ndarray, " points"]) -> Float[np.ndarray, "points 2"]:
    """Half axes along local y and z of the ellipse, full or hollow, that has the area and
    second moments of the section [m]."""

    names = ("area", "second_moment_y", "second_moment_z")
    area, about_y, about_z = (constant_along(rod, name, s) for name in names)
    product = (4 * np.sqrt(about_y * about_z) / area + area / np.pi) / 2
    ratio = np.sqrt(about_z / about_y)
    return np.stack([np.sqrt(product * ratio), np.sqrt(product / ratio)], axis=1)


def constant_along(
    rod: Rod, name: str, s: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " points"]:
    """A constant of the section of a rod at places along it."""
    value = np.asarray(getattr(rod.section, name), float)
    if value.ndim == 0:
        return np.full(len(s), float(value))
    return np.asarray(interpolation_rows(rod.quadrature, s)) @ value


def _tube(rod: Rod, outline: Outline | None, around: int, stations: int):
    """Stations, local places and triangles of a closed tube, its ends with a middle."""
    s = np.linspace(0.0, 1.0, stations)
    if outline is None:
        rings = section_axes(rod, s)[:, None] * circle(around)
    else:
        ring = np.asarray(outline, float)
        _check.shape("rig", "outline", ring, (None, 2), "Give (y, z) around it in metres.")
        ring = ring if area_of(ring) >= 0 else ring[::-1]
        rings = np.broadcast_to(ring, (stations, *ring.shape))
    middles = rings.mean(axis=1)
    across = np.broadcast_to(np.eye(3)[1:], (stations, 2, 3))
    centres = np.column_stack([s, middles])
    points, triangles = tube(centres, across, rings - middles[:, None])
    return points[:, 0], points * [0.0, 1.0, 1.0], triangles


def ellipsoid(link: Link, around: int, thinnest: float = 0.1):
    """The solid ellipsoid with the mass and moments of a link, at least `thinnest` times as
    thick as long; a ball for a planar one, a point for a frame without mass."""
    mass, inertia, axes = float(link.mass), np.asarray(link.inertia, float), np.eye(3)
    if mass == 0:
        half = np.zeros(3)
    elif inertia.ndim == 0:
        half = np.full(3, np.sqrt(2.5 * inertia / mass))
    else:
        moments = inertia
        if inertia.ndim == 2:
            moments, axes = np.linalg.eigh(inertia)
            axes = axes * np.sign(np.linalg.det(axes))
        squares = 2.5 / mass * (moments.sum() - 2 * moments)
        half = np.sqrt(np.maximum(squares, thinnest**2 * squares.max()))
    unit, triangles = ball(max(around // 2, 3), around)
    centre = np.zeros(3) if link.center is None else np.asarray(link.center, float)
    return np.pad(centre, (0, 3 - len(centre))) + (unit * half) @ axes.T, triangles


def _world(table, where, part, s, local) -> Float[np.ndarray, "points 3"]:
    """Points from their places in the frames."""
    first = np.array([place.first for place in where])[part]
    last = np.array([place.count for place in where])[part] - 1
    at = s * last
    step = np.minimum(np.floor(at).astype(int), np.maximum(last - 1, 0))
    return np.asarray(_carried(table[first + step].T, at - step, local.T))


@jax.jit
def _carried(columns, fraction, local) -> Float[Array, "points 3"]:
    return jnp.stack(carry(tuple(columns), fraction, tuple(local)), axis=1)

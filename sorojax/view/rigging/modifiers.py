"""Modifiers: free functions of points that bend, twist, taper, sweep, repeat and mirror.

They act on the points of any surface, mesh or cloud, in metres, and are differentiable in
the points and in their numbers.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.math.compiled import jit_public
from sorojax.math.lie import homogeneous
from sorojax.view.rigging.frames import carry, pose_rows

Points = Float[Array, "points dim"]
Triangles = Int[np.ndarray, "triangles 3"]
Axis = Literal["x", "y", "z"]
_AXES = ("x", "y", "z")


@jit_public
def bend(
    points: Points, curvature, *, along: Axis = "x", towards: Axis = "y", start=None, end=None
) -> Points:
    """Bend the line `along` an axis to an arc towards another axis.

    Args:
        points: (points, 2) or (points, 3) [m].
        curvature: Of the line [1/m].
        along: Axis that becomes the arc; distances from it are kept.
        towards: Axis that the arc turns to.
        start: Where the arc starts on `along` [m]; what lies before stays. No limit if
            omitted, the arc then is flat at zero.
        end: Where it ends [m]; what lies behind moves rigidly.
    """
    points, kappa = _points("bend", points), real(curvature)
    i, j = _axis("bend", points, along), _axis("bend", points, towards)
    if i == j:
        raise ValueError(f"bend: `along` and `towards` are both {along!r}, need two axes.")
    kappa = kappa.astype(points.dtype)
    s, origin = _within(points[:, i], start, end)
    angle = kappa * s
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    ahead, across = points[:, i] - origin - s, points[:, j]
    half = _sinc(angle / 2)
    arc_i = s * _sinc(angle)
    arc_j = s * angle / 2 * half * half
    points = points.at[:, i].set(origin + arc_i + ahead * cosine - across * sine)
    return points.at[:, j].set(arc_j + ahead * sine + across * cosine)


@jit_public
def twist(points: Points, rate, *, along: Axis = "x", start=None, end=None) -> Points:
    """Turn sections about an axis by an angle that grows by `rate` [rad/m] along it.

    Args:
        points: In space [m].
        rate: Angle per length [rad/m].
        along: The axis.
        start, end: Where the angle starts and ends to grow [m]; no limits if omitted.
    """
    points = _points("twist", points, dim=3)
    i = _axis("twist", points, along)
    j, k = (i + 1) % 3, (i + 2) % 3
    s, _ = _within(points[:, i], start, end)
    angle = real(rate).astype(points.dtype) * s
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    a, b = points[:, j], points[:, k]
    return points.at[:, j].set(cosine * a - sine * b).at[:, k].set(sine * a + cosine * b)


def taper(points: Points, factor, *, along: Axis = "x", start, end) -> Points:
    """Scale sections about an axis by a factor that goes from 1 at `start` to `factor` at
    `end` and is constant beyond.

    Args:
        points: (points, 2) or (points, 3) [m].
        factor: Size at the end over size at the start [-].
        along: The axis.
        start, end: Places on the axis [m].
    """
    points = _points("taper", points)
    i = _axis("taper", points, along)
    start, end = (real(x).astype(points.dtype) for x in (start, end))
    _check.positive("taper", "end - start", end - start, "m", "Give the lower place first.")
    return _taper(points, real(factor).astype(points.dtype), i, start, end)


@once
def _taper(points: Points, factor, i: int, start, end) -> Points:
    share = jnp.clip((points[:, i] - start) / (end - start), 0, 1)
    scaled = points * (1 + (factor - 1) * share)[:, None]
    return scaled.at[:, i].set(points[:, i])


@jit_public
def sweep(
    points: Points, curve: Float[Array, "knots 3"], *, along: Axis = "x", up=None
) -> Points:
    """Carry points along a curve: the line `along` an axis, from zero on, becomes the curve.

    Sections follow by frames that do not turn about the curve. From knot to knot it is a
    piece of a helix; beyond its ends it goes on straight.

    Args:
        points: In space [m].
        curve: Knots of the curve [m], 3 or more, about evenly spaced.
        along: Axis that becomes the curve.
        up: Direction of the next axis (y after x, z after y, x after z) at the start, not
            along the curve; some direction across the curve if omitted.

    Reference:
        Wang, Juettler, Zheng, Liu, Computation of rotation minimizing frames, ACM
        Transactions on Graphics 27, 2008 (double reflection).
    """
    points, curve = _points("sweep", points, dim=3), real(curve)
    _check.shape("sweep", "curve", curve, (None, 3), "Give knots in metres.")
    if curve.shape[0] < 3:
        raise ValueError(f"sweep: `curve` has {curve.shape[0]} knots, need 3 or more.")
    curve = curve.astype(points.dtype)
    i = _axis("sweep", points, along)
    poses, length = _moving_frames(curve, up)
    table = pose_rows(poses, np.array([len(poses) - 1]))
    u = jnp.interp(points[:, i], length, jnp.arange(len(length), dtype=points.dtype))
    left = jnp.clip(jnp.floor(u).astype(jnp.int32), 0, len(length) - 2)
    ahead = points[:, i] - jnp.clip(points[:, i], 0, length[-1])
    local = (ahead, points[:, (i + 1) % 3], points[:, (i + 2) % 3])
    moved = carry(tuple(table[left].T), u - left.astype(u.dtype), local)
    return jnp.stack(moved, axis=1)


def array(
    points: Points, triangles: Triangles, offset: Float[Array, " dim"], count: int
) -> tuple[Points, Triangles]:
    """`count` copies of a surface, each moved by `offset` [m] from the one before."""
    points, offset = _points("array", points), real(offset)
    if count < 1:
        raise ValueError(f"array: `count` is {count}, need 1 or more.")
    _check.shape("array", "offset", offset, (points.shape[1],), "Give it in metres.")
    shift = jnp.arange(count, dtype=points.dtype)[:, None] * offset.astype(points.dtype)[None]
    copies = points[None] + shift[:, None]
    numbers = np.asarray(triangles)[None] + len(points) * np.arange(count)[:, None, None]
    return copies.reshape(-1, points.shape[1]), numbers.reshape(-1, 3)


def mirror(
    points: Points, triangles: Triangles, normal: Float[Array, " dim"], origin=None
) -> tuple[Points, Triangles]:
    """A surface and its mirror image; triangles of the image face outwards too.

    Args:
        points: (points, 2) or (points, 3) [m].
        triangles: Rows of points.
        normal: Normal of the mirror, of any length.
        origin: A point on the mirror [m]; zero if omitted.
    """
    points, normal = _points("mirror", points), real(normal)
    _check.shape("mirror", "normal", normal, (points.shape[1],), "Give a direction.")
    _check.positive("mirror", "size of normal", jnp.sum(normal**2), "-", "Give a direction.")
    normal = (normal / jnp.sqrt(jnp.sum(normal**2))).astype(points.dtype)
    shift = jnp.zeros_like(normal) if origin is None else real(origin).astype(points.dtype)
    height = (points - shift[None]) @ normal
    image = points - 2 * height[:, None] * normal[None]
    triangles = np.asarray(triangles)
    flipped = triangles[:, [0, 2, 1]] + len(points)
    return jnp.concatenate([points, image]), np.concatenate([triangles, flipped])


def _points(where: str, points, dim: int | None = None) -> Points:
    points = real(points)
    if points.ndim != 2 or points.shape[1] not in ((2, 3) if dim is None else (dim,)):
        need = "(points, 2) or (points, 3)" if dim is None else f"(points, {dim})"
        raise ValueError(f"{where}: `points` has shape {points.shape}, need {need}.")
    return points


def _axis(where: str, points: Points, name: str) -> int:
    known = _AXES[: points.shape[1]]
    if name not in known:
        raise ValueError(f"{where}: got axis {name!r}, need one of {', '.join(known)}.")
    return known.index(name)


def _within(x: Array, start, end) -> tuple[Array, Array]:
    """Distance from the start along an axis, held at the limits, and where the start is."""
    origin = jnp.zeros((), x.dtype) if start is None else real(start).astype(x.dtype)
    low = None if start is None else 0.0
    high = None if end is None else real(end).astype(x.dtype) - origin
    s = x - origin
    if low is not None:
        s = jnp.maximum(s, low)
    return (s if high is None else jnp.minimum(s, high)), origin


def _sinc(x: Array) -> Array:
    """sin(x) / x, smooth at zero."""
    return jnp.sinc(x / np.pi)


def _moving_frames(curve: Float[Array, "knots 3"], up):
    """Poses at the knots, and the length of the curve up to each."""
    start = (4 * curve[1] - 3 * curve[0] - curve[2]) / 2
    end = (3 * curve[-1] - 4 * curve[-2] + curve[-3]) / 2
    slope = jnp.concatenate([start[None], (curve[2:] - curve[:-2]) / 2, end[None]])
    step = jnp.diff(curve, axis=0)
    middle = 1.5 * step - 0.25 * (slope[1:] + slope[:-1])
    speed = _size(slope)
    pieces = (speed[:-1] + 4 * _size(middle) + speed[1:]) / 6
    length = jnp.concatenate([jnp.zeros(1, curve.dtype), jnp.cumsum(pieces)])
    tangent = slope / speed[:, None]
    across = _across(tangent[0], up)

    def reflect(across, ends):
        chord, before, after = ends
        first = 2 / (chord @ chord)
        turned = across - first * (chord @ across) * chord
        other = before - first * (chord @ before) * chord
        gap = after - other
        following = turned - 2 / (gap @ gap) * (gap @ turned) * gap
        return following, following

    _, others = jax.lax.scan(reflect, across, (step, tangent[:-1], tangent[1:]))
    second = jnp.concatenate([across[None], others])
    rotation = jnp.stack([tangent, second, jnp.cross(tangent, second)], axis=2)
    return homogeneous(rotation, curve), length


def _across(tangent: Float[Array, "3"], up) -> Float[Array, "3"]:
    """A unit vector across the tangent, nearest to `up`."""
    if up is None:
        up = jnp.eye(3, dtype=tangent.dtype)[jnp.argmin(jnp.abs(tangent))]
    else:
        _check.shape("sweep", "up", up := real(up), (3,), "Give a direction.")
        up = up.astype(tangent.dtype)
    across = up - (up @ tangent) * tangent
    return across / jnp.sqrt(across @ across)


def _size(rows: Float[Array, "rows 3"]) -> Float[Array, " rows"]:
    return jnp.sqrt(jnp.sum(rows**2, axis=1))

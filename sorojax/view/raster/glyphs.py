"""Triangles of tubes, arrows and balls."""

import functools

import numpy as np
from jaxtyping import Float, Int

Mesh = tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, "triangles 3"]]


def circle(corners: int) -> Float[np.ndarray, "corners 2"]:
    """Corners on the circle of radius 1, counter-clockwise."""
    angle = 2 * np.pi * np.arange(corners) / corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def area_of(ring: Float[np.ndarray, "corners 2"]) -> float:
    """Area inside a ring of corners, negative where they go clockwise."""
    y, z = ring.T
    return 0.5 * float(np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z))


def tube(
    centres: Float[np.ndarray, "stations 3"],
    across: Float[np.ndarray, "stations 2 3"],
    outlines: Float[np.ndarray, "stations corners 2"],
    *,
    closed: bool = True,
    inner: Float[np.ndarray, "stations corners 2"] | None = None,
) -> Mesh:
    """The surface that closed outlines sweep along a line.

    Args:
        centres: Of the sections [m].
        across: Local y and z of each section, as unit vectors.
        outlines: Corners (y, z) in each section [m], counter-clockwise about local x.
        closed: Put lids on both ends, each with a point in its middle.
        inner: Corners of a hole, as many as of the outline.
    """
    points = _swept(centres, across, outlines)
    count, corners = len(points), outlines.shape[1]
    rings = np.arange(count).reshape(-1, corners)
    triangles = [_between(rings[:-1], rings[1:])]
    if inner is not None:
        points = np.concatenate([points, _swept(centres, across, inner)])
        holes = rings + count
        ends = _between(holes[0], rings[0]), _between(rings[-1], holes[-1])
        triangles += [_between(holes[1:], holes[:-1]), *ends]
    elif closed:
        points = np.concatenate([points, centres[:1], centres[-1:]])
        triangles += [_fan(rings[0][::-1], count), _fan(rings[-1], count + 1)]
    return points, np.concatenate(triangles)


def _swept(centres, across, outlines) -> Float[np.ndarray, "points 3"]:
    return (centres[:, None] + np.einsum("scj,sji->sci", outlines, across)).reshape(-1, 3)


def _between(first, second) -> Int[np.ndarray, "triangles 3"]:
    """Triangles from rings of points to others."""
    after, beyond = np.roll(first, -1, axis=-1), np.roll(second, -1, axis=-1)
    halves = [np.stack([first, after, beyond], -1), np.stack([first, beyond, second], -1)]
    return np.concatenate(halves).reshape(-1, 3)


def _fan(ring, middle: int) -> Int[np.ndarray, "triangles 3"]:
    return np.stack([ring, np.roll(ring, -1), np.full(len(ring), middle)], axis=1)


def line_tube(line: Float[np.ndarray, "points 3"], radius: float, corners: int = 10) -> Mesh:
    """A round tube along a line."""
    line = np.asarray(line, float)
    slope = np.gradient(line, axis=0)
    slope /= np.maximum(np.linalg.norm(slope, axis=1), 1e-300)[:, None]
    across = _carried(slope)
    rings = np.broadcast_to(radius * circle(corners), (len(line), corners, 2))
    return tube(line, across, rings)


def _carried(slope: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 3"]:
    """Two directions across a line that do not wind about it."""
    start = np.eye(3)[np.argmin(np.abs(slope[0]))]
    found = []
    for along in slope:
        start = start - (start @ along) * along
        start = start / np.linalg.norm(start)
        found.append(np.stack([start, np.cross(along, start)]))
    return np.stack(found)


def arrow_triangles(
    starts: Float[np.ndarray, "arrows 3"], vectors: Float[np.ndarray, "arrows 3"], radius: float
) -> Mesh:
    """Arrows with shafts of `radius` [m]; a short arrow has a small head."""
    length = np.linalg.norm(vectors, axis=1)
    kept = length > 1e-12 + 1e-6 * float(length.max(initial=0.0))
    starts, vectors, length = starts[kept], vectors[kept], length[kept]
    shape, triangles = _arrow()
    along = vectors / length[:, None]
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)])
    side /= np.linalg.norm(side, axis=1)[:, None]
    frames = np.stack([along, side, np.cross(along, side)], axis=1)
    head = np.minimum(0.45 * length, 6.0 * radius)
    thin = head / (6.0 * radius) * radius
    along_at = np.where(
        shape[None, :, 0] <= 1,
        shape[None, :, 0] * (length - head)[:, None],
        (length - head)[:, None] + (shape[None, :, 0] - 1) * head[:, None],
    )
    local = np.concatenate(
        [along_at[:, :, None], shape[None, :, 1:] * thin[:, None, None]], axis=2
    )
    points = starts[:, None] + np.einsum("aki,aij->akj", local, frames)
    shift = np.arange(len(starts))[:, None, None] * len(shape)
    return points.reshape(-1, 3), (triangles[None] + shift).reshape(-1, 3)


@functools.cache
def _arrow(corners: int = 12) -> Mesh:
    """Along x: 0 to 1 the shaft of radius 1, 1 to 2 the head."""
    places = ((0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 2.4), (2.0, 0.0))
    centres = np.array([[x, 0.0, 0.0] for x, _ in places])
    across = np.broadcast_to(np.eye(3)[1:], (len(places), 2, 3))
    outlines = np.stack([radius * circle(corners) for _, radius in places])
    return tube(centres, across, outlines, closed=False)


def ball_triangles(
    centres: Float[np.ndarray, "balls 3"], radius: float, corners: int = 10
) -> Mesh:
    """Balls of `radius` [m]."""
    shape, triangles = ball(corners // 2 + 1, corners)
    points = np.asarray(centres, float)[:, None] + radius * shape[None]
    shift = np.arange(len(points))[:, None, None] * len(shape)
    return points.reshape(-1, 3), (triangles[None] + shift).reshape(-1, 3)


@functools.cache
def ball(rows: int, corners: int) -> Mesh:
    """A ball of radius 1 about the origin, in `rows` from pole to pole along x."""
    polar = np.linspace(0, np.pi, rows + 1)[1:-1]
    centres = np.stack([-np.cos(polar), 0 * polar, 0 * polar], axis=1)
    across = np.broadcast_to(np.eye(3)[1:], (len(polar), 2, 3))
    points, triangles = tube(centres, across, np.sin(polar)[:, None, None] * circle(corners))
    points[-2:, 0] = -1.0, 1.0
    return points, triangles

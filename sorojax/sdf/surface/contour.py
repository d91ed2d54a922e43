"""The zero set of a plane shape as curves whose points and corners are exact."""

from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import finite_box, land, raise_empty, values, values_and_gradients

_TURN = 0.05  # rad between neighbours that makes a corner search worth while
_CORNER = 0.02  # rad that are left at a corner when looked at from very near


class Curve(NamedTuple):
    """Points along a piece of a zero set, its inside on the left.

    Attributes:
        points: (n, 2) [m]; a closed curve does not repeat its first point.
        corner: (n,) whether the normal jumps at a point.
        closed: Whether the last point connects to the first.
    """

    points: np.ndarray
    corner: np.ndarray
    closed: bool


def contour(shape: AbstractSdf, size: float) -> list[Curve]:
    """Boundary curves of a plane shape as polygons.

    Marching squares find the curves; their points are then moved onto the zero set to
    rounding. A corner is where the normal jumps; it is put where the two sides meet.

    Args:
        shape: A concrete, bounded plane shape.
        size: Distance between points [m]; finer features may be missed.

    Returns:
        Closed curves with the inside on their left: the outline and one curve per hole.

    Raises:
        ValueError: If `size` is not positive, or the shape is not plane, empty, unbounded or
            traced.

    Example:
        >>> curves = sdf.contour(sdf.Rectangle([0, 0], [20 * mm, 10 * mm]), size=1 * mm)
        >>> len(curves), int(curves[0].corner.sum())
        (1, 4)
    """
    if not size > 0:
        raise ValueError(f"contour: `size` must be positive, got {size} m.")
    lower, upper = finite_box("contour", shape, 2)
    curves = level_curves(shape, lower - 1.37 * size, upper + 1.37 * size, size)
    if not curves:
        raise_empty("contour", lower, upper, size)
    return curves


def level_curves(
    shape: AbstractSdf, lower: np.ndarray, upper: np.ndarray, size: float
) -> list[Curve]:
    """Zero set of `shape` inside a window [m]; curves that leave the window are open."""
    from skimage.measure import find_contours

    counts = np.maximum(np.ceil((upper - lower) / size).astype(int), 2) + 1
    axes = [np.linspace(lower[i], upper[i], counts[i]) for i in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = values(shape, grid.reshape(-1, 2)).reshape(counts)
    # An exact zero on a grid node makes marching squares emit points twice.
    nudge = 1e-6 * size
    field = np.where(np.abs(field) < nudge, nudge, field)
    spacing = (upper - lower) / (counts - 1)
    rough = [lower + c * spacing for c in find_contours(field, 0.0)]
    curves = [_refine(shape, c, size) for c in rough if len(c) > 3]
    return [c for c in curves if len(c.points) > (2 if c.closed else 1)]


def _refine(shape: AbstractSdf, rough: np.ndarray, size: float) -> Curve:
    closed = bool(np.allclose(rough[0], rough[-1], rtol=0, atol=1e-9 * size))
    points = land(shape, rough[:-1] if closed else rough)
    points = points[_spaced(points, 0.02 * size, closed)]
    normals = _normals(shape, points)
    step = np.diff(points, axis=0)
    if (step[:, 1] * normals[:-1, 0] - step[:, 0] * normals[:-1, 1]).sum() < 0:
        points, normals = points[::-1], normals[::-1]
    return _with_corners(shape, points, normals, size, closed)


def _spaced(points: np.ndarray, least: float, closed: bool) -> np.ndarray:
    """Points to keep so that neighbours are at least `least` apart."""
    before = np.roll(points, 1, axis=0)
    keep = np.linalg.norm(points - before, axis=1) > least
    if not closed:
        keep[0] = True
    return keep


def _normals(shape: AbstractSdf, points: np.ndarray) -> np.ndarray:
    g = values_and_gradients(shape, points)[1]
    return g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-300)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _with_corners(shape, points, normals, size, closed) -> Curve:
    """The curve with its corners put in, and points that crowd them left out."""
    last = len(points) if closed else len(points) - 1
    first = np.arange(last)
    second = (first + 1) % len(points)
    turn = np.abs(
        np.arctan2(
            cross(normals[first], normals[second]),
            (normals[first] * normals[second]).sum(axis=1),
        )
    )
    first, second = first[turn > _TURN], second[turn > _TURN]
    found, corners = locate_corners(
        shape, points[first], points[second], normals[first], normals[second]
    )
    after, corners = first[found], corners[found]
    order = np.argsort(np.concatenate([np.arange(len(points)), after + 0.5]), kind="stable")
    merged = np.concatenate([points, corners])[order]
    corner = np.concatenate([np.zeros(len(points), bool), np.ones(len(corners), bool)])
    corner = corner[order]
    keep = np.ones(len(merged), bool)
    numbers = np.flatnonzero(corner)
    for k, c in enumerate(numbers):
        # The same corner seen from two intervals counts once.
        same = np.linalg.norm(merged[numbers[:k]] - merged[c], axis=1) < 1e-6 * size
        keep[c] = not same.any()
        near = np.linalg.norm(merged - merged[c], axis=1) < 0.2 * size
        keep &= corner | ~near
    return Curve(merged[keep], corner[keep], closed)


def locate_corners(shape, a, b, normal_a, normal_b) -> tuple[np.ndarray, np.ndarray]:
    """Whether the zero set has a corner between points `a` and `b`, and where.

    The tangent lines of the two sides meet at the corner up to the curvature of the
    sides; the sides are looked at again from nearer and nearer, which makes it exact,
    and shows no jump where the curve is only strongly bent.
    """
    gap = np.linalg.norm(b - a, axis=1, keepdims=True)
    middle = (a + b) / 2
    corner = _meet(a, b, normal_a, normal_b, middle, gap)
    for zoom in (0.2, 0.05, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        a = land(shape, corner - zoom * gap * tangents(normal_a), 4)
        b = land(shape, corner + zoom * gap * tangents(normal_b), 4)
        normal_a, normal_b = _normals(shape, a), _normals(shape, b)
        corner = _meet(a, b, normal_a, normal_b, (a + b) / 2, gap)
    turn = np.abs(np.arctan2(cross(normal_a, normal_b), (normal_a * normal_b).sum(axis=1)))
    near = np.linalg.norm(corner - middle, axis=1) < 1.5 * gap[:, 0]
    return (turn > _CORNER) & near, corner


def tangents(normal: np.ndarray) -> np.ndarray:
    """Unit tangents with the inside on the left: outward normals turned by 90 degrees."""
    return np.stack([-normal[:, 1], normal[:, 0]], axis=-1)


def _meet(a, b, normal_a, normal_b, fallback, gap) -> np.ndarray:
    """Where the lines through `a` and `b` across their normals meet."""
    det = cross(normal_a, normal_b)
    parallel = np.abs(det) < 1e-9
    safe = np.where(parallel, 1.0, det)
    # Relative to `a`, so that small numbers are not lost beside large coordinates.
    level = ((b - a) * normal_b).sum(axis=1)
    step = np.stack([-level * normal_a[:, 1], level * normal_a[:, 0]], axis=-1)
    meeting = a + step / safe[:, None]
    far = np.linalg.norm(meeting - fallback, axis=1) > 2 * gap[:, 0]
    return np.where((parallel | far)[:, None], fallback, meeting)

"""Points put where several sides of zero sets meet, on the host."""

from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import values_and_gradients

ZOOMS = (0.5, 0.25, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5)
_NO_ROWS = np.zeros((0, 3))


class Sides(NamedTuple):
    """Sides that points lie on, one row each.

    Attributes:
        point: (n,) which point.
        field: (n,) which zero set.
        along: (n, 3) from the point along the side [m]; zero where the set is smooth.
    """

    point: np.ndarray
    field: np.ndarray
    along: np.ndarray

    def of(self, points: np.ndarray, count: int) -> "Sides":
        """The sides of some `points` of `count`, renumbered in their order."""
        place = np.full(count, -1)
        place[points] = np.arange(len(points))
        own = place[self.point] >= 0
        return Sides(place[self.point[own]], self.field[own], self.along[own])


def no_sides() -> Sides:
    return Sides(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))


def joined(*parts: Sides) -> Sides:
    return Sides(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def normals_near(fields: tuple[AbstractSdf, ...], x, sides: Sides, zoom: float):
    """Unit normals of sides looked at from `zoom` of their vectors away, and how far the
    points are from their tangent planes."""
    step = zoom * sides.along
    p = x[sides.point] + step
    f, g = np.zeros(len(p)), np.zeros_like(p)
    for i, field in enumerate(fields):
        own = sides.field == i
        f[own], g[own] = values_and_gradients(field, p[own])
    slope = np.maximum(np.linalg.norm(g, axis=1), 1e-9)
    n = g / slope[:, None]
    return n, (n * step).sum(axis=1) - f / slope


def settle(
    fields: tuple[AbstractSdf, ...], x, sides: Sides, zooms=ZOOMS, ridge=(), tangent=_NO_ROWS
) -> np.ndarray:
    """`x` (points, 3) moved by the shortest way to where their sides meet; those listed in
    `ridge` stay in the planes across their `tangent`."""
    start, x, ridge = np.asarray(x, dtype=float), np.array(x, dtype=float), list(ridge)
    for zoom in zooms if len(x) else ():
        n, level = normals_near(fields, x, sides, zoom)
        matrix = np.broadcast_to(1e-11 * np.eye(3), (len(x), 3, 3)).copy()
        np.add.at(matrix, sides.point, n[:, :, None] * n[:, None, :])
        rhs = np.zeros_like(x)
        np.add.at(rhs, sides.point, n * level[:, None])
        if ridge:
            matrix[ridge] += tangent[:, :, None] * tangent[:, None, :]
            rhs[ridge] += tangent * ((start - x)[ridge] * tangent).sum(axis=1, keepdims=True)
        x += np.linalg.solve(matrix, rhs[..., None])[..., 0]
    return x

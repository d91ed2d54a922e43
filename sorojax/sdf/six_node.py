"""Integrals over closed surfaces of flat or six-node triangles by a rule of degree 5."""

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.isosurface import Surface
from sorojax.sdf.sample import land

_LOW, _HIGH = (6 - 15**0.5) / 21, (6 + 15**0.5) / 21
_RULE = [
    (1 / 3, 1 / 3, 9 / 40),
    *(
        (s, t, weight)
        for q, weight in ((_LOW, (155 - 15**0.5) / 1200), (_HIGH, (155 + 15**0.5) / 1200))
        for s, t in ((q, q), (q, 1 - 2 * q), (1 - 2 * q, q))
    ),
]
# Monomials 1, x, y, z, xx, yy, zz, xy, yz, zx as exponents.
_DEGREE = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])


def monomials(p: np.ndarray) -> np.ndarray:
    """1, x, y, z, xx, yy, zz, xy, yz, zx at points (n, 3)."""
    x, y, z = p.T
    return np.stack([np.ones(len(p)), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x])


def nodes(surface: Surface, shape: AbstractSdf | None = None) -> list[np.ndarray]:
    """Corners and middles of sides of every triangle, put on `shape` if it is given."""
    t = surface.triangles
    side = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=-1), axis=-1)
    name = side[..., 0].astype(np.int64) * len(surface.vertices) + side[..., 1]
    _, first, which = np.unique(name, return_index=True, return_inverse=True)
    ends = side.reshape(-1, 2)[first]
    corners = surface.vertices
    if shape is not None:
        corners = land(shape, corners, 4)
    middles = corners[ends].mean(axis=1)
    if shape is not None:
        middles = land(shape, middles, 4)
    which = which.reshape(-1, 3)
    return [corners[t[:, k]] for k in range(3)] + [middles[which[:, k]] for k in range(3)]


def integrate(six: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments of the inside by the divergence theorem; points and areas of the surface.

    For a monomial g of degree k, div(g x) = (k + 3) g.
    """
    total = np.zeros(10)
    points, areas = [], []
    for s, t, weight in _RULE:
        r = 1 - s - t
        value = (
            r * (2 * r - 1),
            s * (2 * s - 1),
            t * (2 * t - 1),
            4 * r * s,
            4 * s * t,
            4 * t * r,
        )
        along_s = (1 - 4 * r, 4 * s - 1, 0.0, 4 * (r - s), 4 * t, -4 * t)
        along_t = (1 - 4 * r, 0.0, 4 * t - 1, -4 * s, 4 * s, 4 * (r - t))
        x, xs, xt = (_blend(row, six) for row in (value, along_s, along_t))
        vector = weight / 2 * np.cross(xs, xt)
        total += monomials(x) @ (x * vector).sum(axis=1) / (_DEGREE + 3)
        points.append(x)
        areas.append(np.sqrt((vector * vector).sum(axis=1)))
    return total, np.concatenate(points), np.concatenate(areas)


def _blend(weights, six: list[np.ndarray]) -> np.ndarray:
    found = weights[0] * six[0]
    for weight, node in zip(weights[1:], six[1:], strict=True):
        found = found + weight * node
    return found

"""Six-node triangles made from three-node ones, and whether they are valid."""

import numpy as np

from sorojax.mesh.elements import Tri6


def with_middles(
    points: np.ndarray, cells: np.ndarray, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and cells with a node in the middle of every side, and those of `edges`."""
    corners = [facet[:2] for facet in Tri6().facets]
    sides = np.sort(np.concatenate([cells[:, list(c)] for c in corners]), axis=1)
    n = len(points)
    keys, number = np.unique(sides @ [n, 1], return_inverse=True)
    ends = np.stack(np.divmod(keys, n), axis=-1)
    middles = points[ends].mean(axis=1)
    columns = n + number.reshape(3, -1).T
    on_edges = n + np.searchsorted(keys, np.sort(edges, axis=1) @ [n, 1])
    return np.concatenate([points, middles]), np.concatenate([cells, columns], 1), on_edges


def least_jacobian(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Lower bound of det dx/dxi in each six-node triangle over twice its area.

    The determinant is a quadratic polynomial: its smallest Bernstein coefficient
    bounds it from below.
    """
    x = points[cells]
    at_nodes = np.stack([_determinant(x, *node) for node in _NODES], axis=1)
    middles = 2 * at_nodes[:, 3:] - (at_nodes[:, :3] + np.roll(at_nodes[:, :3], -1, 1)) / 2
    return np.minimum(at_nodes[:, :3].min(axis=1), middles.min(axis=1)) / _scale(x)


_NODES = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5))


def _scale(x: np.ndarray) -> np.ndarray:
    a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _determinant(x: np.ndarray, r: float, s: float) -> np.ndarray:
    t = 1 - r - s
    dr = np.array([1 - 4 * t, 4 * r - 1, 0, 4 * (t - r), 4 * s, -4 * s])
    ds = np.array([1 - 4 * t, 0, 4 * s - 1, -4 * r, 4 * r, 4 * (t - s)])
    a, b = np.einsum("cni,n->ci", x, dr), np.einsum("cni,n->ci", x, ds)
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

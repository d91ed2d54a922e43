"""Small distorted meshes of every element, for tests."""

import numpy as np

from sorojax import mesh
from sorojax.mesh import Mesh
from sorojax.mesh.mesh import with_side_nodes


def patch(element: mesh.AbstractElement, lower=(0.0, 0.0, 0.0), seed: int = 0) -> Mesh:
    """A unit square or cube at `lower`; its inner corners are moved, its sides straight."""
    lower = np.array(lower[: element.dim])
    if isinstance(element, mesh.PolyN):
        return Mesh(lower + _POLYGON_POINTS, _POLYGONS, element)
    plain = element.plain or element
    upper, linear = lower + 1, element.linear()
    if element.dim == 2:
        grid = mesh.rectangle(lower, upper, divisions=(3, 2), element=linear)
    else:
        grid = mesh.box(lower, upper, divisions=(2, 2, 2), element=linear)
    points, cells = np.array(grid.points), np.asarray(grid.cells)
    inner = np.all((points > lower + 1e-9) & (points < upper - 1e-9), axis=1)
    points[inner] += np.random.default_rng(seed).uniform(-0.12, 0.12, points[inner].shape)
    if element.order == 2:
        points, cells = with_side_nodes(points, cells, plain)
    made = Mesh(points, cells, plain)
    return made if plain == element else mesh.enrich(made)


def _polygon_patch() -> tuple[np.ndarray, np.ndarray]:
    """A pentagon in a square, and the five cells between rays from its corners."""
    angle = np.pi / 2 + 0.3 + 2 * np.pi / 5 * np.arange(5)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim = ray / np.abs(ray).max(axis=1, keepdims=True)
    square = np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])
    points = 0.5 + 0.5 * np.concatenate([0.4 * ray, rim, square])
    turn = np.arctan2(square[:, 1], square[:, 0])
    cells = [list(range(5))]
    for k in range(5):
        after = (k + 1) % 5
        sector = (turn - angle[k]) % (2 * np.pi)
        between = [10 + c for c in np.argsort(sector) if sector[c] < 2 * np.pi / 5]
        cells.append([k, 5 + k, *between, 5 + after, after])
    widest = max(map(len, cells))
    return points, np.array([c + c[-1:] * (widest - len(c)) for c in cells])


_POLYGON_POINTS, _POLYGONS = _polygon_patch()
POLYGON = mesh.PolyN(_POLYGONS.shape[1])

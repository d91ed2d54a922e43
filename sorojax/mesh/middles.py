"""Mid-side nodes on straight sides, for any quadratic cell."""

import numpy as np

from sorojax.mesh.elements import AbstractElement, Quad8, Tet10, Tri6

_SIDES = {
    Tri6: ((0, 1), (1, 2), (2, 0)),
    Quad8: ((0, 1), (1, 2), (2, 3), (3, 0)),
    Tet10: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
}


def with_side_nodes(
    points: np.ndarray, cells: np.ndarray, element: AbstractElement
) -> tuple[np.ndarray, np.ndarray]:
    """Points and cells of the quadratic `element` from those of its corners."""
    sides = _SIDES[type(element)]
    ends = np.sort(np.concatenate([cells[:, list(s)] for s in sides]), axis=1)
    n = len(points)
    keys, number = np.unique(ends[:, 0] * np.int64(n) + ends[:, 1], return_inverse=True)
    middles = points[np.stack(np.divmod(keys, n), axis=1)].mean(axis=1)
    columns = n + number.reshape(len(sides), -1).T
    return np.concatenate([points, middles]), np.concatenate([cells, columns], axis=1)

"""Regular meshes of boxes."""

import numpy as np

from sorojax.mesh.elements import Tri3, Tri6
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.tri6 import with_middles


def rectangle(lower, upper, *, divisions: tuple[int, int], order: int = 1) -> Mesh:
    """Triangles in a box, two per grid cell with alternating diagonals.

    Node sets and facet sets: "left", "right", "bottom", "top"; node set "corners".

    Args:
        lower: Lower left corner [m].
        upper: Upper right corner [m].
        divisions: Grid cells along x and y.
        order: 1 for `Tri3`, 2 for `Tri6` with straight sides.
    """
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    nx, ny = divisions
    if order not in (1, 2) or nx < 1 or ny < 1 or not np.all(upper > lower):
        raise ValueError(
            f"rectangle: got `lower` {lower}, `upper` {upper} m, `divisions` {divisions}, "
            f"`order` {order}; need upper > lower, divisions of at least 1, order 1 or 2."
        )
    axes = [np.linspace(lower[i], upper[i], n + 1) for i, n in enumerate((nx, ny))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = _split_grid(nx, ny)
    if order == 2:
        points, cells, _ = with_middles(points, cells, cells[:0, :2])
    element = Tri3() if order == 1 else Tri6()
    facets = boundary_facets(Mesh(points, cells, element))
    tol = 1e-9 * (upper - lower)
    node_sets, facet_sets = {}, {}
    for name, axis, place in (
        ("left", 0, lower), ("right", 0, upper), ("bottom", 1, lower), ("top", 1, upper)
    ):  # fmt: skip
        on = np.abs(points[:, axis] - place[axis]) <= tol[axis]
        node_sets[name] = np.flatnonzero(on)
        facet_sets[name] = facets[on[facets].all(axis=1)]
    ends = np.array([0, ny, nx * (ny + 1), nx * (ny + 1) + ny])
    return Mesh(points, cells, element, node_sets | {"corners": ends}, facet_sets)


def _split_grid(nx: int, ny: int) -> np.ndarray:
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a = i * (ny + 1) + j
    b, c, d = a + ny + 1, a + ny + 2, a + 1
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(even, np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    return np.concatenate([first, second])

"""Regular meshes of boxes."""

from itertools import permutations

import numpy as np

from sorojax._types import Numbers
from sorojax.mesh.elements import (
    AbstractElement,
    Hex8,
    Quad4,
    Quad8,
    Quad9,
    Tet4,
    Tet10,
    Tet15,
    Tri3,
    Tri6,
    Tri7,
)
from sorojax.mesh.enrich import enrich, plain_element
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.middles import with_side_nodes

_PLANE = (Tri3, Tri6, Tri7, Quad4, Quad8, Quad9)
_SOLID = (Hex8, Tet4, Tet10, Tet15)


def rectangle(
    lower: Numbers,
    upper: Numbers,
    *,
    divisions: tuple[int, int],
    order: int = 1,
    element: AbstractElement | None = None,
) -> Mesh:
    """Triangles or quadrilaterals in a box.

    Triangles come two per grid cell with alternating diagonals. Node sets and facet
    sets: "left", "right", "bottom", "top"; node set "corners".

    Args:
        lower: Lower left corner [m].
        upper: Upper right corner [m].
        divisions: Grid cells along x and y.
        order: 1 for `Tri3`, 2 for `Tri6` with straight sides; `element` overrides it.
        element: `Tri3()`, `Tri6()`, `Tri7()`, `Quad4()`, `Quad8()` or `Quad9()`.
    """
    lower, upper = _corners("rectangle", lower, upper, divisions, 2)
    if order not in (1, 2):
        raise ValueError(f"rectangle: `order` is {order}, need 1 (Tri3) or 2 (Tri6).")
    element = element or (Tri3() if order == 1 else Tri6())
    _known("rectangle", element, _PLANE)
    if plain := plain_element(element):
        return enrich(rectangle(lower, upper, divisions=divisions, element=plain))
    nx, ny = divisions
    points = _grid(lower, upper, divisions)
    quads = isinstance(element, Quad4 | Quad8)
    cells = _quads(nx, ny) if quads else _split_grid(nx, ny)
    if element.order == 2:
        points, cells = with_side_nodes(points, cells, element)
    names = (("left", "right"), ("bottom", "top"))
    ends = np.array([0, ny, nx * (ny + 1), nx * (ny + 1) + ny])
    return _with_sides(Mesh(points, cells, element), lower, upper, names, {"corners": ends})


def box(
    lower: Numbers,
    upper: Numbers,
    *,
    divisions: tuple[int, int, int],
    element: AbstractElement | None = None,
) -> Mesh:
    """Hexahedra, or tetrahedra six per grid cell, in a cuboid.

    Node sets and facet sets: "left", "right" (x), "front", "back" (y), "bottom", "top"
    (z); node set "corners".

    Args:
        lower: Lower corner [m].
        upper: Upper corner [m].
        divisions: Grid cells along x, y and z.
        element: `Hex8()` (default), `Tet4()`, `Tet10()` or `Tet15()`.
    """
    lower, upper = _corners("box", lower, upper, divisions, 3)
    element = element or Hex8()
    _known("box", element, _SOLID)
    if plain := plain_element(element):
        return enrich(box(lower, upper, divisions=divisions, element=plain))
    points = _grid(lower, upper, divisions)
    corner = _cube_corners(divisions)
    if isinstance(element, Hex8):
        order = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        order += [(i, j, 1) for i, j, _ in order]
        cells = np.stack([corner[c] for c in order], axis=1)
    else:
        cells = np.concatenate([_kuhn(corner, axes) for axes in permutations(range(3))])
    if element.order == 2:
        points, cells = with_side_nodes(points, cells, element)
    names = (("left", "right"), ("front", "back"), ("bottom", "top"))
    counts = np.array(divisions) + 1
    ends = np.array(np.meshgrid(*[(0, n - 1) for n in counts], indexing="ij")).reshape(3, -1)
    sets = {"corners": np.ravel_multi_index(tuple(ends), tuple(counts))}
    return _with_sides(Mesh(points, cells, element), lower, upper, names, sets)


def _corners(where: str, lower, upper, divisions, dim: int):
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    fits = lower.shape == upper.shape == (dim,) and len(divisions) == dim
    finite = np.all(np.isfinite([*lower.flat, *upper.flat]))
    if not fits or not finite or min(divisions) < 1 or not np.all(upper > lower):
        raise ValueError(
            f"{where}: got `lower` {lower}, `upper` {upper} m, `divisions` {divisions}; "
            f"need {dim} finite entries each, upper > lower and divisions of at "
            "least 1."
        )
    return lower, upper


def _known(where: str, element: AbstractElement, kinds: tuple[type, ...]) -> None:
    if not isinstance(element, kinds):
        names = ", ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{where}: `element` is {element.name}, need one of {names}.")


def _grid(lower, upper, divisions) -> np.ndarray:
    axes = [np.linspace(lower[i], upper[i], n + 1) for i, n in enumerate(divisions)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(divisions))


def _with_sides(mesh: Mesh, lower, upper, names, node_sets) -> Mesh:
    points, facets = np.asarray(mesh.points), boundary_facets(mesh)
    facet_sets = {}
    for axis, pair in enumerate(names):
        for name, place in zip(pair, (lower, upper), strict=True):
            on = np.abs(points[:, axis] - place[axis]) <= 1e-9 * (upper - lower)[axis]
            node_sets[name] = np.flatnonzero(on)
            facet_sets[name] = facets[on[facets].all(axis=1)]
    return Mesh(mesh.points, mesh.cells, mesh.element, node_sets, facet_sets)


def _quads(nx: int, ny: int) -> np.ndarray:
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a = i * (ny + 1) + j
    return np.stack([a, a + ny + 1, a + ny + 2, a + 1], axis=1)


def _split_grid(nx: int, ny: int) -> np.ndarray:
    a, b, c, d = _quads(nx, ny).T
    i, j = np.divmod(a, ny + 1)
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(even, np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    return np.concatenate([first, second])


def _cube_corners(divisions) -> dict[tuple[int, int, int], np.ndarray]:
    """Node numbers of the eight corners of every grid cell."""
    base = np.stack(np.meshgrid(*map(np.arange, divisions), indexing="ij"), -1).reshape(-1, 3)
    counts = tuple(n + 1 for n in divisions)
    offsets = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return {o: np.asarray(np.ravel_multi_index(tuple((base + o).T), counts)) for o in offsets}


def _kuhn(corner, axes: tuple[int, ...]) -> np.ndarray:
    """The tetrahedron along one order of axes: neighbours match, diagonals are parallel."""
    place, path = [0, 0, 0], [corner[0, 0, 0]]
    for axis in axes:
        place[axis] = 1
        path.append(corner[tuple(place)])
    if axes in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):  # odd
        path[1], path[2] = path[2], path[1]
    return np.stack(path, axis=1)

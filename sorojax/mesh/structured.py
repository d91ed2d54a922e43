"""Regular meshes of boxes."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers
from sorojax.mesh.elements.base import (
    AbstractElement,
    exported_elements,
    facet_element,
    mirror_order,
)
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.elements.simplex import AbstractSimplex, Tet4, Tri3, Tri6
from sorojax.mesh.elements.tensor import AbstractHypercube, Hex8, Quad4
from sorojax.mesh.enrich import enrich
from sorojax.mesh.mesh import Mesh, boundary_facets, with_side_nodes
from sorojax.mesh.solid.lattice import signed_volumes, wedge
from sorojax.sdf.measure.simplices import kuhn


def rectangle(
    lower: Numbers,
    upper: Numbers,
    *,
    divisions: tuple[int, int],
    order: int = 1,
    element: AbstractElement | None = None,
) -> Mesh:
    """Triangles or quadrilaterals on a regular grid in a rectangle.

    Triangles come two per grid cell with alternating diagonals. Node sets and facet
    sets: "left", "right", "bottom", "top"; node set "corners".

    Args:
        lower: Lower left corner (x, y) [m].
        upper: Upper right corner (x, y) [m].
        divisions: Grid cells along x and y.
        order: 1 for `Tri3`, 2 for `Tri6` with straight sides; `element` overrides it.
        element: `Tri3()`, `Tri6()`, `Tri7()`, `Quad4()`, `Quad8()` or `Quad9()`; as `order`
            says by default.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the corners are not finite or `upper` is not above `lower`, a division
            is below 1, or order or element are none of those above.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> bar.num_cells, bar.num_nodes, len(bar.node_sets["left"])
        (4, 27, 3)
    """
    lower, upper = _corners("rectangle", lower, upper, divisions, 2)
    if order not in (1, 2):
        raise ValueError(f"rectangle: `order` is {order}, need 1 (Tri3) or 2 (Tri6).")
    element = element or (Tri3() if order == 1 else Tri6())
    _check_element("rectangle", element, 2)
    if plain := element.plain:
        return enrich(rectangle(lower, upper, divisions=divisions, element=plain))
    nx, ny = divisions
    points = _grid(lower, upper, divisions)
    cells = _quads(nx, ny) if element.num_corners == 4 else _split_grid(nx, ny)
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
    """Hexahedra, or tetrahedra six per grid cell, on a regular grid in a cuboid.

    Node sets and facet sets: "left", "right" (x), "front", "back" (y), "bottom", "top"
    (z); node set "corners".

    Args:
        lower: Lower corner (x, y, z) [m].
        upper: Upper corner (x, y, z) [m].
        divisions: Grid cells along x, y and z.
        element: `Hex8()` (default), `Tet4()`, `Tet10()` or `Tet15()`.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the corners are not finite or `upper` is not above `lower`, a division
            is below 1, or the element is none of those above.

    Example:
        >>> block = mesh.box([0, 0, 0], [40 * mm, 10 * mm, 10 * mm], divisions=(4, 1, 1))
        >>> block.num_cells, block.num_nodes, len(block.facet_sets["top"])
        (4, 20, 4)

    Reference:
        Kuhn, Some combinatorial lemmas in topology, IBM J. Res. Dev. 4, 1960, for the six
        tetrahedra of a cube.
    """
    lower, upper = _corners("box", lower, upper, divisions, 3)
    element = element or Hex8()
    _check_element("box", element, 3)
    if plain := element.plain:
        return enrich(box(lower, upper, divisions=divisions, element=plain))
    points = _grid(lower, upper, divisions)
    corner = _cube_corners(divisions)
    if element.num_corners == 8:
        cells = np.stack([corner[c] for c in (0, 4, 6, 2, 1, 5, 7, 3)], axis=1)
    else:
        paths = kuhn(3)
        odd = [1, 2, 5]  # orders of the axes that turn the tetrahedron over
        paths[odd] = paths[odd][:, [0, 2, 1, 3]]
        cells = np.concatenate([np.stack(corner, axis=1)[:, path] for path in paths])
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


def _check_element(where: str, element: AbstractElement, dim: int) -> None:
    families = AbstractSimplex | AbstractHypercube
    if element.dim != dim or not isinstance(element, families):
        kinds = [k for k in exported_elements() if k.dim == dim and issubclass(k, families)]
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
    return replace(mesh, node_sets=node_sets, facet_sets=facet_sets)


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


def _cube_corners(divisions) -> list[np.ndarray]:
    """Node numbers of the eight corners of every grid cell, x slowest."""
    base = np.stack(np.meshgrid(*map(np.arange, divisions), indexing="ij"), -1).reshape(-1, 3)
    counts = tuple(n + 1 for n in divisions)
    places = (tuple((base + o).T) for o in np.ndindex(2, 2, 2))
    return [np.asarray(np.ravel_multi_index(place, counts)) for place in places]


# Cells between given lines, and a mesh without some of its cells


def between_lines(
    *lines: Float[np.ndarray, " lines"] | Sequence[float], element: AbstractElement
) -> Mesh:
    """Cells between lines across each axis [m]: thin walls, and what lies between, as drawn.

    `between_lines(x, y, element=Quad8())` fills a rectangle, three lists a cuboid. Sets are
    those of `rectangle` and `box`.

    Args:
        *lines: Coordinates of the lines across one axis [m], rising; one list per axis.
        element: The element of the cells.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If a list does not rise, or the element does not fit.
    """
    places = [np.asarray(line, float) for line in lines]
    if len(places) != element.dim or any(
        p.ndim != 1 or len(p) < 2 or np.any(np.diff(p) <= 0) for p in places
    ):
        raise ValueError(
            f"mesh.between_lines: got {len(places)} lists for {element.name}, need "
            f"{element.dim}, each of two or more rising numbers. np.unique sorts them."
        )
    counts: Any = tuple(len(p) - 1 for p in places)
    make: Any = rectangle if element.dim == 2 else box
    grid = make([0.0] * element.dim, counts, divisions=counts, element=element)
    steps = np.asarray(grid.points).T
    points = [np.interp(s, np.arange(len(p)), p) for s, p in zip(steps, places, strict=True)]
    return Mesh(np.stack(points, axis=1), grid.cells, element, grid.node_sets, grid.facet_sets)


def submesh(mesh: Mesh, cells: Int[np.ndarray, " kept"]) -> Mesh:
    """The mesh with the listed cells only, and the nodes that they use.

    Node sets and regions keep what is left of them; facet sets, whose facets may have gone,
    are dropped: choose facets anew with `facets_where` or `facets_on`.

    Args:
        mesh: The mesh.
        cells: Cell numbers to keep.

    Returns:
        The mesh of these cells.
    """
    chosen = np.asarray(cells)
    if not len(chosen):
        raise ValueError("mesh.submesh: got no cells, need one or more.")
    used, inverse = np.unique(np.asarray(mesh.cells)[chosen], return_inverse=True)
    node_sets, regions = _left_of(mesh.node_sets, used), _left_of(mesh.regions, chosen)
    points = np.asarray(mesh.points)[used]
    return Mesh(points, inverse.reshape(len(chosen), -1), mesh.element, node_sets, {}, regions)


def _left_of(sets: dict, kept: np.ndarray) -> dict[str, np.ndarray]:
    """Which of the `kept` numbers are in each set, by their places."""
    return {name: np.flatnonzero(np.isin(kept, np.asarray(ids))) for name, ids in sets.items()}


# Solid meshes from plane ones: extruded, revolved, swept along frames


def extrude(mesh: Mesh, height: float, *, layers: int) -> Mesh:
    """Solid mesh from a plane one, in layers along z.

    Quadrilaterals become `Hex8`, triangles `Tet4` (three per prism). Facet sets of the
    sides carry over, "start" and "end" are the caps; node sets hold all layers.

    Args:
        mesh: A plane mesh of `Tri3` or `Quad4` cells.
        height: Extent from z = 0 on [m]; positive.
        layers: Number of layers of cells.

    Returns:
        The solid mesh, points [m].

    Raises:
        ValueError: If `height` or `layers` is not positive, or the mesh is traced or has other
            cells.

    Example:
        >>> plate = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1))
        >>> block = mesh.extrude(plate, 6 * mm, layers=2)
        >>> block.element.name, block.num_cells
        ('Tet4', 48)
    """
    if not height > 0:
        raise ValueError(f"extrude: `height` is {height} m, need a positive length.")
    flat = _plane_points("extrude", mesh, layers)
    z = np.linspace(0.0, height, layers + 1)
    levels = [np.concatenate([flat, np.full((len(flat), 1), h)], axis=1) for h in z]
    return _stacked(mesh, np.stack(levels), closed=False)


def revolve(mesh: Mesh, *, layers: int, angle: float = 2 * np.pi) -> Mesh:
    """`mesh` turned about the y axis by `angle` [rad], its x being the radius.

    A full turn closes on itself. Triangles may touch the axis, quadrilaterals not.

    Args:
        mesh: A plane mesh.
        layers: Cells around.
        angle: Of the whole turn [rad].

    Returns:
        The solid mesh, points [m].

    Raises:
        ValueError: If nodes have negative radius, or a quadrilateral touches the axis.
    """
    flat = _plane_points("revolve", mesh, layers)
    closed = bool(abs(angle - 2 * np.pi) < 1e-12)
    if not 0 < angle <= 2 * np.pi + 1e-12 or layers < (3 if closed else 1):
        raise ValueError(
            f"revolve: got `angle` {angle} rad and {layers} `layers`, need an angle in "
            "(0, 2 pi] and at least 3 layers for a full turn."
        )
    tiny = 1e-12 * float(np.ptp(flat, axis=0).max())
    if flat[:, 0].min() < -tiny:
        raise ValueError(
            f"revolve: a node has x = {flat[:, 0].min():g} m, need x >= 0, the radius. Move "
            "the section to one side of the y axis."
        )
    axis = flat[:, 0] <= tiny
    if isinstance(mesh.element, Quad4) and axis.any():
        raise ValueError(
            "revolve: quadrilaterals touch the axis, where hexahedra would collapse. Use "
            "triangles, or leave a hole around the axis."
        )
    turn = np.linspace(0.0, angle, layers + 1)[: layers if closed else None]
    r, y = flat.T
    levels = [np.stack([r * np.cos(t), y, r * np.sin(t)], axis=1) for t in turn]
    return _stacked(mesh, np.stack(levels), closed, axis)


def sweep(mesh: Mesh, frames: np.ndarray) -> Mesh:
    """`mesh` carried along `frames`, (stations, 4, 4) poses; its z axis is the way on.

    Each frame is a homogeneous matrix that takes (x, y, 0) to space.

    Args:
        mesh: A plane mesh.
        frames: Pose of each station.

    Returns:
        The solid mesh, points [m].
    """
    frames = np.asarray(frames, dtype=float)
    if frames.ndim != 3 or frames.shape[1:] != (4, 4) or len(frames) < 2:
        raise ValueError(f"sweep: `frames` has shape {frames.shape}, need (at least 2, 4, 4).")
    flat = _plane_points("sweep", mesh, len(frames) - 1)
    flat = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    levels = np.einsum("sij,nj->sni", frames[:, :3, :3], flat) + frames[:, None, :3, 3]
    return _stacked(mesh, levels, closed=False)


def _plane_points(where: str, mesh: Mesh, layers: int) -> np.ndarray:
    if is_traced(mesh):
        raise ValueError(f"{where}: the mesh is traced, need concrete points. Call it outside.")
    if not isinstance(mesh.element, Tri3 | Quad4):
        raise ValueError(
            f"{where}: got {mesh.element.name} cells, need Tri3 or Quad4. Mesh with order=1."
        )
    if layers < 1:
        raise ValueError(f"{where}: got {layers} `layers`, need at least 1.")
    return np.asarray(mesh.points)


def _stacked(mesh: Mesh, levels: np.ndarray, closed: bool, axis=None) -> Mesh:
    stations, n = levels.shape[:2]
    number = np.arange(stations * n).reshape(stations, n)
    if axis is not None:
        number[:, axis] = number[0, axis]
    flat = np.asarray(mesh.cells)
    below, above = number, np.roll(number, -1, axis=0)
    if not closed:
        below, above = below[:-1], above[:-1]
    low, high = below[:, flat].reshape(-1, flat.shape[1]), above[:, flat]
    high = high.reshape(-1, flat.shape[1])
    points = levels.reshape(-1, 3)
    if flat.shape[1] == 4:
        cells, element = np.concatenate([low, high], axis=1), Hex8()
    else:
        cells, element = _prisms(points, low, high), Tet4()
    used, cells = np.unique(cells, return_inverse=True)
    solid = Mesh(points[used], cells.reshape(-1, element.num_nodes), element)
    return _carry_sets(mesh, solid, used // n, used % n, stations, closed)


def _prisms(points, low, high) -> np.ndarray:
    cells = np.concatenate(wedge(*low.T, *high.T))
    ordered = np.sort(cells, axis=1)
    cells = cells[(np.diff(ordered, axis=1) > 0).all(axis=1)]
    volume = signed_volumes(points[cells])
    return np.where((volume < 0)[:, None], cells[:, [0, 1, 3, 2]], cells)


def _carry_sets(mesh: Mesh, solid: Mesh, station, base, stations: int, closed: bool) -> Mesh:
    facets = boundary_facets(solid)
    roots = base[facets]
    low, high = roots.min(axis=1), roots.max(axis=1)
    # A side facet stands on two nodes of one edge; a cap has three or four.
    side = ((roots == low[:, None]) | (roots == high[:, None])).all(axis=1)
    keys = low * np.int64(mesh.num_nodes) + high
    facet_sets = {}
    for name, edges in mesh.facet_sets.items():
        ends = np.sort(np.asarray(edges)[:, :2], axis=1)
        own = np.isin(keys, ends @ np.array([mesh.num_nodes, 1], np.int64))
        facet_sets[name] = facets[side & own]
    if not closed:
        for name, place in (("start", 0), ("end", stations - 1)):
            facet_sets[name] = facets[~side & (station[facets].max(axis=1) == place)]
    facet_sets["boundary"] = facets
    return replace(solid, node_sets=_left_of(mesh.node_sets, base), facet_sets=facet_sets)


# A mesh and its mirror image as one mesh, node for node the same on both sides


_SAME = 1e-9  # of the extent: on the plane


def mirror(mesh: Mesh, axis: int, at: float) -> Mesh:
    """`mesh` with its image behind the plane x[axis] = `at` [m]; both share the nodes on it.

    A mesh without symmetry has no bifurcation, only an imperfection. Nodes on the plane are
    moved onto it, images come after them. Sets hold the images too; facets on the plane,
    which no longer bound anything, leave theirs.

    Args:
        mesh: The mesh.
        axis: Number of the axis that the plane stands across.
        at: Place of the plane on that axis [m].

    Returns:
        The mesh of both halves.

    Raises:
        ValueError: For polygons, or if the mesh reaches across the plane.

    Example:
        >>> quarter = mesh.rectangle([0, 0], [20 * mm, 20 * mm], divisions=(2, 2))
        >>> whole = mesh.mirror(mesh.mirror(quarter, 0, 20 * mm), 1, 20 * mm)
        >>> whole.num_cells
        32
    """
    if isinstance(mesh.element, PolyN):
        raise ValueError("mesh.mirror: got polygons, need another kind of cells.")
    points = np.array(mesh.points)
    slack = _SAME * float(np.ptp(points, axis=0).max())
    _check_side(points[:, axis] - at, slack)
    shared = np.abs(points[:, axis] - at) <= slack
    points[shared, axis] = at
    image = points[~shared]
    image[:, axis] = 2 * at - image[:, axis]
    number = np.where(shared, np.arange(len(points)), len(points) - 1 + np.cumsum(~shared))
    cells = np.asarray(mesh.cells)
    facets = {name: _facets(mesh, ids, shared, number) for name, ids in mesh.facet_sets.items()}
    return Mesh(
        np.concatenate([points, image]),
        np.concatenate([cells, number[cells[:, mirror_order(mesh.element)]]]),
        mesh.element,
        {
            name: np.unique(np.concatenate([ids, number[np.asarray(ids)]]))
            for name, ids in mesh.node_sets.items()
        },
        facets,
        {
            name: np.concatenate([ids, np.asarray(ids) + len(cells)])
            for name, ids in mesh.regions.items()
        },
    )


def _facets(mesh: Mesh, ids, shared, number) -> np.ndarray:
    facets = np.asarray(ids)
    facets = facets[~shared[facets].all(axis=1)]
    if mesh.element.dim == 2:
        order = np.array([1, 0, *range(2, facets.shape[1])])
    else:
        order = mirror_order(facet_element(mesh.element))
    return np.concatenate([facets, number[facets[:, order]]])


def _check_side(away: np.ndarray, slack: float) -> None:
    if away.min() < -slack and away.max() > slack:
        raise ValueError(
            f"mesh.mirror: the mesh reaches from {away.min():.3g} to {away.max():.3g} m "
            "about the plane, need all of it on one side. Mesh one half only."
        )

"""Nodes, cells and facets of a mesh chosen by place; all results are host arrays."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import Numbers
from sorojax.mesh.elements.base import facet_corners
from sorojax.mesh.measure import enclosed_volume
from sorojax.mesh.mesh import Mesh, boundary_facets, facet_table
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import connected, values

Predicate = Callable[[Any], Any]
Nodes = Int[np.ndarray, " nodes"]
Cells = Int[np.ndarray, " cells"]
Facets = Int[np.ndarray, "facets facet_nodes"]


def nodes_where(mesh: Mesh, predicate: Predicate) -> Nodes:
    """Nodes whose point satisfies a condition.

    A node that should lie at 0 may lie at 1e-18: compare with a tolerance where the
    place is the result of a computation.

    Args:
        mesh: A concrete mesh.
        predicate: Takes a point [m] to True or False, as in `lambda p: p[0] < 1e-9`.

    Returns:
        Node numbers in rising order; empty if there are none.

    Example:
        >>> plate = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1))
        >>> mesh.nodes_where(plate, lambda p: p[0] < 1e-9).tolist()
        [0, 1]
    """
    return np.flatnonzero(_holds(mesh.points, predicate))


def cells_where(mesh: Mesh, predicate: Predicate) -> Cells:
    """Cells whose centroid (mean of the corners) satisfies `predicate(p)`.

    Args:
        mesh: The mesh.
        predicate: Takes a point [m] to True or False.

    Returns:
        Cell numbers in rising order.
    """
    corners = np.asarray(mesh.cells)[:, : mesh.element.num_corners]
    return np.flatnonzero(_holds(np.asarray(mesh.points)[corners].mean(axis=1), predicate))


def facets_where(mesh: Mesh, predicate: Predicate) -> Facets:
    """Boundary facets, as node numbers, whose midpoint satisfies `predicate(p)`.

    Args:
        mesh: The mesh.
        predicate: Takes a point [m] to True or False.

    Returns:
        Nodes of the facets, one row per facet.
    """
    facets = boundary_facets(mesh)
    return facets[_holds(_middles(mesh, facets), predicate)]


def facets_on(mesh: Mesh, shape: AbstractSdf, tol: float | None = None) -> Facets:
    """Boundary facets that lie on the zero set of a shape.

    Args:
        mesh: A mesh; the outline of `shape` should be part of its boundary.
        shape: For example the chambers that were cut out of the body.
        tol: Largest distance of a corner from the zero set [m]; 1e-6 of the extent of
            the mesh by default.

    Returns:
        Facets as rows of node numbers, oriented as by `boundary_facets`; empty if there are
        none.

    Example:
        >>> hole = sdf.Circle([5 * mm, 5 * mm], 2 * mm)
        >>> body = sdf.Rectangle([0, 0], [10 * mm, 10 * mm]) - hole
        >>> cells = mesh.triangulate(body, size=2 * mm)
        >>> facets = mesh.facets_on(cells, hole)
        >>> radii = np.linalg.norm(cells.points[facets[:, 0]] - 5 * mm, axis=1)
        >>> bool(len(facets) > 3), bool(np.allclose(radii, 2 * mm))
        (True, True)
    """
    points = np.asarray(mesh.points)
    if tol is None:
        tol = 1e-6 * float(np.ptp(points, axis=0).max())
    facets = boundary_facets(mesh)
    near = np.abs(values(shape, points)) <= tol
    corners = facets[:, : facet_corners(mesh.element)]  # other nodes may lie beside a curve
    ends = points[corners]
    length = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max(axis=1)
    # Both ends of a chord between two curves lie on them, its middle does not; the
    # middle of a straight side on a fillet is off by less than a tenth of its length.
    off = np.abs(values(shape, ends.mean(axis=1)))
    return facets[near[corners].all(axis=1) & (off <= 0.15 * length + tol)]


def nearest_node(mesh: Mesh, point: Float[Any, " dim"]) -> int:
    """The node closest to `point` [m].

    Args:
        mesh: The mesh.
        point: Where to look [m].

    Returns:
        The node number.
    """
    gap = np.asarray(mesh.points) - np.asarray(point, dtype=float)
    return int(np.argmin((gap**2).sum(axis=1)))


def nodes_in_box(
    mesh: Mesh, lower: Float[np.ndarray, " dim"], upper: Float[np.ndarray, " dim"]
) -> Nodes:
    """Nodes between two corners [m], faces included to 1e-9 of the extent.

    Args:
        mesh: The mesh.
        lower: Corner with the lowest coordinates [m].
        upper: Corner with the highest [m].

    Returns:
        Node numbers in rising order.
    """
    points = np.asarray(mesh.points)
    tol = 1e-9 * float(np.ptp(points, axis=0).max())
    low, high = np.asarray(lower, float) - tol, np.asarray(upper, float) + tol
    return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))


def nodes_on_line(
    mesh: Mesh,
    start: Float[np.ndarray, " dim"],
    end: Float[np.ndarray, " dim"],
    tol: float | None = None,
) -> Nodes:
    """Nodes within `tol` [m] of a straight line, in order from `start` to `end` [m].

    Args:
        mesh: The mesh.
        start: First end [m].
        end: Last end [m].
        tol: Distance from the line [m]; 1e-6 of the extent if omitted.

    Returns:
        Node numbers along the line.
    """
    points = np.asarray(mesh.points)
    if tol is None:
        tol = 1e-6 * float(np.ptp(points, axis=0).max())
    a, along = np.asarray(start, float), np.asarray(end, float) - np.asarray(start, float)
    share = np.clip((points - a) @ along / (along @ along), 0, 1)
    gap = np.linalg.norm(points - a - share[:, None] * along, axis=1)
    near = np.flatnonzero(gap <= tol)
    return near[np.argsort(share[near], kind="stable")]


def nodes_inside(mesh: Mesh, shape: AbstractSdf, tol: float = 0.0) -> Nodes:
    """Nodes inside `shape`, or within `tol` [m] of it.

    Args:
        mesh: The mesh.
        shape: The shape.
        tol: Distance outside that still counts [m].

    Returns:
        Node numbers in rising order.
    """
    return np.flatnonzero(values(shape, np.asarray(mesh.points)) <= tol)


def cells_inside(mesh: Mesh, shape: AbstractSdf) -> Cells:
    """Cells whose centroid (mean of the corners) lies inside `shape`.

    Args:
        mesh: The mesh.
        shape: The shape.

    Returns:
        Cell numbers in rising order.
    """
    corners = np.asarray(mesh.cells)[:, : mesh.element.num_corners]
    return np.flatnonzero(values(shape, np.asarray(mesh.points)[corners].mean(axis=1)) < 0)


def named(mesh: Mesh, name: str) -> np.ndarray:
    """The node set, facet set or region called `name`.

    Args:
        mesh: The mesh.
        name: Of a set.

    Returns:
        Node numbers, facets or cell numbers.

    Raises:
        ValueError: If there is none, with the names that exist.
    """
    for sets in (mesh.facet_sets, mesh.node_sets, mesh.regions):
        if name in sets:
            return np.asarray(sets[name])
    known = sorted({*mesh.facet_sets, *mesh.node_sets, *mesh.regions})
    raise ValueError(f"named: the mesh has no set {name!r}, it has {known}. Name one of them.")


def cells_connected(mesh: Mesh, start: Float[np.ndarray, " dim"], walls: Numbers = ()) -> Cells:
    """Cells reached from the one nearest to the point `start` [m] without crossing `walls`.

    Args:
        mesh: Any mesh.
        start: A point in the part that is wanted.
        walls: Facets, as node numbers, that stop the flood: for example an interface.

    Returns:
        Cell numbers in rising order.
    """
    facets, _, _, number = facet_table(mesh)
    order = np.argsort(number, kind="stable")
    same = number[order][1:] == number[order][:-1]
    first, second = order[:-1][same], order[1:][same]
    walls = np.asarray(walls, dtype=int)
    if walls.size:
        count = facet_corners(mesh.element)
        barred = {tuple(w) for w in np.sort(walls[:, :count], axis=1).tolist()}
        corners = np.sort(facets[first][:, :count], axis=1).tolist()
        free = np.array([tuple(c) not in barred for c in corners], dtype=bool)
        first, second = first[free], second[free]
    label = connected(mesh.num_cells, first % mesh.num_cells, second % mesh.num_cells)
    centres = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    home = int(np.argmin(((centres - np.asarray(start, float)) ** 2).sum(axis=1)))
    return np.flatnonzero(label == label[home])


def _middles(mesh: Mesh, facets: np.ndarray) -> np.ndarray:
    return np.asarray(mesh.points)[facets[:, : facet_corners(mesh.element)]].mean(axis=1)


def _holds(points: Array | np.ndarray, predicate: Predicate) -> np.ndarray:
    if not len(points):
        return np.zeros(0, bool)
    return np.asarray(jax.vmap(lambda p: jnp.asarray(predicate(p), dtype=bool))(points))


# Connected pieces of the boundary: outer surfaces and the chambers they enclose


class Chambers(NamedTuple):
    """A mesh with its chambers named.

    Attributes:
        mesh: The mesh with facet sets "chamber_0", "chamber_1", ... from left to right.
        volumes: What each encloses [m^3]; in the plane the area [m^2].
    """

    mesh: Mesh
    volumes: dict[str, float]

    def largest(self, count: int = 1) -> Int[np.ndarray, "facets facet_nodes"]:
        """Walls of the `count` largest chambers.

        Raises:
            ValueError: If there are not so many.
        """
        if not 1 <= count <= len(self.volumes):
            raise ValueError(
                f"Chambers.largest: got count={count}, need 1 to {len(self.volumes)}, as many "
                "as there are. Look at `volumes`."
            )
        names = sorted(self.volumes, key=lambda name: self.volumes[name])[-count:]
        return np.concatenate([np.asarray(self.mesh.facet_sets[name]) for name in names])


def boundary_loops(mesh: Mesh) -> list[Int[np.ndarray, "facets facet_nodes"]]:
    """Connected pieces of the boundary; in the plane in order along each loop.

    Args:
        mesh: The mesh.

    Returns:
        The facets of each piece.
    """
    facets = boundary_facets(mesh)
    corners = facets[:, : facet_corners(mesh.element)]
    rows = np.repeat(corners[:, 0], corners.shape[1] - 1)
    label = connected(mesh.num_nodes, rows, corners[:, 1:].ravel())[corners[:, 0]]
    pieces = [facets[label == k] for k in np.unique(label)]
    return [_in_order(p) for p in pieces] if mesh.element.dim == 2 else pieces


def _in_order(loop: np.ndarray) -> np.ndarray:
    after: dict[int, list[int]] = {}
    for k, a in enumerate(loop[:, 0].tolist()):
        after.setdefault(a, []).append(k)
    order = [after[loop[0, 0]].pop()]
    while after.get(int(loop[order[-1], 1])):
        order.append(after[int(loop[order[-1], 1])].pop())
    # Loops that touch in a node stay together, the second after the first.
    rest = np.setdiff1d(np.arange(len(loop)), order)
    return loop[np.concatenate([order, rest]).astype(int)]


def chambers(mesh: Mesh) -> Chambers:
    """Every closed inner loop or surface as a facet set, and the volume it encloses.

    `enclosed_volume(mesh, facets)` gives the same number differentiably.

    Args:
        mesh: Cells of a body with closed cavities; one that opens to the outside is none.

    Returns:
        `mesh` with the facet sets "chamber_0", ..., from left to right, and `volumes` by these
        names [m^3], in the plane [m^2].
    """
    points = np.asarray(mesh.points)
    found = []
    for loop in boundary_loops(mesh):
        volume = float(enclosed_volume(mesh, loop))
        if volume > 0:
            found.append((tuple(points[loop].mean(axis=(0, 1)).round(12)), volume, loop))
    found.sort(key=lambda each: each[0])
    names = [f"chamber_{i}" for i in range(len(found))]
    sets = {name: loop for name, (_, _, loop) in zip(names, found, strict=True)}
    volumes = {name: volume for name, (_, volume, _) in zip(names, found, strict=True)}
    return Chambers(replace(mesh, facet_sets=mesh.facet_sets | sets), volumes)

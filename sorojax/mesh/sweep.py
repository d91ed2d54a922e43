"""Solid meshes from plane ones: extruded, revolved, swept along frames."""

import numpy as np

from sorojax._jax.trace_state import is_traced
from sorojax.mesh.elements import Hex8, Quad4, Tet4, Tri3
from sorojax.mesh.lattice import wedge
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.tet_shape import signed_volumes


def extrude(mesh: Mesh, height: float, *, layers: int) -> Mesh:
    """`mesh` drawn along z from 0 to `height` [m].

    Quadrilaterals become `Hex8`, triangles `Tet4` (three per prism). Facet sets of the
    sides carry over, "start" and "end" are the caps; node sets hold all layers.
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
    node_sets = {
        name: np.flatnonzero(np.isin(base, np.asarray(ids)))
        for name, ids in mesh.node_sets.items()
    }
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
    return Mesh(solid.points, solid.cells, solid.element, node_sets, facet_sets)

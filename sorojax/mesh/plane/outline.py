"""The fixed part of a plane mesh: points and edges on the boundary and on interfaces."""

from typing import NamedTuple

import numpy as np

from sorojax.math.host import KDTree
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import land, values, values_and_gradients
from sorojax.sdf.surface.marching import Curve, contour, level_curves

_MAX_TURN = np.deg2rad(44.0)  # of one edge on a fillet
_GRADING = 0.35  # growth of the edge length per distance
_SAME = 1e-6  # of the size: points nearer than that are one point
_CROWD = 0.75  # of the edge length: radius around its middle free of strangers
_FINEST = 32  # size over the shortest edge that splitting may leave
_DETAIL = 1 / 200  # of the size: shorter pieces between corners become one point
_BESIDE = 2.0  # of a short piece between corners: most of the edge next to it
_MAX_SPLITS = 12
_BULGE = 0.4  # of an edge: most distance from its middle to the middle of what it stands for


class Outline(NamedTuple):
    """Fixed points and the edges between them.

    Attributes:
        points: (n, 2) [m].
        edges: (m, 2) ends; the domain lies on the left of a boundary edge.
        owner: (m,) 0 for the boundary, 1 + i for interface i.
        corner: (n,) whether a point is a corner or a crossing of curves.
    """

    points: np.ndarray
    edges: np.ndarray
    owner: np.ndarray
    corner: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        ends = self.points[self.edges]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def outline(
    shape: AbstractSdf, interfaces: tuple[AbstractSdf, ...], size: Sizes, looks: int = 4
) -> Outline:
    """Boundary of `shape` and the interfaces inside it, in edges of about `size` [m]; the
    shapes are looked at `looks` times within a size."""
    fields = (shape, *interfaces)
    dense = max(size.smallest, size.largest / 8) / looks
    pieces = [(0, curve) for curve in contour(shape, dense)]
    every = np.concatenate([curve.points for _, curve in pieces])
    margin = 1.37 * dense
    lower, upper = every.min(axis=0) - margin, every.max(axis=0) + margin
    for i, interface in enumerate(interfaces):
        pieces += [(i + 1, c) for c in level_curves(interface, lower, upper, dense)]
    broken = [(i, _break(fields, i, curve)) for i, curve in pieces]
    chains = [(i, part) for i, c in broken for part in _inside_parts(shape, i, c, size.largest)]
    if interfaces and not any(i > 0 for i, _ in chains):
        raise ValueError(
            "triangulate: none of the `interfaces` passes through the shape. Check their "
            "position, or leave them out."
        )
    resampled = [(i, _resample(fields[i], part, size)) for i, part in chains]
    lines = _contracted(_join(resampled, size.smallest), _DETAIL * size.smallest)
    return _split_crowded(fields, lines, size.smallest / _FINEST)


def _break(fields, owner: int, curve: Curve) -> Curve:
    """`curve` with a corner wherever another field changes sign along it."""
    points, corner = curve.points, curve.corner
    for other, field in enumerate(fields):
        # A boundary is broken by the interfaces, an interface by everything else.
        if other == owner:
            continue
        f = values(field, points)
        count = len(points) if curve.closed else len(points) - 1
        first = np.arange(count)
        second = (first + 1) % len(points)
        cut = f[first] * f[second] < 0
        first, second = first[cut], second[cut]
        share = (f[first] / (f[first] - f[second]))[:, None]
        guess = points[first] + share * (points[second] - points[first])
        crossing = _meet(fields[owner], field, guess)
        where = np.concatenate([np.arange(len(points)), first + 0.5])
        order = np.argsort(where, kind="stable")
        points = np.concatenate([points, crossing])[order]
        corner = np.concatenate([corner, np.ones(len(crossing), bool)])[order]
    return Curve(points, corner, curve.closed)


def _meet(a: AbstractSdf, b: AbstractSdf, points: np.ndarray) -> np.ndarray:
    """Where both fields are zero, from `points` by Newton's method."""
    points = points.copy()
    for _ in range(12 if len(points) else 0):
        (f, df), (g, dg) = values_and_gradients(a, points), values_and_gradients(b, points)
        matrix = np.stack([df, dg], axis=1)
        flat = np.abs(np.linalg.det(matrix)) < 1e-6
        matrix[flat] = np.eye(2)
        move = np.linalg.solve(matrix, np.stack([f, g], axis=1)[..., None])[..., 0]
        points -= np.where(flat[:, None], 0.0, move)
    return points


def _inside_parts(shape, owner: int, curve: Curve, size: float) -> list[Curve]:
    """Boundary curves as they are; interfaces cut down to the parts inside `shape`."""
    if owner == 0:
        return [curve]
    n = len(curve.points)
    shift = int(np.argmax(curve.corner)) if curve.closed and curve.corner.any() else 0
    order = (np.arange(n + (1 if curve.closed else 0)) + shift) % n
    points, corner = curve.points[order], curve.corner[order]
    inside = values(shape, (points[1:] + points[:-1]) / 2) < -1e-3 * size
    if curve.closed and inside.all():
        return [curve]
    starts = np.flatnonzero(inside & ~np.r_[False, inside[:-1]])
    stops = np.flatnonzero(inside & ~np.r_[inside[1:], False]) + 1
    parts = []
    for a, b in zip(starts, stops, strict=True):
        ends = corner[a : b + 1].copy()
        ends[[0, -1]] = True
        parts.append(Curve(points[a : b + 1], ends, False))
    return parts


def _resample(field: AbstractSdf, curve: Curve, size: Sizes) -> Curve:
    """`curve` in edges of about `size`, shorter where it bends, corners kept."""
    points, corner = curve.points, curve.corner
    if curve.closed:
        shift = int(np.argmax(corner)) if corner.any() else 0
        order = (np.arange(len(points) + 1) + shift) % len(points)
        points, corner = points[order], corner[order].copy()
        corner[[0, -1]] = True
    wanted = _spacing(field, points, corner, size)
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    density = np.r_[0, np.cumsum(step * 2 / (wanted[1:] + wanted[:-1]))]
    stops = np.flatnonzero(corner)
    least = 3 if curve.closed and len(stops) == 2 else 1
    targets, starts = [], [0]
    for a, b in zip(stops[:-1], stops[1:], strict=True):
        count = max(least, int(np.ceil(density[b] - density[a] - 0.15)))
        targets.append(np.linspace(density[a], density[b], count + 1)[:-1])
        starts.append(starts[-1] + count)
    target = np.concatenate([*targets, density[-1:]])
    new = np.stack([np.interp(target, density, points[:, k]) for k in (0, 1)], axis=-1)
    fixed = np.zeros(len(target), bool)
    fixed[starts] = True
    new[~fixed] = land(field, new[~fixed])
    new[fixed] = points[stops]
    if not curve.closed:
        return Curve(new, fixed, False)
    fixed[0] = curve.corner.any()
    return Curve(new[:-1], fixed[:-1], True)


def _spacing(field, points, corner, size: Sizes) -> np.ndarray:
    """Wanted edge length at each point: bounded turn, bounded growth."""
    g = values_and_gradients(field, points)[1]
    angle = np.arctan2(g[:, 1], g[:, 0])
    turn = np.abs((np.diff(angle) + np.pi) % (2 * np.pi) - np.pi)
    turn[corner[1:] | corner[:-1]] = 0.0  # a corner ends an edge anyway
    step = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-6 * size.largest)
    bend = np.r_[turn / step, 0.0]
    bend = np.maximum(bend, np.r_[0.0, bend[:-1]])
    wanted = np.minimum(size(points), _MAX_TURN / np.maximum(bend, 1e-9 / size.largest))
    stops = np.flatnonzero(corner)
    piece = np.diff(np.r_[0, np.cumsum(step)][stops])
    piece = np.where(piece < _DETAIL * size.smallest, np.inf, _BESIDE * piece)
    for ends in (stops[:-1], stops[1:]):
        wanted[ends] = np.minimum(wanted[ends], piece)
    for i in range(1, len(points)):
        wanted[i] = min(wanted[i], wanted[i - 1] + _GRADING * step[i - 1])
    for i in range(len(points) - 2, -1, -1):
        wanted[i] = min(wanted[i], wanted[i + 1] + _GRADING * step[i])
    return wanted


def _join(chains, size: float) -> Outline:
    """One list of points; ends of chains that coincide become one point."""
    points, corner, edges, owner, start = [], [], [], [], 0
    for i, curve in chains:
        n = len(curve.points)
        first = np.arange(n if curve.closed else n - 1)
        edges.append(start + np.stack([first, (first + 1) % n], axis=-1))
        owner.append(np.full(len(first), i))
        points.append(curve.points)
        corner.append(curve.corner)
        start += n
    points, corner = np.concatenate(points), np.concatenate(corner)
    target = np.arange(len(points))
    for a, b in sorted(KDTree(points).query_pairs(_SAME * size)):
        target[b] = target[a]
    used, numbers = np.unique(target, return_inverse=True)
    shared = np.zeros(len(points), bool)
    np.logical_or.at(shared, target, corner)
    edges = numbers[np.concatenate(edges)]
    proper = edges[:, 0] != edges[:, 1]
    return Outline(points[used], edges[proper], np.concatenate(owner)[proper], shared[used])


def _contracted(lines: Outline, least: float) -> Outline:
    """`lines` with edges shorter than `least` [m] drawn together to one of their ends."""
    short = lines.edges[lines.lengths < least]
    if not len(short):
        return lines
    target = np.arange(len(lines.points))
    for a, b in short:
        a, b = target[a], target[b]
        keep, gone = (b, a) if lines.corner[b] and not lines.corner[a] else (a, b)
        target[target == gone] = keep
    corner = lines.corner.copy()
    np.logical_or.at(corner, target, lines.corner)
    edges = target[lines.edges]
    # what is smaller than the detail altogether has become points, or edges there and back
    ways = np.sort(edges, axis=1) @ [len(target), 1]
    _, row, count = np.unique(ways, return_inverse=True, return_counts=True)
    there_and_back = (count[row] == 2) & (lines.owner == 0)
    proper = (edges[:, 0] != edges[:, 1]) & ~there_and_back
    used, numbers = np.unique(edges[proper], return_inverse=True)
    return Outline(
        lines.points[used], numbers.reshape(-1, 2), lines.owner[proper], corner[used]
    )


def _split_crowded(fields, lines: Outline, shortest: float) -> Outline:
    """Split edges until no fixed point lies in the circle over an edge.

    Then every edge is in the Delaunay triangulation of the points, and edges in a
    thin wall are not much longer than the wall is thick. Towards a sharp corner the
    splitting would go on for ever: it ends at edges of length `shortest`.
    """
    for _ in range(_MAX_SPLITS):
        crowded = _crowded(lines) & (lines.lengths > 2 * shortest)
        if not crowded.any():
            return lines
        lines = split(fields, lines, np.flatnonzero(crowded))
    return lines  # what is still crowded may do; the finished mesh is checked


def split(fields, lines: Outline, rows) -> Outline:
    """`lines` with the edges `rows` halved, new points on the zero sets; an edge whose middle
    belongs to another part of a zero set stays."""
    points, edges, owner, corner = lines
    rows = np.asarray(rows)
    middle = points[edges[rows]].mean(axis=1)
    new = middle.copy()
    for i, field in enumerate(fields):
        mine = owner[rows] == i
        new[mine] = land(field, new[mine])
    own = np.linalg.norm(new - middle, axis=1) < _BULGE * lines.lengths[rows]
    new, rows = new[own], rows[own]
    halved = np.zeros(len(edges), bool)
    halved[rows] = True
    number = len(points) + np.arange(len(rows))
    first = np.stack([edges[rows, 0], number], axis=-1)
    second = np.stack([number, edges[rows, 1]], axis=-1)
    return Outline(
        np.concatenate([points, new]),
        np.concatenate([edges[~halved], first, second]),
        np.concatenate([owner[~halved], owner[rows], owner[rows]]),
        np.concatenate([corner, np.zeros(len(new), bool)]),
    )


def _crowded(lines: Outline) -> np.ndarray:
    """Edges with a fixed point in the circle over them, a wider one for strangers.

    The wider circle makes angles in thin walls good and not only legal; next to a
    corner the plain circle must do.
    """
    points, edges = lines.points, lines.edges
    neighbours = [{i} for i in range(len(points))]
    for a, b in edges:
        neighbours[a].add(b)
        neighbours[b].add(a)
    middle, length = points[edges].mean(axis=1), lines.lengths
    near = KDTree(points).query_ball_point(middle, _CROWD * length)
    crowded = np.zeros(len(edges), bool)
    for k, (a, b) in enumerate(edges):
        for p in set(near[k]) - {a, b}:
            related = p in neighbours[a] or p in neighbours[b]
            reach = 0.5001 if related else _CROWD
            crowded[k] |= np.linalg.norm(points[p] - middle[k]) < reach * length[k]
    return crowded

"""Loads that are no arrows: torques, springs, beds, rigid parts, walls of cavities."""

import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.fem import Problem
from sorojax.fem.loads import AbstractLoad
from sorojax.mesh.elements import facet_corners
from sorojax.view import style
from sorojax.view.marks import coil, turning
from sorojax.view.quantity import short
from sorojax.view.scene import Dots, Lines, Part, Surface

_SPRING, _RIGID, _TURN, _WALL = (style.COLOURS[k] for k in (2, 0, 4, 1))
_MOST = 24  # springs that are drawn
Points = Float[np.ndarray, "nodes dim"]


def marks_of(
    problem: Problem, load: AbstractLoad, points: Points, size: float
) -> list[Part] | None:
    """The sign of a load on a body of `size` [m] whose nodes are at `points`, None for one
    that has none here."""
    if isinstance(load, fem.Torque):
        return _torque(load, points, size)
    if isinstance(load, fem.Spring):
        return _springs(problem, load, points, size)
    if isinstance(load, fem.Foundation):
        name = f"{load.name}: {_stiffness(load)}"
        return [Dots(points[np.asarray(load.nodes)], _SPRING, 4.0, name)]
    if isinstance(load, fem.Rigid):
        return _rigid(load, points)
    if isinstance(load, fem.SelfContact):
        sides = [load.facets] if load.others is None else [load.facets, load.others]
        rings = _rings(problem, np.concatenate([np.asarray(side) for side in sides]), points)
        return [Lines(rings, style.OBSTACLE, 1.8, name=load.name)]
    return None


def wall_parts(problem: Problem, points: Points) -> list[Part]:
    """Walls of a solid body that are under pressure, which its outside may hide."""
    parts: list[Part] = []
    corners = facet_corners(problem.mesh.element)
    for load in problem.loads:
        if isinstance(load, fem.Pressure) and float(load.value) != 0:
            facets = np.asarray(load.facets)[:, :corners]
            fans = [facets[:, [0, k, k + 1]] for k in range(1, corners - 1)]
            parts.append(Surface(points, np.concatenate(fans), _WALL, name="under pressure"))
    return parts


def _torque(load: fem.Torque, points: Points, size: float) -> list[Part]:
    value = float(load.value)
    centre = points[np.asarray(load.nodes)].mean(axis=0)
    axis = value if load.axis is None else value * np.asarray(load.axis)
    if not value:
        return []
    name = f"{load.name}: {short(abs(value), 'N m')}"
    return turning(centre, axis, 0.08 * size, _TURN, name)


def _springs(problem: Problem, load: fem.Spring, points: Points, size: float) -> list[Part]:
    nodes, ends = np.asarray(load.nodes), np.asarray(load.ends)
    to_nodes = np.issubdtype(ends.dtype, np.integer)
    far = points[ends] if to_nodes else np.broadcast_to(ends, (len(nodes), points.shape[1]))
    some = slice(None, None, max(1, len(nodes) // _MOST))
    starts, far = points[nodes[some]], far[some]
    runs = [coil(a, b, 0.012 * size) for a, b in zip(starts, far, strict=True)]
    parts: list[Part] = [Lines(runs, _SPRING, 1.3, name=f"{load.name}: {_stiffness(load)}")]
    return parts if to_nodes else [*parts, Dots(far, style.HOLD, 4.0)]


def _rigid(load: fem.Rigid, points: Points) -> list[Part]:
    """The nodes, and bars between those that carry the others."""
    first, second = np.triu_indices(len(load.leaders), 1)
    ends = points[np.asarray(load.leaders)]
    bars = [np.stack([ends[a], ends[b]]) for a, b in zip(first, second, strict=True)]
    dots = Dots(points[np.asarray(load.nodes)], _RIGID, 3.0, load.name)
    return [dots, Lines(bars, _RIGID, 1.6)]


def _stiffness(load: fem.Spring | fem.Foundation) -> str:
    return short(float(np.max(np.asarray(load.stiffness))), "N/m")


def _rings(problem: Problem, facets: np.ndarray, points: Points) -> list[np.ndarray]:
    corners = facet_corners(problem.mesh.element)
    closed = [*range(corners), 0] if corners > 2 else [0, *range(2, facets.shape[1]), 1]
    return list(points[facets[:, closed]])

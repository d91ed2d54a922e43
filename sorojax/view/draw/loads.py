"""Supports and loads of a body as parts of a scene: arrows, coils for springs, arcs for
torques.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.fem import Problem
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.loads.rigid import Rigid
from sorojax.fem.supports import AbstractSupport, known_components
from sorojax.mesh.elements.base import facet_corners
from sorojax.mesh.measure import Locations
from sorojax.view import style
from sorojax.view.draw.shapes import obstacle_part
from sorojax.view.raster.scene import Arrows, Dots, Lines, Part, Surface, short

_SWING = np.array([0.0, 0, 1, -1, 1, -1, 1, -1, 0, 0])
_ALONG = np.concatenate([[0.0], np.linspace(0.2, 0.8, 8), [1.0]])
_ARC = 1.5 * np.pi  # rad, of an arc


def coil(
    start: Float[np.ndarray, " dim"], end: Float[np.ndarray, " dim"], width: float
) -> Float[np.ndarray, "points dim"]:
    """The sign of a spring between two places, `width` [m] to each side."""
    along = end - start
    side = across(along / max(float(np.linalg.norm(along)), 1e-300))
    return start + np.outer(_ALONG, along) + width * np.outer(_SWING, side)


def turning(
    centre: Float[np.ndarray, " dim"],
    axis: Float[np.ndarray, "3"] | float,
    radius: float,
    colour: str,
    name: str = "",
) -> list[Part]:
    """An arc with a head about `centre`: counter-clockwise about `axis` in space, in the
    plane by the sign of the number `axis`."""
    if len(centre) == 2:
        first, second = np.array([1.0, 0.0]), np.array([0.0, float(np.sign(axis))])
    else:
        along = np.asarray(axis) / np.linalg.norm(axis)
        first = across(along)
        second = np.cross(along, first)
    angle = np.linspace(0.0, _ARC, 49)
    arc = centre + radius * (np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second))
    ahead = np.cos(_ARC) * second - np.sin(_ARC) * first
    head = Arrows(arc[-1:], 0.45 * radius * ahead[None], colour)
    return [Lines([arc], colour, 1.6, name=name), head]


def across(along: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
    """A unit vector perpendicular to the unit vector `along`, to its left in the plane."""
    if len(along) == 2:
        return np.array([-along[1], along[0]])
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return side / np.linalg.norm(side)


# Loads that are no arrows: torques, springs, beds, rigid parts, walls of cavities


_SPRING, _RIGID, _TURN, _WALL = (style.COLOURS[k] for k in (2, 0, 4, 1))

Points = Float[np.ndarray, "nodes dim"]


def _load(problem: Problem, load: AbstractLoad, points: Points, size: float) -> list[Part]:
    """The sign of a load on a body of `size` [m] whose nodes are at `points`."""
    if isinstance(load, fem.Tendon | fem.Cable):
        line = np.asarray(Locations(load.route.nodes, load.route.weights)(jnp.asarray(points)))
        pull = f": {short(float(load.value), 'N')}" if isinstance(load, fem.Tendon) else ""
        return [Lines([line], style.COLOURS[3], 1.6, name=f"{load.name}{pull}")]
    if isinstance(load, fem.EmbeddedRod):
        runs = list(np.asarray(load.vertices(jnp.asarray(points))))
        return [Lines(runs, style.COLOURS[3], 1.6, name=load.name)]
    if isinstance(load, fem.BondedRod):
        run = points[np.asarray(load.nodes)]
        return [Lines([run], style.COLOURS[3], 1.6, name=load.name)]
    if isinstance(load, fem.Contact):
        shift = None if load.value is None else np.asarray(load.value)
        return obstacle_part(load.obstacle, points, size, shift)
    if isinstance(load, fem.Torque):
        return _torque(load, points, size)
    if isinstance(load, fem.Spring):
        return _springs(problem, load, points, size)
    if isinstance(load, fem.Foundation):
        name = f"{load.name}: {_stiffness(load)}"
        return [Dots(points[np.asarray(load.nodes)], _SPRING, 4.0, name)]
    if isinstance(load, Rigid):
        return _rigid(load, points)
    if isinstance(load, fem.SelfContact):
        sides = [load.facets] if load.others is None else [load.facets, load.others]
        rings = _rings(problem, np.concatenate([np.asarray(side) for side in sides]), points)
        return [Lines(rings, style.OBSTACLE, 1.8, name=load.name)]
    return _arrows(problem, load, points, size)


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


def _rigid(load: Rigid, points: Points) -> list[Part]:
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


# What holds a body and what acts on it, as parts of a scene


_LENGTH = 0.10  # of the body, that of the longest arrow of a load
_MOST = 24  # arrows of one load
_UNITS = {
    fem.Pressure: "Pa", fem.Traction: "Pa", fem.Force: "N", fem.Tendon: "N", fem.Cable: "m",
    fem.Gravity: "m/s$^2$", fem.Contact: "m", fem.Torque: "N m", fem.Spring: "m",
}  # fmt: skip
_SUPPORTS = {"held": style.HOLD, "sliding": style.GREY, "moved": style.COLOURS[3]}


def support_parts(problem: Problem, u: Float[np.ndarray, "nodes dim"]) -> list[Part]:
    """Marks on the nodes that supports hold, where they are now."""
    points = np.asarray(problem.mesh.points) + u
    outer = _boundary_nodes(problem)
    parts: list[Part] = []
    for name in _SUPPORTS:
        group = [s.nodes for s in problem.supports if _kind(s, problem) == name]
        nodes = np.unique(np.concatenate([np.asarray(ids).ravel() for ids in group] or [[]]))
        nodes = nodes.astype(int)
        nodes = nodes[outer[nodes]]
        if len(nodes):
            parts.append(Dots(points[nodes], _SUPPORTS[name], 3.0, name))
    return parts


def load_parts(problem: Problem, u: Float[np.ndarray, "nodes dim"]) -> list[Part]:
    """Arrows of forces, tractions, pressures and weight; lines of cables; obstacles; arcs of
    torques, coils of springs, rigid parts.

    Arrows of one load share one scale; those of different loads do not compare.
    """
    points = np.asarray(problem.mesh.points) + u
    rest = np.asarray(problem.mesh.points)
    size = float(np.linalg.norm(rest.max(axis=0) - rest.min(axis=0)))
    parts: list[Part] = []
    for load in problem.loads:
        parts += _load(problem, load, points, size)
    return parts


def _arrows(problem: Problem, load: AbstractLoad, points: Points, size: float) -> list[Part]:
    """Arrows in proportion to a load that has a direction, named with its size."""
    value = np.asarray(getattr(load, "value", 0.0))
    if isinstance(load, fem.Pressure):
        starts, normals = _facet_frames(problem, _thinned(problem, load.facets), points)
        vectors, strength = -value * normals, float(value)
    elif value.shape != (points.shape[1],):
        return []
    else:
        if isinstance(load, fem.Traction):
            starts, _ = _facet_frames(problem, _thinned(problem, load.facets), points)
        elif isinstance(load, fem.Force):
            starts = points[np.asarray(load.nodes)].mean(axis=0)[None]
        elif isinstance(load, fem.Gravity):
            starts = points.mean(axis=0)[None]
        else:
            return []
        vectors, strength = np.tile(value, (len(starts), 1)), float(np.linalg.norm(value))
    longest = np.linalg.norm(vectors, axis=1).max(initial=0.0)
    if not longest > 0:
        return []
    vectors = vectors * (_LENGTH * size / longest)
    if isinstance(load, fem.Pressure):  # pushes: the head is on the wall
        starts = starts - vectors
    name = f"{load.name}: {short(strength, unit_of(load))}"
    return [Arrows(starts, vectors, style.LOAD, name)]


def unit_of(load: AbstractLoad) -> str:
    """What the value of a load is measured in."""
    return next((unit for kind, unit in _UNITS.items() if isinstance(load, kind)), "")


def _facet_frames(problem: Problem, facets: np.ndarray, points: np.ndarray):
    """Middles and outward unit normals of facets."""
    corners = facet_corners(problem.mesh.element)
    x = points[facets[:, :corners]]
    if corners == 2:
        along = x[:, 1] - x[:, 0]
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    else:
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    return x.mean(axis=1), normal


def _thinned(problem: Problem, facets) -> np.ndarray:
    """At most so many facets, far from each other, that their arrows can be distinguished."""
    facets = np.asarray(facets)
    middles = np.asarray(problem.mesh.points)[facets].mean(axis=1)
    chosen, off = [], np.full(len(facets), np.inf)
    while len(chosen) < min(_MOST, len(facets)):  # the one farthest from those before
        chosen.append(int(np.argmax(off)))
        off = np.minimum(off, np.linalg.norm(middles - middles[chosen[-1]], axis=1))
    return facets[chosen]


def _kind(support: AbstractSupport, problem: Problem) -> str:
    if np.any(np.asarray(support.displacement)):
        return "moved"
    dim = problem.mesh.element.dim
    return "sliding" if len(known_components(support, dim)) < dim else "held"


def _boundary_nodes(problem: Problem) -> np.ndarray:
    from sorojax.mesh import boundary_facets

    mask = np.zeros(problem.mesh.num_nodes, bool)
    mask[np.unique(boundary_facets(problem.mesh))] = True
    return mask

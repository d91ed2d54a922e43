"""What holds a body and what acts on it, as parts of a scene."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.fem import Problem
from sorojax.fem.loads import AbstractLoad
from sorojax.fem.supports import AbstractSupport, known_components
from sorojax.mesh.elements import facet_corners
from sorojax.mesh.locate import Locations
from sorojax.view import style
from sorojax.view.load_marks import marks_of
from sorojax.view.quantity import short
from sorojax.view.scene import Arrows, Dots, Lines, Part
from sorojax.view.shapes import obstacle_part

_LENGTH = 0.10  # of the body, that of the longest arrow of a load
_MOST = 24  # arrows of one load
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


def _load(problem: Problem, load: AbstractLoad, points: np.ndarray, size: float) -> list[Part]:
    if isinstance(load, fem.Tendon | fem.Cable):
        line = np.asarray(Locations(load.route.nodes, load.route.weights)(jnp.asarray(points)))
        pull = f": {short(float(load.value), 'N')}" if isinstance(load, fem.Tendon) else ""
        return [Lines([line], style.COLOURS[3], 1.6, name=f"{load.name}{pull}")]
    if isinstance(load, fem.Contact):
        shift = None if load.value is None else np.asarray(load.value)
        return obstacle_part(load.obstacle, points, size, shift)
    marks = marks_of(problem, load, points, size)
    if marks is not None:
        return marks
    found = _arrows(problem, load, points)
    if found is None:
        return []
    starts, vectors, name = found
    length = np.linalg.norm(vectors, axis=1)
    if not len(length) or not length.max() > 0:
        return []
    vectors = vectors * (_LENGTH * size / length.max())
    if isinstance(load, fem.Pressure):  # pushes: the head is on the wall
        starts = starts - vectors
    return [Arrows(starts, vectors, style.LOAD, name)]


def _arrows(problem: Problem, load: AbstractLoad, points: np.ndarray):
    """Starts, vectors in proportion to the load, and a name with the size."""
    if isinstance(load, fem.Pressure):
        facets = _thinned(np.asarray(load.facets))
        middle, normal = _facet_frames(problem, facets, points)
        value = float(load.value)
        return middle, -value * normal, f"{load.name}: {short(value, 'Pa')}"
    value = np.asarray(getattr(load, "value", 0.0))
    if value.shape != (points.shape[1],):
        return None
    size = float(np.linalg.norm(value))
    if isinstance(load, fem.Traction):
        facets = _thinned(np.asarray(load.facets))
        middle, _ = _facet_frames(problem, facets, points)
        return middle, np.tile(value, (len(middle), 1)), f"{load.name}: {short(size, 'Pa')}"
    if isinstance(load, fem.Force):
        at = points[np.asarray(load.nodes)].mean(axis=0)
        return at[None], value[None], f"{load.name}: {short(size, 'N')}"
    if isinstance(load, fem.Gravity):
        middle = points.mean(axis=0)
        return middle[None], value[None], f"{load.name}: {short(size, 'm/s$^2$')}"
    return None


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


def _thinned(facets: np.ndarray) -> np.ndarray:
    """At most so many facets that their arrows can be told apart."""
    step = max(1, len(facets) // _MOST)
    return facets[::step]


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

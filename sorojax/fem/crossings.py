"""Sides of a deformed body that pass through each other, where no contact keeps them apart."""

import numpy as np
from jaxtyping import Float, Int

from sorojax._types import Numbers
from sorojax.fem.problem import Problem
from sorojax.mesh.elements.base import facet_corners
from sorojax.mesh.mesh import boundary_facets
from sorojax.sdf.trimesh.tree import crossing_triangles


def self_crossings(problem: Problem, u: Numbers) -> Int[np.ndarray, "crossings 2"]:
    """Pairs of boundary facets that pass through each other in a deformed body.

    Neither `fem.solve` nor `fem.simulate` keeps a body from passing through itself unless its
    sides are in a `fem.SelfContact`; what they find then is an equilibrium, but of no real
    body. Sides are taken as straight between their nodes, faces as flat between their corners.
    Facets that touch, or lie in one plane, do not cross.

    Args:
        problem: Body.
        u: Displacement of the nodes [m], (nodes, dim).

    Returns:
        Numbers of facets in `mesh.boundary_facets(problem.mesh)`, one pair a row; at most
        1000 in space.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 2))
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4)
        >>> problem = fem.problem(bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...                       supports=(fem.Fixed(bar.node_sets["left"]),))
        >>> still = 0 * bar.points
        >>> len(fem.self_crossings(problem, still))
        0

    Reference:
        Ericson, Real-Time Collision Detection, 2004, section 5.1.9, for segments.
    """
    facets = boundary_facets(problem.mesh)
    x = np.asarray(problem.mesh.points) + np.asarray(u)
    if problem.mesh.element.dim == 2:
        return _crossing_sides(x, facets)
    corners = facets[:, : facet_corners(problem.mesh.element)]
    fans = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
    found = crossing_triangles(x, np.concatenate(fans)) % len(facets)
    return np.unique(np.sort(found, axis=1), axis=0)


def _crossing_sides(
    x: Float[np.ndarray, "nodes 2"], facets: Int[np.ndarray, "facets facet_nodes"]
) -> Int[np.ndarray, "crossings 2"]:
    """Of sides in the plane, each straight from node to node."""
    chains = facets[:, [0, *range(2, facets.shape[1]), 1]]
    ends = np.stack([chains[:, :-1], chains[:, 1:]], axis=2).reshape(-1, 2)
    start, end = x[ends[:, 0]], x[ends[:, 1]]
    first, second = _beside(start, end)
    p, q, r, s = start[first], end[first], start[second], end[second]
    longest = np.abs(end - start).max(initial=0.0)
    rounding = 16 * np.finfo(float).eps * np.abs(x).max(initial=0.0) * longest
    cross = _apart(p, q, r, s, rounding) & _apart(r, s, p, q, rounding)
    found = np.stack([first[cross], second[cross]], axis=1) // (chains.shape[1] - 1)
    return np.unique(np.sort(found, axis=1), axis=0)


def _beside(start, end) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of segments that overlap along the axis in which the body is longest."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    axis = np.argmax(high.max(axis=0) - low.min(axis=0))
    order = np.argsort(low[:, axis])
    last = np.searchsorted(low[order, axis], high[order, axis], side="right")
    count = last - np.arange(len(order)) - 1
    first = np.repeat(np.arange(len(order)), count)
    since = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return order[first], order[first + 1 + since]


def _apart(p, q, r, s, rounding: float) -> np.ndarray:
    """Whether r and s lie on different sides of the line from p to q."""
    first, second = _area(p, q, r), _area(p, q, s)
    return (np.minimum(first, second) < -rounding) & (np.maximum(first, second) > rounding)


def _area(p, q, r) -> np.ndarray:
    """Twice the signed area of triangles."""
    a, b = q - p, r - p
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

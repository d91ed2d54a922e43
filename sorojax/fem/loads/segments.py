"""Where two surfaces of facets that need not match face each other, as pieces on which the
shape functions of both are smooth (on the host)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from sorojax.mesh.elements.base import (
    AbstractElement,
    facet_corners,
    facet_element,
    quadrature,
    shape_functions,
    shape_gradients,
    side_functions,
    side_slopes,
)
from sorojax.mesh.elements.simplex import Tri3

_SLIVER = 1e-9  # of a facet: pieces that are smaller count as none


class Pieces(NamedTuple):
    """Quadrature points of all pieces: the facet of each, the facet that it faces, its place
    on the first and its weight there, such that weights over a whole facet add up to the size
    of the reference facet."""

    facet: Int[np.ndarray, " quad"]
    other: Int[np.ndarray, " quad"]
    at: Float[np.ndarray, "quad dim_minus_1"]
    weights: Float[np.ndarray, " quad"]


class FacetFunctions(NamedTuple):
    """Shape functions of facets at places on them, their slopes, and those of the corners."""

    values: Float[np.ndarray, "quad facet_nodes"]
    slopes: Float[np.ndarray, "quad facet_nodes dim_minus_1"]
    corners: Float[np.ndarray, "quad corners"]


def functions_at(
    element: AbstractElement, at: Float[np.ndarray, "quad dim_minus_1"]
) -> FacetFunctions:
    """Shape functions of the facets of `element` at places on them."""
    if element.dim == 2:
        along = at[:, 0]
        slopes = side_slopes(element.order, along)[:, :, None]
        return FacetFunctions(
            side_functions(element.order, along), slopes, side_functions(1, along)
        )
    face = facet_element(element)
    return FacetFunctions(
        shape_functions(face, at), shape_gradients(face, at), shape_functions(face.linear(), at)
    )


def pieces(
    points: Float[np.ndarray, "nodes dim"],
    element: AbstractElement,
    facets: Int[np.ndarray, "facets facet_nodes"],
    others: Int[np.ndarray, "others facet_nodes"],
) -> Pieces:
    """The overlaps of `facets` with those of `others` that face them.

    Corners are projected along the mean normal of each facet; an overlap is an interval in the
    plane, in space a convex polygon, cut into triangles. Curved facets are cut at the
    projected corners too, so that little is missed there.

    Reference: Puso and Laursen, A mortar segment-to-segment contact method for large
    deformation solid mechanics, CMAME 193, 2004.
    """
    count = facet_corners(element)
    mine, yours = points[facets[:, :count]], points[others[:, :count]]
    cut = _interval if element.dim == 2 else _polygon
    found: list[tuple] = []
    for k, near in enumerate(_near(mine, yours)):
        for j in near:
            at, weights = cut(element, mine[k], yours[j])
            found += [(k, j, x, w) for x, w in zip(at, weights, strict=True)]
    if not found:
        none = np.zeros(0)
        return Pieces(none.astype(int), none.astype(int), none[:, None], none)
    facet, other, at, weights = zip(*found, strict=True)
    return Pieces(np.array(facet), np.array(other), np.array(at), np.array(weights))


def _near(mine: np.ndarray, yours: np.ndarray) -> list[list[int]]:
    """For every facet those of the other side that face it and may overlap with it."""
    centres, seen = mine.mean(axis=1), yours.mean(axis=1)
    radii = np.linalg.norm(mine - centres[:, None], axis=2).max(axis=1)
    reach = np.linalg.norm(yours - seen[:, None], axis=2).max()
    normals, others = _normals(mine), _normals(yours)
    listed = KDTree(seen).query_ball_point(centres, 1.01 * (radii + reach))
    return [[j for j in near if normals[k] @ others[j] < -0.5] for k, near in enumerate(listed)]


def _normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals of facets, outward."""
    if corners.shape[2] == 2:
        along = corners[:, 1] - corners[:, 0]
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    else:
        last = corners[:, 2] if corners.shape[1] == 3 else corners[:, 3]
        normal = np.cross(corners[:, 1] - corners[:, 0], last - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _interval(element, mine, yours) -> tuple[np.ndarray, np.ndarray]:
    along = mine[1] - mine[0]
    ends = np.sort((yours - mine[0]) @ along / (along @ along))
    low, high = max(ends[0], 0.0), min(ends[1], 1.0)
    if high - low < _SLIVER:
        return np.zeros((0, 1)), np.zeros(0)
    at, weights = np.polynomial.legendre.leggauss(element.order + 2)
    share = (low + high) / 2 + (high - low) / 2 * at
    return (2 * share - 1)[:, None], weights * (high - low)


def _polygon(element, mine, yours) -> tuple[np.ndarray, np.ndarray]:
    frame = _plane(mine)
    subject, clip = (x @ frame.T for x in (yours - mine[0], mine - mine[0]))
    subject = subject[::-1]  # seen from the other side
    for start, end in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        subject = _clipped(subject, start, end - start)
        if len(subject) < 3:
            return np.zeros((0, 2)), np.zeros(0)
    rule = quadrature(Tri3(), 2 * element.order)
    places, weights = [], []
    for b, c in zip(subject[1:-1], subject[2:], strict=True):
        edges = np.stack([b - subject[0], c - subject[0]])
        area = abs(np.linalg.det(edges))
        if area > _SLIVER * np.ptp(clip, axis=0).max() ** 2:
            places.append(subject[0] + rule.points @ edges)
            weights.append(rule.weights * area)
    if not places:
        return np.zeros((0, 2)), np.zeros(0)
    at, sizes = _on_facet(element, clip, np.concatenate(places))
    return at, np.concatenate(weights) / sizes


def _plane(corners: np.ndarray) -> np.ndarray:
    """Two directions across the mean normal of a facet."""
    normal = _normals(corners[None])[0]
    first = corners[1] - corners[0]
    first = first - normal * (first @ normal)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _clipped(polygon: np.ndarray, start: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The part of a polygon on the left of a line."""
    away = polygon - start
    side = along[0] * away[:, 1] - along[1] * away[:, 0]
    kept = []
    for k in range(len(polygon)):
        a, b = polygon[k - 1], polygon[k]
        if (side[k - 1] >= 0) != (side[k] >= 0):
            kept.append(a + side[k - 1] / (side[k - 1] - side[k]) * (b - a))
        if side[k] >= 0:
            kept.append(b)
    return np.array(kept).reshape(-1, 2)


def _on_facet(element, corners: np.ndarray, places: np.ndarray):
    """Reference coordinates of places in the plane of a flat facet, and its size over that of
    the reference facet there."""
    face = facet_element(element).linear()
    at = np.full((len(places), 2), 1 / 3)
    for _ in range(6):  # exact after one on triangles and parallelograms
        slopes = np.einsum("qad,ai->qid", shape_gradients(face, at), corners)
        gap = places - shape_functions(face, at) @ corners
        at = at + np.linalg.solve(slopes, gap[..., None])[..., 0]
    slopes = np.einsum("qad,ai->qid", shape_gradients(face, at), corners)
    return at, np.abs(np.linalg.det(slopes))

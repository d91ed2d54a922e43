"""Shape tables of a mesh: one for all cells, or for polygons one per number of corners."""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax.mesh.elements import AbstractElement, PolyN
from sorojax.mesh.shape import (
    Quadrature,
    nodes,
    quadrature,
    shape_functions,
    shape_gradients,
)


class Tables(NamedTuple):
    """Shape functions, their slopes and weights at reference points, by kind of cell.

    Polygons have a kind per number of corners, padded by points of no weight; every other
    element has one kind.
    """

    values: Float[np.ndarray, "kinds quad cell_nodes"]
    slopes: Float[np.ndarray, "kinds quad cell_nodes dim"]
    weights: Float[np.ndarray, "kinds quad"]


def quadrature_tables(element: AbstractElement) -> Tables:
    """Tables at the quadrature points of the stiffness."""
    return _tables(element, "quadrature")


def node_tables(element: AbstractElement) -> Tables:
    """Tables at the nodes."""
    return _tables(element, "nodes")


@cache
def _tables(element: AbstractElement, at: str) -> Tables:
    if not isinstance(element, PolyN):
        rule = _rule(element, at)
        values, slopes = _at(element, rule)
        return Tables(values[None], slopes[None], rule.weights[None])
    kinds = [PolyN(max(n, 3)) for n in range(element.sides + 1)]
    rules = [_rule(kind, at) for kind in kinds]
    most = max(len(rule.weights) for rule in rules)
    rows = [
        _padded(kind, rule, most, element.sides)
        for kind, rule in zip(kinds, rules, strict=True)
    ]
    return Tables(*(np.stack(column) for column in zip(*rows, strict=True)))


def _rule(element: AbstractElement, at: str) -> Quadrature:
    if at == "quadrature":
        return quadrature(element)
    return Quadrature(nodes(element), np.ones(element.num_nodes))


def _at(element: AbstractElement, rule: Quadrature) -> tuple[np.ndarray, np.ndarray]:
    return shape_functions(element, rule.points), shape_gradients(element, rule.points)


def _padded(kind: AbstractElement, rule: Quadrature, num_points: int, num_nodes: int):
    """Tables with the last point repeated without weight, and nodes that do nothing."""
    values, slopes = _at(kind, rule)
    more = num_points - len(rule.weights)
    values = np.pad(np.concatenate([values, values[-1:].repeat(more, 0)]),
                    ((0, 0), (0, num_nodes - kind.num_nodes)))  # fmt: skip
    slopes = np.pad(np.concatenate([slopes, slopes[-1:].repeat(more, 0)]),
                    ((0, 0), (0, num_nodes - kind.num_nodes), (0, 0)))  # fmt: skip
    return values, slopes, np.pad(rule.weights, (0, more))

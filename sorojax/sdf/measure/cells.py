"""The cells that moments are counted in: their frame, their nodes and their parts."""

import functools
import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.measure.simplices import kuhn

SHIFT = 0.3819660113  # cells; of the golden ratio: no face at a fraction falls on nodes
STRAIGHT, BENT = 2e-3, 2e-2  # squared change of slope in a cell: kept as it is, halved
LEVELS = {2: 8, 3: 4}  # halvings of a cell where the field bends
# Cells lie askew in space. All cells along an edge of a box would else be cut alike: what they
# miss would add up, come and go with every cell the edge moves by, and spoil derivatives.
_SPIN = np.array([[0.0, -0.31, 0.23], [0.31, 0.0, -0.17], [-0.23, 0.17, 0.0]])
TURN = np.linalg.solve(np.eye(3) - _SPIN, np.eye(3) + _SPIN)


def turn_of(dim: int) -> np.ndarray:
    """(dim, dim) of the cells against the axes."""
    return TURN if dim == 3 else np.eye(2)


class Rule(NamedTuple):
    """How to count, all of it fixed numbers.

    Attributes:
        where: Public name of the verb.
        dim: Of the shape.
        resolution: Cells along the longest side of the box.
        order: Highest degree of a moment.
        most: Cells of one level that may hold surface, where the shape is traced.
    """

    where: str
    dim: int
    resolution: int
    order: int
    most: int


@eqx.filter_jit
def frame(shape: AbstractSdf, resolution: int) -> tuple[Float[Array, " dim"], Float[Array, ""]]:
    """Middle of the bounding box and cell size [m], differentiable."""
    lower, upper = (jnp.asarray(c, dtype=jnp.result_type(float)) for c in shape.bounding_box())
    return (lower + upper) / 2, jnp.max(upper - lower) / resolution


@functools.cache
def lattice_of(dim: int) -> np.ndarray:
    """The 3^dim nodes of a cell and its halves, in shares of its edge."""
    return np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=dim)))


@functools.cache
def halves_of(dim: int) -> np.ndarray:
    """Lower corners of the 2^dim halves of a cell, in shares of its edge."""
    return np.array(list(itertools.product((0.0, 0.5), repeat=dim)))


@functools.cache
def parts_of(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplices of the cell and of its halves as nodes, and the factor of each."""
    stride = 3 ** np.arange(dim - 1, -1, -1)
    corners = np.array(list(itertools.product((0, 1), repeat=dim)))
    rows = kuhn(dim)
    coarse = (2 * corners @ stride)[rows]
    fine = [((corners + start) @ stride)[rows] for start in corners]
    factor = np.concatenate([np.full(len(rows), -1 / 3), np.full(len(rows) << dim, 4 / 3)])
    return np.concatenate([coarse, *fine]), factor


@functools.cache
def differences_of(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that take second and first differences along all lines of three nodes."""
    unit = np.eye(3**dim).reshape(*dim * (3,), 3**dim)
    second, first = [], []
    for axis in range(dim):
        a, b, c = np.moveaxis(unit, axis, 0)
        second.append((a - 2 * b + c).reshape(-1, 3**dim))
        first.append((c - a).reshape(-1, 3**dim))
    return np.concatenate(second), np.concatenate(first)

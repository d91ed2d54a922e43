"""Multigrid as a preconditioner: numbers on the index maps of `aggregation`, in pure JAX.

One cycle is a symmetric positive definite map also where the matrix is not definite: the
smoother is a Chebyshev polynomial that is positive on both sides of zero, and the coarsest
matrix enters by the absolute values of its eigenvalues. So conjugate gradients can go on
and see how many eigenvalues are negative.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.aggregation import Hierarchy, Level
from sorojax.math.block_rows import BlockMatrix, block_matrix, folded, sum_products

_DEGREE = 3  # of the smoother
_SHARE = 0.07  # of the spectrum, from below, that the smoother leaves to coarser levels
_POWER_STEPS = 10
_SAFETY = 1.1  # the power method finds the largest eigenvalue from below


class Grid(NamedTuple):
    """One level: the matrix, the inverse of its diagonal, a bound of the eigenvalues of
    their product, and the ways to and from the next level."""

    matrix: BlockMatrix
    inverse: Float[Array, "nodes unknowns"]
    largest: Float[Array, ""]
    prolongation: BlockMatrix
    restriction: BlockMatrix


class Multigrid(NamedTuple):
    """All levels of one matrix A; `sums` are those of |A| along its rows, `coarse` is the
    inverse of the coarsest matrix."""

    matrix: BlockMatrix
    sums: Float[Array, "nodes unknowns"]
    grids: tuple[Grid, ...]
    coarse: Float[Array, "coarse coarse"]


@jax.jit
def multigrid(maps: Hierarchy, values: Float[Array, " nnz"]) -> Multigrid:
    """The levels of the matrix that has these values in the pattern of the system."""
    blocks = values.at[maps.entries].get(mode="fill", fill_value=0)
    finest = block_matrix(maps.matrices[0], blocks)
    sums = folded(finest.more, jnp.sum(jnp.abs(finest.values), axis=2))
    grids = []
    for number, (rows, level) in enumerate(zip(maps.matrices, maps.levels, strict=False)):
        matrix = block_matrix(rows, blocks) if number else finest
        tentative = jax.lax.stop_gradient(level.tentative).astype(values.dtype)
        if number == 0:  # unknowns that supports decide take no part
            free = sums > jnp.abs(_diagonal(level, blocks))
            tentative = jnp.where(free[:, :, None], tentative, jnp.zeros_like(tentative))
        grid, blocks = _grid(level, matrix, blocks, tentative)
        grids.append(grid)
    return Multigrid(finest, sums, tuple(grids), _coarse_inverse(maps, blocks))


def _grid(level: Level, matrix: BlockMatrix, blocks, tentative) -> tuple[Grid, Array]:
    """One level, and the blocks of the matrix of the next."""
    size = jnp.abs(_diagonal(level, blocks))
    empty = size <= _nothing(size)
    inverse = jnp.where(empty, jnp.zeros_like(size), 1 / jnp.where(empty, 1.0, size))
    largest = _largest_eigenvalue(matrix, inverse)
    spread = sum_products(level.smoothing, blocks, tentative)
    damping = (4 / 3 / largest) * inverse[level.prolonged]
    smooth = (-damping[:, :, None] * spread).at[level.owned].add(tentative)
    back = jnp.swapaxes(smooth, 1, 2)
    coarser = sum_products(level.galerkin, back, sum_products(level.applied, blocks, smooth))
    ways = block_matrix(level.prolongation, smooth), block_matrix(level.restriction, back)
    return Grid(matrix, inverse, largest, *ways), coarser


def _diagonal(level: Level, blocks: Float[Array, "blocks a a"]) -> Float[Array, "nodes a"]:
    return jnp.diagonal(blocks[level.diagonal], axis1=1, axis2=2)


def _nothing(size: Array) -> Array:
    """What is zero to rounding beside the largest entry."""
    return 100 * jnp.finfo(size.dtype).eps * jnp.max(size)


def _largest_eigenvalue(matrix: BlockMatrix, inverse: Array) -> Float[Array, ""]:
    """Of D^-1 A, by power steps on D^-1/2 A D^-1/2."""
    root = jnp.sqrt(inverse)

    def step(_, state):
        way, _ = state
        way = root * (matrix @ (root * way))
        size = jnp.linalg.norm(way)
        return way / jnp.where(size > 0, size, 1.0), size

    number = jnp.arange(inverse.size, dtype=jnp.uint32)
    mixed = number * number * jnp.uint32(2654435761)  # signs without an order
    start = jnp.where(mixed >> 31 == 0, 1.0, -1.0).astype(root.dtype).reshape(root.shape)
    _, size = jax.lax.fori_loop(0, _POWER_STEPS, step, (start, jnp.zeros((), start.dtype)))
    return jnp.where(size > 0, _SAFETY * size, 1.0)


def _coarse_inverse(maps: Hierarchy, blocks: Float[Array, "blocks a a"]) -> Array:
    """Dense |A|^-1 of the coarsest matrix."""
    count, unknowns = maps.num_coarse, blocks.shape[1]
    dense = jnp.zeros((count, count, unknowns, unknowns), blocks.dtype)
    dense = dense.at[maps.rows, maps.cols].set(blocks)
    dense = jnp.swapaxes(dense, 1, 2).reshape(count * unknowns, -1)
    dense = jnp.where(jnp.isfinite(dense), (dense + dense.T) / 2, 0.0)
    size = jnp.abs(jnp.diagonal(dense))
    dense = dense + jnp.diag(jnp.where(size <= _nothing(size), jnp.max(size), 0.0))
    factor = jnp.linalg.cholesky(dense)

    def definite():
        eye = jnp.eye(len(dense), dtype=dense.dtype)
        return jax.scipy.linalg.cho_solve((factor, True), eye)

    def indefinite():
        eigenvalues, modes = jnp.linalg.eigh(dense)
        size = jnp.abs(eigenvalues)
        return (modes / jnp.maximum(size, _nothing(size))[None]) @ modes.T

    return jax.lax.cond(jnp.all(jnp.isfinite(factor)), definite, indefinite)


def cycle(levels: Multigrid, r: Float[Array, "nodes unknowns"]) -> Array:
    """What the preconditioner makes of a residual: one V-cycle from zero."""
    return _cycle(levels.grids, levels.coarse, r)


def _cycle(grids: tuple[Grid, ...], coarse: Array, r: Array) -> Array:
    if not grids:
        return (coarse @ r.ravel()).reshape(r.shape)
    grid = grids[0]
    before, r = _smoothed(grid, r)
    below = grid.prolongation @ _cycle(grids[1:], coarse, grid.restriction @ r)
    after, _ = _smoothed(grid, r - grid.matrix @ below)
    return before + below + after


def _smoothed(grid: Grid, r: Array) -> tuple[Array, Array]:
    """Chebyshev steps from zero and the residual after them.

    Reference: Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 12.1.
    """
    centre, radius = (grid.largest * (1 + sign * _SHARE) / 2 for sign in (1, -1))
    ratio = centre / radius
    share, step = 1 / ratio, grid.inverse * r / centre
    x = step
    for _ in range(_DEGREE - 1):
        r = r - grid.matrix @ step
        next_share = 1 / (2 * ratio - share)
        step = next_share * share * step + 2 * next_share / radius * grid.inverse * r
        x, share = x + step, next_share
    return x, r - grid.matrix @ step

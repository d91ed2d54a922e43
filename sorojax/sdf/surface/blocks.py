"""The cells of a grid that a surface may cross, found without evaluating the others.

Blocks of 64 cells are halved down to 8 wherever |f| at the centre is within reach of
the Lipschitz constant; what is left is sampled in batches of one fixed size.
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sorojax._progress import report
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.sampling import finite_box, in_pieces, raise_empty, values

LEAF = 8  # cells along a block
_TOP = 64
_BATCH = 64  # blocks per call of the compiled kernel
_MOST = 4_000_000  # blocks held at a time: about 12 GB of field values
_BITS = np.array(list(np.ndindex(2, 2, 2)))


class Grid(NamedTuple):
    """Cubic cells of edge `size` [m] from `lower` [m]; `counts` are multiples of 8."""

    lower: np.ndarray
    size: float
    counts: np.ndarray

    def points(self, nodes: np.ndarray) -> np.ndarray:
        """Positions [m] of (fractional) node numbers."""
        return self.lower + self.size * nodes

    def number(self, nodes: np.ndarray) -> np.ndarray:
        """One integer for each node (n, 3)."""
        wide = self.counts + 1
        return (nodes[..., 0] * wide[1] + nodes[..., 1]) * wide[2] + nodes[..., 2]

    def node(self, number: np.ndarray) -> np.ndarray:
        """Nodes (n, 3) of their integers."""
        rest, k = np.divmod(number, self.counts[2] + 1)
        i, j = np.divmod(rest, self.counts[1] + 1)
        return np.stack([i, j, k], axis=-1)


def grid_around(where: str, shape: AbstractSdf, size: float) -> Grid:
    """A grid that holds the surface of `shape` with more than a cell to spare."""
    if not (np.isfinite(size) and size > 0):
        raise ValueError(f"{where}: `size` must be positive, got {size} m.")
    lower, upper = finite_box(where, shape, 3)
    # An odd margin, so that flat faces seldom fall on grid nodes.
    margin = 1.37 * size
    counts = np.ceil((upper - lower + 2 * margin) / size / LEAF) * LEAF
    if np.prod(np.ceil(counts / _TOP)) > _MOST:
        _refuse(where, size, float((upper - lower).max()))
    return Grid(lower - margin, float(size), counts.astype(np.int64))


def _refuse(where: str, size: float, extent: float) -> None:
    raise ValueError(
        f"{where}: cells of {size:g} m over {extent:g} m take more than {_MOST} blocks of "
        f"{LEAF}^3 cells, which does not fit in memory. Raise `size`."
    )


def active_blocks(where: str, shape: AbstractSdf, grid: Grid) -> np.ndarray:
    """First nodes (n, 3) of the blocks of 8^3 cells that may hold surface, in order."""
    axes = [np.arange(0, n, _TOP) for n in grid.counts]
    blocks = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    edge = _TOP
    while True:
        f = values(shape, grid.points(blocks + edge / 2))
        if np.isnan(f).any():
            raise ValueError(
                f"{where}: the field of the shape is NaN at {np.isnan(f).sum()} points, need "
                "numbers. Check its parameters."
            )
        # The margin keeps values at the walls of a dropped block away from zero.
        reach = shape.lipschitz * grid.size * edge * 3**0.5 / 2
        blocks = blocks[np.abs(f) <= reach * (1 + 1e-4)]
        if edge == LEAF:
            break
        edge //= 2
        if 8 * len(blocks) > 8 * _MOST:
            _refuse(where, grid.size, grid.size * float(grid.counts.max()))
        blocks = (blocks[:, None] + edge * _BITS).reshape(-1, 3)
        blocks = blocks[(blocks < grid.counts).all(axis=1)]
    if not len(blocks):
        raise_empty(where, grid.lower, grid.points(grid.counts), grid.size)
    return blocks[np.argsort(grid.number(blocks), kind="stable")]


@eqx.filter_jit
def _sample(shape, corners, size):
    """Field [m] at the 9^3 nodes of every block."""
    step = size * jnp.arange(LEAF + 1, dtype=corners.dtype)
    full = (len(corners), LEAF + 1, LEAF + 1, LEAF + 1)
    x = corners[:, 0, None, None, None] + step[None, :, None, None]
    y = corners[:, 1, None, None, None] + step[None, None, :, None]
    z = corners[:, 2, None, None, None] + step[None, None, None, :]
    at = (jnp.broadcast_to(c, full) for c in (x, y, z))
    field = cast(shape, corners.dtype).distance(*at) / size
    return jnp.broadcast_to(field, full).astype(jnp.float32)


def _sampled(shape: AbstractSdf, grid: Grid, blocks: np.ndarray) -> np.ndarray:
    """Field in cells (n, 9, 9, 9) of `blocks`."""
    if not len(blocks):
        return np.zeros((0, LEAF + 1, LEAF + 1, LEAF + 1), np.float32)
    dtype = jnp.result_type(float)
    corners, size = grid.points(blocks).astype(dtype), jnp.asarray(grid.size, dtype=dtype)
    return in_pieces(lambda at: _sample(shape, at, size), _BATCH, corners)[0]


def leaf_fields(
    shape: AbstractSdf, grid: Grid, blocks: np.ndarray, least: int = 2048
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Groups of `blocks` with their field in cells (n, 9, 9, 9), equal where they touch.

    A group has `least` blocks or more, and all that have the same first coordinate.
    """
    groups = _groups(blocks, least)
    done = 0
    field = _sampled(shape, grid, groups[0])
    for now, ahead in zip(groups, [*groups[1:], groups[0][:0]], strict=True):
        next_field = _sampled(shape, grid, ahead)
        _share(grid, now, field, ahead, next_field)
        yield now, field
        field, done = next_field, done + len(now)
        report("isosurface", done, len(blocks))


def _groups(blocks: np.ndarray, least: int) -> list[np.ndarray]:
    """`blocks` cut where their first coordinate changes, into pieces of similar length."""
    starts = np.flatnonzero(np.diff(blocks[:, 0], prepend=-1))
    keep = [0]
    for start in starts:
        if start - keep[-1] >= least:
            keep.append(int(start))
    return np.split(blocks, keep[1:])


def _share(grid, now, field, ahead, next_field) -> None:
    """Let blocks take the nodes on their far sides from the block that begins there.

    Rounding differs between lanes of a vectorised kernel: without this the sign of a
    node could differ between blocks, and the surface would crack.
    """
    every = np.concatenate([now, ahead])
    numbers = grid.number(every)
    for offset in _BITS[1:]:
        wanted = grid.number(now + LEAF * offset)
        found = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
        mine = np.flatnonzero(numbers[found] == wanted)
        theirs = found[mine]
        far = tuple(LEAF if o else slice(0, LEAF) for o in offset)
        near = tuple(0 if o else slice(0, LEAF) for o in offset)
        here = theirs < len(now)
        field[(mine[here], *far)] = field[(theirs[here], *near)]
        beyond = theirs[~here] - len(now)
        field[(mine[~here], *far)] = next_field[(beyond, *near)]

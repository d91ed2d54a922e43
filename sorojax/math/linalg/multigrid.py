"""Multigrid by smoothed aggregation, as a preconditioner in pure JAX: index maps of all
levels, made once per mesh, and the numbers on them.

Neighbouring nodes form aggregates, and the rigid motions of an aggregate are the unknowns
of one node of the next level, at its centre; so the tentative prolongation is a closed form.
One cycle is a symmetric positive definite map also where the matrix is not definite: the
smoother is a Chebyshev polynomial that is positive on both sides of zero, and the coarsest
matrix enters by the absolute values of its eigenvalues. Conjugate gradients can then go on
and count negative eigenvalues. Lists of different length are stored on lines of fixed width,
longer ones on several lines whose sums are added: all work is gathers and sums along lines.

Reference: Vanek, Mandel, Brezina, Algebraic multigrid by smoothed aggregation for second
and fourth order elliptic problems, Computing 56 (1996).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_CHUNK = 1 << 16  # products of blocks at once, so that their factors stay in the cache
_LINE = 2  # what a further line costs, in entries


class Lines(eqx.Module):
    """Entries of `count` lists: one line for each, then further lines of the lists `more`.

    Missing entries are numbered one beyond the last.
    """

    entries: Int[Array, "lines width"]
    more: Int[Array, " further"]

    @property
    def count(self) -> int:
        return self.entries.shape[-2] - self.more.shape[-1]


def lines(owner: Int[np.ndarray, " entries"], count: int) -> Lines:
    """The entries 0, 1, 2, ... of lists, listed by their owners in ascending order."""
    lengths = np.bincount(owner, minlength=count)
    width = _best_width(lengths)
    place = np.arange(len(owner)) - (np.cumsum(lengths) - lengths)[owner]
    further = np.maximum(-(-lengths // width) - 1, 0)
    first = count + np.cumsum(further) - further
    number = place // width
    line = np.where(number == 0, owner, first[owner] + number - 1)
    entries = np.full((count + further.sum(), width), len(owner), np.int32)
    entries[line, place % width] = np.arange(len(owner))
    more = np.repeat(np.arange(count), further).astype(np.int32)
    return Lines(jnp.asarray(entries), jnp.asarray(more))


def _best_width(lengths: Int[np.ndarray, " lists"]) -> int:
    """The width of least work: padding on the one hand, further lines on the other."""
    sizes, often = np.unique(np.maximum(lengths, 1), return_counts=True)
    widths = np.unique(np.concatenate([sizes, np.arange(1, min(sizes[-1], 64) + 1)]))
    num_lines = (-(-sizes[None] // widths[:, None]) * often[None]).sum(axis=1)
    work = num_lines * (widths + _LINE)
    return int(widths[np.argmin(work)])


def folded(more: Int[Array, " further"], sums: Float[Array, "lines ..."]) -> Array:
    """Sums of lists from those of their lines."""
    count = sums.shape[0] - more.shape[0]
    return sums[:count].at[more].add(sums[count:]) if more.shape[0] else sums


class Rows(eqx.Module):
    """A sparse matrix of blocks by rows: which blocks, and the column of each of them."""

    at: Lines
    cols: Int[Array, "lines width"]


class BlockMatrix(eqx.Module):
    """`Rows` with numbers: every line is one dense row of `width` blocks side by side."""

    cols: Int[Array, "lines width"]
    more: Int[Array, " further"]
    values: Float[Array, "lines rows entries"]

    def __matmul__(self, x: Float[Array, "nodes entries"]) -> Float[Array, "rows entries"]:
        picked = x[self.cols].reshape(self.cols.shape[0], 1, -1)
        return folded(self.more, jnp.sum(self.values * picked, axis=2))


def rows(owner: np.ndarray, cols: np.ndarray, count: int) -> Rows:
    """Blocks in the order of their rows `owner`, with columns `cols`."""
    at = lines(owner, count)
    padded = np.append(cols, 0)[np.asarray(at.entries)]
    return Rows(at, jnp.asarray(padded, jnp.int32))


def block_matrix(rows: Rows, blocks: Float[Array, "blocks a b"]) -> BlockMatrix:
    """The matrix of the given blocks."""
    picked = jnp.swapaxes(_picked(blocks, rows.at.entries), 1, 2)
    values = picked.reshape(*picked.shape[:2], -1)
    return BlockMatrix(rows.cols, rows.at.more, values)


def _picked(blocks, entries):
    return blocks.at[entries].get(mode="fill", fill_value=0)


class Products(eqx.Module):
    """Sums of products of blocks: list k sums first[i] @ second[j] over its pairs (i, j).

    Pairs are kept in chunks of lines.
    """

    first: Int[Array, "chunks lines width"]
    second: Int[Array, "chunks lines width"]
    more: Int[Array, " further"]
    count: int = eqx.field(static=True)


def products(owner, first, second, missing: int, count: int) -> Products:
    """Pairs in the order of their lists `owner`; `missing` is the number of first blocks."""
    at = lines(owner, count)
    entries = np.asarray(at.entries)
    chunk = min(max(1, _CHUNK // entries.shape[1]), len(entries))
    spare = np.full((-len(entries) % chunk, entries.shape[1]), len(owner), np.int32)
    entries = np.concatenate([entries, spare]).reshape(-1, chunk, entries.shape[1])
    first, second = np.append(first, missing)[entries], np.append(second, 0)[entries]
    as_array = [jnp.asarray(x, jnp.int32) for x in (first, second)]
    return Products(*as_array, at.more, count)


def sum_products(
    pairs: Products, first: Float[Array, "m a b"], second: Float[Array, "n b c"]
) -> Float[Array, "count a c"]:
    """The sums of all lists."""

    def work(part):
        left, right = _picked(first, part[0]), second[part[1]]
        return jax.lax.dot_general(
            jnp.swapaxes(left, 1, 2).reshape(len(left), first.shape[1], -1),
            right.reshape(len(right), -1, second.shape[2]),
            (((2,), (1,)), ((0,), (0,))),
        )

    sums = jax.lax.map(work, (pairs.first, pairs.second))
    sums = sums.reshape(-1, *sums.shape[2:])[: pairs.count + pairs.more.shape[0]]
    return folded(pairs.more, sums)


# Multigrid by smoothed aggregation: the index maps of all levels, once per mesh


_FAR = 0.3  # squared distance to the nearest neighbour over that to a weak one


class Level(eqx.Module):
    """One level and the way to the next: `smoothing`, `applied` and `galerkin` sum up
    A T, A P and P' (A P) from blocks; `owned` are the blocks of P inside aggregates."""

    diagonal: Int[Array, " nodes"]
    tentative: Float[Array, "nodes unknowns modes"]
    smoothing: Products
    owned: Int[Array, " nodes"]
    prolonged: Int[Array, " blocks"]
    prolongation: Rows
    restriction: Rows
    applied: Products
    galerkin: Products


class Hierarchy(eqx.Module):
    """Levels from fine to coarse: where the blocks of the finest lie in the values of the
    system, the rows of all matrices that are smoothed, the ways between them, and rows and
    columns of the blocks of the coarsest."""

    entries: Int[Array, "blocks unknowns unknowns"]
    matrices: tuple[Rows, ...]
    levels: tuple[Level, ...]
    rows: Int[Array, " coarse_blocks"]
    cols: Int[Array, " coarse_blocks"]
    num_coarse: int = eqx.field(static=True)


class _Graph(NamedTuple):
    """Blocks of a matrix in the order of rows and columns."""

    rows: np.ndarray
    cols: np.ndarray
    count: int

    @property
    def starts(self) -> np.ndarray:
        return np.searchsorted(self.rows, np.arange(self.count + 1))


class _Nodes(NamedTuple):
    """Centres, and how far what they stand for reaches."""

    centres: np.ndarray
    reach: np.ndarray


def hierarchy(
    points: Float[np.ndarray, "nodes dim"],
    upper_rows: Int[np.ndarray, " nnz"],
    upper_cols: Int[np.ndarray, " nnz"],
    coarsest: int,
) -> Hierarchy:
    """All levels down to `coarsest` unknowns, for a matrix of displacements of nodes whose
    upper triangle is given by rows."""
    points = np.asarray(points, float)
    graph, entries = _node_blocks(points.shape, upper_rows, upper_cols)
    nodes, unknowns, levels = _Nodes(points, np.zeros(len(points))), points.shape[1], []
    matrices = [rows(graph.rows, graph.cols, graph.count)]
    while graph.count * unknowns > coarsest:
        groups = _aggregates(graph, nodes.centres)
        if groups.max() + 1 >= graph.count:
            break
        level, graph, nodes = _level(graph, nodes, groups, unknowns)
        unknowns = level.tentative.shape[2]
        levels.append(level)
        matrices.append(rows(graph.rows, graph.cols, graph.count))
    return Hierarchy(
        jnp.asarray(entries, jnp.int32),
        tuple(matrices[: max(1, len(levels))]),
        tuple(levels),
        jnp.asarray(graph.rows, jnp.int32),
        jnp.asarray(graph.cols, jnp.int32),
        graph.count,
    )


def _node_blocks(shape, upper_rows, upper_cols) -> tuple[_Graph, np.ndarray]:
    """Pairs of nodes that are coupled, and the values of the system in each block."""
    count, dim = shape
    upper_rows, upper_cols = np.asarray(upper_rows, int), np.asarray(upper_cols, int)
    keys, block = np.unique(upper_rows // dim * count + upper_cols // dim, return_inverse=True)
    first, second = keys // count, keys % count
    off = np.flatnonzero(first != second)
    every = np.concatenate([keys, second[off] * count + first[off]])
    order = np.argsort(every)
    place = np.empty(len(every), int)
    place[order] = np.arange(len(every))
    mirror = place[: len(keys)].copy()
    mirror[off] = place[len(keys) :]
    entries = np.full((len(every), dim, dim), len(upper_rows), np.int32)
    number = np.arange(len(upper_rows))
    i, k = upper_rows % dim, upper_cols % dim
    entries[place[block], i, k] = number
    entries[mirror[block], k, i] = number
    every = every[order]
    return _Graph(every // count, every % count, count), entries


def _aggregates(graph: _Graph, x: np.ndarray) -> Int[np.ndarray, " nodes"]:
    """The aggregate of every node: whole neighbourhoods first, what is left joins the
    nearest, and what has no neighbour in an aggregate stays together.

    Neighbours much farther away than the nearest one do not count: elements that are thin
    across couple weakly along.
    """
    near = _near(graph, x)
    starts, cols = near.starts, near.cols
    groups, count = np.full(graph.count, -1), 0
    lone = np.diff(starts) == 0
    for i in range(graph.count):
        if groups[i] < 0 and not lone[i]:
            members = cols[starts[i] : starts[i + 1]]
            if (groups[members] < 0).all():
                groups[members], groups[i], count = count, count, count + 1
    _join(near, x, groups)
    for i in np.flatnonzero((groups < 0) & ~lone):
        if groups[i] < 0:
            members = cols[starts[i] : starts[i + 1]]
            groups[members[groups[members] < 0]] = count
            groups[i], count = count, count + 1
    groups[lone] = count  # no unknown there is coupled to any other
    return np.unique(groups, return_inverse=True)[1]


def _near(graph: _Graph, x: np.ndarray) -> _Graph:
    """Pairs of different nodes, without those that are far apart for both."""
    off = graph.rows != graph.cols
    first, second = graph.rows[off], graph.cols[off]
    square = ((x[first] - x[second]) ** 2).sum(axis=1)
    nearest = np.full(graph.count, np.inf)
    np.minimum.at(nearest, first, square)
    keep = np.maximum(nearest[first], nearest[second]) >= _FAR * square
    return _Graph(first[keep], second[keep], graph.count)


def _join(near: _Graph, x: np.ndarray, groups: np.ndarray) -> None:
    """Left-over nodes go with their nearest neighbour in an aggregate."""
    waits = (groups[near.rows] < 0) & (groups[near.cols] >= 0)
    first, second = near.rows[waits], near.cols[waits]
    square = ((x[first] - x[second]) ** 2).sum(axis=1)
    order = np.lexsort((square, first))
    node, where = np.unique(first[order], return_index=True)
    groups[node] = groups[second[order][where]]


def _level(graph: _Graph, nodes: _Nodes, groups: np.ndarray, unknowns: int):
    """One level, the graph of the next and its nodes."""
    num, count = int(groups.max()) + 1, len(graph.rows)
    tentative, coarse = _tentative(nodes, groups, num, unknowns)
    here = np.arange(graph.count)
    wide, smoothed = _listed(graph.rows, groups[graph.cols], num, graph.count)
    order = np.argsort(smoothed, kind="stable")
    starts = wide.starts
    first, second = _joined(graph.cols, starts)
    far, applied = _listed(graph.rows[first], wide.cols[second], num, graph.count)
    by_product = np.argsort(applied, kind="stable")
    low, high = _joined(wide.rows, far.starts)
    next_graph, galerkin = _listed(wide.cols[low], far.cols[high], num, num)
    by_entry = np.argsort(galerkin, kind="stable")
    turned = np.argsort(wide.cols, kind="stable")
    back = rows(wide.cols[turned], wide.rows[turned], num)
    level = Level(
        diagonal=jnp.asarray(_find(graph, here, here), jnp.int32),
        tentative=jnp.asarray(tentative),
        smoothing=products(smoothed[order], order, graph.cols[order], count, len(wide.rows)),
        owned=jnp.asarray(_find(wide, here, groups), jnp.int32),
        prolonged=jnp.asarray(wide.rows, jnp.int32),
        prolongation=rows(wide.rows, wide.cols, graph.count),
        restriction=_renumbered(back, turned),
        applied=products(
            applied[by_product], first[by_product], second[by_product], count, len(far.rows)
        ),
        galerkin=products(
            galerkin[by_entry],
            low[by_entry],
            high[by_entry],
            len(wide.rows),
            len(next_graph.rows),
        ),
    )
    return level, next_graph, coarse


def _listed(first, second, width: int, count: int) -> tuple[_Graph, np.ndarray]:
    """Different pairs in order, and the number of each given pair among them."""
    keys, inverse = np.unique(np.asarray(first, int) * width + second, return_inverse=True)
    return _Graph(keys // width, keys % width, count), inverse


def _joined(owner: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of an entry and an entry of the row that the first one owns."""
    lengths = np.diff(starts)[owner]
    first = np.repeat(np.arange(len(owner)), lengths)
    begin = np.repeat(starts[owner] - (np.cumsum(lengths) - lengths), lengths)
    return first, begin + np.arange(len(first))


def _find(graph: _Graph, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    width = int(graph.cols.max()) + 1
    return np.searchsorted(graph.rows * width + graph.cols, rows * width + cols)


def _renumbered(found: Rows, numbers: np.ndarray) -> Rows:
    entries = np.append(numbers, len(numbers))[np.asarray(found.at.entries)]
    return eqx.tree_at(lambda r: r.at.entries, found, jnp.asarray(entries, jnp.int32))


def _tentative(nodes: _Nodes, groups: np.ndarray, num: int, unknowns: int):
    """Rigid motions of the aggregates at their nodes, turns over the reach of each, and the
    nodes of the next level.

    A turn w moves a node at y from the centre by w x y; the turn of the node itself is
    w times its own reach.
    """
    x, dim = nodes.centres, nodes.centres.shape[1]
    often = np.bincount(groups, minlength=num)
    centres = (
        np.stack([np.bincount(groups, axis, num) for axis in x.T], axis=1) / often[:, None]
    )
    away = x - centres[groups]
    square = (away**2).sum(axis=1) + nodes.reach**2
    reach = np.sqrt(np.bincount(groups, square, num) / often)
    length = np.where(reach > 0, reach, 1.0)[groups]
    planes = [(i, j) for i in range(dim) for j in range(i + 1, dim)]
    modes = np.zeros((len(x), unknowns, dim + len(planes)))
    modes[:, :dim, :dim] = np.eye(dim)
    for k, (i, j) in enumerate(planes, start=dim):
        modes[:, i, k], modes[:, j, k] = -away[:, j] / length, away[:, i] / length
        if unknowns > dim:
            modes[:, k, k] = nodes.reach / length
    return modes, _Nodes(centres, reach)


# Multigrid as a preconditioner: numbers on the index maps of `aggregation`, in pure JAX


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
    """Whether entries are zero to rounding beside the largest one."""
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
    """The preconditioner applied to a residual: one V-cycle from zero."""
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

"""Multigrid by smoothed aggregation: the index maps of all levels, once per mesh.

Neighbouring nodes form aggregates, and the rigid motions of an aggregate are the unknowns
of one node of the next level, which sits at its centre. So the tentative prolongation is a
closed form of where the centres are, on every level.

Reference: Vanek, Mandel, Brezina, Algebraic multigrid by smoothed aggregation for second
and fourth order elliptic problems, Computing 56 (1996).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.math.block_rows import Products, Rows, products, rows

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
        applied=products(applied[by_product], first[by_product], second[by_product], count,
                         len(far.rows)),
        galerkin=products(galerkin[by_entry], low[by_entry], high[by_entry], len(wide.rows),
                          len(next_graph.rows)),
    )  # fmt: skip
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

"""Lists of different length as arrays: rows of blocks, and sums of products of blocks.

A list lies on a line of fixed width; a longer one goes on on further lines, whose sums are
added to its own. All work is then gathers and sums along lines, which suits accelerators
as well as vector units; a few long rows (ties of a rigid part) do not widen all others.
"""

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

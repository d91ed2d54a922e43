"""dP/dF at the points of a block, between kept entries of F.

The part that the law of the material fills comes as one dense array for each pair of
displacement components; the geometric part, most of which is absent, is added entry by
entry where an entry is read.
"""

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.kinematics import AbstractKinematics, component_pairs, entries_of
from sorojax.fem.shape_response import Shape, ShapeVectors
from sorojax.fem.tensor import Entries, stress_pairs
from sorojax.material.kinematics import Entry

_NEXT = (1, 2, 0)
Block = Float[Array, "rows cols quad lanes"]


class Tangent(NamedTuple):
    """dP/dF [Pa]: `blocks` of the pairs of components i <= k, and the `geometric` part, a
    multiple of the kept entries of F and of one, and S of the pairs of columns."""

    blocks: tuple[Block, ...]
    geometric: tuple[Entry | None, ...]


def point_tangent(
    kinematics: AbstractKinematics,
    F: Entries,
    shape: Shape,
    weight: Entry | None,
    S: tuple[Entry, ...],
) -> Tangent:
    """dP/dF of `shape`, plus `weight` times d2J / dF dF, plus `S` between the entries of one
    row of F."""
    tilted = (None,) * (len(kinematics.slots) + 1)
    if weight is not None:
        tilted = (*(weight * entry for entry in F), weight)
    if isinstance(shape, ShapeVectors):
        pairs = stress_pairs(type(kinematics))
        S = tuple(s + shape.flat if i == j else s for s, (i, j) in zip(S, pairs, strict=True))
    rows = [[e for e, _ in entries_of(kinematics, i)] for i in range(kinematics.dim)]
    blocks = [_block(shape, rows[i], rows[k]) for i, k in component_pairs(kinematics.dim)]
    return Tangent(tuple(blocks), (*tilted, *S))


def _block(shape: Shape, rows: list[int], cols: list[int]) -> Block:
    if not isinstance(shape, ShapeVectors):
        return _taken(jnp.moveaxis(_taken(shape, rows), 1, 0), cols).swapaxes(0, 1)
    half, C = shape.half, shape.C
    total = _outer(half, C, rows, cols) + _outer(C, half, rows, cols)
    if shape.second is None:
        return total
    return total + _outer(shape.second[None] * shape.slopes, shape.slopes, rows, cols)


def _outer(a: Entries, b: Entries, rows: list[int], cols: list[int]) -> Block:
    return _taken(a, rows)[:, None] * _taken(b, cols)[None]


def _taken(array: Array, numbers: list[int]) -> Array:
    """Rows of an array; a slice where they follow each other, which stays one fast loop."""
    first, last = numbers[0], numbers[-1] + 1
    if numbers == list(range(first, last)):
        return array[first:last]
    return jnp.stack([array[n] for n in numbers])


def tangent_entries(
    kinematics: AbstractKinematics, tangent: Tangent
) -> list[list[list[Float[Array, "quad lanes"]]]]:
    """Entries of the blocks with their geometric part."""
    places = _geometric_places(type(kinematics))

    def entry(value, e: int, f: int):
        number, add = places.get((e, f), (None, jnp.add))
        part = None if number is None else tangent.geometric[number]
        return value if part is None else add(value, part)

    return [
        [
            [entry(block[a, b], e, f) for b, (f, _) in enumerate(entries_of(kinematics, k))]
            for a, (e, _) in enumerate(entries_of(kinematics, i))
        ]
        for (i, k), block in zip(component_pairs(kinematics.dim), tangent.blocks, strict=True)
    ]


@cache
def _geometric_places(kind: type[AbstractKinematics]) -> dict[tuple[int, int], tuple[int, Any]]:
    """Which of the geometric parts is added to or subtracted from an entry of dP/dF: S between
    entries of one row of F, and d2J / dF dF, an entry of F, between others."""
    slots, pairs = kind.slots, stress_pairs(kind)
    at = {(s.row, s.col): number for number, s in enumerate(slots)}
    places = {}
    for e, a in enumerate(slots):
        for f, b in enumerate(slots):
            if a.row == b.row:
                pair = (min(a.col, b.col), max(a.col, b.col))
                places[e, f] = len(slots) + 1 + pairs.index(pair), jnp.add
            elif a.col != b.col:
                third = (3 - a.row - b.row, 3 - a.col - b.col)
                even = (_NEXT[a.row] == b.row) == (_NEXT[a.col] == b.col)
                # entries that are not kept are those of the identity
                if third in at or third[0] == third[1]:
                    places[e, f] = at.get(third, len(slots)), jnp.add if even else jnp.subtract
    return places

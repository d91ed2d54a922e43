"""Rows of equal structure worked on one after the other: a program holds the work once."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def each(function: Callable[..., Any], rows: Sequence[tuple[Any, ...]]) -> list[Any]:
    """`[function(*row) for row in rows]`; rows that differ in numbers alone share a loop."""
    groups: dict[Any, list[int]] = {}
    parted = [eqx.partition(row, eqx.is_array) for row in rows]
    for place, (arrays, rest) in enumerate(parted):
        leaves, form = jax.tree.flatten(arrays)
        others, rest_form = jax.tree.flatten(rest)
        kinds = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        groups.setdefault((form, kinds, rest_form, tuple(others)), []).append(place)
    found: list[Any] = [None] * len(rows)
    for places in groups.values():
        if len(places) == 1:
            found[places[0]] = function(*rows[places[0]])
            continue
        rest = parted[places[0]][1]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(parted[k][0] for k in places))
        answers = jax.lax.map(lambda row, rest=rest: function(*eqx.combine(row, rest)), stacked)
        for nth, place in enumerate(places):
            found[place] = jax.tree.map(lambda leaf, nth=nth: leaf[nth], answers)
    return found

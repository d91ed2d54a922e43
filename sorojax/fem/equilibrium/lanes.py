"""An operation of the numbers of a call, at once on the host and as a loop inside a trace, and
its lanes under `jax.vmap`: leading axes that some of the arrays have.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from sorojax._jax.operations import Rules, operation
from sorojax._jax.trace_state import evaluated_now
from sorojax._types import from_host

Arrays = Sequence[Any]


class Lanes(NamedTuple):
    """Arrays of many lanes on the host: those that are `batched` have one leading axis."""

    rows: list[Any]
    batched: tuple[bool, ...]
    count: int

    def lane(self, k: int) -> list[Any]:
        """The arrays of one of them."""
        pairs = zip(self.rows, self.batched, strict=True)
        return [from_host(x[k]) if b else x for x, b in pairs]


def lane_operation(
    name: str,
    alone: Callable[[Any, Arrays], Arrays],
    side_by_side: Callable[[Any, Lanes], Sequence[Arrays]],
    in_trace: Callable[[Any, Arrays], Arrays],
    shapes: Callable[[Any], Sequence[tuple[int, ...]]],
) -> Callable[[Any, Arrays], tuple]:
    """A function of a call, compared by identity, and of arrays, that is one operation.

    Args:
        name: Of the operation.
        alone: The results of concrete arrays.
        side_by_side: Those of every lane.
        in_trace: The same by operations of JAX.
        shapes: Of the results of a call.
    """

    def run(*leaves, call, lead, batched):
        with evaluated_now():
            if not lead:
                return list(alone(call, leaves))
            num = int(np.prod(lead))
            pairs = zip(leaves, batched, strict=True)
            rows = [_flat(np.asarray(x), num, lead) if b else x for x, b in pairs]
            found = side_by_side(call, Lanes(rows, batched, num))
            stacked = [jnp.stack(column) for column in zip(*found, strict=True)]
            return [x.reshape(*lead, *x.shape[1:]) for x in stacked]

    def stage(*leaves, call, lead, batched):
        """Lanes run one after another, so that none waits for the slowest."""
        # hidden from constant folding, which takes seconds on index arrays
        leaves = jax.lax.optimization_barrier(leaves)
        if not lead:
            return list(in_trace(call, list(leaves)))
        num, pairs = int(np.prod(lead)), list(zip(leaves, batched, strict=True))

        def lane(row):
            row = iter(row)
            return list(in_trace(call, [next(row) if b else x for x, b in pairs]))

        out = jax.lax.map(lane, [_flat(x, num, lead) for x, b in pairs if b])
        return [x.reshape(*lead, *x.shape[1:]) for x in out]

    def sizes(*_, call, lead, batched):
        dtype = jnp.result_type(float)
        return [jax.ShapeDtypeStruct((*lead, *shape), dtype) for shape in shapes(call)]

    def batch(leaves, axes, *, call, lead, batched):
        rows, wide, batched = _widened(leaves, axes, lead, batched)
        return bound(*rows, call=call, lead=wide, batched=batched)

    bound = operation(name, Rules(run, stage, sizes, batch))

    def of(call, leaves):
        return tuple(bound(*leaves, call=call, lead=(), batched=(False,) * len(leaves)))

    return of


def _flat(x, num: int, lead: tuple[int, ...]):
    return x.reshape(num, *x.shape[len(lead) :])


def _widened(leaves, axes, lead: tuple[int, ...], batched: tuple[bool, ...]):
    """One more leading axis: arrays that have any of the axes get all of them."""
    sizes = [x.shape[a] for x, a in zip(leaves, axes, strict=True) if a is not None]
    wide = (sizes[0], *lead)
    rows = []
    for x, axis, before in zip(leaves, axes, batched, strict=True):
        if axis is not None:
            x = jnp.moveaxis(x, axis, 0)
            if not before and lead:
                x = x.reshape(x.shape[0], *(1 for _ in lead), *x.shape[1:])
        if axis is not None or before:
            own = x.shape[len(wide) :] if axis is not None else x.shape[len(lead) :]
            x = jnp.broadcast_to(x, (*wide, *own))
        rows.append(x)
    return rows, wide, tuple(b or a is not None for a, b in zip(axes, batched, strict=True))


def moving_part(numbers: Any, rates: Any) -> tuple[Any, Any, Any]:
    """The leaves of `numbers` that move, all others, and how the first move: numbers without
    a derivative are left out, so that they cost nothing."""
    moves = jax.tree.map(lambda rate: not isinstance(rate, SymbolicZero), rates)
    moving, rest = eqx.partition(numbers, moves)
    return moving, rest, eqx.filter(rates, moves)

"""Long batches by `jax.vmap`, in chunks that stay in the cache of a CPU."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import DynamicJaxprTracer
from jaxtyping import Array

from sorojax._types import at_the_top, platform
from sorojax.math.batch import CHUNK

Verb = TypeVar("Verb", bound=Callable[..., Any])


def long_batches(verb: Verb) -> Verb:
    """`verb`, of which `jax.vmap` takes many lanes in chunks on a CPU.

    All lanes at once write what is between arguments and answer to memory. They stay at once
    inside a derivative, and where `jax.vmap` is around a loop or a compiled function that the
    verb is in: `batched` takes such a function in chunks as a whole.
    """

    @functools.wraps(verb)
    def call(*args: Any, **kwargs: Any) -> Any:
        if at_the_top():  # looking through the arguments takes a tenth of such a call
            return verb(*args, **kwargs)
        leaves, tree = jax.tree.flatten((args, kwargs))
        if all(_lanes(leaf) <= 2 * CHUNK for leaf in leaves) or platform() != "cpu":
            return verb(*args, **kwargs)
        moving = [k for k, leaf in enumerate(leaves) if isinstance(leaf, Tracer)]
        flat = _Flat(verb, leaves, tree, moving)
        found = _lanes_p.bind(*(leaves[k] for k in moving), verb=flat)
        return jax.tree.unflatten(flat.form, found)

    return call  # type: ignore[return-value]


def _lanes(leaf: Any) -> int:
    """Of the `jax.vmap` that `leaf` is in, if no derivative is around it."""
    axis = getattr(leaf, "batch_dim", None) if isinstance(leaf, Tracer) else None
    if not isinstance(axis, int):
        return 0
    all_lanes: Any = leaf.val  # type: ignore[attr-defined]
    plain = not isinstance(all_lanes, Tracer) or isinstance(all_lanes, DynamicJaxprTracer)
    return all_lanes.shape[axis] if plain else 0


class _Flat:
    """A call of a verb as a function of the arrays that are traced; compared by identity."""

    def __init__(self, verb, leaves: list, tree, moving: list[int]):
        self.verb, self.tree, self.moving = verb, tree, moving
        self.leaves = [None if k in moving else leaf for k, leaf in enumerate(leaves)]

    def __call__(self, *moved: Array) -> list[Array]:
        values = list(self.leaves)
        for k, leaf in zip(self.moving, moved, strict=True):
            values[k] = leaf
        args, kwargs = jax.tree.unflatten(self.tree, values)
        found, self.form = jax.tree.flatten(self.verb(*args, **kwargs))
        return found


_lanes_p = Primitive("long_batch")
_lanes_p.multiple_results = True
_lanes_p.def_impl(lambda *moved, verb: verb(*moved))


@_lanes_p.def_abstract_eval
def _(*moved, verb):
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in moved]
    return [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(verb, *shapes)]


def _derivative(values, rates, *, verb):
    return jax.jvp(verb, tuple(values), tuple(map(ad.instantiate_zeros, rates)))


def _in_chunks(values, axes, *, verb):
    count = next(x.shape[a] for x, a in zip(values, axes, strict=True) if a is not None)
    chunks = -(-count // (2 * CHUNK))
    size = -(-count // chunks)
    every = [k for k, axis in enumerate(axes) if axis is not None]

    def in_rows(x, axis):
        x = jnp.moveaxis(x, axis, 0)
        spare = jnp.broadcast_to(x[-1:], (chunks * size - count, *x.shape[1:]))
        return jnp.concatenate([x, spare]).reshape(chunks, size, *x.shape[1:])

    def one(*lane):
        moved = list(values)
        for k, x in zip(every, lane, strict=True):
            moved[k] = x
        return verb(*moved)

    if chunks == 1:
        moved = [jnp.moveaxis(values[k], axes[k], 0) for k in every]
        found = jax.vmap(one)(*moved)
    else:
        rows = [in_rows(values[k], axes[k]) for k in every]
        found = jax.lax.map(lambda chunk: jax.vmap(one)(*chunk), rows)
        found = [x.reshape(chunks * size, *x.shape[2:])[:count] for x in found]
    return found, [0] * len(found)


ad.primitive_jvps[_lanes_p] = _derivative
batching.primitive_batchers[_lanes_p] = _in_chunks
mlir.register_lowering(
    _lanes_p, mlir.lower_fun(lambda *moved, verb: verb(*moved), multiple_results=True)
)

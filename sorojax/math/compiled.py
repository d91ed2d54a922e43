"""Compilation of public functions: once per structure of their arguments, for large trees that
stay the same from call to call, in batches that stay in the cache, and with barriers.

To flatten a problem costs as much as to evaluate its forces on a small mesh, so it is done
once and calls pass the list of arrays. On the CPU, XLA drops optimisation barriers before it
fuses loops and then repeats the work of a producer in every entry that reads it; what crosses
a branch is written to memory once.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from sorojax import _check
from sorojax._jax.jit import by_itself
from sorojax._types import platform, real

Verb = TypeVar("Verb", bound=Callable[..., Any])


def jit_public(verb: Verb) -> Verb:
    """`verb` compiled by `jit_trees`, with floats and lists of numbers traced."""
    return floats_traced(jit_trees(full_products(verb)))


def floats_traced(verb: Verb) -> Verb:
    """`verb` with floats and lists of numbers as arrays.

    A Python float would otherwise be static and recompile at every new value. Integers
    and booleans stay static: they choose loops and branches.
    """

    @functools.wraps(verb)
    def call(*args: Any, **kwargs: Any) -> Any:
        args = tuple(_traced(value) for value in args)
        return verb(*args, **{name: _traced(value) for name, value in kwargs.items()})

    return call  # type: ignore[return-value]


def jit_trees(function: Verb, *, kernels: bool = True, **how: Any) -> Verb:
    """`function` of pytrees compiled: arrays are traced, all else is static.

    It does what `sorojax.jit` does for functions of arrays and nouns, with a third less to
    do before each call: 170 us instead of 228 for the equilibrium of a small rod.

    Args:
        function: Of pytrees.
        kernels: As of `sorojax.jit`.
        how: As of `by_itself`.
    """
    early = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = inspect.signature(function).parameters.values()
    names = [parameter.name for parameter in parameters if parameter.kind in early]

    def flat(arrays: list[Any], static: tuple[Any, ...]) -> Split:
        tree, others = static
        found = zip(arrays, others, strict=True)
        leaves = [x if other is None else other[1] for x, other in found]
        args, kwargs = jax.tree.unflatten(tree, leaves)
        return Split(function(*args, **kwargs))

    flat.__name__ = flat.__qualname__ = function.__name__
    compiled = by_itself(flat, kernels=kernels, **how)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # the same program, whether an argument is given by its place or its name
        while kwargs and len(args) < len(names) and names[len(args)] in kwargs:
            args = (*args, kwargs.pop(names[len(args)]))
        leaves, tree = jax.tree.flatten((args, kwargs))
        traced = [x if isinstance(x, _ARRAYS) else None for x in leaves]
        # with their types, since 1 and True are equal
        others = tuple(
            (type(x), x) if y is None else None for x, y in zip(leaves, traced, strict=True)
        )
        return compiled(traced, (tree, others)).whole()

    return call  # type: ignore[return-value]


_ARRAYS = jax.Array, np.ndarray, np.generic


def full_products(verb: Verb) -> Verb:
    """`verb` whose products keep all digits of single precision.

    By default JAX rounds the factors of such products to 10 bits on recent accelerators, where
    an acceleration of a soft finger came out 14 % wrong. A precision that the user has
    chosen by `jax_default_matmul_precision` is left alone.
    """

    @functools.wraps(verb)
    def call(*args: Any, **kwargs: Any) -> Any:
        chosen = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
        if platform() == "cpu" or chosen is not None:
            return verb(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return verb(*args, **kwargs)

    return call  # type: ignore[return-value]


def _traced(value: Any) -> Any:
    is_list = isinstance(value, list | tuple) and len(value) > 0
    if isinstance(value, float) or (
        is_list and all(isinstance(entry, int | float) for entry in value)
    ):
        return real(value)
    return value


# Compiled functions of large pytrees that stay the same from call to call


class _Form:
    """All of a pytree but its arrays."""

    def __init__(self, tree, others, others_tree):
        self._parts = tree, others_tree, tuple(others)
        self._hash = hash(self._parts)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, _Form) and self._parts == other._parts)

    def whole(self, leaves) -> Any:
        tree, others_tree, others = self._parts
        if not others:
            return jax.tree.unflatten(tree, leaves)
        return eqx.combine(
            jax.tree.unflatten(tree, leaves), jax.tree.unflatten(others_tree, others)
        )


@jax.tree_util.register_pytree_node_class
class Split:
    """A pytree, taken apart once; what a kernel gives as one it takes without a look."""

    def __init__(self, tree: Any):
        arrays, others = eqx.partition(tree, eqx.is_array)
        self.leaves, form = jax.tree.flatten(arrays)
        self.form = _Form(form, *jax.tree.flatten(others))

    def whole(self) -> Any:
        return self.form.whole(self.leaves)

    def like(self, leaves: list[Any]) -> "Split":
        """The same tree with other `leaves`."""
        return self.tree_unflatten(self.form, leaves)

    def tree_flatten(self):
        return self.leaves, self.form

    @classmethod
    def tree_unflatten(cls, form, leaves) -> "Split":
        made = object.__new__(cls)
        made.leaves, made.form = list(leaves), form
        return made


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(*trees, *arrays)` compiled, to be called as `(splits, *arrays)`."""

    @jax.jit
    def flat(splits: tuple[Split, ...], *arrays) -> Split:
        return Split(function(*(split.whole() for split in splits), *arrays))

    def call(splits: tuple[Split, ...], *arrays):
        return flat(tuple(splits), *arrays).whole()

    return call


# Many items through one verb, in batches that stay in the cache


CHUNK = 64  # items of a few kB each; more leave the cache of a core


def batched(verb: Callable[..., Any], *, chunk: int = CHUNK) -> Callable[..., Any]:
    """`verb` over the first axis of all its arguments, as `jax.vmap` but in chunks.

    On a CPU the intermediate values of a whole batch travel through memory, those of a
    chunk stay in the cache. Accelerators take the batch at once. What all items share is
    closed over, and made once:

        constants = rod.operators(finger)
        batched(lambda q: rod.motion(finger, q, constants=constants).position)(many_q)

    Args:
        verb: Of arrays, or pytrees of them: models too.
        chunk: Items at once on a CPU.

    Raises:
        ValueError: If the arguments do not have equally many items.
    """
    _check.positive("batched", "chunk", chunk, "items", "Give how many to take at once.")

    def every(*items: Any) -> Any:
        arrays, rest = eqx.partition(items, lambda x: isinstance(x, jax.Array | np.ndarray))
        _check_counts(arrays)

        def one(item: Any) -> Any:
            return verb(*eqx.combine(item, rest))

        def in_chunks(items: Any) -> Any:
            return jax.lax.map(one, items, batch_size=chunk)

        if len(jax.tree.leaves(arrays)[0]) <= chunk:
            return jax.vmap(one)(arrays)
        return jax.lax.platform_dependent(arrays, cpu=in_chunks, default=jax.vmap(one))

    return every


def chunked_lanes(verb: Verb, chunk: int = CHUNK) -> Verb:
    """`verb`, whose lanes by `jax.vmap` are taken in chunks too; all at once in a derivative.

    Without this an acceleration of a rod in 1024 states by `jax.vmap` takes 1.4 times as long.
    """

    @functools.wraps(verb)
    def call(*args: Any) -> Any:
        arrays, rest = eqx.partition(args, eqx.is_array)

        def whole(arrays: Any) -> Any:
            return verb(*eqx.combine(arrays, rest))

        # A rule gives what a function closes over no derivative, without an error.
        closed = eqx.filter_closure_convert(whole, arrays)
        known, traced = eqx.partition(closed, _check.is_concrete)
        leaves, tree = jax.tree.flatten((arrays, traced))

        def plain(*leaves: Array) -> Any:
            arrays, traced = jax.tree.unflatten(tree, leaves)
            return eqx.combine(known, traced)(arrays)

        lanes = jax.custom_batching.custom_vmap(plain)

        @lanes.def_vmap
        def _(count: int, moves: list[bool], *leaves: Array):
            def one(lane: dict[int, Array]) -> Any:
                return plain(*(lane.get(k, x) for k, x in enumerate(leaves)))

            moving = {k: x for k, x in enumerate(leaves) if moves[k]}
            every = batched(one, chunk=chunk) if count > 2 * chunk else jax.vmap(one)
            found = every(moving)
            return found, jax.tree.map(lambda _: True, found)

        def rule(values: tuple[Array, ...], rates: tuple[Any, ...]) -> Any:
            found, rate = jax.jvp(plain, values, rates)
            return _in_every_lane(found, values), rate

        outer = jax.custom_jvp(lanes)
        outer.defjvp(rule)
        return outer(*leaves)

    return call  # type: ignore[return-value]


def _in_every_lane(found: Any, values: tuple[Array, ...]) -> Any:
    """`found`, with the lanes of `values` in all its arrays.

    A function with a rule and that rule must have lanes in the same arrays: where they do not,
    JAX (0.10.2 was tried) takes one axis for another.
    """
    firsts = (x[(0,) * x.ndim] for x in values if x.size)
    never = functools.reduce(jnp.logical_or, (x > x for x in firsts))
    return jax.tree.map(lambda x: x + never.astype(x.dtype), found)


def _check_counts(arrays: Any) -> None:
    counts = {leaf.shape[0] if leaf.ndim else 0 for leaf in jax.tree.leaves(arrays)}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(
            f"batched: got first axes of {sorted(counts)} items (0: none), need one count "
            "for all. Close over what all items share."
        )


# Work that XLA keeps apart from what uses it


Answer = TypeVar("Answer")
Alone = Callable[[Callable[[], Any]], Any]


def apart(always: Bool[Array, ""]) -> Alone:
    """A function that calls `work()` by itself. `always` is true, but known at run time only:
    where it is not, the answer is NaN."""

    def alone(work: Callable[[], Answer]) -> Answer:
        once = jax.jit(work, inline=True)  # traced for the shapes, and not again
        shapes = jax.eval_shape(once)

        def never() -> Any:
            return jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), shapes)

        return jax.lax.cond(always, once, never)

    return alone

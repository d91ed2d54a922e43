"""Compiled functions of large pytrees that stay the same from call to call.

To take a problem apart costs as much as to evaluate its forces on a small mesh: it is done
once, and calls hand over the list of its arrays.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


class _Form:
    """All of a pytree but its arrays."""

    def __init__(self, tree, others, others_tree):
        self._parts = tree, others_tree, tuple(others)
        self._hash = hash(self._parts)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, _Form) and self._parts == other._parts

    def whole(self, leaves) -> Any:
        tree, others_tree, others = self._parts
        return eqx.combine(
            jax.tree.unflatten(tree, leaves), jax.tree.unflatten(others_tree, others)
        )


class Split:
    """A pytree, taken apart once."""

    def __init__(self, tree: Any):
        arrays, others = eqx.partition(tree, eqx.is_array)
        self.leaves, form = jax.tree.flatten(arrays)
        self.form = _Form(form, *jax.tree.flatten(others))


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(*trees, *arrays)` compiled, to be called as `(splits, *arrays)`."""

    @functools.partial(jax.jit, static_argnums=0)
    def flat(forms, leaves, *arrays):
        return function(*(f.whole(x) for f, x in zip(forms, leaves, strict=True)), *arrays)

    def call(splits: tuple[Split, ...], *arrays):
        return flat(tuple(s.form for s in splits), tuple(s.leaves for s in splits), *arrays)

    return call

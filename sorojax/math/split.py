"""Compiled functions of large pytrees that stay the same from call to call.

To take a problem apart costs as much as to evaluate its forces on a small mesh, to take a
network apart a third of its step: it is done once, and calls hand over the list of arrays.
"""

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

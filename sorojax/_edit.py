"""Editing a noun: the same noun with some leaves replaced."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

from sorojax._types import real

Noun = TypeVar("Noun")


def replace(noun: Noun, where: Callable[[Noun], Any], value: Any) -> Noun:
    """`noun` with the leaf or subtree that `where` selects replaced by `value`.

    Numbers become strongly typed arrays, so that a new value never retraces and
    always has a gradient. Modules are put in as they are.

    Args:
        noun: Any module of the framework.
        where: Selects what to replace, `lambda p: p.material.shear_modulus`.
        value: The new number, array or module.
    """
    is_module = isinstance(value, eqx.Module)
    new = value if is_module else jax.tree.map(real, value)
    return eqx.tree_at(where, noun, new, is_leaf=lambda leaf: leaf is None)

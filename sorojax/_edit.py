"""Editing a noun: the same noun with some leaves replaced."""

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from sorojax import _check, _explain
from sorojax._kinds import whole
from sorojax._types import integers, real

Noun = TypeVar("Noun")


def replace(noun: Noun, where: Callable[[Noun], Any], value: Any) -> Noun:
    """`noun` with the number, array or module that `where` selects replaced by `value`.

    Numbers become strongly typed arrays, so that a new value never retraces and
    always has a gradient. Modules and functions are put in as they are. Nouns along the way
    convert and check the new value as their constructors do.

    Args:
        noun: Any module of the framework.
        where: Selects what to replace, `lambda p: p.material.shear_modulus`; a tuple selects
            several.
        value: The new number, array or module, in the unit of the old; for several a tuple.

    Returns:
        The new noun; the old one is unchanged.

    Raises:
        TypeError: If the value is of another kind than what it replaces.
        ValueError: If the constructor of a noun refuses it.

    Example:
        >>> ball = sdf.Circle([0, 0], 10 * mm)
        >>> larger = sj.replace(ball, lambda shape: shape.radius, 12 * mm)
        >>> print(f"{float(larger(jnp.zeros(2))) / mm:.1f} mm")
        -12.0 mm
    """
    if not callable(where):
        raise TypeError(
            f"replace: got {_explain.got(where)} for `where`, need a function that selects, as "
            "`lambda noun: noun.length`."
        )
    try:
        old = where(noun)
    except AttributeError as error:
        raise TypeError(
            f"replace: `where` selects what {type(noun).__name__} has not: {error}. Select one "
            f"of its fields: {', '.join(_names(noun))}."
        ) from error
    new = _in_place_of(old, value)
    made = eqx.tree_at(where, noun, new, is_leaf=lambda leaf: leaf is None)
    return _as_constructed(noun, made)


def _names(noun: Any) -> list[str]:
    return [f.name for f in dataclasses.fields(noun)] if dataclasses.is_dataclass(noun) else []


def _in_place_of(old: Any, value: Any) -> Any:
    """`value` as it stands in a tree in place of `old`."""
    if type(old) in (list, tuple) and isinstance(value, list | tuple):
        if len(old) == len(value):
            return type(old)(map(_in_place_of, old, value))
        raise ValueError(
            f"replace: `where` selects {len(old)} things, got {len(value)} to put there. Give "
            "as many."
        )
    if isinstance(value, eqx.Module) or callable(value):
        return value
    if not isinstance(old, jax.Array | np.ndarray) and (old is not None or value is None):
        return jax.tree.map(real, value)
    try:
        indices = old is not None and whole(old) and whole(value)
        return integers(value) if indices else real(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"replace: got {_explain.got(value)}, need numbers, as where it goes. Give a "
            "number or an array."
        ) from error


def _as_constructed(old: Any, new: Any) -> Any:
    """`new`, an edited copy of `old`, converted and checked where it differs."""
    if type(old) is not type(new) or _is_same(old, new):
        return new
    if isinstance(new, Mapping):
        return {name: _as_constructed(old.get(name), each) for name, each in new.items()}
    if type(new) in (list, tuple):
        same_length = len(old) == len(new)
        return type(new)(map(_as_constructed, old, new)) if same_length else new
    if not isinstance(new, eqx.Module):
        return new
    made: Any = copy.copy(new)
    kinds = getattr(type(new), "__arguments__", None)
    for field in dataclasses.fields(new):
        before, after = getattr(old, field.name), getattr(new, field.name)
        if _is_same(before, after):
            continue
        kind = kinds.kinds.get(field.name) if kinds is not None else None
        if kind is not None and not kind.accepts(after):
            where = f"replace: {type(new).__name__}"
            raise _explain.refusal(where, field.name, kind, after)
        after = _as_constructed(before, after)
        convert = field.metadata.get("converter", lambda value: value)
        object.__setattr__(made, field.name, convert(after))
    _check.same_space("replace", old, made)
    for each in type(made).__mro__:
        if "__check_init__" in each.__dict__:
            each.__check_init__(made)
    return made


def _is_same(old: Any, new: Any) -> bool:
    """Whether the leaves are the very same ones."""
    before, after = jax.tree.flatten(old), jax.tree.flatten(new)
    if before[1] != after[1]:
        return False
    return all(a is b for a, b in zip(before[0], after[0], strict=True))


def without_derivatives(tree: Noun) -> Noun:
    """The same noun, or tree, without derivatives."""
    moving, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(moving), rest)

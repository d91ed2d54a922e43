"""Public verbs compiled once per structure of their arguments."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

from sorojax._types import platform, real

Verb = TypeVar("Verb", bound=Callable[..., Any])


def door(verb: Verb) -> Verb:
    """`verb` compiled by `eqx.filter_jit`, with floats and lists of numbers traced.

    A Python float would otherwise be static and recompile at every new value. Integers
    and booleans stay static: they choose loops and branches.
    """
    compiled = eqx.filter_jit(full_products(verb))

    @functools.wraps(verb)
    def call(*args: Any, **kwargs: Any) -> Any:
        args = tuple(_traced(value) for value in args)
        return compiled(*args, **{name: _traced(value) for name, value in kwargs.items()})

    return call  # type: ignore[return-value]


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

"""Checks of user input that raise in the form got - need - do.

Each check looks at concrete values only: inside a JAX transformation it passes,
because there a value cannot be known, and statuses report instead.
"""

import dataclasses
import inspect
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np

from sorojax._jax.trace_state import is_tracer


def is_concrete(value: Any) -> bool:
    return not is_tracer(value)


_BETWEEN = {"sorojax", "jax", "equinox"}  # packages that a call of the user passes through


def warn(message: str) -> None:
    """A `UserWarning` at the line of the user that led to it."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in _BETWEEN:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def finite(where: str, name: str, value: Any, do: str) -> None:
    """Raise a `ValueError` if `value` holds NaN or infinity."""
    if is_concrete(value) and not np.all(np.isfinite(np.asarray(value))):
        raise ValueError(f"{where}: `{name}` must be finite, got {_short(value)}. {do}")


def positive(where: str, name: str, value: Any, unit: str, do: str) -> None:
    """Raise a `ValueError` unless every entry of `value` is finite and positive."""
    if is_concrete(value):
        numbers = np.asarray(value)
        if not (np.all(np.isfinite(numbers)) and np.all(numbers > 0)):
            raise ValueError(
                f"{where}: `{name}` must be positive, got {_short(value)}{_after(unit)}. {do}"
            )


def _after(unit: str) -> str:
    """A unit behind its number; nothing where there is none."""
    return f" {unit}" if unit else ""


def not_negative(where: str, name: str, value: Any, unit: str, do: str) -> None:
    """Raise a `ValueError` if an entry of `value` is known to be negative."""
    if is_concrete(value) and np.any(np.asarray(value) < 0):
        raise ValueError(
            f"{where}: `{name}` is {_short(value)}{_after(unit)}, need 0 or more. {do}"
        )


def between(
    where: str,
    name: str,
    value: Any,
    low: float,
    high: float,
    unit: str,
    do: str,
    ends: str = "()",
) -> None:
    """Raise a `ValueError` unless every entry of `value` lies between `low` and `high`, which
    belong to the interval, and values that rounding moved beyond, where `ends` has square
    brackets."""
    if is_concrete(value):
        numbers = np.asarray(value)
        slack = float(np.finfo(np.result_type(numbers, np.float32)).eps) ** 0.75
        above = numbers >= low - slack if ends[0] == "[" else numbers > low
        below = numbers <= high + slack if ends[1] == "]" else numbers < high
        if not (np.all(above) and np.all(below)):
            span = f"{ends[0]}{low:g}, {high:g}{ends[1]}{_after(unit)}"
            raise ValueError(
                f"{where}: `{name}` must lie in {span}, got {_short(value)}{_after(unit)}. {do}"
            )


def shape(where: str, name: str, value: Any, want: Sequence[int | None], do: str) -> None:
    """Raise a `ValueError` unless `value.shape` matches `want` (None: any length)."""
    got = np.shape(value)
    fits = len(got) == len(want) and all(
        w is None or g == w for g, w in zip(got, want, strict=True)
    )
    if not fits:
        need = "(" + ", ".join("any" if w is None else str(w) for w in want) + ")"
        raise ValueError(f"{where}: `{name}` has shape {got}, need {need}. {do}")


def axes(noun: Any) -> Iterator[tuple[str, str, int]]:
    """Field, name and length of the axes of arrays that hold one vector of a named space, as
    `Float[Array, " dim"]`."""
    for field in dataclasses.fields(noun):
        value = getattr(noun, field.name)
        for each in (field.type, *get_args(field.type)):
            names = getattr(each, "dim_str", "").split()
            if len(names) == 1 and names[0].isalpha() and len(np.shape(value)) == 1:
                yield field.name, names[0], np.shape(value)[0]


def in_space(where: str, noun: Any, **lengths: int) -> None:
    """Raise a `ValueError` if a vector of `noun` has another length than that of its axis
    among `lengths`."""
    for field, axis, length in axes(noun):
        if lengths.get(axis, length) != length:
            raise ValueError(
                f"{where}: `{field}` of {type(noun).__name__} has {length} numbers, need "
                f"{lengths[axis]}. Give one for each axis of the space."
            )


def same_space(where: str, old: Any, new: Any) -> None:
    """Raise a `ValueError` if a vector of `new` is of another space than that of `old`."""
    space = {axis: n for _, axis, n in axes(old) if axis in ("dim", "twist")}
    in_space(where, new, **space)


def float64(where: str, value: Any) -> None:
    """Raise a `ValueError` unless `value` is float64."""
    if value.dtype != jnp.float64:
        raise ValueError(
            f"{where}: needs float64, got {value.dtype}: single precision misses the "
            'tolerances. Call jax.config.update("jax_enable_x64", True) first.'
        )


def _short(value: Any) -> str:
    numbers = np.asarray(value)
    return f"{numbers:g}" if numbers.ndim == 0 else np.array2string(numbers, threshold=6)

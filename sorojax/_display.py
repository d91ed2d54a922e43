"""How nouns tell about themselves: a picture in notebooks, a short text for `print`.

The floor that draws lies above the nouns, so it is imported by name, in the call that
displays, and nothing is drawn or imported before.
"""

import importlib
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
import wadler_lindig as wl

from sorojax._jax.trace_state import is_traced

Noun = TypeVar("Noun", bound=type)
_FEW = 6  # numbers that are written out


def displayed(noun: Noun) -> Noun:
    """A class whose instances, and those of its subclasses, are drawn by a notebook and
    printed by their `_text()`, or by their fields with small arrays written out."""

    def _repr_png_(self: Any) -> bytes | None:
        if is_traced(self):
            return None
        try:
            return importlib.import_module("sorojax.view").show(self).png
        except ValueError:  # unbounded, not finite: the text remains
            return None

    noun._repr_png_ = _repr_png_  # type: ignore[attr-defined]
    return printed(noun)


def printed(noun: Noun) -> Noun:
    """A class whose instances are printed so, but drawn only with what they do not hold."""

    def __repr__(self: Any) -> str:
        try:
            return self._text() if hasattr(self, "_text") else fields(self)
        except (TypeError, ValueError, AttributeError, IndexError):
            return eqx.tree_pformat(self)  # transformations put other things into leaves

    if "__repr__" not in vars(noun):
        noun.__repr__ = __repr__  # type: ignore[assignment]
    return noun


def fields(noun: Any) -> str:
    """A noun by its fields, with the values of numbers and the shapes of larger arrays."""

    def small(value: Any) -> wl.AbstractDoc | None:
        array = hasattr(value, "shape") and hasattr(value, "dtype")
        if not array or is_traced(value) or value.size > _FEW or value.dtype.kind not in "fiu":
            return None
        if not isinstance(value, np.ndarray | np.generic) and not eqx.is_array(value):
            return None
        flat = [f"{entry:.4g}" for entry in np.ravel(np.asarray(value))]
        return wl.TextDoc(flat[0] if not value.shape else f"[{', '.join(flat)}]")

    return wl.pformat(noun, width=88, short_arrays=True, custom=small, hide_defaults=True)


def number(value: Any, unit: str = "") -> str:
    """A number for people, `?` for one that is traced, the range of several."""
    if is_traced(value):
        return "?"
    flat = np.ravel(np.asarray(value))
    flat = flat[np.isfinite(flat)]
    if not flat.size:
        return "not finite"
    low, high = flat.min(), flat.max()
    text = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    return f"{text} {unit}".strip()


def outcome(status: Any) -> str:
    """Name of a status; of several how many are no success."""
    if is_traced(status):
        return "?"
    names = list(status._enumeration._name_to_item)
    values = np.ravel(np.asarray(status._value))
    found = [names[int(k)] for k in values]
    if len(set(found)) == 1:
        return found[0]
    good = found.count("successful")
    return f"{good} of {len(found)} successful"

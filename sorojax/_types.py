"""Conversion of user numbers to strongly typed arrays."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax import devices
from sorojax._jax.trace_state import outside_transformations

if TYPE_CHECKING:
    _Entry = jax.Array | np.ndarray | np.generic | float
    _Row = Sequence[_Entry]
    Numbers = _Entry | _Row | Sequence[_Row] | Sequence[Sequence[_Row]]
else:

    class Numbers:
        """A number, or what becomes an array: of these, arguments without a fixed shape.

        Type checkers see the union; in signatures it is one word.
        """


def real(value: Numbers) -> jax.Array:
    """`value` as a floating array that keeps one dtype and never retraces.

    Floating arrays keep their dtype; Python numbers and integers take the
    default floating dtype (float64 where `jax_enable_x64` is set). A Python
    float left inside a pytree would be weakly typed or static: it would retrace
    at every new value and have no gradient.
    """
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        dtype = value.dtype
        floating = jnp.issubdtype(dtype, jnp.floating)
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise TypeError(
                f"got complex numbers of shape {value.shape}, need real ones. Take `.real`, if "
                "the rest is rounding."
            )
        if floating and isinstance(value, jax.Array) and not value.weak_type:
            return value  # a conversion of a traced value costs a derivative
        if not floating:
            dtype = jnp.result_type(float)
        return _array(value, dtype)
    if isinstance(value, list | tuple) and any(
        isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(list(value))
    ):
        return jnp.stack([real(item) for item in value])
    if type(value) is object or value is None:  # placeholders that JAX puts in
        return value  # type: ignore[return-value]
    return _array(np.asarray(value, dtype=np.float64), jnp.result_type(float))


def optional_real(value: Numbers | None) -> jax.Array | None:
    """Like `real`, and `None` stays `None`."""
    return None if value is None else real(value)


def integers(value: Numbers) -> jax.Array:
    """`value` as an int32 array: connectivity, slots and node numbers."""
    if type(value) is object:
        return value  # type: ignore[return-value]
    return _array(value, jnp.int32)


def _array(value: Any, dtype: Any) -> jax.Array:
    """A new array; the first one of a program starts JAX, whatever its plug-ins do."""
    try:
        return from_host(value, dtype)
    except Exception as error:
        if not devices.start(error):
            raise
        return jnp.asarray(value, dtype=dtype)


_FEW = 16  # numbers in an array of which shapes come again


def from_host(value: Any, dtype: Any = None) -> jax.Array:
    """`jnp.asarray`, which compiles a program for every shape and kind of NumPy's arrays; here
    they are copied without. That takes 10 us more, so not for few numbers of one kind."""
    plain = isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    if plain and outside_transformations():
        kind = value.dtype if dtype is None else dtype
        if value.size > _FEW or value.dtype != kind:
            return jax.device_put(np.array(value, kind))
    return jnp.asarray(value, dtype=dtype)


def platform() -> str:
    """Where arrays are made here: "cpu", "gpu", "tpu"."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is None:
        return jax.default_backend()
    return chosen if isinstance(chosen, str) else chosen.platform

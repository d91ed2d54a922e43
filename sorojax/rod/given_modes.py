"""Modes that a user gives: as functions of s, or as samples."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.rod.basis import AbstractModes, StrainBasis, checked_breaks


class SampledModes(AbstractModes):
    """Data-driven modes, linear between samples and constant beyond the first and last.

    A mode is differentiable in its values. Sampled modes need as many Gauss nodes as
    their ripples, not as their number; `fitted` makes smooth ones of them.
    """

    s: Float[Array, " samples"] = eqx.field(converter=real)
    values: Float[Array, "samples modes"] = eqx.field(converter=real)

    def __check_init__(self):
        do = "Give s in [0, 1] and one column per mode, as `values[sample, mode]`."
        _check.shape("SampledModes", "values", self.values, (len(self.s), None), do)
        _check.finite("SampledModes", "values", self.values, "Check the snapshots.")
        if _check.is_concrete(self.s) and not _is_grid(np.asarray(self.s)):
            raise ValueError(
                "SampledModes: `s` must rise strictly inside [0, 1], got "
                f"{np.array2string(np.asarray(self.s), threshold=6)}. Divide the arc "
                "length [m] by the length of the backbone."
            )

    @property
    def count(self) -> int:
        return self.values.shape[1]

    @property
    def resolution(self) -> int:
        return min(48, max(8, self.s.shape[0] // 4))

    def __call__(self, s):
        return _interpolated(self.s, self.values, jnp.asarray(s, dtype=self.s.dtype))


@jax.jit
def _interpolated(s: Array, values: Array, at: Array) -> Float[Array, "points modes"]:
    """Linear between samples, constant beyond the first and last."""
    right = jnp.clip(jnp.searchsorted(s, at), 1, s.shape[0] - 1)
    left = right - 1
    fraction = jnp.clip((at - s[left]) / (s[right] - s[left]), 0, 1)[:, None]
    return (1 - fraction) * values[left] + fraction * values[right]


def _as_function(given: Any) -> Any:
    """A pytree that can be called, so that the numbers in a module stay differentiable."""
    if isinstance(given, list | tuple):
        return _Stacked(tuple(_as_function(one) for one in given))
    return given if isinstance(given, eqx.Module) else jax.tree_util.Partial(given)


class _Stacked(eqx.Module):
    """One column per function."""

    functions: tuple[Callable, ...]

    def __call__(self, s):
        rows = [f(s) for f in self.functions]
        if any(np.shape(row) != np.shape(s) for row in rows):
            shapes = ", ".join(str(np.shape(row)) for row in rows)
            raise ValueError(
                f"functions: {np.size(s)} points gave values of shapes {shapes}, need "
                f"{np.shape(s)} of each mode. Return one value per point, of a constant mode "
                "np.ones_like(s)."
            )
        xp = jnp if any(isinstance(row, jax.Array) for row in rows) else np
        return xp.stack([xp.asarray(row) for row in rows], axis=1)


class Functions(AbstractModes):
    """Modes by a user function of s: points in, (points, modes) out.

    Attributes:
        function: A function of an array of points. An `eqx.Module` is differentiable in
            its numbers.
        count: Number of modes.
        nodes: Gauss nodes between joints that resolve the modes; None for count + 6.
        joints: Where the modes jump or kink.
    """

    function: Callable = eqx.field(converter=_as_function)
    count: int = eqx.field(static=True)
    nodes: int | None = eqx.field(static=True, default=None)
    joints: tuple[float, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        checked_breaks("Functions", self.joints)
        shape = np.shape(self.function(np.array([0.25, 0.5, 0.75])))
        if shape != (3, self.count) or self.count < 1:
            raise ValueError(
                f"Functions: 3 points gave values of shape {shape}, need (3, {self.count}). "
                "Stack the modes along axis 1, or give one function per mode."
            )

    @property
    def breaks(self) -> tuple[float, ...]:
        return self.joints

    @property
    def resolution(self) -> int:
        return max(8, self.count + 6) if self.nodes is None else self.nodes

    def __call__(self, s):
        return self.function(s)


def functions(
    *,
    nodes: int | None = None,
    breaks: Sequence[float] = (),
    **modes: Callable | Sequence[Callable],
) -> StrainBasis:
    """Modes of your own per strain: `functions(kappa_z=[lambda s: s, lambda s: s**2])`.

    Args:
        nodes: Gauss nodes between breaks that resolve them; 8 or more by default.
        breaks: Where they jump or kink, in (0, 1).
        modes: A function from points to (points, modes), or one function per mode.

    Raises:
        ValueError: If a function gives another shape.
    """
    joints = checked_breaks("functions", breaks)
    own = {name: _as_function(f) for name, f in modes.items()}
    modes_of: dict[str, AbstractModes] = {
        k: _functions(f, nodes, joints) for k, f in own.items()
    }
    return StrainBasis(modes_of)


def _functions(function: Any, nodes: int | None, joints: tuple[float, ...]) -> Functions:
    shape = np.shape(function(np.array([0.25, 0.5, 0.75])))
    if shape[:1] != (3,) or len(shape) > 2:
        raise ValueError(
            f"functions: 3 points gave values of shape {shape}, need (3,) or (3, modes). "
            "Return one value per point, of a constant mode np.ones_like(s)."
        )
    count = shape[1] if len(shape) == 2 else 1
    return Functions(function=function, count=count, nodes=nodes, joints=joints)


def _is_grid(s: np.ndarray) -> bool:
    rises = s.ndim == 1 and s.size > 1 and bool(np.all(np.diff(s) > 0))
    return rises and s[0] >= 0 and s[-1] <= 1 + 1e-12

"""The abstract signed distance: negative inside, in metres."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from sorojax._types import real

Box = tuple[Float[Array, " dim"], Float[Array, " dim"]]


class AbstractSdf(eqx.Module):
    """An implicit shape: a field that is negative inside and zero on the surface.

    A new shape gives `distance`, `dim` and `bounding_box`; it states its
    `lipschitz` constant when that is not 1 and `exact` when the field is the true
    Euclidean distance everywhere (otherwise it is a lower bound of it).

    Shapes combine by `|` or `+` (union), `&` or `/` (intersection), `-` (difference).
    """

    @property
    @abc.abstractmethod
    def dim(self) -> int:
        """2 or 3."""

    @abc.abstractmethod
    def distance(self, *x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Field [m] at separate coordinate arrays x, y[, z] [m]."""

    @abc.abstractmethod
    def bounding_box(self) -> Box:
        """Lower and upper corner [m] of a box that holds the inside; may be infinite."""

    @property
    def lipschitz(self) -> float:
        """Bound of |grad f|: no point within |f| / lipschitz changes sign."""
        return 1.0

    @property
    def exact(self) -> bool:
        """Whether |f| is the true distance to the surface everywhere."""
        return False

    def __call__(self, p: Float[Array, "*points dim"]) -> Float[Array, "*points"]:
        """Field [m] at points `p` [m]."""
        p = real(p)
        if p.ndim < 1 or p.shape[-1] != self.dim:
            raise ValueError(
                f"{type(self).__name__}: points have shape {p.shape}, this shape needs "
                f"(..., {self.dim}). Put the coordinates on the last axis."
            )
        return cast(self, p.dtype).distance(*(p[..., i] for i in range(self.dim)))

    def __or__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.combine import union

        return union(self, other)

    def __and__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.combine import intersection

        return intersection(self, other)

    def __sub__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.combine import Difference

        return Difference(self, other)

    def __add__(self, other: AbstractSdf) -> AbstractSdf:
        return self | other

    def __truediv__(self, other: AbstractSdf) -> AbstractSdf:
        return self & other


def cast(shape: AbstractSdf, dtype: jnp.dtype) -> AbstractSdf:
    """`shape` with its parameters in `dtype`, so that the field follows its input."""

    def convert(leaf: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
        same = not eqx.is_inexact_array(leaf) or leaf.dtype == dtype
        return leaf if same else leaf.astype(dtype)

    return jax.tree.map(convert, shape)

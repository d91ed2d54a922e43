"""Modes that live on one stretch of the rod each."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.rod.basis import (
    AbstractModes,
    StrainBasis,
    checked_breaks,
    each_count,
    merged,
)
from sorojax.rod.polynomial_modes import Legendre
from sorojax.rod.spline_modes import BSpline


class Piecewise(AbstractModes):
    """The same modes anew on each segment between `joints`, zero elsewhere.

    Ordered by segment, then by mode. At a joint the segment behind it holds.
    """

    inner: AbstractModes
    joints: tuple[float, ...] = eqx.field(static=True)

    @property
    def count(self) -> int:
        return self.inner.count * (len(self.joints) + 1)

    @property
    def edges(self) -> np.ndarray:
        return np.array([0.0, *self.joints, 1.0])

    @property
    def breaks(self) -> tuple[float, ...]:
        sizes = np.diff(self.edges)
        own = np.asarray(self.inner.breaks)
        within = [
            tuple((start + size * own).tolist())
            for start, size in zip(self.edges, sizes, strict=False)
        ]
        return merged(self.joints, *within)

    @property
    def resolution(self) -> int:
        return 6 if self.inner.count == 1 else self.inner.resolution

    @property
    def least(self) -> int:
        return self.inner.least

    def __call__(self, s):
        edges, last, parts = self.edges, len(self.joints), []
        for k in range(last + 1):
            start, size = float(edges[k]), float(edges[k + 1] - edges[k])
            values = self.inner((s - start) / size)
            inside = s >= start if k else s < float(edges[1])
            if 0 < k < last:
                inside = inside & (s < float(edges[k + 1]))
            xp = jnp if isinstance(values, jax.Array) else np
            parts.append(xp.where(xp.asarray(inside)[:, None], values, xp.zeros_like(values)))
        return xp.concatenate(parts, axis=1)


def piecewise(basis: StrainBasis, segments: int | Sequence[float]) -> StrainBasis:
    """Every strain of `basis` piecewise: `piecewise(legendre(kappa_z=2), 3)`.

    Args:
        basis: Modes of one segment.
        segments: Number of equal segments, or where they meet in (0, 1).

    Raises:
        ValueError: If there are no segments, or the joints do not rise inside (0, 1).
    """
    if isinstance(segments, int):
        joints = _joints(each_count("piecewise", {"segments": segments})["segments"])
    else:
        joints = checked_breaks("piecewise", segments)
    return StrainBasis({name: Piecewise(m, joints) for name, m in basis.modes.items()})


def piecewise_constant(**segments: int) -> StrainBasis:
    """Constant strains on equal segments: `piecewise_constant(kappa_y=3, kappa_z=3)`."""
    counts = each_count("piecewise_constant", segments)
    return StrainBasis({k: Piecewise(Legendre(1), _joints(n)) for k, n in counts.items()})


def piecewise_linear(**knots: int) -> StrainBasis:
    """Continuous, linear between the values at equal knots: `piecewise_linear(kappa_z=4)`.

    For linear strains that may jump use `piecewise(legendre(kappa_z=2), segments)`.
    """
    counts = each_count("piecewise_linear", knots)
    few = [name for name, count in counts.items() if count < 2]
    if few:
        raise ValueError(
            f"piecewise_linear: `{few[0]}` has 1 knot, need 2 or more, the ends included. Use "
            "constant for one value."
        )
    return StrainBasis({k: BSpline(_joints(n - 1), degree=1) for k, n in counts.items()})


def _joints(segments: int) -> tuple[float, ...]:
    return tuple((np.arange(1, segments) / segments).tolist())

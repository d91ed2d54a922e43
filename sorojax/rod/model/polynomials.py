"""Modes that are smooth along the whole rod: polynomials and Fourier series."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from sorojax.math.quadrature import array_module, chebyshev_values, legendre_values
from sorojax.rod.model.basis import (
    AbstractModes,
    BSpline,
    StrainBasis,
    checked_breaks,
    each_count,
    merged,
)


class Chebyshev(AbstractModes):
    """The first `count` shifted Chebyshev polynomials; the first is constant."""

    count: int = eqx.field(static=True)

    @property
    def resolution(self) -> int:
        return max(8, self.count + 4)

    def __call__(self, s):
        return chebyshev_values(s, self.count - 1).T


class Legendre(AbstractModes):
    """The first `count` shifted Legendre polynomials, orthogonal on [0, 1]."""

    count: int = eqx.field(static=True)

    @property
    def resolution(self) -> int:
        return max(8, self.count + 4)

    def __call__(self, s):
        return legendre_values(s, self.count - 1).T


class Bernstein(AbstractModes):
    """The `count` Bernstein polynomials of degree count - 1: positive, and they sum to 1."""

    count: int = eqx.field(static=True)

    @property
    def resolution(self) -> int:
        return max(8, self.count + 4)

    def __call__(self, s):
        degree, xp = self.count - 1, array_module(s)
        rows = [
            math.comb(degree, k) * s**k * (1 - s) ** (degree - k) for k in range(self.count)
        ]
        return xp.stack(rows, axis=1)


class Fourier(AbstractModes):
    """1, cos 2 pi s, sin 2 pi s, cos 4 pi s, ...: the first `count` of the full waves."""

    count: int = eqx.field(static=True)

    @property
    def resolution(self) -> int:
        return 8 + 4 * (self.count // 2)

    def __call__(self, s):
        xp = array_module(s)
        rows = [s * 0 + 1]
        for k in range(1, self.count):
            wave = 2 * math.pi * ((k + 1) // 2) * s
            rows.append(xp.cos(wave) if k % 2 else xp.sin(wave))
        return xp.stack(rows, axis=1)


def chebyshev(**modes: int) -> StrainBasis:
    """A strain basis of Chebyshev polynomials of the first kind, T_k(2 s - 1), per strain.

    Args:
        **modes: Number of polynomials by strain: `kappa_x` (twist), `kappa_y`, `kappa_z`
            (bending), `sigma_x` (stretch), `sigma_y`, `sigma_z` (shear). Strains that are not
            named keep their rest value.

    Returns:
        The basis; a coordinate has the unit of its strain, [1/m] or [-].

    Raises:
        ValueError: If a strain is unknown, none is named, or a number is below 1.

    Example:
        >>> basis = rod.chebyshev(kappa_z=3, sigma_x=1)
        >>> basis.active, basis.num_dof
        (('kappa_z', 'sigma_x'), 4)
    """
    return _basis("chebyshev", Chebyshev, modes)


def legendre(**modes: int) -> StrainBasis:
    """Legendre modes per strain: `legendre(kappa_z=4, sigma_x=1)`.

    Args:
        **modes: Number of modes of each strain, by its name.

    Returns:
        The basis.
    """
    return _basis("legendre", Legendre, modes)


def bernstein(**modes: int) -> StrainBasis:
    """Bernstein modes per strain: `bernstein(kappa_z=4)` are cubics.

    Args:
        **modes: Number of modes of each strain, by its name.

    Returns:
        The basis.
    """
    return _basis("bernstein", Bernstein, modes)


def fourier(**modes: int) -> StrainBasis:
    """Fourier modes per strain: `fourier(kappa_z=5)` has two full waves.

    Args:
        **modes: Number of modes of each strain, by its name.

    Returns:
        The basis.
    """
    return _basis("fourier", Fourier, modes)


def constant(*names: str) -> StrainBasis:
    """One constant mode per strain: `constant("kappa_z", "sigma_x")`.

    Args:
        *names: Of the active strains.

    Returns:
        The basis, of one coordinate per strain.
    """
    return StrainBasis({name: Legendre(1) for name in names})


def _basis(where: str, kind: type, modes: dict[str, int]) -> StrainBasis:
    return StrainBasis({name: kind(n) for name, n in each_count(where, modes).items()})


# Modes that live on one stretch of the rod each


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
            xp = array_module(values)
            parts.append(xp.where(xp.asarray(inside)[:, None], values, xp.zeros_like(values)))
        return xp.concatenate(parts, axis=1)


def piecewise(basis: StrainBasis, segments: int | Sequence[float]) -> StrainBasis:
    """Every strain of `basis` piecewise: `piecewise(legendre(kappa_z=2), 3)`.

    Args:
        basis: Modes of one segment.
        segments: Number of equal segments, or where they meet in (0, 1).

    Returns:
        The basis of as many segments, each with the modes of `basis`.

    Raises:
        ValueError: If there are no segments, or the joints do not rise inside (0, 1).
    """
    if isinstance(segments, int):
        joints = _joints(each_count("piecewise", {"segments": segments})["segments"])
    else:
        joints = checked_breaks("piecewise", segments)
    return StrainBasis({name: Piecewise(m, joints) for name, m in basis.modes.items()})


def piecewise_constant(**segments: int) -> StrainBasis:
    """A strain basis of constant strains on equal segments (piecewise constant strain).

    Args:
        **segments: Number of segments by strain, names as in `chebyshev`.

    Returns:
        The basis; a coordinate is the strain of one segment, [1/m] or [-].

    Raises:
        ValueError: If a strain is unknown, none is named, or a number is below 1.

    Example:
        >>> basis = rod.piecewise_constant(kappa_z=2)
        >>> basis(np.array([0.25, 0.75]))[0].tolist()
        [[1.0, 0.0], [0.0, 1.0]]

    Reference:
        Renda, Boyer, Dias and Seneviratne, Discrete Cosserat approach for multisection soft
        manipulator dynamics, IEEE T-RO 34, 2018.
    """
    counts = each_count("piecewise_constant", segments)
    return StrainBasis({k: Piecewise(Legendre(1), _joints(n)) for k, n in counts.items()})


def piecewise_linear(**knots: int) -> StrainBasis:
    """Continuous, linear between the values at equal knots: `piecewise_linear(kappa_z=4)`.

    For linear strains that may jump use `piecewise(legendre(kappa_z=2), segments)`.

    Args:
        **knots: Number of knots of each strain, by its name, both ends among them.

    Returns:
        The basis; a coordinate is the strain at a knot.
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

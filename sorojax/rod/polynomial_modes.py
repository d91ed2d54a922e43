"""Modes that are smooth along the whole rod: polynomials and Fourier series."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.math.quadrature import chebyshev_values, legendre_values
from sorojax.rod.basis import AbstractModes, StrainBasis, each_count


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
        degree, xp = self.count - 1, _numbers(s)
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
        xp = _numbers(s)
        rows = [s * 0 + 1]
        for k in range(1, self.count):
            wave = 2 * math.pi * ((k + 1) // 2) * s
            rows.append(xp.cos(wave) if k % 2 else xp.sin(wave))
        return xp.stack(rows, axis=1)


def chebyshev(**modes: int) -> StrainBasis:
    """Chebyshev modes per strain: `chebyshev(kappa_y=3, kappa_z=3)`."""
    return _basis("chebyshev", Chebyshev, modes)


def legendre(**modes: int) -> StrainBasis:
    """Legendre modes per strain: `legendre(kappa_z=4, sigma_x=1)`."""
    return _basis("legendre", Legendre, modes)


def bernstein(**modes: int) -> StrainBasis:
    """Bernstein modes per strain: `bernstein(kappa_z=4)` are cubics."""
    return _basis("bernstein", Bernstein, modes)


def fourier(**modes: int) -> StrainBasis:
    """Fourier modes per strain: `fourier(kappa_z=5)` has two full waves."""
    return _basis("fourier", Fourier, modes)


def constant(*names: str) -> StrainBasis:
    """One constant mode per strain: `constant("kappa_z", "sigma_x")`."""
    return StrainBasis({name: Legendre(1) for name in names})


def _basis(where: str, kind: type, modes: dict[str, int]) -> StrainBasis:
    return StrainBasis({name: kind(n) for name, n in each_count(where, modes).items()})


def _numbers(s):
    return jnp if isinstance(s, jax.Array) else np

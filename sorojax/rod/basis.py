"""Strain bases: which strains of a rod are active, and the shapes they may take."""

import abc
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.quadrature import chebyshev_values, legendre_values

Points: TypeAlias = Float[Array, " points"] | np.ndarray

STRAINS = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")


class AbstractModes(eqx.Module):
    """Shape functions of one strain over the normalised arc length s in [0, 1].

    `count` is the number of modes.
    """

    count: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def resolution(self) -> int:
        """Number of Gauss nodes along the rod that resolves the modes."""

    @abc.abstractmethod
    def __call__(self, s: Points) -> Float[Array, "points modes"]:
        """Values at `s`; a NumPy `s` may give NumPy values, which become constants."""


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


class SampledModes(AbstractModes):
    """Data-driven modes, linear between samples and constant beyond the first and last.

    A mode is differentiable in its values. Sampled modes need as many Gauss nodes as
    their ripples, not as their number.
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
        at = jnp.asarray(s, dtype=self.s.dtype)
        right = jnp.clip(jnp.searchsorted(self.s, at), 1, self.s.shape[0] - 1)
        left = right - 1
        fraction = (at - self.s[left]) / (self.s[right] - self.s[left])
        fraction = jnp.clip(fraction, 0, 1)[:, None]
        return (1 - fraction) * self.values[left] + fraction * self.values[right]


class StrainBasis(eqx.Module):
    """Modes of each active strain; a strain that is not named has no coordinate.

    The coordinates are ordered by strain (`kappa_x kappa_y kappa_z sigma_x sigma_y
    sigma_z`), then by mode: [1/m] for curvatures, [-] for stretch and shear, times the
    value of the mode.
    """

    modes: dict[str, AbstractModes]

    def __check_init__(self):
        unknown = sorted(self.modes.keys() - set(STRAINS))
        if unknown or not self.modes:
            raise ValueError(
                f"StrainBasis: got the strains {unknown or 'none'}, need one or more of "
                f"{', '.join(STRAINS)}. Curvatures are kappa, stretch is sigma_x."
            )

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active strains, in coordinate order."""
        return tuple(name for name in STRAINS if name in self.modes)

    @property
    def num_dof(self) -> int:
        return sum(modes.count for modes in self.modes.values())

    @property
    def resolution(self) -> int:
        return max(modes.resolution for modes in self.modes.values())

    def __or__(self, other: "StrainBasis") -> "StrainBasis":
        """Both bases together; `other` wins where both name a strain."""
        return StrainBasis({**self.modes, **other.modes})

    def __call__(self, s: Points) -> Any:
        """Values at `s`, (active, points, dof), zero outside a strain's own columns."""
        rows, offset = [], 0
        for name in self.active:
            modes = self.modes[name]
            values, behind = modes(s), self.num_dof - offset - modes.count
            xp = jnp if isinstance(values, jax.Array) else np
            rows.append(xp.pad(values, ((0, 0), (offset, behind))))
            offset += modes.count
        is_traced = any(isinstance(row, jax.Array) for row in rows)
        return jnp.stack(rows) if is_traced else np.stack(rows)


def columns(basis: StrainBasis, name: str) -> slice:
    """Where the coordinates of strain `name` lie in q."""
    if name not in basis.modes:
        raise ValueError(
            f"columns: the strain `{name}` is not active, need one of "
            f"{', '.join(basis.active)}. Add it to the basis to give it coordinates."
        )
    start = 0
    for other in basis.active[: basis.active.index(name)]:
        start += basis.modes[other].count
    return slice(start, start + basis.modes[name].count)


def chebyshev(**modes: int) -> StrainBasis:
    """Chebyshev modes per strain: `chebyshev(kappa_y=3, kappa_z=3)`."""
    return StrainBasis({k: Chebyshev(_positive("chebyshev", k, v)) for k, v in modes.items()})


def legendre(**modes: int) -> StrainBasis:
    """Legendre modes per strain: `legendre(kappa_z=4, sigma_x=1)`."""
    return StrainBasis({k: Legendre(_positive("legendre", k, v)) for k, v in modes.items()})


def constant(*names: str) -> StrainBasis:
    """One constant mode per strain: `constant("kappa_z", "sigma_x")`."""
    return StrainBasis({name: Legendre(1) for name in names})


def _positive(where: str, name: str, count: int) -> int:
    if not isinstance(count, int) or count < 1:
        raise ValueError(
            f"{where}: `{name}` must be a number of modes, 1 or more, got {count!r}. "
            "Leave the strain out to keep it at rest."
        )
    return count


def _is_grid(s: np.ndarray) -> bool:
    rises = s.ndim == 1 and s.size > 1 and bool(np.all(np.diff(s) > 0))
    return rises and s[0] >= 0 and s[-1] <= 1 + 1e-12

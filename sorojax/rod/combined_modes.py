"""Combinations of modes: orthonormal ones, and smooth ones fitted to samples."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.trace_state import is_traced
from sorojax.math.quadrature import Quadrature, gauss_legendre
from sorojax.rod.basis import AbstractModes, StrainBasis, merged
from sorojax.rod.given_modes import SampledModes


class Combined(AbstractModes):
    """Linear combinations of other modes, one per column of `mix`."""

    inner: AbstractModes
    mix: Float[Array, "inner modes"] | np.ndarray

    def __check_init__(self):
        shape = jnp.shape(self.mix)
        if len(shape) != 2 or shape[0] != self.inner.count or shape[1] < 1:
            raise ValueError(
                f"Combined: `mix` has shape {shape}, need ({self.inner.count}, modes). Give "
                "one row per mode of `inner`."
            )

    @property
    def count(self) -> int:
        return self.mix.shape[1]

    @property
    def breaks(self) -> tuple[float, ...]:
        return self.inner.breaks

    @property
    def resolution(self) -> int:
        return self.inner.resolution

    def __call__(self, s):
        values = self.inner(s)
        if isinstance(values, jax.Array) or isinstance(self.mix, jax.Array):
            return jnp.asarray(values) @ jnp.asarray(self.mix, values.dtype)
        return values @ self.mix


def orthonormalise(basis: StrainBasis) -> StrainBasis:
    """The modes of each strain made orthonormal: integral of f_i f_j over [0, 1] = delta_ij.

    They span what the modes of `basis` span, and mode k uses the first k of them only.

    Raises:
        ValueError: If the modes of a strain depend on each other.
    """
    return StrainBasis({name: _orthonormal(name, modes) for name, modes in basis.modes.items()})


def _orthonormal(name: str, modes: AbstractModes) -> Combined:
    s, w = gauss_legendre(_exact_rule(modes))
    values = modes(s)
    # QR keeps twice the digits of a Cholesky factor of the Gram matrix.
    if is_traced(values):
        factor = jnp.linalg.qr(jnp.sqrt(jnp.asarray(w, values.dtype))[:, None] * values)[1]
        return Combined(modes, jnp.linalg.inv(factor * jnp.sign(jnp.diagonal(factor))[:, None]))
    factor = np.linalg.qr(np.sqrt(w)[:, None] * np.asarray(values, np.float64))[1]
    _check_independent(name, np.diag(factor))
    mix = np.linalg.inv(factor * np.sign(np.diag(factor))[:, None])
    is_on_device = isinstance(values, jax.Array)
    return Combined(modes, jnp.asarray(mix, values.dtype) if is_on_device else mix)


def fitted(basis: StrainBasis, to: AbstractModes) -> StrainBasis:
    """`basis` with its sampled modes replaced by the nearest combinations of `to`.

    Smooth modes need fewer Gauss nodes, and keep the order of the rotations. The distance
    is that of least squares at the samples, by trapezoidal weights.

    Args:
        basis: Modes; those that are not sampled stay as they are.
        to: What to combine, e.g. `Legendre(12)` or `BSpline((0.25, 0.5, 0.75))`.

    Raises:
        ValueError: If there are fewer samples than modes in `to`.
    """
    return StrainBasis({name: _fit(name, modes, to) for name, modes in basis.modes.items()})


def _fit(name: str, modes: AbstractModes, to: AbstractModes) -> AbstractModes:
    if not isinstance(modes, SampledModes):
        return modes
    s = np.asarray(modes.s)
    if len(s) < to.count:
        raise ValueError(
            f"fitted: `{name}` has {len(s)} samples, need {to.count} or more for the "
            f"{to.count} modes of {type(to).__name__}. Take fewer modes."
        )
    gaps = np.pad(np.diff(s), 1)
    root = np.sqrt((gaps[1:] + gaps[:-1]) / 2)[:, None]
    shapes, dtype = to(s), modes.values.dtype
    if is_traced(shapes):
        inverse = jnp.linalg.pinv(jnp.asarray(root, shapes.dtype) * shapes)
    else:
        inverse = np.linalg.pinv(root * np.asarray(shapes, np.float64))
    return Combined(to, jnp.asarray(inverse, dtype) @ (jnp.asarray(root, dtype) * modes.values))


def _exact_rule(modes: AbstractModes) -> Quadrature:
    """A rule exact for products of the modes, to rounding if they are no polynomials."""
    if isinstance(modes, SampledModes):
        s = np.clip(np.asarray(modes.s), 0.0, 1.0)
        return Quadrature(2, merged(tuple(s[(s > 0) & (s < 1)].tolist())))
    if isinstance(modes, Combined):
        return _exact_rule(modes.inner)
    return Quadrature(2 * modes.resolution + 16, modes.breaks)


def _check_independent(name: str, diagonal: np.ndarray) -> None:
    least = np.abs(diagonal).min() / np.abs(diagonal).max()
    if not least > 1e-12:
        raise ValueError(
            f"orthonormalise: the {len(diagonal)} modes of `{name}` depend on each other (to "
            f"{least:.0e}), need independent ones. Leave some out."
        )

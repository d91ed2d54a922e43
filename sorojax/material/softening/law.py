"""Softening of filled rubbers by what they have borne (the Mullins effect).

A stretch beyond all before follows the law of the first loading; below the largest one the
rubber is softer, on the way back and when it is loaded again. With W the energy of the change
of shape by the law `base`, and M the largest W since the rubber was made, the stress of that
energy is multiplied by

    eta = 1 - erf((M - W) / s) / r,        s = m + beta M,

and the rubber gives back psi = int_0^W eta dW, while

    D(M) = s / r g(M / s),        g(y) = y erf(y) - (1 - exp(-y^2)) / sqrt(pi)

has turned into heat: dD/dM = (erf(y) m / s + beta g(y)) / r with y = M / s is never negative.
Within a step M is known, so the rubber is hyperelastic there; after the step M is the larger
of M and W. Stress is continuous at W = M, its slope is not: loading again is stiffer there.

References:
    Mullins, "Effect of stretching on the properties of rubber", J. Rubber Res. 16, 1947.
    Ogden and Roxburgh, "A pseudo-elastic model for the Mullins effect in filled rubber", Proc.
    R. Soc. A 455, 1999, with beta = 0. Bose, Hurtado, Snyman, Mars and Chen, "Modelling of
    stress softening in filled elastomers", Constitutive Models for Rubber III, 2003, for beta.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._types import Numbers, optional_real, real
from sorojax.material import checks
from sorojax.material.homogeneous import lateral_stretch
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    finite_share,
    first_invariant_energy,
    rest_stretches,
)
from sorojax.material.kinematics import Entry, Tensor

Peak = Float[Array, "..."]


class Softening(AbstractHyperelastic):
    """`base` that is softer below the largest energy that it has stored.

    `fem.solve_path`, `fem.simulate` and bodies in networks remember that energy at every
    quadrature point, from state to state and from step to step. Everywhere else, `fem.solve`
    for instance, `peak` stays as it is. The equations are those at the head of this module.

    It stands outermost, or within `Viscoelastic` alone: `Softening(Mixed(...), ...)`, with one
    number per cell where cells differ and an infinite `r` where nothing softens.

    Attributes:
        base: The law of the first loading.
        r: Stress is at least 1 - 1/r of that of the first loading [-]; above 1.
        m: Energy below the peak within which most of the rest is lost [J/m^3], after small
            peaks; after large ones it is beta times the peak more.
        beta: That factor [-].
        peak: Largest energy before [J/m^3]; none by default, the rubber is as made.
        remembers: Whether larger energies raise the peak. `preconditioned` gives False: a
            plain elastic law.

    References: Ogden & Roxburgh, Proc. R. Soc. A 455, 1999; Bose et al., Constitutive Models
    for Rubber III, 2003.
    """

    base: AbstractHyperelastic
    r: Float[Array, "..."] = eqx.field(converter=real)
    m: Float[Array, "..."] = eqx.field(converter=real)
    beta: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    peak: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    remembers: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        checks.leaves("Softening", self)
        if _check.is_concrete(self.r) and not np.all(np.asarray(self.r) > 1):
            raise ValueError(
                f"Softening: `r` is {np.asarray(self.r).tolist()}, need more than 1: at 1 all "
                "stiffness would be lost. Typical are 1.2 to 5."
            )
        _check.positive("Softening", "m", self.m, "J/m^3", "An energy: 1 kJ/m^3 is 1e3.")
        do = "It is 0 where every peak recovers within the energy m."
        _check.finite("Softening", "beta", self.beta, do)
        _check.not_negative("Softening", "beta", self.beta, "", do)
        if self.peak is not None:
            do = "The energy of the first loading, 0 of a rubber as made."
            _check.finite("Softening", "peak", self.peak, do)
            _check.not_negative("Softening", "peak", self.peak, "J/m^3", do)
        if not is_traced(self.base):
            with evaluated_now():
                _check_rest(self.base)

    @property
    def density(self):
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self._recoverable(self.base.isochoric_energy(F))

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.base.volumetric_energy(J)

    def _recoverable(self, W: Entry) -> Entry:
        """psi [J/m^3] at the energy `W` of the first loading."""
        if self.peak is None:
            return W
        # a body back at its peak meets it but for rounding, in which programs differ: it is on
        # the first loading in all of them, or the parts of a derivative would not fit
        peak = self.peak * (1 - jnp.finfo(self.peak.dtype).eps ** (2 / 3))
        s = self.m + self.beta * peak
        below = jnp.where(peak > W, (peak - W) / s, jnp.zeros_like(W / s))
        return W + s / self.r * _area(below) - dissipated_energy(self, peak)


def _check_rest(base: AbstractHyperelastic) -> None:
    """Raise unless the energy that softens is least, and zero, where the body is at rest:
    otherwise a softened body would not be free of stress there."""
    ways = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    factors = 1 + 1e-2 * np.concatenate([ways, -ways])
    if any(np.ndim(leaf) for leaf in jax.tree.leaves(base)):
        factors = factors[:, :, None]  # in front of cells
    rest = (real(g)[None] if np.ndim(g) else g for g in rest_stretches(base))
    a, b, c = (real(g * factor) for g, factor in zip(rest, factors.swapaxes(0, 1), strict=True))
    F = ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    values = np.asarray(base.isochoric_energy(F))
    largest = values.max(axis=0)
    if np.any(values.min(axis=0) < -0.1 * largest) or np.any(values[0] > 0.1 * largest):
        raise ValueError(
            f"Softening: the energy of the change of shape of {type(base).__name__} is not "
            "least, and zero, at rest, so the softened body would be stressed there. Take a "
            "law with an isochoric part, such as NeoHookean."
        )


@rest_stretches.register
def _(material: Softening):
    return rest_stretches(material.base)


@finite_share.register
def _(material: Softening):
    return finite_share(material.base)


@first_invariant_energy.register
def _(material: Softening):
    base = first_invariant_energy(material.base)
    return None if base is None else lambda x: material._recoverable(base(x))


@jax.custom_jvp
def _area(y: Entry) -> Entry:
    """Integral of erf from 0 to y."""
    return y * jax.lax.erf(y) + jnp.expm1(-y * y) / math.sqrt(math.pi)


@_area.defjvp
def _(primals, tangents):
    (y,), (move,) = primals, tangents
    return _area(y), jax.lax.erf(y) * move


def dissipated_energy(softening: Softening, peak: Numbers) -> Float[Array, "..."]:
    """D [J/m^3]: what a rubber has turned into heat whose largest energy is `peak` [J/m^3].

    A loop of loading up to a peak and back encloses its rise.

    Args:
        softening: The rubber; its own `peak` plays no part.
        peak: Largest energy of the first loading [J/m^3].

    Returns:
        Energy per reference volume [J/m^3].

    Example:
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
        >>> soft = material.Softening(rubber, r=2.0, m=2e4)
        >>> print(f"{float(material.dissipated_energy(soft, 1e5)) / 1e3:.1f} kJ/m^3")
        44.4 kJ/m^3

    Reference:
        Ogden and Roxburgh, Proc. R. Soc. A 455, 1999.
    """
    peak = real(peak)
    s = softening.m + softening.beta * peak
    return s / softening.r * _area(peak / s)


def preconditioned(
    softening: Softening, *, stretch: Numbers | None = None, energy: Numbers | None = None
) -> Softening:
    """The elastic law of a rubber that has been stretched before, the same at every point.

    A part that was cycled to the uniaxial `stretch` until its stress repeats follows this law
    below it. Beyond, it follows the first loading, which it does not remember: the law may be
    used wherever an elastic one may.

    Args:
        softening: The rubber as made.
        stretch: Largest uniaxial stretch before, with free sides [-]; or
        energy: the largest energy of the first loading before [J/m^3].

    Returns:
        The law with that `peak`, a number or one per cell.

    Raises:
        ValueError: If not exactly one of `stretch` and `energy` is given, or out of range.

    Example:
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.49)
        >>> soft = material.Softening(rubber, r=2.0, m=2e4)
        >>> used = material.preconditioned(soft, stretch=2.0)
        >>> stress = [material.uniaxial_stress(law, jnp.array(1.5)) for law in (soft, used)]
        >>> [round(float(s) / kPa) for s in stress]
        [350, 176]

    Reference:
        Ogden and Roxburgh, Proc. R. Soc. A 455, 1999.
    """
    _check_kind("preconditioned", softening)
    if (stretch is None) == (energy is None):
        raise ValueError(
            "preconditioned: got both of `stretch` and `energy`, or none, need one. Write "
            "preconditioned(rubber, stretch=2.0)."
        )
    given = energy if stretch is None else uniaxial_energy(softening.base, stretch)
    assert given is not None
    peak = real(given)
    _check.not_negative("preconditioned", "energy", peak, "J/m^3", "That of a first loading.")
    made = with_peak(softening, peak)
    return Softening(made.base, made.r, made.m, made.beta, made.peak, remembers=False)


def _check_kind(where: str, softening: Any) -> None:
    if not isinstance(softening, Softening):
        raise TypeError(
            f"{where}: got a {type(softening).__name__}, need a rubber that softens. Write "
            "material.Softening(rubber, r=2.0, m=2e4)."
        )


def uniaxial_energy(base: AbstractHyperelastic, stretch: Numbers) -> Float[Array, "..."]:
    """Energy of the change of shape [J/m^3] of a bar at `stretch` with free sides."""
    stretch = real(stretch)
    _check.positive("preconditioned", "stretch", stretch, "", "1 is at rest, 2 twice as long.")
    across = lateral_stretch(base, stretch)
    return base.isochoric_energy(((stretch, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across)))


# What remembers


def remembering(material: AbstractHyperelastic) -> Softening | None:
    """`material` if it remembers its largest energy."""
    return material if isinstance(material, Softening) and material.remembers else None


def with_peak(softening: Softening, peak: Peak) -> Softening:
    """`softening` with the largest energy `peak` [J/m^3], points in front of cells if it has
    one number for each."""
    return eqx.tree_at(lambda law: law.peak, softening, peak, is_leaf=lambda x: x is None)


def raised(softening: Softening, F: Tensor) -> Peak:
    """The peak after the deformation `F`; that of a rubber as made is 0."""
    W = softening.base.isochoric_energy(F)
    before = jnp.zeros_like(W) if softening.peak is None else softening.peak
    return jnp.where(before < W, W, before)

"""Viscoelastic rubbers: a hyperelastic law with Maxwell branches beside it.

The law `base` bears what is left when everything has relaxed. Branch i is a network of chains
that break at the rate 1/tau_i and form anew without stress. With C = J^(-2/3) F'F, the
isochoric strain, it stores and takes per reference volume

    W_i = g_i mu / 2 (A_i : C - 3 - ln det A_i),        dA_i/dt = (C^-1 - A_i) / tau_i,
    D_i = g_i mu / (2 tau_i) tr(X + X^-1 - 2 I) >= 0,   X = A_i C,

with mu the shear modulus of `base` at rest. A_i is the inverse (F_v'F_v)^-1 of a multiplicative
split F = F_e F_v whose flow is linear in it, so a step has a closed form, where that of Reese
and Govindjee is iterated at every point. Simo's convolution of the stress of any law has a
closed form too, but laws of the second invariant give energy back in some cycles
(`tests/test_viscoelastic.py`); D_i is positive in every history.

Where C^-1 changes linearly in a step of x = h / tau_i, with f = (1 - e^-x) / x,

    A_i(t + h) = e^-x A_i(t) + (f - e^-x) C^-1(t) + (1 - f) C^-1(t + h),

of order 2 and stable at every step. The isochoric stress of C^-1 at the end vanishes, so the
step has the potential W + H : C / 2 with a positive definite H that is known when it begins.

References:
    Green and Tobolsky, "A new approach to the theory of relaxing polymeric media", J. Chem.
    Phys. 14, 1946. Lubliner, "A model of rubber viscoelasticity", Mech. Res. Commun. 12, 1985.
    Simo, "On a fully three-dimensional finite-strain viscoelastic damage model", CMAME 60,
    1987. Reese and Govindjee, "A theory of finite viscoelasticity and numerical aspects",
    Int. J. Solids Struct. 35, 1998.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.material import checks
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    finite_share,
    first_invariant_energy,
    first_piola_kirchhoff_stress,
    rest_stretches,
    small_strain_moduli,
)
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    cofactor,
    determinant,
    from_matrix,
    is_planar,
    plus,
    right_cauchy_green,
    times,
)
from sorojax.material.softening.law import Softening, raised, remembering, with_peak
from sorojax.math.linalg.dense import inverse_cube_root

Terms = tuple[Float[Array, "..."], ...]


def _terms(value: Any) -> Terms:
    """One leaf per branch: from a sequence, or the rows of an array."""
    many = isinstance(value, list | tuple) or np.ndim(value)
    return tuple(real(entry) for entry in value) if many else (real(value),)


class Prony(eqx.Module):
    """A relaxation spectrum: G(t) / G_inf = 1 + sum_i g_i exp(-t / tau_i).

    `shares` g_i [-] are moduli of the branches over the long-time modulus G_inf, `times` tau_i
    [s] increase; each has one entry per branch, a number or one number per cell of a mesh.
    `prony_of_instantaneous` takes shares of the instantaneous modulus, as tables often have
    them. Solids and rods take the same spectrum.
    """

    shares: Terms = eqx.field(converter=_terms)
    times: Terms = eqx.field(converter=_terms)

    def __check_init__(self):
        if len(self.shares) != len(self.times) or not self.shares:
            raise ValueError(
                f"Prony: got {len(self.shares)} shares and {len(self.times)} times, need as "
                "many of each, at least one. Give two tuples of equal length."
            )
        checks.leaves("Prony", self)
        do = "A branch adds stiffness: shares are its modulus over the long-time one."
        for share in self.shares:
            _check.finite("Prony", "shares", share, do)
            _check.not_negative("Prony", "shares", share, "", do)
        for time in self.times:
            _check.positive("Prony", "times", time, "s", "A relaxation time is in seconds.")
        for early, late in zip(self.times[:-1], self.times[1:], strict=True):
            if _concrete(early, late) and np.any(np.asarray(early) >= np.asarray(late)):
                raise ValueError(
                    f"Prony: `times` are {_listed(self.times)} s, need each longer than the "
                    "one before. Sort the branches by time and merge those of equal times."
                )


def _concrete(*values: Any) -> bool:
    return all(_check.is_concrete(value) for value in values)


def _listed(values: Terms) -> list:
    return [np.asarray(value).tolist() for value in values]


def prony_of_instantaneous(shares: Numbers, times: Numbers) -> Prony:
    """The spectrum whose `shares` [-] are of the instantaneous modulus G_0 instead:
    G(t) / G_0 = 1 - sum_i s_i (1 - exp(-t / tau_i)), with a sum of shares below 1.

    The base of a `Viscoelastic` with it is the law of slow loading, of modulus
    G_inf = G_0 `long_time_share(spectrum)`.

    Args:
        shares: Moduli of the branches over G_0 [-].
        times: Relaxation times [s].

    Returns:
        The spectrum.

    Raises:
        ValueError: If the shares leave no long-time modulus, or `Prony` refuses them.
    """
    found = Prony(_terms(shares), times)
    left = 1 - sum(found.shares[1:], start=found.shares[0])
    _check.positive(
        "prony_of_instantaneous",
        "1 - sum of shares",
        left,
        "",
        "A solid keeps some stiffness for ever: shares of G_0 add up to less than 1.",
    )
    return Prony(tuple(share / left for share in found.shares), found.times)


def long_time_share(spectrum: Prony) -> Float[Array, "..."]:
    """Long-time modulus over the instantaneous one [-].

    Args:
        spectrum: Shares and relaxation times.

    Returns:
        The share [-].
    """
    return 1 / relaxation_modulus(spectrum, 0.0)


def relaxation_modulus(spectrum: Prony, t: Numbers) -> Float[Array, "..."]:
    """G(t) / G_inf at the time `t` [s] after a step of strain.

    Args:
        spectrum: Shares and relaxation times.
        t: Time [s].

    Returns:
        Modulus over that of slow loading [-].
    """
    t = real(t)
    total = jnp.ones_like(t)
    for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
        total = total + g * jnp.exp(-t / tau)
    return total


def storage_modulus(spectrum: Prony, omega: Numbers) -> Float[Array, "..."]:
    """G'(omega) / G_inf, in phase with a strain of the angular frequency `omega` [rad/s].

    Args:
        spectrum: Shares and relaxation times.
        omega: Angular frequency [rad/s].

    Returns:
        Modulus over that of slow loading [-].
    """
    omega = real(omega)
    total = jnp.ones_like(omega)
    for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
        x = omega * tau
        total = total + g * x**2 / (1 + x**2)
    return total


def loss_modulus(spectrum: Prony, omega: Numbers) -> Float[Array, "..."]:
    """G''(omega) / G_inf, a quarter of a period ahead of the strain.

    Args:
        spectrum: Shares and relaxation times.
        omega: Angular frequency [rad/s].

    Returns:
        Modulus over that of slow loading [-].
    """
    omega = real(omega)
    total = jnp.zeros_like(omega)
    for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
        x = omega * tau
        total = total + g * x / (1 + x**2)
    return total


def uniaxial_spectrum(spectrum: Prony, poisson_ratio: Numbers) -> Prony:
    """The spectrum of Young's modulus, E(t) / E_inf, of a solid whose shear modulus relaxes by
    `spectrum` while its bulk modulus is constant.

    By the correspondence principle E = 9 K G / (3 K + G) holds between Laplace transforms. It
    has a simple pole between each two of G, so E has as many branches as G: with K = G_inf /
    (3 a) and a = (1 - 2 nu) / (2 + 2 nu) their rates are the roots of 1 + a G / G_inf, their
    shares the residues there. For nu = 0.5 both spectra are the same.

    Args:
        spectrum: Of the shear modulus, one number for each constant.
        poisson_ratio: Long-time ratio nu [-].

    Returns:
        Shares of E_inf and times [s], as many as those of the shear modulus.

    Raises:
        ValueError: If a constant is more than one number, or the ratio is outside (-1, 0.5].

    Example:
        >>> shear = material.Prony([0.5, 0.3], [0.01, 0.1])
        >>> pull = material.uniaxial_spectrum(shear, 0.4)
        >>> print([round(float(g), 3) for g in pull.shares])
        [0.432, 0.276]

    Reference:
        Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989, for the
        principle.
    """
    nu, do = real(poisson_ratio), "Give the ratio of slow loading; rubber has almost 0.5."
    _check.between("uniaxial_spectrum", "poisson_ratio", nu, -1, 0.5, "-", do, "(]")
    for name, value in (("shares", spectrum.shares), ("times", spectrum.times)):
        for entry in value:
            do = "Make one spectrum per region."
            _check.shape("uniaxial_spectrum", name, entry, (), do)
    a, g, tau = (1 - 2 * nu) / (2 + 2 * nu), *map(jnp.stack, (spectrum.shares, spectrum.times))
    eye = jnp.eye(g.shape[0], dtype=bool)

    def shear(s):
        """G / G_inf at -s, times the product of all 1 - s tau, and that product."""
        factors = 1 - s * tau
        others = jnp.prod(jnp.where(eye, 1.0, factors[None]), axis=1)
        whole = jnp.prod(factors)
        return whole - s * jnp.sum(g * tau * others), whole

    def poles(s):
        numerator, whole = shear(s)
        return whole + a * numerator

    u, slope = jnp.sqrt(g / tau), jax.vmap(jax.grad(poles))
    matrix = jnp.diag(1 / tau) - a / (1 + a * (1 + jnp.sum(g))) * u[:, None] * u[None]
    rates = jax.lax.stop_gradient(jnp.linalg.eigvalsh(matrix)[::-1])
    for _ in range(3):  # removes rounding, and gives the roots their derivatives
        rates = rates - jax.vmap(poles)(rates) / slope(rates)
    shares = (1 + a) * jax.vmap(shear)(rates)[0] / (rates * slope(rates))
    shares = shares - jax.lax.stop_gradient(jnp.minimum(shares, 0))  # rounding of a share of 0
    return Prony(tuple(shares), tuple(1 / rates))


Weights = tuple[Entry, Entry, Entry]


def step_weights(spectrum: Prony, step: Float[Array, ""] | float) -> list[Weights]:
    """`branch_weights` of each branch for a step [s]."""
    return [branch_weights(tau, step) for tau in spectrum.times]


def branch_weights(tau: Entry, step: Float[Array, ""] | float) -> Weights:
    """e^-x, f - e^-x and 1 - f with x = `step` / `tau` and f = (1 - e^-x) / x: weights of the
    state of a branch before a step [s] and of what it relaxes to before and after."""
    x = step / tau
    decay, mean = jnp.exp(-x), -jnp.expm1(-x) / x
    return decay, mean - decay, 1 - mean


# The materials: of a body, and of a body within a step


class Viscoelastic(AbstractHyperelastic):
    """`base` with Maxwell branches of the spectrum `relaxation` beside it.

    Where time plays a part (`fem.simulate`, `fem.solve_path` with `times`, bodies in
    networks) the branches bear g_i mu, mu the shear modulus of `base` at rest, and relax;
    they are neo-Hookean and isochoric. Everywhere else, `fem.solve` for instance, the body
    has all the time there is: it is `base`. A motion begins relaxed at the displacement that
    it begins with. The equations are those at the head of this module.

    It stands outermost: `Viscoelastic(Mixed(...), ...)`, with shares per cell and 0 where
    there is no branch.

    References: Lubliner, Mech. Res. Commun. 12, 1985; Reese & Govindjee, Int. J. Solids
    Struct. 35, 1998.
    """

    base: AbstractHyperelastic
    relaxation: Prony

    def __check_init__(self):
        if not isinstance(self.relaxation, Prony):
            raise TypeError(
                f"Viscoelastic: `relaxation` is a {type(self.relaxation).__name__}, need a "
                "spectrum. Write material.Prony(shares, times)."
            )
        checks.leaves("Viscoelastic", self)

    @property
    def density(self):
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.base.isochoric_energy(F)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.base.volumetric_energy(J)


class Overstressed(AbstractHyperelastic):
    """The energy of `base` plus `stress` : C / 2 of the isochoric strain C: a viscoelastic
    solid within a step, or at an instant, with `stress` [Pa] the sum g_i mu A_i of what its
    branches remember. `stress` has the entries of `pairs`, points behind them.
    """

    base: AbstractHyperelastic
    stress: Float[Array, "pairs ..."]

    @property
    def density(self):
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        work = contraction(tuple(self.stress), isochoric_strain(F))
        return self.base.isochoric_energy(F) + work / 2

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.base.volumetric_energy(J)


@rest_stretches.register
def _(material: Viscoelastic):
    return rest_stretches(material.base)


@first_invariant_energy.register(Viscoelastic)
@first_invariant_energy.register(Overstressed)
def _(material):
    """Of the part without the overstress."""
    return first_invariant_energy(material.base)


@finite_share.register(Viscoelastic)
@finite_share.register(Overstressed)
def _(material):
    return finite_share(material.base)


# Symmetric tensors by the entries that may differ from zero, elementwise over points


Sym = tuple[Entry, ...]
_PLANAR = ((0, 0), (0, 1), (1, 1), (2, 2))
_SPATIAL = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Places of the entries of a symmetric tensor of 4 (planar) or 6 entries."""
    return _PLANAR if count == len(_PLANAR) else _SPATIAL


def _symmetric(F: Tensor, full: Tensor) -> Sym:
    return tuple(full[i][j] for i, j in (_PLANAR if is_planar(F) else _SPATIAL))


def contraction(a: Sym, b: Sym) -> Entry:
    """a : b."""
    total: Entry = 0.0
    for (i, j), x, y in zip(pairs(len(a)), a, b, strict=True):
        both = times(x, y)
        total = plus(total, both if i == j else plus(both, both))
    return total


def isochoric_strain(F: Tensor) -> Sym:
    """C = J^(-2/3) F'F."""
    root = inverse_cube_root(determinant(F))
    return tuple(times(root * root, entry) for entry in _symmetric(F, right_cauchy_green(F)))


def inverse_strain(F: Tensor) -> Sym:
    """C^-1 of the isochoric strain C."""
    scale = inverse_cube_root(determinant(F)) ** 4
    return tuple(
        times(scale, entry) for entry in _symmetric(F, right_cauchy_green(cofactor(F)))
    )


def overstress(material: AbstractHyperelastic) -> Tensor | None:
    """The `stress` of a material within a step, `None` where there is none."""
    return _tensor(tuple(material.stress)) if isinstance(material, Overstressed) else None


def _tensor(a: Sym) -> Tensor:
    full: list[list[Entry]] = [[0.0] * 3 for _ in range(3)]
    for (i, j), entry in zip(pairs(len(a)), a, strict=True):
        full[i][j] = full[j][i] = entry
    return tuple(map(tuple, full))  # type: ignore[return-value]


def _inverse(a: Sym) -> Sym:
    full = _tensor(a)
    shrink = 1 / determinant(full)
    return tuple(times(entry, shrink) for entry in _symmetric(full, cofactor(full)))


# One step of the branches; `rows` are C^-1 and every A_i


def branch_moduli(material: Viscoelastic) -> Terms:
    """Shear moduli g_i mu of the branches [Pa]."""
    shear = small_strain_moduli(material.base)[0]
    return tuple(share * shear for share in material.relaxation.shares)


def remembered(moduli: Terms, weights: list[Weights], rows: list[Sym]) -> Sym:
    """H [Pa]: the overstress at the end of a step, with what it began with."""
    inverse, *states = rows
    total = [0.0] * len(inverse)
    for modulus, (decay, before, _), state in zip(moduli, weights, states, strict=True):
        each = (decay * a + before * c for a, c in zip(state, inverse, strict=True))
        total = [plus(sum_, modulus * entry) for sum_, entry in zip(total, each, strict=True)]
    return tuple(total)


def relaxed_by(weights: list[Weights], rows: list[Sym], inverse: Sym) -> list[Sym]:
    """The rows after a step that ends with `inverse` C^-1."""
    first, *states = rows
    new = [inverse]
    for (decay, before, after), state in zip(weights, states, strict=True):
        entries = zip(state, first, inverse, strict=True)
        new.append(tuple(decay * a + before * c + after * d for a, c, d in entries))
    return new


def borne(moduli: Terms, rows: list[Sym]) -> Sym:
    """H [Pa] of the instant: sum of g_i mu A_i."""
    scaled = [
        tuple(modulus * entry for entry in state)
        for modulus, state in zip(moduli, rows[1:], strict=True)
    ]
    return tuple(sum(column[1:], start=column[0]) for column in zip(*scaled, strict=True))


def free_energy(moduli: Terms, rows: list[Sym]) -> Entry:
    """Sum of W_i [J/m^3] without its part H : C / 2."""
    total: Entry = 0.0
    for modulus, A in zip(moduli, rows[1:], strict=True):
        total = plus(total, -modulus / 2 * (3 + jnp.log(determinant(_tensor(A)))))
    return total


def dissipation(moduli: Terms, spectrum: Prony, rows: list[Sym]) -> Entry:
    """Sum of D_i [W/m^3], never negative."""
    inverse, *states = rows
    C, total = _inverse(inverse), 0.0
    for modulus, tau, A in zip(moduli, spectrum.times, states, strict=True):
        excess = contraction(A, C) + contraction(_inverse(A), inverse) - 6
        total = plus(total, modulus / (2 * tau) * excess)
    return total


def stress_history(
    material: Viscoelastic | Softening,
    times: Float[Array, " steps"] | None,
    F: Float[Array, "steps 3 3"],
) -> Float[Array, "steps 3 3"]:
    """First Piola-Kirchhoff stress [Pa] along a history of the deformation gradient.

    The material is relaxed at the first `F`; between two times C^-1 changes linearly. One that
    softens remembers the largest energy of the deformations before.

    Args:
        material: With one number for each constant.
        times: Increasing times [s]; None of a `Softening`, where they play no part.
        F: Deformation gradients, one for each time.

    Returns:
        P at every time.

    Raises:
        ValueError: If the shapes do not fit or times do not increase.

    Example:
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
        >>> silicone = material.Viscoelastic(rubber, material.Prony([0.5], [0.1]))
        >>> sheared = jnp.eye(3).at[0, 1].set(0.2)
        >>> times, F = jnp.array([0, 1e-6, 0.1, 1.0]), [jnp.eye(3), *3 * [sheared]]
        >>> P = material.stress_history(silicone, times, jnp.stack(F))
        >>> (P[:, 0, 1] / kPa).round(1).tolist()
        [0.0, 103.4, 81.7, 69.0]

    Reference:
        Lubliner, A model of rubber viscoelasticity, Mech. Res. Commun. 12, 1985.
    """
    if isinstance(material, Softening):
        return _softened_history(material, real(F))
    if times is None:
        raise ValueError(
            "stress_history: got no times of a Viscoelastic, need them: branches relax. Give "
            "one increasing time [s] for each F."
        )
    times, F = real(times), real(F)
    _check.shape("stress_history", "times", times, (None,), "Give a row of times [s].")
    _check.shape(
        "stress_history", "F", F, (times.shape[0], 3, 3), "Give one matrix for each time."
    )
    steps = jnp.diff(times)
    _check.positive("stress_history", "steps of times", steps, "s", "Sort the times.")
    moduli, spectrum = branch_moduli(material), material.relaxation
    law = remembering(material.base)

    def advance(carry, row):
        (rows, peak), (step, F) = carry, row
        softened = None if law is None else with_peak(law, peak)
        base = material.base if softened is None else softened
        weights = step_weights(spectrum, step)
        before = [tuple(each) for each in rows]
        stress = jnp.stack(remembered(moduli, weights, before))
        P = first_piola_kirchhoff_stress(Overstressed(base, stress), F)
        rows = _stacked(relaxed_by(weights, before, inverse_strain(from_matrix(F))))
        return (rows, None if softened is None else raised(softened, from_matrix(F))), P

    first = jnp.stack(inverse_strain(from_matrix(F[0])))
    start = jnp.broadcast_to(first, (1 + len(moduli), *first.shape))
    peak = None if law is None else raised(law, from_matrix(F[0]))
    _, later = jax.lax.scan(advance, (start, peak), (steps, F[1:]))
    at_start = first_piola_kirchhoff_stress(material, F[0])
    return jnp.concatenate([at_start[None], later])


def _softened_history(softening: Softening, F: Float[Array, "steps 3 3"]):
    if not softening.remembers:
        return jax.vmap(lambda F: first_piola_kirchhoff_stress(softening, F))(F)

    def advance(peak, F):
        law = with_peak(softening, peak)
        return raised(law, from_matrix(F)), first_piola_kirchhoff_stress(law, F)

    return jax.lax.scan(advance, raised(softening, from_matrix(F[0])), F)[1]


def _stacked(rows: list[Sym]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])

"""Time integration methods of second order.

A step from n to n + 1 of size h solves, with x_c = (1 - c) x_(n+1) + c x_n,

    M a_am + C v_af + f_int(u_af) = f_ext(t_af),
    u_(n+1) = u_n + h v_n + h^2 ((1/2 - beta) a_n + beta a_(n+1)),
    v_(n+1) = v_n + h ((1 - gamma) a_n + gamma a_(n+1)).

The energy-momentum method takes the stress dE/dC at the mean C = F'F of the states before and
after, plus the multiple of the increment of C that makes its work the increment of energy.

References:
    Chung, Hulbert, "A time integration algorithm for structural dynamics with improved
    numerical dissipation: the generalized-alpha method", J. Appl. Mech. 60, 1993.
    Newmark, "A method of computation for structural dynamics", J. Eng. Mech. 85, 1959.
    Gonzalez, "Exact energy and momentum conserving algorithms for general models in
    nonlinear elasticity", CMAME 190, 2000.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.fem.assembly.energy import energy_density
from sorojax.fem.assembly.geometry import deformation, quadrature_points
from sorojax.fem.kinematics import AbstractKinematics, green_rates, strain_pairs
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.problem import body_at


class Coefficients(NamedTuple):
    """Weights of the old state in forces and in inertia, and those of Newmark."""

    af: Float[Array, ""]
    am: Float[Array, ""]
    beta: Float[Array, ""]
    gamma: Float[Array, ""]


class AbstractMethod(eqx.Module):
    """How a step goes from one state to the next."""

    conserves: eqx.AbstractClassVar[bool]  # whether the body's forces keep its energy

    @abc.abstractmethod
    def coefficients(self) -> Coefficients:
        """The member of the family."""


class GeneralisedAlpha(AbstractMethod):
    """Damps what the step cannot resolve: an oscillation much faster than the step keeps
    `rho_inf` of its size in one step, 1 keeps all of it and 0 nothing. Resolved motion
    is damped least at a given `rho_inf`. Of order 2; stable in the linear range."""

    rho_inf: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    conserves: ClassVar[bool] = False

    def __check_init__(self):
        _check.between(
            "GeneralisedAlpha",
            "rho_inf",
            self.rho_inf,
            -1e-12,
            1 + 1e-12,
            "",
            "1 keeps fast oscillations, 0 removes them.",
        )

    def coefficients(self):
        af = self.rho_inf / (1 + self.rho_inf)
        am = (2 * self.rho_inf - 1) / (1 + self.rho_inf)
        return Coefficients(af, am, (1 - am + af) ** 2 / 4, 0.5 - am + af)


class Newmark(AbstractMethod):
    """Newmark's method, by default that of constant average acceleration; `beta` and `gamma`
    [-] are the weights of the new acceleration in displacement and velocity. Of order 2 where
    `gamma` is 1/2, which damps nothing."""

    beta: Float[Array, ""] = eqx.field(converter=real, default=0.25)
    gamma: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    conserves: ClassVar[bool] = False

    def __check_init__(self):
        _check.positive("Newmark", "beta", self.beta, "", "An explicit method has no place.")
        _check.positive("Newmark", "gamma", self.gamma, "", "Take 1/2 or more.")

    def coefficients(self):
        zero = jnp.zeros_like(self.beta)
        return Coefficients(zero, zero, self.beta, self.gamma)


class EnergyMomentum(AbstractMethod):
    """The midpoint rule with the stress of a discrete gradient: linear and angular momentum
    and, without loads that do work or damping, energy stay what they are at any step. Of
    order 2. It damps nothing, and a motion has no derivative by it.

    Reference: Gonzalez, "Exact energy and momentum conserving algorithms for general models
    in nonlinear elasticity", CMAME 190, 2000.
    """

    conserves: ClassVar[bool] = True

    def coefficients(self):
        half = jnp.asarray(0.5, jnp.result_type(float))
        return Coefficients(half, half, half / 2, half)


# Stresses that conserve energy over a step: the discrete gradient of the stored energy


_SMALL = 1e-2  # increments of C whose energy Gauss's rule integrates exactly


class Conserving(AbstractLoad):
    """The force of the discrete gradient minus that of the mean state, for the
    step from `before`. Its stiffness is left out, so that the tangent stays symmetric."""

    before: Float[Array, "nodes dim"]
    value: Float[Array, ""]
    name: str = eqx.field(static=True, default="conserving")
    smooth: ClassVar[bool] = True

    def potential(self, problem, u):
        held = jax.lax.stop_gradient(_difference(problem, self.before, u))
        return jnp.sum(held * u)

    def curved_part(self, problem):
        return None


def _difference(problem, before, middle) -> Float[Array, "nodes dim"]:
    points = quadrature_points(problem.mesh, problem.kinematics)
    body = body_at(problem, points)
    volumes, kinematics = points.volumes, problem.kinematics

    def strain(u):
        return deformation(problem.mesh, kinematics, points, u)

    def green(F, H):
        return jnp.stack(green_rates(kinematics, F, H))

    def energies(C):
        """Stored energy of every cell, of a deformation without rotation."""
        return jnp.sum(volumes * energy_density(body, _stretch(kinematics, C)), axis=0)

    F0, F1, F = strain(before), strain(2 * middle - before), strain(middle)
    C0, C1 = green(F0, F0), green(F1, F1)
    mean, rise = (C0 + C1) / 2, C1 - C0
    slopes = jax.grad(lambda C: jnp.sum(energies(C)))
    slope = slopes(mean)
    gained = jnp.sum(volumes * (energy_density(body, F1) - energy_density(body, F0)), axis=0)
    missing = gained - jnp.sum(slope * rise, axis=(0, 1))
    # the energies of small increments differ by less than their rounding
    curved = [slopes(mean + sign * 0.15**0.5 * rise) - slope for sign in (-1, 1)]
    small = 5 / 18 * jnp.sum((curved[0] + curved[1]) * rise, axis=(0, 1))
    size = jnp.sum(volumes[None] * rise**2, axis=(0, 1))  # small points get their share
    large = size > _SMALL**2 * jnp.sum(volumes, axis=0)
    missing = jnp.where(large, missing, small)
    still = size <= jnp.finfo(size.dtype).tiny
    factor = jnp.where(still, 0.0, missing / jnp.where(still, 1.0, size))
    slope = slope + (factor[None, None] * volumes[None]) * rise

    def work(u):
        return jnp.sum(slope * 2 * green(F, strain(u)))

    def stored(u):
        return jnp.sum(volumes * energy_density(body, strain(u)))

    return jax.grad(work)(middle) - jax.grad(stored)(middle)


def _stretch(kinematics: AbstractKinematics, C):
    """The upper triangular F with F'F = C, as kept entries."""
    pairs = strain_pairs(kinematics)
    at = dict(zip(pairs, C, strict=True))
    U: dict[tuple[int, int], Array] = {}
    for j, k in pairs:
        inner = [U[i, j] * U[i, k] for i in range(j) if (i, j) in U and (i, k) in U]
        left = at[j, k] - sum(inner[1:], start=inner[0]) if inner else at[j, k]
        U[j, k] = jnp.sqrt(left) if j == k else left / U[j, j]
    zero = jnp.zeros_like(C[0])
    return jnp.stack([U.get((s.row, s.col), zero) for s in kinematics.slots])

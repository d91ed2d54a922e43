"""Time integration methods of second order, as coefficients of one family.

A step from n to n + 1 of size h solves, with x_c = (1 - c) x_(n+1) + c x_n,

    M a_am + C v_af + f_int(u_af) = f_ext(t_af),
    u_(n+1) = u_n + h v_n + h^2 ((1/2 - beta) a_n + beta a_(n+1)),
    v_(n+1) = v_n + h ((1 - gamma) a_n + gamma a_(n+1)).

References:
    Chung, Hulbert, "A time integration algorithm for structural dynamics with improved
    numerical dissipation: the generalized-alpha method", J. Appl. Mech. 60, 1993.
    Newmark, "A method of computation for structural dynamics", J. Eng. Mech. 85, 1959.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real


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
        _check.between("GeneralisedAlpha", "rho_inf", self.rho_inf, -1e-12, 1 + 1e-12, "",
                       "1 keeps fast oscillations, 0 removes them.")  # fmt: skip

    def coefficients(self):
        af = self.rho_inf / (1 + self.rho_inf)
        am = (2 * self.rho_inf - 1) / (1 + self.rho_inf)
        return Coefficients(af, am, (1 - am + af) ** 2 / 4, 0.5 - am + af)


class Newmark(AbstractMethod):
    """Newmark's method, by default that of constant average acceleration; of order 2 where
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

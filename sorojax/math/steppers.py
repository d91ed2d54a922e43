"""Fixed-step integrators, for loops whose cost must be known beforehand."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.dense import solve_symmetric

Field = Callable[[Float[Array, ""], Any], Any]

_DORMAND_PRINCE = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_DORMAND_PRINCE_TIMES = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
_RK4 = ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6))
_RK4_TIMES = (1 / 2, 1 / 2, 1.0)


def rk4_step(field: Field, t: Float[Array, ""], y: Any, h: Float[Array, ""]) -> Any:
    """One classical Runge-Kutta step of y' = field(t, y), order 4, any pytree."""
    return _explicit_step(_RK4, _RK4_TIMES, field, t, y, h)


def dormand_prince_step(field: Field, t: Float[Array, ""], y: Any, h) -> Any:
    """One Dormand-Prince step of y' = field(t, y), order 5, any pytree."""
    return _explicit_step(_DORMAND_PRINCE, _DORMAND_PRINCE_TIMES, field, t, y, h)


def _explicit_step(tableau, times, field, t, y, h):
    slopes = [field(t, y)]
    for row, time in zip(tableau[:-1], times, strict=True):
        slopes.append(field(t + time * h, _advance(y, h, row, slopes)))
    return _advance(y, h, tableau[-1], slopes)


def _advance(y, h, row, slopes):
    used = [(w, k) for w, k in zip(row, slopes, strict=True) if w]

    def move(value, *rates):
        total = used[0][0] * rates[0]
        for (weight, _), rate in zip(used[1:], rates[1:], strict=True):
            total = total + weight * rate
        return value + h * total

    return jax.tree.map(move, y, *(slope for _, slope in used))


class SecondOrder(NamedTuple):
    """Equations M(q) a = f(t, q, v) with the matrices an implicit method may lean on.

    Attributes:
        equations: (t, q, v) -> (mass matrix, force).
        stiffness: About - df/dq.
        damping: About - df/dv.
    """

    equations: Callable[[Array, Array, Array], tuple[Array, Array]]
    stiffness: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]


class Kinematic(NamedTuple):
    """Coordinates, rates and accelerations of a second-order system."""

    q: Float[Array, " dof"]
    v: Float[Array, " dof"]
    a: Float[Array, " dof"]


class AbstractStepper(eqx.Module):
    """A fixed-step method for second-order systems."""

    @abc.abstractmethod
    def step(self, problem: SecondOrder, t, h, state: Kinematic) -> Kinematic:
        """The state after a step of `h` [s] from `t` [s]."""


def start(problem: SecondOrder, t, q: Array, v: Array) -> Kinematic:
    """A state with the acceleration that belongs to (q, v)."""
    return Kinematic(q, v, solve_symmetric(*problem.equations(t, q, v)))


class GeneralisedAlpha(AbstractStepper):
    """Generalised-alpha with approximate Newton passes: implicit, second order.

    Attributes:
        spectral_radius: At infinite frequency, 1 keeps and 0 kills fast modes [-].
        passes: Newton passes per step; 2 are as good as 3 on soft rods.

    Reference:
        Chung and Hulbert, J. Appl. Mech. 60, 1993.
    """

    spectral_radius: Float[Array, ""] = eqx.field(converter=real, default=0.8)
    passes: int = eqx.field(static=True, default=2)

    def step(self, problem, t, h, state):
        rho = self.spectral_radius
        am, af = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 1 / 2 + af - am
        beta = (gamma + 1 / 2) ** 2 / 4
        q, v, a = state
        drift = q + h * v + h * h * (1 / 2 - beta) * a
        surge = v + h * (1 - gamma) * a
        implicit = (1 - af) * (gamma * h * problem.damping + beta * h**2 * problem.stiffness)
        new = a
        for _ in range(self.passes):
            middle_q = (1 - af) * (drift + h * h * beta * new) + af * q
            middle_v = (1 - af) * (surge + h * gamma * new) + af * v
            mass, force = problem.equations(t + (1 - af) * h, middle_q, middle_v)
            residual = mass @ ((1 - am) * new + am * a) - force
            new = new - solve_symmetric((1 - am) * mass + implicit, residual)
        return Kinematic(drift + h * h * beta * new, surge + h * gamma * new, new)


class RungeKutta4(AbstractStepper):
    """Classical explicit method of order 4; unstable beyond h omega = 2.8."""

    def step(self, problem, t, h, state):
        q, v = rk4_step(_first_order(problem), t, (state.q, state.v), h)
        return Kinematic(q, v, state.a)


class DormandPrince(AbstractStepper):
    """Explicit method of order 5, for undamped motion at high accuracy."""

    def step(self, problem, t, h, state):
        q, v = dormand_prince_step(_first_order(problem), t, (state.q, state.v), h)
        return Kinematic(q, v, state.a)


def _first_order(problem: SecondOrder) -> Field:
    def field(t, y):
        return y[1], solve_symmetric(*problem.equations(t, *y))

    return field


def integrate(
    stepper: AbstractStepper,
    problem: SecondOrder,
    state: Kinematic,
    *,
    t: Float[Array, ""],
    h: Float[Array, ""],
    saves: int,
    every: int,
) -> Kinematic:
    """The states after each of `saves` runs of `every` steps, stacked after the first."""

    def advance(carry, _):
        def one(_, carry):
            index, state = carry
            return index + 1, stepper.step(problem, t + index * h, h, state)

        carry = jax.lax.fori_loop(0, every, one, carry) if every > 1 else one(0, carry)
        return carry, carry[1]

    begin = (jnp.zeros((), h.dtype), state)
    _, states = jax.lax.scan(advance, begin, length=saves)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, states)

"""Generalised-alpha for y' = f(t, y): implicit, of order 2, with damping by choice."""

from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax import _check
from sorojax._types import real
from sorojax.math.ode.explicit import AbstractMethod, MethodStep
from sorojax.math.ode.step_control import SearchedAttempt, cut, filled

_SHORTENINGS = 10
_ROUNDING = 1e-9  # share of a rate, below which a residual need not fall


class _Part(NamedTuple):
    """A part of a step: the field, the method, and where it starts."""

    field: Any
    method: "GeneralisedAlpha"
    t: Float[Array, ""]
    h: Float[Array, ""]
    y: PyTree
    rate: PyTree


class _Search(NamedTuple):
    """Newton's method: the best state and residual so far, and the step tried from there."""

    x: Array
    residual: Array
    move: Array
    share: Float[Array, ""]
    count: Int[Array, ""]
    shortened: Int[Array, ""]
    converged: Bool[Array, ""]
    running: Bool[Array, ""]


class GeneralisedAlpha(AbstractMethod):
    """Generalised-alpha for systems of first and second order, as they stand in a network.

    An oscillation much faster than the step keeps `rho_inf` of its size in one step. Positions
    and velocities of a body are stepped by one rule, which is the method for structures
    without its overshoot, and pressures, filters and controllers beside them. Every step is
    solved by Newton's method with the exact Jacobian and a line search; one that does not
    converge is halved, at most `max_cuts` times in a row, and never accepted.

    Attributes:
        rho_inf: 1 keeps fast oscillations, 0 removes them.
        tolerance: Of Newton's last update over the largest entry of its leaf of the state.
        max_iterations: Jacobians in a step.
        max_cuts: How often a part of a step may be halved in a row.

    References:
        Jansen, Whiting, Hulbert, A generalized-alpha method for integrating the filtered
        Navier-Stokes equations with a stabilized finite element method, Comput. Methods
        Appl. Mech. Engrg. 190, 2000.
        Kadapa, Dettmer, Peric, On the advantages of using the first-order generalised-alpha
        scheme for structural dynamic problems, Comput. Struct. 193, 2017.
    """

    rho_inf: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    tolerance: float = eqx.field(static=True, default=1e-10)
    max_iterations: int = eqx.field(static=True, default=15)
    max_cuts: int = eqx.field(static=True, default=10)
    num_order: ClassVar[int] = 2
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    def __check_init__(self):
        do = "1 keeps fast oscillations, 0 removes them."
        _check.between("GeneralisedAlpha", "rho_inf", self.rho_inf, 0, 1, "", do, "[]")

    @property
    def carries(self) -> bool:
        return True

    def begin(self, field, t, y, h):
        return field(t, y)

    def advance(self, field, t, y, h, memory):
        given = (field, self, t)
        (new, rate), converged = cut(_PART, self.max_cuts, given, h, (y, memory))
        return MethodStep(new, None, rate, {}, converged)

    def weights(self) -> tuple[Array, Array, Array]:
        """Of the new rate, of the new state, and of the new rate in the state's update."""
        am = (3 - self.rho_inf) / (2 * (1 + self.rho_inf))
        af = 1 / (1 + self.rho_inf)
        return am, af, 1 / 2 + am - af


def _part(given, offset, size, state) -> _Part:
    field, method, t = given
    return _Part(field, method, t + offset, size, *state)


def _searched(*at):
    return _newton(_part(*at))


def _taken(given, offset, size, state, found):
    part = _part(given, offset, size, state)
    x = _solution(part, found)
    return x, _new_rate(part, x)


def _new_rate(part: _Part, x: PyTree) -> PyTree:
    _, _, gamma = part.method.weights()

    def one(x, y, rate):
        return (x - y - part.h * (1 - gamma) * rate) / (part.h * gamma)

    return jax.tree.map(one, x, part.y, part.rate)


def _unbalanced(part: _Part, x: PyTree) -> PyTree:
    """Rate of the step minus that of the field."""
    am, af, _ = part.method.weights()
    middle = jax.tree.map(lambda x, y: y + af * (x - y), x, part.y)
    wanted = part.field(part.t + af * part.h, middle)
    rate = jax.tree.map(lambda a, b: am * a + (1 - am) * b, _new_rate(part, x), part.rate)
    return jax.tree.map(lambda a, b: a - b, rate, wanted)


@eqx.filter_custom_jvp
def _solution(part: _Part, found: PyTree) -> PyTree:
    """The state found at the end of a part, with the derivative of its equations."""
    return found


@_solution.def_jvp
def _solution_jvp(primals, tangents):
    part, x = primals
    flat, unravel = ravel_pytree(x)
    moved = filled(*eqx.filter_jvp(lambda part: _unbalanced(part, x), (part,), tangents[:1]))
    jacobian = jax.jacfwd(lambda x: ravel_pytree(_unbalanced(part, unravel(x)))[0])(flat)
    dot = -jnp.linalg.solve(jacobian, ravel_pytree(moved)[0])
    return x, unravel(dot)


def _newton(part: _Part) -> tuple[PyTree, Bool[Array, ""]]:
    start, unravel = ravel_pytree(part.y)

    def residual(x):
        return ravel_pytree(_unbalanced(part, unravel(x)))[0]

    def sized(x):
        """Largest entry of each leaf, for all its entries."""
        return ravel_pytree(
            jax.tree.map(lambda a: jnp.full_like(a, jnp.max(jnp.abs(a))), unravel(x))
        )[0]

    def step(x, residual_there):
        return -jnp.linalg.solve(jax.jacfwd(residual)(x), residual_there)

    def one(now: _Search) -> _Search:
        trial = now.x + now.share * now.move
        found = residual(trial)
        # the linear model lowers the residual by the share that is taken; half will do
        rate = ravel_pytree(_new_rate(part, unravel(trial)))[0]
        limit = (1 - now.share / 2) * sized(now.residual) + _ROUNDING * sized(rate)
        better = jnp.all(jnp.abs(found) <= limit)
        tiny = jnp.all(jnp.abs(now.move) <= part.method.tolerance * sized(trial))
        stuck = ~better & ~tiny & (now.shortened < _SHORTENINGS) & jnp.all(jnp.isfinite(now.x))
        shorter = now._replace(share=0.4 * now.share, shortened=now.shortened + 1)
        fine = jnp.all(jnp.isfinite(found))
        converged = tiny & fine
        stop = converged | ~fine | (now.count >= part.method.max_iterations)
        move = jax.lax.cond(stop, lambda: jnp.zeros_like(trial), lambda: step(trial, found))
        taken = _Search(
            trial,
            found,
            move,
            jnp.ones_like(now.share),
            now.count + 1,
            jnp.zeros_like(now.shortened),
            converged,
            ~stop,
        )
        return jax.tree.map(lambda a, b: jnp.where(stuck, a, b), shorter, taken)

    guess = start + part.h * ravel_pytree(part.rate)[0]
    first = residual(guess)
    sound = jnp.all(jnp.isfinite(first))
    guess = jnp.where(sound, guess, start)
    first = jnp.where(sound, first, residual(start))
    whole, none = jnp.ones_like(part.h), jnp.zeros((), jnp.int32)
    false = jnp.array(False)
    begin = _Search(guess, first, step(guess, first), whole, none, none, false, ~false)
    end = jax.lax.while_loop(lambda now: now.running, one, begin)
    return unravel(end.x), end.converged


_PART = SearchedAttempt(_searched, _taken)

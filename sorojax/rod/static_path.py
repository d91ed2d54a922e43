"""Equilibria under loads that are applied in steps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._types import Numbers, real
from sorojax.math.door import door
from sorojax.math.implicit_root import implicit_root
from sorojax.math.status import Status
from sorojax.math.told import tell
from sorojax.rod.assembly import dtype_of
from sorojax.rod.loads import Load, total_force
from sorojax.rod.model import Model, motion, operators
from sorojax.rod.statics import Search, ended, first_guess, newton, prepare, stability
from sorojax.rod.tangent import squared
from sorojax.rod.validity import checked_status

Loading = Callable[[Array], tuple[Load, ...]]


class EquilibriumPath(eqx.Module):
    """Coordinates at rest under each load, how each search ended, and its iterations.

    Where a search fails, the path stops: the rest of `q` repeats the last equilibrium
    and says so in `status`. A state that is in balance without being stable is an
    `unstable_equilibrium`; the path goes on.
    """

    q: Float[Array, "steps coordinates"]
    status: Status
    num_iterations: Int[Array, " steps"]


@door
def equilibrium_path(
    model: Model,
    loading: Loading,
    factors: Float[Array, "steps *loads"],
    q: Float[Array, " coordinates"] | None = None,
    *,
    begin: Numbers | None = None,
    t=0.0,
    tolerance=1e-10,
    max_iterations: int = 25,
    max_cuts: int = 8,
    progress: bool = False,
) -> EquilibriumPath:
    """Equilibria at given load factors, each started from the one before.

    A step whose search fails is cut in halves, all in one compiled loop. Differentiable as
    `equilibrium` is, in all that `loading` holds.

    Args:
        model: The rod or assembly.
        loading: Takes a factor, or a row of pressures, to the forces. Define it once: a new
            function compiles anew.
        factors: Load factors, or one row of them for each step.
        q: Equilibrium to start from; at rest if omitted.
        begin: Factors at `q`; zero if omitted.
        t: Time at which the forces act [s].
        tolerance: As of `equilibrium`.
        max_iterations: Limit of one search.
        max_cuts: How often a step may be halved.
        progress: Report progress while running; under `vmap` in one report.

    Raises:
        ValueError: If `q` has the wrong shape.
    """
    constants, dtype = operators(model), dtype_of(model)
    factors, t = real(factors).astype(dtype), real(t).astype(dtype)
    guess = first_guess("equilibrium_path", model, q)
    search = prepare(model, constants, tolerance, max_iterations)
    first = jnp.zeros_like(factors[0]) if begin is None else real(begin).astype(dtype)

    def residual(q: Array, factor: Array) -> Array:
        return -total_force(loading(factor), t, motion(model, q, constants=constants))

    shares = jnp.linspace(0.0, 1.0, len(factors) + 1, dtype=dtype)[1:]

    def find(_, guesses):
        def advance(state, row):
            (q, last, alive), (target, share) = state, row
            new, done, count, unstable = _step(
                residual, q, last, target, alive, search, max_cuts
            )
            if progress:
                tell("equilibrium path", share)
            ends = tuple(x.astype(dtype) for x in (done, count, unstable))
            return (new, target, done), (new, ends)

        start = (guesses[0], first, jnp.array(True))
        return jax.lax.scan(advance, start, (factors, shares))[1]

    def balance(q):
        return jax.vmap(lambda q, f: squared(model, q, residual(q, f)))(q, factors)

    guesses = jnp.broadcast_to(guess, (factors.shape[0], guess.shape[0]))
    rest, (done, count, unstable) = implicit_root(
        balance, guesses, find, _solve_rows, has_aux=True
    )
    status = jax.vmap(lambda done, unstable, *values: ended(done, *values, unstable=unstable))(
        done, unstable, rest, jax.vmap(residual)(rest, factors)
    )
    status = jax.vmap(lambda x, q: checked_status(x, model, q))(status, rest)
    return EquilibriumPath(rest, status, count.astype(jnp.int32))


def _step(residual, q: Array, last: Array, target: Array, alive, search: Search, max_cuts: int):
    """From the equilibrium `q` at `last` to `target`, in as few parts as converge."""
    whole = jnp.ones((), q.dtype)
    shortest = 0.5**max_cuts

    def going(state):
        _, at, part, *_ = state
        return alive & (at < 1) & (part >= shortest)

    def advance(state):
        q, at, part, count, slope = state
        aim = jnp.minimum(at + part, whole)
        factor = last + aim * (target - last)
        found = newton(lambda q: residual(q, factor), q, search)
        good = found.done
        new = jnp.where(good, found.q, q), jnp.where(good, aim, at)
        slope = jnp.where(good, found.slope, slope)
        return *new, jnp.where(good, 2 * part, part / 2), count + found.count, slope

    state = (q, 0 * whole, whole, jnp.array(0, dtype=jnp.int32), search.metric)
    q, at, _, count, slope = jax.lax.while_loop(going, advance, state)
    _, unstable = stability(slope, search)
    return q, alive & (at >= 1), count, unstable


def _solve_rows(linear, right: Float[Array, "steps unknowns"]) -> Array:
    """The steps do not see each other: one small system each, all at once."""
    eye = jnp.eye(right.shape[1], dtype=right.dtype)
    columns = jax.vmap(lambda e: linear(jnp.broadcast_to(e, right.shape)))(eye)
    return jnp.linalg.solve(jnp.moveaxis(columns, 0, 2), right[:, :, None])[:, :, 0]

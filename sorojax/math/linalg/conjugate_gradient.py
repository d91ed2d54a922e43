"""Conjugate gradients with multigrid: an iterative solver that is one compiled program.

It does what a direct factorisation does for a symmetric system, without leaving the
device: the answer, derivatives and batches by transformations, and a count of negative
eigenvalues. The status says whether a system is solved.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax.math.linalg.multigrid import Hierarchy, Multigrid, cycle, multigrid

_ROUNDING = 8  # units of rounding in a residual that no method makes smaller
_ANYWHERE = 100  # tolerances: a residual of one corner alone hardly enters its norm


class ConjugateGradient(eqx.Module):
    """When to stop; the preconditioner is multigrid by smoothed aggregation.

    Args:
        tolerance: Of solutions and derivatives: error over solution in the energy norm, as
            the preconditioner sees it.
        newton_tolerance: The same of a Newton step, whose error the next step removes.
        max_iterations: Where the system counts as not solved.
        coarsest: Unknowns of the level that is inverted.
    """

    tolerance: float = eqx.field(static=True, default=1e-10)
    newton_tolerance: float = eqx.field(static=True, default=1e-5)
    max_iterations: int = eqx.field(static=True, default=1000)
    coarsest: int = eqx.field(static=True, default=300)

    def __check_init__(self):
        for name in ("tolerance", "newton_tolerance", "max_iterations", "coarsest"):
            do = "Leave it out for the default."
            _check.positive("ConjugateGradient", name, getattr(self, name), "", do)


class Iterative(eqx.Module):
    """An iterative solver for one pattern: settings and index maps."""

    settings: ConjugateGradient
    maps: Hierarchy


class Found(NamedTuple):
    """Where the iteration ended: `negative` counts the directions of negative curvature that
    it went, in exact arithmetic at most the number of negative eigenvalues."""

    x: Float[Array, " size"]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    negative: Int[Array, ""]


class _State(NamedTuple):
    """`exact` says whether r is b - A x itself or its update."""

    x: Array
    r: Array
    way: Array
    size: Array
    goal: Array
    exact: Bool[Array, ""]
    started_again: Bool[Array, ""]
    iterations: Int[Array, ""]
    negative: Int[Array, ""]
    converged: Bool[Array, ""]
    running: Bool[Array, ""]


@jax.jit
def iterate(
    levels: Multigrid, b: Float[Array, " size"], tolerance: float, max_iterations: int
) -> Found:
    """x with A x = b, until the residual is below `tolerance` times b in the norm of the
    preconditioner, and no number of it above a hundred times `tolerance` of the largest of
    b, or as small as rounding lets any method make it.

    Negative curvature does not stop it: without a breakdown the iteration finds the answer
    of an indefinite system too.
    """
    b = b.reshape(levels.sums.shape)
    unit = _ROUNDING * jnp.finfo(b.dtype).eps
    least = jnp.maximum(jnp.asarray(tolerance, b.dtype), jnp.finfo(b.dtype).eps)
    highest = _ANYWHERE * least * jnp.max(jnp.abs(b))

    def one_pass(s: _State) -> _State:
        z = cycle(levels, s.r)
        size = jnp.vdot(s.r, z)
        first = s.iterations == 0
        goal = jnp.where(first, jnp.square(least) * size, s.goal)
        rounding = unit * (levels.sums * jnp.max(jnp.abs(s.x)) + jnp.abs(b))
        left = jnp.abs(s.r)
        small = (jnp.abs(size) <= goal) & jnp.all(left <= highest) | jnp.all(left <= rounding)
        check = small & ~s.exact
        way = z + jnp.where(s.exact, 0.0, size / s.size) * s.way
        image = levels.matrix @ jnp.where(check, s.x, way)
        curvature = jnp.vdot(way, image)
        share = size / curvature
        bent = ~check & ~s.started_again & (curvature < 0)
        iterations = s.iterations + (~check).astype(jnp.int32)
        converged = small & s.exact
        return _State(
            x=jnp.where(small, s.x, s.x + share * way),
            r=jnp.where(check, b - image, s.r - share * image),
            way=way,
            size=size,
            goal=goal,
            exact=check,
            started_again=s.started_again | check,
            iterations=jnp.where(converged, s.iterations, iterations),
            negative=jnp.where(converged, s.negative, s.negative + bent.astype(jnp.int32)),
            converged=converged,
            running=~converged & (check | jnp.isfinite(share)) & (iterations <= max_iterations),
        )

    zero, false, none = jnp.zeros((), b.dtype), jnp.asarray(False), jnp.asarray(0, jnp.int32)
    start = _State(
        x=jnp.zeros_like(b),
        r=b,
        way=jnp.zeros_like(b),
        size=zero,
        goal=zero,
        exact=~false,
        started_again=false,
        iterations=none,
        negative=none,
        converged=false,
        running=jnp.all(jnp.isfinite(b)),
    )
    end = jax.lax.while_loop(lambda s: s.running, one_pass, start)
    return Found(end.x.ravel(), end.converged, end.iterations, end.negative)


def solve(
    solver: Iterative,
    product: Callable[[Array], Array],
    values: Float[Array, " nnz"],
    b: Float[Array, " size"],
) -> Float[Array, " size"]:
    """x with A(values) x = b, differentiable in both; NaN where the iteration ends
    without it. `product` is A(values) for derivatives."""
    settings = solver.settings
    levels = multigrid(solver.maps, jax.lax.stop_gradient(values))

    def inside(_, rhs):
        found = iterate(levels, rhs, settings.tolerance, settings.max_iterations)
        return jnp.where(found.converged, found.x, jnp.nan)

    return jax.lax.custom_linear_solve(
        product, b, solve=inside, transpose_solve=inside, symmetric=True
    )


@jax.jit
def newton_step(
    solver: Iterative, values: Float[Array, " nnz"], b: Float[Array, " size"]
) -> tuple[Float[Array, " size"], Int[Array, ""]]:
    """x with A(values) x = b as a Newton step needs it, and the negative eigenvalues that it
    met; zeros and -1 where the iteration ends without an answer."""
    settings = solver.settings
    levels = multigrid(solver.maps, values)
    found = iterate(levels, b, settings.newton_tolerance, settings.max_iterations)
    x = jnp.where(found.converged, found.x, jnp.zeros_like(found.x))
    return x, jnp.where(found.converged, found.negative, -1)


class IterativeFactor:
    """The levels of one matrix, in the place of a factor."""

    def __init__(self, levels: Multigrid, settings: ConjugateGradient):
        self.levels, self._settings = levels, settings

    def solve(self, b: np.ndarray) -> np.ndarray:
        """x with A x = b for one right-hand side or rows of them; NaN, and a warning, where
        the iteration ends without it."""
        settings, found = self._settings, _iterate_rows if np.ndim(b) == 2 else iterate
        args = jnp.asarray(b), settings.tolerance, settings.max_iterations
        end = found(self.levels, *args)
        solved = np.asarray(end.converged)
        if not solved.all():
            _check.warn(
                f"conjugate gradients: {solved.size - solved.sum()} of {solved.size} systems "
                f"not solved to {settings.tolerance:g} in at most "
                f"{settings.max_iterations} iterations, their answer is NaN. Raise "
                "max_iterations, or take the direct solver."
            )
        return np.where(solved[..., None], np.asarray(end.x), np.nan)

    def count(self, b: np.ndarray, tolerance: float | None = None) -> int:
        """Iterations to a tolerance, that of solutions when omitted."""
        tolerance = self._settings.tolerance if tolerance is None else tolerance
        found = iterate(self.levels, jnp.asarray(b), tolerance, self._settings.max_iterations)
        return int(found.iterations)

    def step(self, b: np.ndarray) -> tuple[np.ndarray | None, int]:
        """A Newton step and the negative eigenvalues it met; `None` without an answer."""
        settings = self._settings
        args = settings.newton_tolerance, settings.max_iterations
        found = iterate(self.levels, jnp.asarray(b), *args)
        if not bool(found.converged):
            return None, -1
        return np.asarray(found.x), int(found.negative)

    @functools.cached_property
    def negative_eigenvalues(self) -> int:
        """As seen from a random right-hand side, with directions kept orthogonal so that
        none counts twice; of equal eigenvalues only one is seen."""
        levels, shape, count = self.levels, self.levels.sums.shape, 0
        r = np.random.default_rng(0).standard_normal(np.prod(shape))
        way, before, first, seen, duals = np.zeros_like(r), np.inf, 0.0, [], []
        while len(seen) < min(self._settings.max_iterations, r.size):
            z = np.asarray(cycle_once(levels, jnp.asarray(r.reshape(shape)))).ravel()
            size = float(r @ z)
            first = first or size
            if not size > self._settings.tolerance**2 * first:
                break
            seen.append(r / np.sqrt(size))
            duals.append(z / np.sqrt(size))
            way, before = z + size / before * way, size
            image = np.asarray(product_once(levels, jnp.asarray(way.reshape(shape)))).ravel()
            curvature = float(way @ image)
            count += curvature < 0
            r = r - size / curvature * image
            for _ in range(2):
                r = r - np.asarray(duals) @ r @ np.asarray(seen)
        return count


cycle_once = jax.jit(cycle)
product_once = jax.jit(lambda levels, x: levels.matrix @ x)


@jax.jit
def _iterate_rows(levels: Multigrid, rows, tolerance: float, max_iterations: int) -> Found:
    return jax.vmap(lambda b: iterate(levels, b, tolerance, max_iterations))(rows)


class IterativeBackend:
    """The class whose factors `DirectSolver` keeps."""

    name = "conjugate_gradient"

    def __init__(self, solver: Iterative):
        self.solver = solver

    def factor(self, values: np.ndarray, slot: int) -> IterativeFactor:
        levels = multigrid(self.solver.maps, jnp.asarray(values))
        return IterativeFactor(levels, self.solver.settings)

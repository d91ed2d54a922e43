"""What the uncertainty of numbers does to a result: first and second order of its moments."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import root


class Propagated(NamedTuple):
    """Mean and standard deviation of a result, in its unit.

    Attributes:
        mean: Expected value.
        deviation: Standard deviation.
        shares: What each number alone adds to the variance of first order, over that of all;
            like the numbers. The sum is one where they are independent; zero where nothing
            moves.
    """

    mean: Float[Array, ""]
    deviation: Float[Array, ""]
    shares: PyTree


def propagate_covariance(
    function: Callable[[Any], Numbers],
    numbers: PyTree,
    *,
    covariance: Float[Any, "n n"] | None = None,
    deviation: PyTree | None = None,
    order: int = 1,
) -> Propagated:
    """Mean and standard deviation of a scalar function of uncertain numbers.

    First-order second-moment method: with the gradient g at the mean x and the covariance C the
    mean is f(x) and the variance g'C g, by one reverse sweep. At an optimum g vanishes and only
    the second order is left: mean f(x) + tr(H C) / 2 and variance g'C g + tr((H C)^2) / 2, for
    numbers that are normally distributed, by one Hessian-vector product for each of them. Both
    are exact where f is linear, the second where it is quadratic.

    Args:
        function: From `numbers` to one number, differentiable; for `order=2` twice.
        numbers: Means: numbers, arrays, or a tree of them.
        covariance: Of the numbers, (n, n) in the order of `jax.flatten_util.ravel_pytree`, each
            entry in the product of the units of two. As in the record of a calibration.
        deviation: Standard deviations of independent numbers instead, a tree like `numbers`.
        order: 1 or 2.

    Returns:
        Mean, standard deviation and the share of each number.

    Raises:
        ValueError: If not one of `covariance` and `deviation` is given; if it does not fit the
            numbers, or is no covariance; if `order` is neither 1 nor 2, or the result is not
            one number.

    Example:
        >>> def area(p):
        ...     return p["width"] * p["height"]
        >>> sides = {"width": 30 * mm, "height": 10 * mm}
        >>> cut = {"width": 0.1 * mm, "height": 0.1 * mm}
        >>> found = design.propagate_covariance(area, sides, deviation=cut)
        >>> mean, spread = (float(x) / mm**2 for x in (found.mean, found.deviation))
        >>> print(f"{mean:.0f} +- {spread:.2f} mm^2")
        300 +- 3.16 mm^2

    Reference:
        Ang and Tang, Probability Concepts in Engineering, 2nd edition, 2007, for the first
        order; Mathai and Provost, Quadratic Forms in Random Variables, 1992, for the second.
    """
    if order not in (1, 2):
        raise ValueError(
            f"propagate_covariance: `order` is {order}, need 1 or 2. Take 2 near an optimum."
        )
    x, build = ravel_pytree(jax.tree.map(real, numbers))
    spread = _matrix(x, numbers, covariance, deviation)

    def value(x):
        found = real(function(build(x)))
        if found.shape != ():
            raise ValueError(
                f"propagate_covariance: the function gives shape {found.shape}, need one "
                "number. Call it once for each result."
            )
        return found

    mean, slope = jax.value_and_grad(value)(x)
    pulled = spread @ slope
    variance = first = slope @ pulled
    if order == 2:
        curved = _curved(value, x, spread)
        mean = mean + jnp.trace(curved) / 2
        variance = variance + jnp.sum(curved * curved.T) / 2
    moving = first > 0
    own = slope**2 * jnp.diag(spread) / jnp.where(moving, first, jnp.ones_like(first))
    return Propagated(mean, root(variance), build(jnp.where(moving, own, jnp.zeros_like(own))))


def _curved(value: Callable[[Array], Array], x, spread) -> Float[Array, "n n"]:
    """H C, from what the slope does along the columns of C."""
    along = jax.linearize(jax.grad(value), x)[1]
    return jax.vmap(along, in_axes=1, out_axes=1)(spread)


def _matrix(x, numbers, covariance, deviation) -> Float[Array, "n n"]:
    where, count = "propagate_covariance", len(x)
    if (covariance is None) == (deviation is None):
        raise ValueError(
            f"{where}: got {'neither' if covariance is None else 'both'} of `covariance` and "
            "`deviation`, need one. Give standard deviations where numbers are independent."
        )
    if covariance is None:
        return jnp.diag(_deviations(numbers, deviation) ** 2)
    matrix = real(covariance)
    _check.shape(where, "covariance", matrix, (count, count), "A row for each number.")
    _check.finite(where, "covariance", matrix, "Leave out what is not known, or bound it.")
    if _check.is_concrete(matrix):
        given = np.asarray(matrix)
        scale = np.sqrt(np.abs(np.diag(given)))
        whole = given / np.outer(*2 * [np.where(scale > 0, scale, 1.0)])
        even = np.allclose(whole, whole.T, atol=1e-6)
        if not even or np.linalg.eigvalsh((whole + whole.T) / 2).min(initial=0.0) < -1e-6:
            raise ValueError(
                f"{where}: `covariance` is {'not symmetric' if not even else 'indefinite'}, "
                "need variances that are nowhere negative. Check its signs and its order."
            )
    return matrix


def _deviations(numbers: PyTree, deviation: PyTree) -> Float[Array, " n"]:
    """Standard deviations in the order of the numbers."""
    want, got = jax.tree.structure(numbers), jax.tree.structure(deviation)
    shapes = [[jnp.shape(leaf) for leaf in jax.tree.leaves(t)] for t in (numbers, deviation)]
    if want != got or shapes[0] != shapes[1]:
        raise ValueError(
            f"propagate_covariance: `deviation` is {got} of shapes {shapes[1]}, need {want} of "
            f"shapes {shapes[0]}. Give one standard deviation for each number."
        )
    flat = ravel_pytree(jax.tree.map(real, deviation))[0]
    do = "A standard deviation is 0 where a number is known."
    _check.finite("propagate_covariance", "deviation", flat, do)
    _check.not_negative("propagate_covariance", "deviation", flat, "(its unit)", do)
    return flat

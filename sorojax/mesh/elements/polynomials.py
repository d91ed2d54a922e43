"""Shape functions at reference points that are traced, by the polynomials that they are."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.mesh.elements.base import AbstractElement, nodes, shape_functions


def traced_shape_functions(
    element: AbstractElement, at: Float[Array, "points dim"]
) -> Float[Array, "points cell_nodes"]:
    """`shape_functions`, differentiable in the reference points, any number of times."""
    exponents, coefficients = _polynomials(element)
    powers = [jnp.ones_like(at)]
    for _ in range(exponents.max()):
        powers.append(powers[-1] * at)
    table = jnp.stack(powers)  # (powers, points, dim)
    axes = np.arange(element.dim)
    monomials = jnp.prod(table[exponents[:, None, :], np.arange(len(at))[:, None], axes], 2)
    return monomials.T @ jnp.asarray(coefficients, at.dtype)


@functools.cache
def _polynomials(element: AbstractElement) -> tuple[np.ndarray, np.ndarray]:
    """Exponents (monomials, dim) and coefficients (monomials, cell_nodes), from values of
    the shape functions at more points than there are monomials."""
    degree = 2 * element.dim  # of x^2 y^2 z^2, and of the bubble of a tetrahedron and less
    every = np.indices((degree + 1,) * element.dim).reshape(element.dim, -1).T
    exponents = every[every.sum(axis=1) <= degree]
    corners = nodes(element)
    low, high = corners.min(axis=0), corners.max(axis=0)
    at = np.random.default_rng(0).uniform(low, high, (4 * len(exponents), element.dim))
    monomials = np.prod(at[:, None] ** exponents, axis=2)
    found = np.linalg.lstsq(monomials, shape_functions(element, at), rcond=None)[0]
    used = np.abs(found).max(axis=1) > 1e-9
    exponents = exponents[used]
    found = np.linalg.lstsq(monomials[:, used], shape_functions(element, at), rcond=None)[0]
    return exponents, found

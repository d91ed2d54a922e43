"""Which points can be left out because an obstacle is far away."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.math.host import KDTree
from sorojax.sdf.base import AbstractSdf


def far(
    obstacle: AbstractSdf,
    points: Float[Array, "*points dim"],
    reach: Float[Array, ""] | None = None,
) -> Bool[Array, ""]:
    """Whether none of `points` [m] can lie inside `obstacle`, by one value of its field; or
    within `reach` [m] of it.

    A field changes by at most its Lipschitz constant per length, so a field at the centre
    of a ball above that constant times the radius is positive in the whole ball. `False`
    may also mean that it is not known.
    """
    return clearance(obstacle, points, reach) > 0


def clearance(
    obstacle: AbstractSdf,
    points: Float[Array, "*points dim"],
    reach: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """How far all of `points` [m] may move at least before one lies inside `obstacle`, or
    within `reach` [m] of it, by one value of its field; what is not positive says nothing."""
    flat = points.reshape(-1, points.shape[-1])
    low, high = jnp.min(flat, axis=0), jnp.max(flat, axis=0)
    centre = (low + high) / 2
    radius = jnp.sqrt(jnp.max(jnp.sum((flat - centre[None]) ** 2, axis=1)))
    bound = obstacle.lipschitz
    room = obstacle(centre) / bound - radius
    return room if reach is None else room - reach / bound


# Broad phase by balls: bodies that cannot touch, found by one number each


def near(
    obstacle: AbstractSdf, centre: Float[Array, " dim"], radius: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether a ball may reach into `obstacle`; `False` is certain, `True` is not.

    A field changes by at most its Lipschitz constant per length.
    """
    return obstacle(centre) <= obstacle.lipschitz * radius


# Broad phase among facets, on the host: for each the few others that it may meet


Facets = Float[np.ndarray, "facets facet_nodes dim"]


def close_pairs(x: Facets, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All ordered pairs of facets at positions `x` [m] closer than `reach` [m], and about
    how far they are apart: between their nodes and centres, less what lies between those."""
    centres = x.mean(axis=1)
    radii = np.sqrt(((x - centres[:, None]) ** 2).sum(axis=2).max(axis=1))
    pairs = KDTree(centres).query_pairs(reach + 2 * radii.max(), output_type="ndarray")
    if not len(pairs):
        none = np.zeros(0, int)
        return none, none, np.zeros(0)
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    samples = np.concatenate([x, centres[:, None]], axis=1)
    apart = np.full(len(first), np.inf)
    for at in np.moveaxis(samples, 1, 0):
        gap = np.sqrt(((samples[second] - at[first][:, None]) ** 2).sum(axis=2)).min(axis=1)
        apart = np.minimum(apart, gap)
    close = apart - radii[first] / 2 - radii[second] / 2 < reach
    return first[close], second[close], apart[close]


def listed(
    first: Int[np.ndarray, " pairs"],
    second: Int[np.ndarray, " pairs"],
    apart: Float[np.ndarray, " pairs"],
    num_facets: int,
    count: int,
) -> tuple[Int[np.ndarray, "facets count"], Bool[np.ndarray, "facets count"]]:
    """The `count` nearest partners of each facet by number, and which of them are real."""
    order = np.lexsort((apart, first))
    first, second = first[order], second[order]
    rank = np.arange(len(first)) - np.searchsorted(first, first)
    kept = rank < count
    partners = np.repeat(np.arange(num_facets)[:, None], count, axis=1)
    real = np.zeros(partners.shape, bool)
    partners[first[kept], rank[kept]] = second[kept]
    real[first[kept], rank[kept]] = True
    nearest = np.where(real, partners, num_facets)  # in the order of their numbers
    order = np.argsort(nearest, axis=1, kind="stable")
    return np.take_along_axis(partners, order, 1), np.take_along_axis(real, order, 1)

"""Whether a step took points of a body through an obstacle."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.contact import far, passes
from sorojax.fem.contact_load import Contact
from sorojax.fem.curved import blockwise
from sorojax.fem.facets import facet_tables
from sorojax.fem.problem import Problem


def passed_through(
    problem: Problem, loads: tuple, u: Float[Array, "nodes dim"]
) -> Bool[Array, ""]:
    """Whether any point jumped through the obstacle of a contact among `loads`, those of a
    step that ends at displacement `u` [m]."""
    found = [_jumped(load, problem, u) for load in loads if isinstance(load, Contact)]
    return jnp.any(jnp.stack(found)) if found else jnp.zeros((), bool)


def _jumped(load: Contact, problem: Problem, u) -> Bool[Array, ""]:
    assert load.began is not None and load.start is not None
    values = jnp.asarray(facet_tables(problem.mesh.element).values)
    places = jnp.stack([load.start.place, load.value])

    def points_of(ends):
        """In the frame of the obstacle, that may move."""
        points = jnp.einsum("qa,feai->efqi", values, ends)
        return (points - places[:, None, None]).reshape(2, -1, points.shape[3])

    def jumped(ends, _):
        hit = passes(load.obstacle, *points_of(ends))
        return jnp.any(hit.reshape(ends.shape[0], -1), axis=1).astype(ends.dtype)

    def idle(ends, _):
        return far(load.obstacle, points_of(ends))

    ends = jnp.stack([load.began, (problem.mesh.points + u)[load.facets]], axis=1)
    return jnp.any(blockwise(jumped, idle, ends, None, ()) > 0)

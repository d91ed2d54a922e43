"""A contact that has touched nothing yet, and one in a motion that begins."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.contact import no_grip
from sorojax.fem.facets import facet_tables
from sorojax.mesh.mesh import Mesh

if TYPE_CHECKING:
    from sorojax.fem.contact_load import Contact


class Start(NamedTuple):
    """Where a step of a contact begins: place of the obstacle, how far before its surface
    pressure starts, and how far points of a facet may move until one feels it [m]."""

    place: Float[Array, " dim"]
    shift: Float[Array, "facets quad"]
    clear: Float[Array, " facets"]


def at_end(share: Float[Array, ""]) -> Float[Array, ""]:
    """Share of the pressure at the end of a step, beside that of its mean: none where
    forces act in the middle of the step, all where they act after 2/3 of it or more."""
    return jnp.clip(3 * (2 * share - 1), 0.0, 1.0)


def untouched(load: "Contact", mesh: Mesh) -> "Contact":
    """`load` that has touched nothing yet."""
    load = dataclasses.replace(load, place=load.value)
    if load.friction is None:
        return load
    stiffness = load.stiffness if load.friction_stiffness is None else load.friction_stiffness
    grip = no_grip(_at_rest(load, mesh))
    return dataclasses.replace(load, friction_stiffness=stiffness, grip=grip)


def _at_rest(load: "Contact", mesh: Mesh) -> Float[Array, "facets quad dim"]:
    values = jnp.asarray(facet_tables(mesh.element).values)
    return jnp.einsum("qa,fai->fqi", values, mesh.points[load.facets])


def moving(load: "Contact", mesh: Mesh, place: Float[Array, " dim"]) -> "Contact":
    """`load` of a motion that begins with the obstacle at `place` [m]."""
    none = jnp.zeros_like(_at_rest(load, mesh)[..., 0])
    one = jnp.ones((), none.dtype)
    load = dataclasses.replace(
        load, place=place, began=mesh.points[load.facets], share=one,
        start=Start(place, none, none[:, 0]),
    )  # fmt: skip
    if load.release_velocity is None:
        return load
    return dataclasses.replace(load, sunk=none, fresh=one)

"""Frictionless contact of a body with a shape that does not deform."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import integers, is_traced, optional_real
from sorojax.contact import Contacts, Penalty, contacts, far, gaps
from sorojax.fem.curved import CurvedPart, blockwise
from sorojax.fem.facets import facet_tables, normals
from sorojax.fem.loads import AbstractLoad
from sorojax.material.hyperelastic import small_strain_moduli
from sorojax.mesh.elements import facet_corners
from sorojax.sdf.base import AbstractSdf

_TOGETHER = 32  # facets that the broad phase judges by one ball


class Contact(AbstractLoad):
    """`facets` may not enter `obstacle`, which is `value` away from its place [m].

    A penalty per reference area at the quadrature points of the facets, `contact.Penalty`.
    Facets of which no point can touch cost one value of the obstacle's field for every 32.

    `stiffness` [Pa/m] is 10 E / h when omitted, h being the mean size of the facets:
    pressure p then overlaps by about h p / (10 E). `smoothing` [m] is E / 1000 over the
    stiffness: the law is linear beyond pressures of E / 2000. Under
    `solve_path(problem, name=positions)` the obstacle moves.
    """

    smooth: ClassVar[bool] = False

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    obstacle: AbstractSdf
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    smoothing: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    value: Float[Array, " dim"] = eqx.field(converter=optional_real, default=None)  # type: ignore
    name: str = eqx.field(static=True, default="contact")

    @property
    def law(self) -> Penalty:
        if self.stiffness is None or self.smoothing is None:
            raise ValueError(
                f"fem.Contact '{self.name}': no stiffness yet. Take the load of the problem, "
                "problem.loads, where the default is filled in."
            )
        return Penalty(self.stiffness, self.smoothing)

    def potential(self, problem, u):
        x = (problem.mesh.points + u)[self.facets]
        energies = jax.vmap(self._energy(problem))
        areas = areas_of(problem, self.facets)
        return jnp.sum(blockwise(energies, self._idle(problem), x, areas, ()))

    def curved_part(self, problem):
        areas = areas_of(problem, self.facets)
        return CurvedPart(self.facets, self._energy(problem), areas, self._idle(problem))

    def _energy(self, problem):
        values, law = jnp.asarray(facet_tables(problem.mesh.element).values), self.law

        def energy(x, areas):
            return jnp.sum(areas * law.energy(gaps(self.obstacle, values @ x, self.value)))

        return energy

    def _idle(self, problem):
        values = jnp.asarray(facet_tables(problem.mesh.element).values)

        def idle(x, _):
            points = jnp.einsum("qa,fai->fqi", values, x)
            return far(self.obstacle, points - jnp.broadcast_to(self.value, points.shape))

        return idle

    def completed(self, mesh, material, kinematics):
        facets, size = _compact(mesh, self.facets), _mean_size(mesh, self.facets)
        value = jnp.zeros(mesh.element.dim) if self.value is None else self.value
        stiffness, smoothing = self.stiffness, self.smoothing
        shear, bulk = small_strain_moduli(material)
        young = jnp.max(9 * bulk * shear / (3 * bulk + shear))
        stiffness = 10 * young / size if stiffness is None else stiffness
        smoothing = 1e-3 * young / stiffness if smoothing is None else smoothing
        return eqx.tree_at(
            lambda load: (load.facets, load.stiffness, load.smoothing, load.value),
            self, (integers(facets), stiffness, smoothing, value),
            is_leaf=lambda leaf: leaf is None,
        )  # fmt: skip

    def check(self, where, mesh, kinematics):
        if self.obstacle.dim != mesh.element.dim:
            raise ValueError(
                f"fem.problem: {where} has an obstacle in {self.obstacle.dim} dimensions, the "
                f"mesh has {mesh.element.dim}. Use a shape of the same space."
            )
        for what, number, unit in (
            ("stiffness", self.stiffness, "Pa/m"), ("smoothing", self.smoothing, "m"),
        ):  # fmt: skip
            _check.positive("fem.problem", f"{where} {what}", number, unit,
                            "Leave it out for the default.")  # fmt: skip


def areas_of(problem, facets: Int[Array, "facets facet_nodes"]) -> Float[Array, "facets quad"]:
    """Reference areas of the quadrature points of facets [m^2]."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics
    weights, values = jnp.asarray(tables.weights), jnp.asarray(tables.values)

    def one(X):
        size = jnp.sqrt(jnp.sum(normals(tables, X) ** 2, axis=1))
        return weights * size * kinematics.depth(tuple((values @ X).T))

    return jax.vmap(one)(problem.mesh.points[facets])


def contact_state(problem, u: Float[Array, "nodes dim"], name: str = "contact") -> Contacts:
    """Gap, pressure, normal and force at the quadrature points of the contact `name`.

    `.total` is the force of the obstacle on the body [N], `.active` the points that touch.
    """
    loads = [load for load in problem.loads if load.name == name]
    if not loads or not isinstance(loads[0], Contact):
        names = [load.name for load in problem.loads if isinstance(load, Contact)]
        raise ValueError(f"fem.contact_state: got name {name!r}, need one of {names}.")
    return _state(loads[0], problem, u)


@eqx.filter_jit
def _state(load: Contact, problem, u: Float[Array, "nodes dim"]) -> Contacts:
    values = jnp.asarray(facet_tables(problem.mesh.element).values)
    points = jnp.einsum("qa,fai->fqi", values, (problem.mesh.points + u)[load.facets])
    areas = areas_of(problem, load.facets).ravel()
    flat = points.reshape(-1, points.shape[-1])
    return contacts(load.law, load.obstacle, flat, areas, load.value)


def _mean_size(mesh, facets) -> Float[Array, ""]:
    corners = mesh.points[facets[:, : facet_corners(mesh.element)]]
    return jnp.mean(jnp.sqrt(jnp.sum((corners[:, 1] - corners[:, 0]) ** 2, axis=1)))


def _compact(mesh, facets) -> Int[np.ndarray, "facets facet_nodes"] | Array:
    """The facets in an order that keeps neighbours together, by halving the longest side."""
    if is_traced((mesh.points, facets)):
        return facets
    facets = np.asarray(facets)
    centres = np.asarray(mesh.points)[facets].mean(axis=1)

    def halved(ids):
        if len(ids) <= _TOGETHER:
            return [ids]
        axis = np.argmax(np.ptp(centres[ids], axis=0))
        ids = ids[np.argsort(centres[ids, axis], kind="stable")]
        middle = -(-len(ids) // (2 * _TOGETHER)) * _TOGETHER
        return halved(ids[:middle]) + halved(ids[middle:])

    return facets[np.concatenate(halved(np.arange(len(facets))))]

"""Contact of deformable surfaces with each other: self-contact and contact of two bodies.
Facets on the two sides of one wall, which are near each other but never meet, are excluded.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, optional_real, real
from sorojax.contact.broadphase import close_pairs, listed
from sorojax.contact.facet import Contacts, over, shared
from sorojax.fem.checks import check_ids
from sorojax.fem.contact.obstacle import (
    AbstractPenaltyContact,
    compact,
    default_law,
    mean_size,
)
from sorojax.fem.loads.facets import CurvedPart, areas_of, facet_tables, group_energy, normals
from sorojax.mesh.elements.base import facet_corners, facet_element, flat_triangles
from sorojax.mesh.mesh import Mesh


def through_own_wall(
    mesh: Mesh,
    facets: Int[np.ndarray, "facets facet_nodes"],
    first: Int[np.ndarray, " pairs"],
    second: Int[np.ndarray, " pairs"],
    reach: float,
) -> Bool[np.ndarray, " pairs"]:
    """Whether the first facet of a pair lies behind the second in the reference
    configuration, back to back, in the same body and within twice the reach [m]."""
    X = np.asarray(mesh.points)
    corners = X[facets[:, : facet_corners(mesh.element)]]
    middle, normal = corners.mean(axis=1), _normals(corners)
    away = middle[first] - middle[second]
    behind = (away * normal[second]).sum(axis=1) < 0
    opposed = (normal[first] * normal[second]).sum(axis=1) < 0
    close = (away**2).sum(axis=1) < (2 * reach + _size(corners)) ** 2
    body = _bodies(mesh)[facets[:, 0]]
    return behind & opposed & close & (body[first] == body[second])


def _size(corners) -> float:
    return float(np.ptp(corners, axis=1).max())


def _normals(corners):
    along = corners[:, 1] - corners[:, 0]
    if corners.shape[2] == 2:
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    return np.cross(along, corners[:, 2] - corners[:, 0])


def _bodies(mesh: Mesh) -> Int[np.ndarray, " nodes"]:
    """Number of the connected part of the mesh that each node belongs to."""
    cells = np.asarray(mesh.cells)
    label = np.arange(mesh.num_nodes)
    while True:  # the smallest number of each cell, and of what it points to
        before = label
        label = label.copy()
        np.minimum.at(label, cells.ravel(), np.repeat(label[cells].min(axis=1), cells.shape[1]))
        label = label[label]
        if np.array_equal(label, before):
            return label


# Contact of deformable surfaces with each other: self-contact, and body with body


_CANDIDATES = {2: 4, 3: 8}


class SelfContact(AbstractPenaltyContact):
    """`facets` may not enter each other; with `others`, the two sets may not.

    A penalty per reference area, `contact.Penalty`, at the quadrature points of both
    sides, each for half of its area, along the normal of the facet that is closest among
    the `candidates` listed for a facet: those that were nearest, within `reach` [m], when
    the lists were made. They hold while points move by less than about half of it;
    `fem.update_contact_pairs` makes them anew. A point counts as inside up to a depth of
    `reach`, and where the surfaces face each other.

    Two sets belong to one mesh, `mesh.merge(a=..., b=...)` for two bodies. `value` [m] is a
    clearance kept between the surfaces. `reach` is twice the mean size of the facets when
    omitted; `stiffness`, `smoothing` and `offset` are those of `Contact`.

    The fields that follow are set by `problem` and `update_contact_pairs`, in a motion by
    `simulate`; leave them out.

    Attributes:
        partners: The listed facets of each facet, by number in `facets` and `others` together.
        real: Where `partners` lists one; the rest fills up the rows.
        began: Where the nodes were when the step began [m].
        share: Of the step, after which forces act [-].
    """

    units: ClassVar[dict[str, str]] = {"stiffness": "Pa/m", "smoothing": "m", "reach": "m"}
    forgets: ClassVar[bool] = True

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    others: Int[Array, "others facet_nodes"] | None = eqx.field(
        converter=lambda ids: None if ids is None else integers(ids), default=None
    )
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    smoothing: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    reach: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="self_contact")
    candidates: int | None = eqx.field(static=True, default=None)
    offset: Float[Array, "rows quad"] | None = eqx.field(converter=optional_real, default=None)
    partners: Int[Array, "rows candidates"] | None = None
    real: Bool[Array, "rows candidates"] | None = None
    began: Float[Array, "nodes dim"] | None = None
    share: Float[Array, ""] | None = None

    @property
    def _reach(self) -> Float[Array, ""]:
        assert self.reach is not None  # `problem` fills it in
        return self.reach

    def rows(self, xp=jnp):
        """All facets that look for others."""
        if self.others is None:
            return xp.asarray(self.facets)
        return xp.concatenate([xp.asarray(self.facets), xp.asarray(self.others)])

    def potential(self, problem, u):
        return group_energy((problem.mesh.points + u)[self._groups()], self, problem)

    def stored(self, problem, u):
        now = dataclasses.replace(self, began=None, share=None)
        return now.potential(problem, u)

    def begun(self, problem, step):
        share = jnp.broadcast_to(jnp.asarray(step.share, step.u.dtype), ())
        return dataclasses.replace(self, began=problem.mesh.points + step.u, share=share)

    def curved_part(self, problem):
        groups = self._groups()
        began = None if self.began is None else self.began[groups]
        data = areas_of(problem, self.rows()) / 2, self.real, self.offset, began
        return CurvedPart(groups, self._energy(problem), data, self._idle(problem))

    def longest_share(self, du):
        """No facet moves by more than half the reach towards those that it looks for."""
        moves = jnp.mean(du[self.rows()], axis=1)
        apart = moves[self.partners] - moves[:, None]
        far = jnp.sqrt(jnp.max(jnp.sum(apart**2, axis=2)))
        half = self._reach / 2 * (1.0 if self.share is None else self.share)
        return jnp.where(far > half, half / far, 1.0)

    def couples(self):
        if self.partners is None or is_traced(self.partners):
            return None
        return self._groups(np)

    def _groups(self, xp=jnp):
        """A facet, then its candidates."""
        rows = self.rows(xp)
        found = rows[xp.asarray(self.partners)]
        return xp.concatenate([rows, found.reshape(len(rows), -1)], axis=1)

    def _energy(self, problem):
        near = self._near(problem)

        def energy(x, data):
            areas, real, offset, began = data
            height, weight, _ = near(self.end_of_step(x, began), real)
            gap, before = self._gap(height, offset), None
            if self.share is not None:
                before = self._gap(near(began, real).height, offset)
            density = self.density(gap, before)
            return jnp.sum(areas * jnp.sum(weight * density, axis=1))

        return energy

    def _gap(self, height, offset):
        gap = height - self.value
        return gap if offset is None else gap - offset[..., None]

    def _near(self, problem):
        """Heights of the quadrature points of a facet over its candidates, weights and
        normals of these."""
        element = problem.mesh.element
        tables, dim = facet_tables(element), element.dim
        values, width = jnp.asarray(tables.values), self.facets.shape[1]
        parts = np.arange(width)[None] if dim == 2 else flat_triangles(facet_element(element))

        def near(x, real):
            points = values @ x[:width]
            facing = jax.lax.stop_gradient(normals(tables, x[:width]))
            found = x[width:].reshape(-1, width, dim)[:, parts]
            found = found.reshape(-1, *found.shape[2:])
            real = jnp.repeat(real, len(parts))

            def one(point, facing):
                seen = jax.vmap(lambda piece: over(piece, point))(found)
                meets = real & (seen.normal @ facing < 0) & (seen.height > -self._reach)
                weight = jnp.where(meets, seen.weight, jnp.zeros_like(seen.weight))
                return seen._replace(weight=shared(weight))

            return jax.vmap(one)(points, facing)

        return near

    def _idle(self, problem):
        near = self._near(problem)

        def idle(x, data):
            _, real, offset, began = data
            height, weight, _ = jax.vmap(near)(self.end_of_step(x, began), real)
            return jnp.all((self._gap(height, offset) > 0) | (weight <= 0))

        return idle

    def completed(self, mesh, material, kinematics):
        if is_traced((mesh.points, self.facets)):
            return self
        if self.partners is not None or not self._fits(mesh):
            return self  # `check` says why
        others = None if self.others is None else compact(mesh, self.others)
        made = dataclasses.replace(self, facets=compact(mesh, self.facets), others=others)
        law = default_law(mesh, material, made.rows(), self.stiffness, self.smoothing)
        made = dataclasses.replace(
            made,
            stiffness=law[0],
            smoothing=law[1],
            reach=2 * mean_size(mesh, made.rows()) if self.reach is None else self.reach,
            candidates=self.candidates or _CANDIDATES[mesh.element.dim],
        )
        return with_partners(made, mesh, np.zeros(mesh.points.shape))

    def _fits(self, mesh) -> bool:
        """Whether `others` are facets of this mesh."""
        if self.others is None:
            return True
        others = np.asarray(self.others)
        alike = others.ndim == 2 and others.shape[1:] == self.facets.shape[1:]
        return alike and others.size > 0 and others.min() >= 0 and others.max() < mesh.num_nodes

    def check(self, where, mesh, kinematics):
        super().check(where, mesh, kinematics)
        if self.others is None:
            return
        if self.others.ndim != 2 or self.others.shape[1] != self.facets.shape[1]:
            raise ValueError(
                f"fem.problem: {where} has `others` of shape {self.others.shape}, need facets "
                f"of {self.facets.shape[1]} nodes. Take them from this mesh: mesh.facet_sets."
            )
        check_ids(f"{where} others", self.others, mesh.num_nodes)

    def sank(self, problem, u: Float[Array, "nodes dim"]) -> Bool[Array, ""]:
        """Whether a point that was inside is deeper than `reach` after a step to `u` [m],
        where nothing pushes it out any more."""
        assert self.began is not None
        groups = self._groups()
        deep = dataclasses.replace(self, reach=jnp.full_like(self._reach, jnp.inf))
        near = jax.vmap(deep._near(problem))
        before, now = (
            near(x[groups], self.real) for x in (self.began, problem.mesh.points + u)
        )
        inside = (before.weight > 0) & (before.height < 0) & (before.height > -self._reach)
        return jnp.any(inside & (now.weight > 0) & (now.height <= -self._reach))

    def outran(self, problem, u: Float[Array, "nodes dim"]) -> Bool[Array, ""]:
        """Whether two facets passed near each other in a step to `u` [m] faster than lists
        can follow."""
        assert self.began is not None
        rows, most = self.rows(), self._reach / 2
        began, end = (x[rows] for x in (self.began, problem.mesh.points + u))
        place, move = jnp.mean(began, axis=1), jnp.mean(end - began, axis=1)
        sizes = [
            jnp.sum((x - jnp.mean(x, axis=1, keepdims=True)) ** 2, axis=2) for x in (began, end)
        ]
        size = jnp.sqrt(jnp.max(jnp.maximum(*sizes), axis=1))
        second = np.arange(len(rows)) >= len(self.facets)

        def met(row):
            place_of, move_of, size_of, side = row
            apart, way = place_of[None] - place, move_of[None] - move
            square = jnp.sum(way**2, axis=1)
            along = jnp.sum(apart * way, axis=1)
            nearest = jnp.clip(-along / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
            least = jnp.sum((apart + nearest[:, None] * way) ** 2, axis=1)
            meets = (square > most**2) & (least < (size_of + size + self._reach) ** 2)
            return jnp.any(meets if self.others is None else meets & (side != second))

        def looked():
            return jnp.any(jax.lax.map(met, (place, move, size, jnp.asarray(second))))

        spread = jnp.max(move, axis=0) - jnp.min(move, axis=0)
        return jax.lax.cond(jnp.sum(spread**2) > most**2, looked, lambda: jnp.array(False))

    def state(self, problem, u: Float[Array, "nodes dim"]) -> Contacts:
        """Contact of the quadrature points of each side with the other one."""
        part, near = self.curved_part(problem), self._near(problem)
        x = (problem.mesh.points + u)[part.groups]
        areas, real, offset, _ = part.data
        height, weight, normal = jax.vmap(near)(x, real)
        clear = height - self.value
        pressure = self.law.pressure(self._gap(height, offset))
        force = jnp.einsum("fq,fqk,fqki->fqi", areas, weight * pressure, normal)
        total = jnp.sum(weight, axis=2)
        seen = jnp.where(total > 0, total, jnp.ones_like(total))
        gap = jnp.where(total > 0, jnp.sum(weight * clear, axis=2) / seen, jnp.inf)
        mean = jnp.einsum("fqk,fqki->fqi", weight, normal) / seen[..., None]
        values = jnp.asarray(facet_tables(problem.mesh.element).values)
        width, dim = self.facets.shape[1], x.shape[2]
        points = jnp.einsum("qa,fai->fqi", values, x[:, :width])
        flat = [a.reshape(-1, dim) for a in (points, mean, force)]
        pressure = jnp.sum(weight * pressure, axis=2).ravel()
        return Contacts(
            flat[0], gap.ravel(), pressure, flat[1], flat[2], jnp.zeros_like(flat[2])
        )


def with_partners(load: SelfContact, mesh, u: np.ndarray) -> SelfContact:
    """`load` with the facets that are near each other at displacement `u` [m]."""
    rows = load.rows(np)
    X = np.asarray(mesh.points)
    reach = float(load.reach)  # type: ignore[arg-type]
    first, second, apart = close_pairs((X + np.asarray(u))[rows], reach)
    shared = (rows[first][:, :, None] == rows[second][:, None, :]).any(axis=(1, 2))
    kept = ~shared & ~through_own_wall(mesh, rows, first, second, reach)
    if load.others is not None:
        is_other = np.arange(len(rows)) >= len(load.facets)
        kept &= is_other[first] != is_other[second]
    partners, real = listed(
        first[kept], second[kept], apart[kept], len(rows), load.candidates or 1
    )
    return dataclasses.replace(load, partners=integers(partners), real=jnp.asarray(real))

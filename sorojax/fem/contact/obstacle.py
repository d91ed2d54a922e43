"""Contact of a body with a shape that does not deform: its facets, their areas and sizes, and
the penalty law that suits them.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, optional_real, real
from sorojax.contact import AbstractFriction, Penalty, SpringSlider
from sorojax.contact.broadphase import far
from sorojax.contact.facet import Contacts, contacts, gaps
from sorojax.contact.friction import Grip, friction_law
from sorojax.fem.contact.friction import Start, at_end, felt, gripped, released, untouched
from sorojax.fem.loads.facets import CurvedPart, facet_tables, group_energy, normals
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.material.hyperelastic import small_strain_moduli
from sorojax.mesh.elements.base import facet_corners
from sorojax.sdf.base import AbstractSdf

_TOGETHER = 32  # facets that the broad phase judges by one ball


def areas_of(problem, facets: Int[Array, "facets facet_nodes"]) -> Float[Array, "facets quad"]:
    """Reference areas of the quadrature points of facets [m^2]."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics
    weights, values = jnp.asarray(tables.weights), jnp.asarray(tables.values)

    def one(X):
        size = jnp.sqrt(jnp.sum(normals(tables, X) ** 2, axis=1))
        return weights * size * kinematics.depth(tuple((values @ X).T))

    return jax.vmap(one)(problem.mesh.points[facets])


def default_law(mesh, material, facets, stiffness, smoothing) -> tuple[Array, Array]:
    """Stiffness [Pa/m] and smoothing [m], where they are not given, from the size of the
    facets and the softest cells at their nodes."""
    shear, bulk = small_strain_moduli(material)
    young = jnp.broadcast_to(9 * bulk * shear / (3 * bulk + shear), (mesh.num_cells,))
    of_nodes = jnp.full(mesh.num_nodes, jnp.inf, young.dtype)
    young = jnp.mean(of_nodes.at[mesh.cells].min(young[:, None])[facets])
    stiffness = 10 * young / mean_size(mesh, facets) if stiffness is None else stiffness
    return stiffness, 1e-3 * young / stiffness if smoothing is None else smoothing


def mean_size(mesh, facets) -> Float[Array, ""]:
    """Mean length of the first sides of facets [m]."""
    corners = mesh.points[facets[:, : facet_corners(mesh.element)]]
    return jnp.mean(jnp.sqrt(jnp.sum((corners[:, 1] - corners[:, 0]) ** 2, axis=1)))


def compact(mesh, facets) -> Int[np.ndarray, "facets facet_nodes"] | Array:
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


# Contact of a body with a shape that does not deform


class Contact(AbstractLoad):
    """`facets` may not enter `obstacle`, which is `value` away from its place [m].

    A penalty per reference area at the quadrature points of the facets, `contact.Penalty`.
    Facets of which no point can touch cost one value of the obstacle's field for every 32; in
    a step of `simulate` it is asked once, and forces leave the contact out until a point has
    moved as far as it had room.

    `stiffness` [Pa/m] is 10 E / h when omitted, h being the mean size of the facets:
    pressure p then overlaps by about h p / (10 E). `smoothing` [m] is E / 1000 over the
    stiffness: the law is linear beyond pressures of E / 2000. Under
    `solve_path(problem, name=positions)` the obstacle moves.

    `friction` is a law, or the coefficient [-] of Coulomb's; the contact follows it by a
    `contact.SpringSlider`. `friction_stiffness` [Pa/m] is the stiffness when omitted, so that
    held points give way by the coefficient times the overlap, and `friction_velocity` [m/s]
    that of its dashpot. Friction has a memory: `simulate` keeps it; in statics `solve` takes
    friction at the pressures that the load knows of, none at first, and
    `advanced(problem, u)` lets it know of an equilibrium.

    Points that are deep inside when a motion begins are let out at `release_velocity` [m/s],
    not shot out; with `None` the whole overlap pushes at once. In a step the pressure is
    that at its end, which takes energy where steps do not resolve the contact, or its mean
    over the way of the point, which keeps it: methods that damp nothing take the mean, those
    of `rho_inf` up to 1/2 the end, others both. On a flat obstacle neither adds energy.

    Reference: Laursen, Chawla, "Design of energy conserving algorithms for frictionless
    dynamic contact problems", Int. J. Num. Meth. Eng. 40, 1997, for the mean.

    `offset` [m] of every point is how far the pressure starts before the surface, the
    multiplier of an augmented Lagrangian; `solve_contact` finds it.
    """

    smooth: ClassVar[bool] = False
    overshoots: ClassVar[bool] = True

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    obstacle: AbstractSdf
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    smoothing: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    value: Float[Array, " dim"] = eqx.field(converter=optional_real, default=None)  # type: ignore
    name: str = eqx.field(static=True, default="contact")
    friction: AbstractFriction | None = eqx.field(converter=friction_law, default=None)
    friction_velocity: Float[Array, ""] = eqx.field(converter=real, default=1e-3)
    friction_stiffness: Float[Array, ""] | None = eqx.field(
        converter=optional_real, default=None
    )
    offset: Float[Array, "facets quad"] | None = eqx.field(
        converter=optional_real, default=None
    )
    release_velocity: Float[Array, ""] | None = eqx.field(converter=optional_real, default=0.1)
    sunk: Float[Array, "facets quad"] | None = None  # found: overlap not let out yet [m]
    fresh: Float[Array, ""] | None = None  # found: one before a motion, then zero
    began: Float[Array, "facets facet_nodes dim"] | None = None  # found: positions [m]
    share: Float[Array, ""] | None = None  # found: of a step, after which forces act
    start: Start | None = None  # found
    grip: Grip | None = None  # found
    place: Float[Array, " dim"] | None = None  # of the obstacle at the end of the last step

    @property
    def law(self) -> Penalty:
        if self.stiffness is None or self.smoothing is None:
            raise ValueError(
                f"fem.Contact '{self.name}': no stiffness yet. Take the load of the problem, "
                "problem.loads, where the default is filled in."
            )
        return Penalty(self.stiffness, self.smoothing)

    @property
    def slider(self) -> SpringSlider:
        if self.friction is None or self.friction_stiffness is None:
            raise ValueError(
                f"fem.Contact '{self.name}': got no friction, need a law. Give "
                "friction=0.5 and take the load of the problem, problem.loads."
            )
        return SpringSlider(self.friction, self.friction_stiffness, self.friction_velocity)

    def shift(self) -> Float[Array, "facets quad"] | None:
        """How far before the surface pressure starts [m]."""
        return _sum(self.offset, self.sunk)

    def points_of(self, problem, u) -> Float[Array, "facets quad dim"]:
        """Where the quadrature points of the facets are [m]."""
        return self.points_at(problem, (problem.mesh.points + u)[self.facets])

    def points_at(self, problem, x) -> Float[Array, "facets quad dim"]:
        """Where they are with the nodes of facets at `x` [m]."""
        values = jnp.asarray(facet_tables(problem.mesh.element).values)
        return jnp.einsum("qa,fai->fqi", values, x)

    def acted(self, problem, u) -> Float[Array, "facets quad dim"]:
        """Where its quadrature points were [m] when forces acted in the step to `u`."""
        x = (problem.mesh.points + u)[self.facets]
        x = x if self.share is None else self.began + self.share * (x - self.began)
        return self.points_at(problem, x)

    def potential(self, problem, u):
        return group_energy((problem.mesh.points + u)[self.facets], self, problem)

    def stored(self, problem, u):
        """Energy of the overlap and of the springs of friction [J]."""
        now = dataclasses.replace(self, began=None, share=None, start=None)
        bare = dataclasses.replace(now, grip=None)
        energy = bare.potential(problem, u)
        if self.grip is None:
            return energy
        held = self.slider.stored(self.stretch(problem, u, self.value))
        return energy + jnp.sum(areas_of(problem, self.facets) * held)

    def stretch(self, problem, u, place) -> Float[Array, "facets quad dim"]:
        """Lengths of the springs of friction [m] after a step to `u` [m], in which forces
        acted with the obstacle at `place` [m]."""
        assert self.grip is not None
        share = 1.0 if self.share is None else self.share
        return self.slider.stretch(self.grip, self.acted(problem, u) - place[None, None], share)

    def curved_part(self, problem):
        rows = jnp.arange(self.facets.shape[0])
        return CurvedPart(self.facets, self._energy(problem), rows, self._idle(problem))

    def rows(self, xp=jnp):
        """All facets that look for the obstacle."""
        return xp.asarray(self.facets)

    def state(self, problem, u: Float[Array, "nodes dim"]) -> Contacts:
        """Contact of the quadrature points with the obstacle."""
        points = self.points_of(problem, u)
        areas = areas_of(problem, self.facets)
        flat = points.reshape(-1, points.shape[-1])
        offset = self.shift()
        offset = None if offset is None else offset.ravel()
        found = contacts(self.law, self.obstacle, flat, areas.ravel(), self.value, offset)
        if self.grip is None:
            return found
        traction = self.slider.traction(self.grip, points - self.value[None, None])
        friction = (areas[..., None] * traction).reshape(flat.shape)
        return found._replace(force=found.force + friction, friction=friction)

    def begun(self, problem, step):
        load, at_first = self, self
        if self.sunk is not None:
            assert self.fresh is not None
            load = released(self, problem, step.u, step.step)
            assert load.sunk is not None
            # what is not felt when a motion begins has not been felt before
            sunk = jnp.where(self.fresh > 0, load.sunk, self.sunk)
            at_first = dataclasses.replace(self, sunk=sunk)
        began = (problem.mesh.points + step.u)[self.facets]
        share = jnp.broadcast_to(jnp.asarray(step.share, began.dtype), ())
        shift = at_first.shift()
        assert self.start is not None and self.place is not None
        shift = jnp.zeros_like(self.start.shift) if shift is None else shift
        feels = felt(load, problem, step.u)
        size = jnp.broadcast_to(jnp.asarray(step.step, began.dtype), ())
        start = Start(self.place, shift, feels.clear, size)
        if load.grip is not None:
            load = gripped(load, problem, step.u, step, feels)
        return dataclasses.replace(
            load, began=began, share=share, start=start, place=self.value
        )

    def _energy(self, problem):
        values, law = jnp.asarray(facet_tables(problem.mesh.element).values), self.law
        known = self.facets, self.offset, self.sunk, self.grip, self.began
        start = self.start

        def energy(x, row):
            # only where a block may touch are the data of its facets looked up
            facet, offset, sunk, grip, began = jax.tree.map(lambda leaf: leaf[row], known)
            areas, offset = areas_of(problem, facet[None])[0], _sum(offset, sunk)
            position = values @ x - self.value[None]
            gap = self.gap_of(values @ self._end(x, began), offset)
            density = law.energy(gap)
            if self.share is not None and start is not None:
                ending = at_end(self.share)
                before = gaps(self.obstacle, values @ began, start.place)
                mean = law.energy_of_step(before - start.shift[row], gap)
                density = self.share * (ending * density + (1 - ending) * mean)
            if grip is not None:
                density = density + self.slider.energy(grip, position)
            return jnp.sum(areas * density)

        return energy

    def gap_of(self, points, offset) -> Float[Array, "..."]:
        """Gap of points [m] to where the pressure starts."""
        gap = gaps(self.obstacle, points, self.value)
        return gap if offset is None else gap - offset

    def _end(self, x, began):
        """Positions at the end of a step, of those where forces act."""
        return x if self.share is None else began + (x - began) / self.share

    def _idle(self, problem):
        shift, grip, start = self.shift(), self.grip, self.start
        reach = None if shift is None or start is not None else jnp.max(shift)

        def near(x, rows):
            """In a step nothing is asked of the field: it was where the step began."""
            assert start is not None and self.began is not None
            began = self.began[rows]
            way = self.points_at(problem, self._end(x, began) - began)
            way = way - (self.value - start.place)[None, None]
            return jnp.sum(way**2, axis=2) < start.clear[rows, None] ** 2

        def idle(x, rows):
            if start is not None:
                return jnp.all(near(x, rows))
            points = self.points_at(problem, x) - self.value[None, None]
            free = far(self.obstacle, points, reach)
            return free if grip is None else free & ~jnp.any(grip.pressure[rows] > 0)

        return idle

    def room(self, problem):
        values = facet_tables(problem.mesh.element).values
        assert self.start is not None and self.share is not None
        moved = jnp.sqrt(jnp.sum((self.value - self.start.place) ** 2))
        free = self.share * (jnp.min(self.start.clear) - moved)
        return free / float(np.abs(values).sum(axis=1).max())

    def completed(self, mesh, material, kinematics):
        facets = self.facets if self._kept else compact(mesh, self.facets)
        value = jnp.zeros(mesh.element.dim) if self.value is None else self.value
        law = default_law(mesh, material, self.facets, self.stiffness, self.smoothing)
        made = dataclasses.replace(
            self, facets=facets, stiffness=law[0], smoothing=law[1], value=value
        )
        return made if self._kept and self.place is not None else untouched(made, mesh)

    @property
    def _kept(self) -> bool:
        """Whether numbers of single facets hang on their order."""
        return any(x is not None for x in (self.place, self.offset))

    def check(self, where, mesh, kinematics):
        if self.obstacle.dim != mesh.element.dim:
            raise ValueError(
                f"fem.problem: {where} has an obstacle in {self.obstacle.dim} dimensions, the "
                f"mesh has {mesh.element.dim}. Use a shape of the same space."
            )
        for what, number, unit in (
            ("stiffness", self.stiffness, "Pa/m"),
            ("smoothing", self.smoothing, "m"),
            ("friction_velocity", self.friction_velocity, "m/s"),
            ("friction_stiffness", self.friction_stiffness, "Pa/m"),
            ("release_velocity", self.release_velocity, "m/s"),
        ):
            if number is None:
                continue
            _check.positive(
                "fem.problem", f"{where} {what}", number, unit, "Leave it out for the default."
            )


def _sum(*terms: Array | None) -> Array | None:
    """Of those that there are."""
    given = [term for term in terms if term is not None]
    return sum(given[1:], start=given[0]) if given else None

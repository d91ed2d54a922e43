"""Contact of a body with a shape that does not deform: facets, penalty, and what a contact
remembers between steps, friction and overlap that is relaxed.

Pressure and normal of friction are those of the step before, which keeps the tangent
symmetric. So the friction impulse on sliding points is the coefficient times the normal
impulse, one step later, whether steps resolve an impact or not, and are cut or not.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, optional_real, real
from sorojax.contact import AbstractFriction, Penalty, SpringSlider
from sorojax.contact.broadphase import clearance, far
from sorojax.contact.facet import Contacts, contacts, gaps, surface
from sorojax.contact.friction import DirectionalCoulomb, Grip, friction_law, no_grip
from sorojax.fem.loads.facets import CurvedPart, areas_of, blockwise, facet_tables, group_energy
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.material.hyperelastic import small_strain_young_modulus
from sorojax.mesh.elements.base import facet_corners
from sorojax.mesh.mesh import Mesh
from sorojax.sdf.base import AbstractSdf

if TYPE_CHECKING:
    from sorojax.fem.dynamics.step import StepState
    from sorojax.fem.problem import Problem


class Start(NamedTuple):
    """Where a step of a contact begins.

    Attributes:
        place: Of the obstacle [m].
        shift: How far before its surface pressure starts [m].
        clear: How far points of a facet may move until one feels it [m].
        step: Size of the step, zero before a motion [s].
    """

    place: Float[Array, " dim"]
    shift: Float[Array, "facets quad"]
    clear: Float[Array, " facets"]
    step: Float[Array, ""]


def at_end(share: Float[Array, ""]) -> Float[Array, ""]:
    """Share of the pressure at the end of a step, beside that of its mean: none where
    forces act in the middle of the step, all where they act after 2/3 of it or more."""
    return jnp.clip(3 * (2 * share - 1), 0.0, 1.0)


_TOGETHER = 32  # facets that the broad phase judges by one ball


def default_law(mesh, material, facets, stiffness, smoothing) -> tuple[Array, Array]:
    """Stiffness [Pa/m] and smoothing [m], where they are not given, from the size of the
    facets and the softest cells at their nodes."""
    young = jnp.broadcast_to(small_strain_young_modulus(material), (mesh.num_cells,))
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


class AbstractPenaltyContact(AbstractLoad):
    """What contacts of the facets of a body share: the penalty, and its mean over a step."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        stiffness: ClassVar[Float[Array, ""] | None]
        smoothing: ClassVar[Float[Array, ""] | None]
        share: ClassVar[Float[Array, ""] | None]  # of a step, after which forces act
    smooth: ClassVar[bool] = False
    overshoots: ClassVar[bool] = True
    units: eqx.AbstractClassVar[dict[str, str]]  # of numbers that have to be positive

    @property
    def law(self) -> Penalty:
        if self.stiffness is None or self.smoothing is None:
            raise ValueError(
                f"fem.{type(self).__name__} '{self.name}': no stiffness yet. Take the load of "
                "the problem, problem.loads, where the default is filled in."
            )
        return Penalty(self.stiffness, self.smoothing)

    def density(self, gap, before) -> Float[Array, "..."]:
        """Energy per area [J/m^2] at a `gap`, in a step that began at the gap `before`."""
        density = self.law.energy(gap)
        if self.share is None:
            return density
        ending, mean = at_end(self.share), self.law.energy_of_step(before, gap)
        return self.share * (ending * density + (1 - ending) * mean)

    def end_of_step(self, x, began):
        """Positions at the end of a step, of those where forces act."""
        return x if self.share is None else began + (x - began) / self.share

    def check(self, where, mesh, kinematics):
        for name, unit in self.units.items():
            if (number := getattr(self, name)) is not None:
                do = "Leave it out for the default."
                _check.positive("fem.problem", f"{where} {name}", number, unit, do)


# Contact of a body with a shape that does not deform


class Contact(AbstractPenaltyContact):
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
    `fem.update_friction(problem, u)` lets it know of an equilibrium.

    Points that are deep inside when a motion begins are let out at `release_velocity` [m/s],
    not shot out; with `None` the whole overlap pushes at once. In a step the pressure is
    that at its end, which takes energy where steps do not resolve the contact, or its mean
    over the way of the point, which keeps it: methods that damp nothing take the mean, those
    of `rho_inf` up to 1/2 the end, others both. On a flat obstacle neither adds energy.

    Reference: Laursen, Chawla, "Design of energy conserving algorithms for frictionless
    dynamic contact problems", Int. J. Num. Meth. Eng. 40, 1997, for the mean.

    `offset` [m] of every point is how far the pressure starts before the surface, the
    multiplier of an augmented Lagrangian; `solve_contact` finds it.

    `problem`, `simulate` and `update_friction` set the fields that follow; leave them out.

    Attributes:
        sunk: Overlap that has not been let out yet, zero or less [m]; None where all of it
            is felt.
        fresh: One before the first step of a motion, then zero.
        began: Where the nodes of the facets were when the step began [m].
        share: Of the step, after which forces act [-].
        start: Where the obstacle was when it began, where its pressure started, and how far
            points could move until one felt it.
        grip: Friction at every point: its spring, and the pressure and normal it is taken at.
        place: Displacement of the obstacle at the end of the last step [m].
    """

    units: ClassVar[dict[str, str]] = {
        "stiffness": "Pa/m",
        "smoothing": "m",
        "friction_velocity": "m/s",
        "friction_stiffness": "Pa/m",
        "release_velocity": "m/s",
    }

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
    sunk: Float[Array, "facets quad"] | None = None
    fresh: Float[Array, ""] | None = None
    began: Float[Array, "facets facet_nodes dim"] | None = None
    share: Float[Array, ""] | None = None
    start: Start | None = None
    grip: Grip | None = None
    place: Float[Array, " dim"] | None = None

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

    def in_motion(self, problem):
        return self if self.start is not None else moving(self, problem.mesh, self.value)

    def remembered(self, problem, u):
        return self if self.grip is None else settled(self, problem, u)

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
        values = jnp.asarray(facet_tables(problem.mesh.element).values)
        known = self.facets, self.offset, self.sunk, self.grip, self.began
        start = self.start

        def energy(x, row):
            # only where a block may touch are the data of its facets looked up
            facet, offset, sunk, grip, began = jax.tree.map(lambda leaf: leaf[row], known)
            areas, offset = areas_of(problem, facet[None])[0], _sum(offset, sunk)
            position = values @ x - self.value[None]
            gap, before = self.gap_of(values @ self.end_of_step(x, began), offset), None
            if start is not None:
                before = gaps(self.obstacle, values @ began, start.place) - start.shift[row]
            density = self.density(gap, before)
            if grip is not None:
                density = density + self.slider.energy(grip, position)
            return jnp.sum(areas * density)

        return energy

    def gap_of(self, points, offset) -> Float[Array, "..."]:
        """Gap of points [m] to where the pressure starts."""
        gap = gaps(self.obstacle, points, self.value)
        return gap if offset is None else gap - offset

    def _idle(self, problem):
        shift, grip, start = self.shift(), self.grip, self.start
        reach = None if shift is None or start is not None else jnp.max(shift)

        def near(x, rows):
            """In a step nothing is asked of the field: it was where the step began."""
            assert start is not None and self.began is not None
            began = self.began[rows]
            way = self.points_at(problem, self.end_of_step(x, began) - began)
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
        if isinstance(self.friction, DirectionalCoulomb):
            given = f"{where} direction of friction"
            do = "Give as many numbers as the mesh has axes."
            _check.shape("fem.problem", given, self.friction.direction, (mesh.element.dim,), do)
        super().check(where, mesh, kinematics)


def _sum(*terms: Array | None) -> Array | None:
    """Of those that there are."""
    given = [term for term in terms if term is not None]
    return sum(given[1:], start=given[0]) if given else None


# The state of a contact between steps


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
        load,
        place=place,
        began=mesh.points[load.facets],
        share=one,
        start=Start(place, none, none[:, 0], 0 * one),
    )
    if load.release_velocity is None:
        return load
    return dataclasses.replace(load, sunk=none, fresh=one)


Nodal = Float[Array, "nodes dim"]

_DEEP = 50.0  # times the smoothing: overlap under pressures of E / 20


class Felt(NamedTuple):
    """Of points where a step begins: pressure in the step before [Pa], normal of the obstacle,
    and how far points of a facet may move until one feels it [m]."""

    pressure: Float[Array, "facets quad"]
    normal: Float[Array, "facets quad dim"]
    clear: Float[Array, " facets"]


def released(
    load: "Contact", problem: "Problem", u: Nodal, step: Float[Array, ""]
) -> "Contact":
    """`load` for a step from `u`: overlap far beyond what contacts carry is not felt when a
    motion begins, and let out at the velocity of release."""
    assert load.sunk is not None and load.fresh is not None
    assert load.release_velocity is not None and load.smoothing is not None
    zero, depth = jnp.zeros_like(load.sunk), _DEEP * load.smoothing

    def found():
        gap = gaps(load.obstacle, load.points_of(problem, u), load.value)
        return jnp.where(gap < -depth, gap, zero)

    left = jnp.minimum(load.sunk + load.release_velocity * step, zero)
    sunk = jax.lax.cond(load.fresh > 0, found, lambda: left)
    fresh = jnp.zeros_like(load.fresh)
    return eqx.tree_at(lambda load: (load.sunk, load.fresh), load, (sunk, fresh))


def gripped(
    load: "Contact", problem: "Problem", u: Nodal, step: "StepState | None", feels: Felt
) -> "Contact":
    """`load`, as the last step left it, with friction of the step from `u`, where its points
    feel `feels`; its obstacle has moved from its last place to `value`. At rest without one."""
    slider, share = load.slider, 1.0 if step is None else step.share
    assert load.place is not None
    place = load.value - share * (load.value - load.place)  # where the step begins
    back = load.points_of(problem, u) - place[None, None]
    pressure = feels.pressure if step is None else _kept_impulse(load, problem, u, step, feels)
    anchor = back - slider.bounded(load.stretch(problem, u, load.place), pressure, feels.normal)
    limit = slider.law.limit(pressure)
    drag = jnp.zeros_like(limit)
    if step is not None:
        rests = step.step <= 0
        rate = jnp.where(rests, 0.0, 1 / jnp.where(rests, 1.0, step.step))
        drag = limit * rate / (slider.velocity * share)
    grip = Grip(anchor, pressure, feels.normal, drag, back)
    return eqx.tree_at(lambda load: (load.grip, load.place), load, (grip, load.value))


def _kept_impulse(
    load: "Contact", problem: "Problem", u: Nodal, step: "StepState", feels: Felt
) -> Float[Array, "facets quad"]:
    """Pressure of points [Pa] that has over a step, where they slid in the last one, the
    impulse that it had in that, of another size if steps are cut or grow."""
    assert load.grip is not None and load.place is not None and load.start is not None
    same = (load.start.step <= 0) | (step.step <= 0)
    ratio = jnp.where(same, 1.0, load.start.step / jnp.where(same, 1.0, step.step))
    acted = load.acted(problem, u) - load.place[None, None]
    slid = load.slider.loading(load.grip, acted) > 1
    return jnp.where(slid, ratio * feels.pressure, feels.pressure)


def felt(load: "Contact", problem: "Problem", u: Nodal) -> Felt:
    """Contact of the points where a step from `u` begins, from `load` as the last step left
    it; nothing where a block of facets was and is far from the obstacle."""
    law, shift, start, bound = load.law, load.shift(), load.start, load.obstacle.lipschitz
    assert load.place is not None
    points = load.points_of(problem, u) - load.place[None, None]
    was = (
        None if start is None else load.points_at(problem, load.began) - start.place[None, None]
    )
    reach = None if shift is None else jnp.max(shift)

    def near(points, row):
        row, was = row
        gap, _, normal = surface(load.obstacle, points)
        gap = gap if shift is None else gap - shift[row]
        pressure = law.pressure(gap)
        if start is not None:
            assert load.share is not None
            ending = at_end(load.share)
            mean = law.mean_pressure(gaps(load.obstacle, was) - start.shift[row], gap)
            pressure = ending * pressure + (1 - ending) * mean
        room = jnp.where(pressure > 0, jnp.zeros_like(gap), gap / bound)
        return jnp.concatenate([pressure[:, None], normal, room[:, None]], axis=1)

    def idle(points, row):
        free = far(load.obstacle, points, reach)
        if start is None:
            return free
        return free & far(load.obstacle, row[1], jnp.max(start.shift))

    def away(points, _):
        room = clearance(load.obstacle, points, reach)
        nothing = jnp.zeros((*points.shape[:2], points.shape[2] + 1), points.dtype)
        rooms = jnp.broadcast_to(room, nothing[..., :1].shape)
        return jnp.concatenate([nothing, rooms], axis=2)

    num, quad, dim = points.shape
    rows = jnp.arange(num), was
    found = blockwise(jax.vmap(near), idle, points, rows, (quad, dim + 2), away)
    least = jax.lax.stop_gradient(jnp.min(found[..., -1], axis=1))
    clear = jnp.maximum(least, jnp.zeros_like(least))
    return Felt(found[..., 0], found[..., 1:-1], clear)


@once
def settled(load: "Contact", problem: "Problem", u: Nodal) -> "Contact":
    """`load` after an equilibrium `u`, ready for the next one."""
    load = dataclasses.replace(load, place=load.value)
    return gripped(load, problem, u, None, felt(load, problem, u))

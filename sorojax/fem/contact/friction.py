"""The state of a contact between steps: friction, and overlap that is relaxed.

Pressure and normal of friction are those of the step before, which keeps the tangent
symmetric. So the friction impulse on sliding points is the coefficient times the normal
impulse, one step later, whether steps resolve an impact or not, and are cut or not. Also the
state of a contact that has touched nothing yet, and of one in a motion that begins.
"""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.contact.broadphase import clearance, far
from sorojax.contact.facet import gaps
from sorojax.contact.friction import Grip, no_grip
from sorojax.fem.loads.facets import blockwise, facet_tables
from sorojax.mesh.mesh import Mesh

if TYPE_CHECKING:
    from sorojax.fem.contact.obstacle import Contact
    from sorojax.fem.dynamics.step import StepState
    from sorojax.fem.problem import Problem


class Start(NamedTuple):
    """Where a step of a contact begins: place of the obstacle, how far before its surface
    pressure starts, how far points of a facet may move until one feels it [m], and the size
    of the step [s], zero before a motion."""

    place: Float[Array, " dim"]
    shift: Float[Array, "facets quad"]
    clear: Float[Array, " facets"]
    step: Float[Array, ""]


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
        load,
        place=place,
        began=mesh.points[load.facets],
        share=one,
        start=Start(place, none, none[:, 0], 0 * one),
    )
    if load.release_velocity is None:
        return load
    return dataclasses.replace(load, sunk=none, fresh=one)


# What a contact remembers from step to step: friction, and overlap that is let out


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
    anchor = back - slider.bounded(load.stretch(problem, u, load.place), pressure)
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
        gap, slope = jax.vmap(jax.value_and_grad(lambda x: gaps(load.obstacle, x)))(points)
        size = jnp.sqrt(jnp.sum(slope**2, axis=-1, keepdims=True))
        normal = slope / jnp.where(size > 0, size, jnp.ones_like(size))
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


@eqx.filter_jit
def settled(load: "Contact", problem: "Problem", u: Nodal) -> "Contact":
    """`load` after an equilibrium `u`, ready for the next one."""
    load = dataclasses.replace(load, place=load.value)
    return gripped(load, problem, u, None, felt(load, problem, u))

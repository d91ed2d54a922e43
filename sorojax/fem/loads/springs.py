"""Springs from node to node and from nodes to the ground, a bed of linear springs, tendons and
cables.
"""

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, real
from sorojax.fem.checks import check_ids
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.mesh.measure import Locations, locate
from sorojax.mesh.mesh import Mesh

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem


class Spring(AbstractLoad):
    """Springs from `nodes` to `ends`: other nodes (integers, one each) or points of the
    ground [m] (one for all or one each).

    Force proportional to the elongation, along the line between the ends: `stiffness` in
    N/m, one for all or one each. `value` [m] is by how much the rest length is shorter than
    the distance in the reference configuration, so that a row of values is an actuator.
    """

    nodes: Int[Array, " springs"] = eqx.field(converter=integers)
    ends: Int[Array, " springs"] | Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    stiffness: Float[Array, "..."] = eqx.field(converter=real)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="spring")
    holds: ClassVar[bool] = True

    @property
    def _to_nodes(self) -> bool:
        return jnp.issubdtype(self.ends.dtype, jnp.integer)

    @eqx.filter_jit
    def _ends(self, X) -> tuple[Float[Array, "springs dim"], Float[Array, " springs"]]:
        """Reference position of the far ends, and how far away they are [m]."""
        ends = (
            X[self.ends]
            if self._to_nodes
            else jnp.broadcast_to(jnp.atleast_2d(self.ends), (self.nodes.size, X.shape[1]))
        )
        return ends, jnp.sqrt(jnp.sum((X[self.nodes] - ends) ** 2, axis=1))

    def curved_part(self, problem):
        ends, length = self._ends(problem.mesh.points)
        rest = length - self.value
        stiffness = jnp.broadcast_to(self.stiffness, rest.shape)
        if self._to_nodes:
            groups = jnp.stack([self.nodes, self.ends.astype(self.nodes.dtype)], axis=1)
            return CurvedPart(
                groups, lambda x, d: _stretch_energy(x[0] - x[1], *d), (rest, stiffness)
            )
        return CurvedPart(
            self.nodes[:, None],
            lambda x, d: _stretch_energy(x[0] - d[0], d[1], d[2]),
            (ends, rest, stiffness),
        )

    def couples(self):
        if not self._to_nodes:
            return None
        return np.stack([np.asarray(self.nodes), np.asarray(self.ends)], axis=1)

    def check(self, where, mesh, kinematics):
        _check.positive(
            "fem.problem",
            f"{where} stiffness",
            self.stiffness,
            "N/m",
            "A spring pulls its ends together.",
        )
        count, dim = self.nodes.size, mesh.element.dim
        want = ((count,),) if self._to_nodes else ((dim,), (count, dim))
        if self.ends.shape not in want:
            raise ValueError(
                f"fem.problem: {where} has `ends` of shape {self.ends.shape}, need ({count},) "
                f"node numbers, or points of shape ({dim},) or ({count}, {dim})."
            )
        _check_sizes(where, self.stiffness, (count,))
        if self._to_nodes:
            check_ids(f"{where} ends", self.ends, mesh.num_nodes)
        else:
            _check.finite("fem.problem", f"{where} ends", self.ends, "Give points in metres.")
        if is_traced((mesh.points, self.ends)):
            return
        _, lengths = self._ends(mesh.points)
        lengths = np.asarray(lengths)
        if lengths.min() <= 0:
            raise ValueError(
                f"fem.problem: {where} has ends at the same place (spring "
                f"{int(lengths.argmin())}), so it has no direction. Use fem.Foundation."
            )


class Foundation(AbstractLoad):
    """Linear springs from each of `nodes` to the ground: force = -stiffness (u - value).

    `stiffness` [N/m] of one node, the same on every axis or one entry per axis; `value`
    [m] is the displacement of the ground.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    stiffness: Float[Array, "..."] = eqx.field(converter=real)
    value: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="foundation")
    holds: ClassVar[bool] = True

    def curved_part(self, problem):
        def energy(x, X):
            stiffness, ground = (
                jnp.broadcast_to(a, X.shape) for a in (self.stiffness, self.value)
            )
            return 0.5 * jnp.sum(stiffness * (x[0] - X - ground) ** 2)

        return CurvedPart(self.nodes[:, None], energy, problem.mesh.points[self.nodes])

    def check(self, where, mesh, kinematics):
        _check_sizes(where, self.stiffness, (mesh.element.dim,))
        stiffness = self.stiffness
        if _check.is_concrete(stiffness) and not (
            np.all(np.isfinite(stiffness)) and np.min(stiffness) >= 0 < np.max(stiffness)
        ):
            raise ValueError(
                f"fem.problem: {where} has a stiffness of {np.asarray(stiffness)} N/m, need "
                "numbers of at least 0, one of them above 0."
            )


def _stretch_energy(gap, rest, stiffness):
    """Energy of springs along `gap` (..., dim), with a slope where the ends meet."""
    square = jnp.sum(gap**2, axis=-1)
    apart = square > 0
    length = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    return 0.5 * stiffness * (length - rest) ** 2


def _check_sizes(where: str, stiffness, shape: tuple[int, ...]) -> None:
    if stiffness.shape not in ((), shape):
        raise ValueError(
            f"fem.problem: {where} has a stiffness of shape {stiffness.shape}, need () or "
            f"{shape}."
        )


# Tendons: cables without friction through points of the body


class Route(eqx.Module):
    """Points of a body: `nodes` of the cells that hold them and the `weights` of these [-]."""

    nodes: Int[Array, "points cell_nodes"] = eqx.field(converter=integers)
    weights: Float[Array, "points cell_nodes"] = eqx.field(converter=real)

    def lengths(self, x: Float[Array, "nodes dim"]) -> Float[Array, " segments"]:
        """Lengths of the straight segments [m] where the nodes are at `x` [m]."""
        return _lengths(Locations(self.nodes, self.weights)(x))


def route(mesh: Mesh, points: Float[np.ndarray, "points dim"]) -> Route:
    """The way of a tendon through `points` [m] of the reference configuration, in order.

    Args:
        mesh: The mesh.
        points: In order [m]; a tendon is fixed to the last one.

    Returns:
        The way, as `Tendon`, `Cable` and embedded rods take it.

    Raises:
        ValueError: If there are fewer than two points, two in a row are the same, or one
            lies outside the mesh.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != mesh.element.dim or len(points) < 2:
        raise ValueError(
            f"fem.route: `points` has shape {points.shape}, need (points, "
            f"{mesh.element.dim}) with at least two points. Give one row per point."
        )
    _check.finite("fem.route", "points", points, "Give points in metres.")
    if (gaps := np.linalg.norm(np.diff(points, axis=0), axis=1)).min() <= 0:
        raise ValueError(
            f"fem.route: points {gaps.argmin()} and {gaps.argmin() + 1} are the same. Leave "
            "one out."
        )
    nodes, weights, _ = locate(mesh, points)
    return Route(nodes, weights)


def tendon_length(mesh: Mesh, u: Float[Array, "nodes dim"], route: Route) -> Float[Array, ""]:
    """Length of the polyline of a tendon at displacement `u` [m].

    Args:
        mesh: The mesh.
        u: Displacement of the nodes [m].
        route: The way of the tendon.

    Returns:
        Length [m].
    """
    return jnp.sum(route.lengths(mesh.points + u))


class Tendon(AbstractLoad):
    """Cable of tension `value` [N] along `route`, a `route(mesh, points)`, fixed to its end.

    Without friction the tension is the same all along, and the potential is tension times
    length. The force at the first point is that of a cable which leaves the body there
    along the last segment, or of one that is fixed to it.

    A tendon pulls and never pushes: a negative tension is refused where it is known, and acts
    as none where a path, a command or a traced number gives it.
    """

    route: Route
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="tendon")

    def __check_init__(self):
        do = "Tendons pull; put one on the other side to pull back."
        _check.not_negative("Tendon", "value", self.value, "N", do)

    @property
    def tension(self) -> Float[Array, ""]:
        """[N]; with the slope of `value` at zero too, where paths of loads begin."""
        return jnp.where(self.value >= 0, self.value, jnp.zeros_like(self.value))

    def curved_part(self, problem):
        weights = self.route.weights

        def energy(x, weights):
            ends = jnp.einsum("pa,pai->pi", weights, x.reshape(*weights.shape, -1))
            return self.tension * jnp.sum(_lengths(ends))

        data = jnp.stack([weights[:-1], weights[1:]], axis=1)
        return CurvedPart(_segments(self.route.nodes, jnp), energy, data)

    def couples(self):
        return _segments(np.asarray(self.route.nodes), np)


class Cable(AbstractLoad):
    """Elastic cable along `route`, a `route(mesh, points)`, shortened by `value` [m].

    Tension = stiffness (length - rest length + value) [N] where that is positive, slack
    otherwise; the rest length is that of the reference configuration. A high `stiffness`
    [N/m] prescribes the length up to tension / stiffness.
    """

    route: Route
    stiffness: Float[Array, ""] = eqx.field(converter=real)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="cable")

    def curved_part(self, problem):
        # The tension depends on the whole length: all nodes of the cable are one group.
        rest = tendon_length(problem.mesh, jnp.zeros_like(problem.mesh.points), self.route)
        shape = self.route.weights.shape

        def energy(x, weights):
            ends = jnp.einsum("pa,pai->pi", weights, x.reshape(*shape, -1))
            elongation = jnp.sum(_lengths(ends)) - rest + self.value
            taut = jnp.where(elongation > 0, elongation, jnp.zeros_like(elongation))
            return 0.5 * self.stiffness * taut**2

        nodes = self.route.nodes.reshape(1, -1)
        return CurvedPart(nodes, energy, self.route.weights[None])

    def couples(self):
        return np.asarray(self.route.nodes).reshape(1, -1)

    def check(self, where, mesh, kinematics):
        _check.positive(
            "fem.problem",
            f"{where} stiffness",
            self.stiffness,
            "N/m",
            "Give axial stiffness over length, EA / L.",
        )


def tension(problem: "Problem", u: Float[Array, "nodes dim"], name: str) -> Float[Array, ""]:
    """Tension [N] in the tendon or cable called `name`, the sum over the springs of one
    term.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].
        name: Of the tendon or cable.

    Returns:
        Tension [N].
    """
    load = next(load for load in problem.loads if load.name == name)
    if isinstance(load, Tendon):
        return load.tension
    return jax.grad(_energy_of_value)(load.value, load, problem, u)


def _energy_of_value(value, load, problem, u):
    return eqx.tree_at(lambda load: load.value, load, value).potential(problem, u)


def _segments(nodes, xp):
    return xp.concatenate([nodes[:-1], nodes[1:]], axis=1)


def _lengths(ends: Float[Array, "points dim"]) -> Float[Array, " segments"]:
    return jnp.sqrt(jnp.sum((ends[1:] - ends[:-1]) ** 2, axis=1))

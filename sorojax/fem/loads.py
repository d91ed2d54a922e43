"""Loads as potentials: the force is minus the derivative, the load stiffness the second.

Every load here is conservative, so the tangent stays symmetric. A follower pressure is
conservative on a closed cavity, or on a run of facets whose ends cannot move.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import integers, real
from sorojax.fem.points import integral
from sorojax.mesh.shape import side_functions, side_slopes

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem


class AbstractLoad(eqx.Module):
    """A load of size `value`, called by `name` in `solve_path(problem, name=values)`."""

    value: eqx.AbstractVar[Float[Array, "..."]]
    name: eqx.AbstractVar[str]

    @abc.abstractmethod
    def potential(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        """Potential energy of the load [J]."""

    @abc.abstractmethod
    def curved_part(self, problem: "Problem") -> "CurvedPart | None":
        """The part of the potential that is not linear in u; `None` adds no stiffness."""


class CurvedPart(NamedTuple):
    """Facets, and the energy [J] of one at its deformed positions [m]."""

    facets: Int[Array, "facets facet_nodes"]
    energy: Callable[[Float[Array, "facet_nodes dim"]], Float[Array, ""]]


class Pressure(AbstractLoad):
    """Follower pressure [Pa, gauge] on the outside of `facets`, pushing on the body.

    Give the facets of whole cavities, `facets_on(mesh, cavity)`.
    """

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="pressure")

    def potential(self, problem, u):
        x = problem.mesh.points + u
        return -self.value * cavity_volume(
            x, self.facets, problem.mesh.element.order, problem.kinematics.depth
        )

    def curved_part(self, problem):
        order, depth = problem.mesh.element.order, problem.kinematics.depth
        return CurvedPart(self.facets, lambda x: -self.value * _facet_volume(x, order) * depth)


class Traction(AbstractLoad):
    """Dead force per reference area [Pa] on `facets`, one vector."""

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    value: Float[Array, " dim"] = eqx.field(converter=real)
    name: str = eqx.field(static=True, default="traction")

    def potential(self, problem, u):
        order = problem.mesh.element.order
        at, weights = np.polynomial.legendre.leggauss(order + 1)
        X = problem.mesh.points[self.facets]
        slope = jnp.einsum("qa,fai->fqi", side_slopes(order, at), X)
        length = jnp.sqrt(jnp.sum(slope**2, axis=-1))
        moved = jnp.einsum("qa,fai->fqi", side_functions(order, at), u[self.facets])
        work = jnp.einsum("q,fq,fqi,i->", weights, length, moved, self.value)
        return -work * problem.kinematics.depth

    def curved_part(self, problem):
        return None


class Gravity(AbstractLoad):
    """Weight of the body; `value` is the acceleration [m/s^2]."""

    value: Float[Array, " dim"] = eqx.field(converter=real, default=(0.0, -9.81))
    name: str = eqx.field(static=True, default="gravity")

    def potential(self, problem, u):
        moved = integral(problem.mesh, u) * problem.kinematics.depth
        density = jnp.broadcast_to(jnp.asarray(problem.material.density), moved.shape[:1])
        return -jnp.einsum("c,ci,i->", density, moved, self.value)

    def curved_part(self, problem):
        return None


def _facet_volume(x: Float[Array, "facet_nodes dim"], order: int) -> Float[Array, ""]:
    """Area between a facet and the origin, positive where the outside encloses it [m^2]."""
    at, weights = np.polynomial.legendre.leggauss(order + 1)
    position = side_functions(order, at) @ x
    slope = side_slopes(order, at) @ x
    turn = position[:, 0] * slope[:, 1] - position[:, 1] * slope[:, 0]
    return -0.5 * jnp.sum(weights * turn)


def cavity_volume(
    x: Float[Array, "nodes dim"],
    facets: Int[Array, "facets facet_nodes"],
    order: int,
    depth: Float[Array, ""],
) -> Float[Array, ""]:
    """Volume that closed loops of facets enclose on their outer side [m^3]."""
    volumes = jax.vmap(lambda x: _facet_volume(x, order))(x[facets])
    return jnp.sum(volumes) * depth


def open_ends(facets: Int[np.ndarray, "facets facet_nodes"]) -> np.ndarray:
    """Nodes at which a run of facets starts or stops."""
    ends = np.asarray(facets)[:, :2].ravel()
    nodes, count = np.unique(ends, return_counts=True)
    return nodes[count % 2 == 1]

"""Loads as potentials: the force is minus the derivative, the load stiffness the second.

Every load here is conservative, so the tangent stays symmetric. A follower pressure is
conservative on a closed cavity, on a run of facets whose ends cannot move, and on one cut
by planes of symmetry.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, optional_real, real
from sorojax.fem.assembly.geometry import interpolated, quadrature_points
from sorojax.fem.kinematics import Axisymmetric
from sorojax.fem.loads.facets import CurvedPart, facet_integral, facet_volume, pressure_force

if TYPE_CHECKING:
    from sorojax.fem.dynamics.masses import Masses
    from sorojax.fem.dynamics.step import StepState
    from sorojax.fem.problem import Problem


class AbstractLoad(eqx.Module):
    """A load of size `value`, called by `name` in `solve_path(problem, name=values)`."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        value: ClassVar[Float[Array, "..."]]
        name: ClassVar[str]
    holds: ClassVar[bool] = False  # whether its stiffness can hold the body
    smooth: ClassVar[bool] = True  # whether the tangent at one load foretells the next
    overshoots: ClassVar[bool] = False  # whether steps may run past where its force changes
    dead: ClassVar[bool] = False  # whether its force is the same in every state
    stiff_in_positions: ClassVar[bool] = False  # whether rounding of positions is felt
    directed: ClassVar[bool] = False  # whether its value is a vector of the space
    forgets: ClassVar[bool] = False  # whether nothing that it knows of a step lasts

    def potential(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        """Potential energy of the load [J]: that of its curved part where there is no other."""
        part = self.curved_part(problem)
        assert part is not None
        x = (problem.mesh.points + u)[part.groups]
        return jnp.sum(jax.vmap(part.energy)(x, part.data))

    def stored(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        """The part of the potential that is an energy at an instant [J]: all but that of
        friction in a step."""
        return self.potential(problem, u)

    @abc.abstractmethod
    def curved_part(self, problem: "Problem") -> CurvedPart | None:
        """The part of the potential that is not linear in u; `None` adds no stiffness."""

    def longest_share(self, du: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        """Share of a Newton step [m] after which the load still sees what it acts on."""
        return jnp.ones((), du.dtype)

    def room(self, problem: "Problem") -> Float[Array, ""] | None:
        """How far nodes may move from where a step began [m] before the load acts; `None` for
        one that may act anywhere."""
        return None

    def couples(self) -> Int[np.ndarray, "groups group_nodes"] | None:
        """Groups of nodes that share no cell but do share stiffness; `None` if there are
        none. `fem.space(mesh, loads)` makes room for them in the tangent."""
        return None

    def tangent_values(self, problem: "Problem") -> Float[Array, " nnz"] | None:
        """Stiffness that does not depend on u, in the pattern of the tangent [N/m], beside
        that of `curved_part`; `None` adds nothing."""
        return None

    def lumped_mass(self, problem: "Problem") -> Float[Array, " nodes"] | None:
        """Mass that the load adds to the nodes [kg]; `None` adds nothing."""
        return None

    def masses(self, problem: "Problem") -> "Masses | None":
        """Masses that the load has elsewhere than at nodes; `None` if there are none."""
        return None

    def in_motion(self, problem: "Problem") -> "AbstractLoad":
        """The load with room for what it remembers in a motion."""
        return self

    def without_inertia(self) -> "AbstractLoad":
        """The load without the inertia of its masses in a step that it has begun."""
        return self

    def begun(self, problem: "Problem", step: "StepState") -> "AbstractLoad":
        """The load for one time step: what depends on rates or on the state before. What it
        returns is the load that the next step begins with, its `value` set anew."""
        return self

    def remembered(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> "AbstractLoad":
        """The load that knows of the equilibrium `u` of a step, for the next one: itself where
        it has no memory."""
        return self

    def completed(self, mesh: Any, material: Any, kinematics: Any) -> "AbstractLoad":
        """The load with the numbers filled in that it takes from body and mesh."""
        return self

    def check(self, where: str, mesh: Any, kinematics: Any) -> None:
        """Raise a `ValueError` if the load does not fit the body."""


def remembers(load: AbstractLoad) -> bool:
    """Whether a step of a motion hands what the load knows on to the next one."""
    return type(load).begun is not AbstractLoad.begun and not load.forgets


def has_masses(load: AbstractLoad) -> bool:
    """Whether some mass of the load may be elsewhere than at nodes."""
    return type(load).masses is not AbstractLoad.masses


class Pressure(AbstractLoad):
    """Follower pressure [Pa, gauge] on the outside of `facets`, pushing on the body.

    Give the facets of whole cavities, `facets_on(mesh, cavity)`; the cavity may be cut by
    planes of symmetry through `origin` [m], the origin of the mesh when omitted, and by
    planes across some of the axes anywhere. Nodes of an end have to stay on their plane.

    `flux_shares` [-], one per axis, say how much of the flux along each makes the volume of a
    cavity whose ends may slide; `problem` sets them, None are equal shares.
    """

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="pressure")
    origin: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)
    flux_shares: tuple[float, ...] | None = eqx.field(static=True, default=None)

    def curved_part(self, problem):
        element, kinematics = problem.mesh.element, problem.kinematics

        def energy(x, _):
            x = x if self.origin is None else x - self.origin[None]
            return -self.value * facet_volume(element, kinematics, x, self.flux_shares)

        return CurvedPart(self.facets, energy)

    def edge_force(
        self, problem: "Problem", u: Float[Array, "nodes dim"]
    ) -> Float[Array, "nodes dim"]:
        """What the pressure exerts beyond its potential [N]: at the edges of an open cavity,
        where they are held; the potential is that of the cavity with lids through `origin`."""
        slope = jax.grad(lambda u: self.potential(problem, u))(u)
        return self.value * pressure_force(problem, u, self.facets) + slope


class Traction(AbstractLoad):
    """Dead force per reference area [Pa] on `facets`, one vector."""

    dead: ClassVar[bool] = True

    facets: Int[Array, "facets facet_nodes"] = eqx.field(converter=integers)
    value: Float[Array, " dim"] = eqx.field(converter=real)
    name: str = eqx.field(static=True, default="traction")

    def potential(self, problem, u):
        return -jnp.sum(facet_integral(problem, self.facets, u) * self.value)

    def curved_part(self, problem):
        return None


class Force(AbstractLoad):
    """Dead force [N], one vector in all, shared equally by `nodes`."""

    dead: ClassVar[bool] = True

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    value: Float[Array, " dim"] = eqx.field(converter=real)
    name: str = eqx.field(static=True, default="force")

    def potential(self, problem, u):
        return -jnp.sum(jnp.mean(u[self.nodes], axis=0) * self.value)

    def curved_part(self, problem):
        return None


class Gravity(AbstractLoad):
    """Weight of the body; `value` is the acceleration [m/s^2], one entry per axis."""

    dead: ClassVar[bool] = True

    value: Float[Array, " dim"] = eqx.field(converter=real, default=(0.0, -9.81))
    name: str = eqx.field(static=True, default="gravity")

    def potential(self, problem, u):
        points = quadrature_points(problem.mesh, problem.kinematics)
        moved = jnp.sum(points.volumes[None] * interpolated(problem.mesh, points, u), axis=1)
        density = jnp.broadcast_to(jnp.asarray(problem.material.density), moved.shape[1:])
        return -jnp.einsum("c,ic,i->", density, moved, self.value)

    def curved_part(self, problem):
        return None


# A torque on a set of nodes, as the potential of their mean rotation


class Torque(AbstractLoad):
    """Torque `value` [N m] on `nodes` about `axis`, counter-clockwise in the plane.

    It does work on the mean rotation of the nodes about their centre and follows them; the
    forces on the nodes have no sum. `axis`, needed in space, keeps its direction.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    value: Float[Array, ""] = eqx.field(converter=real)
    axis: Float[Array, "3"] | None = eqx.field(converter=optional_real, default=None)
    name: str = eqx.field(static=True, default="torque")

    def curved_part(self, problem):
        X = problem.mesh.points[self.nodes]

        def energy(x, X):
            return -self.value * mean_rotation(X, x, self.axis)

        return CurvedPart(self.nodes[None], energy, X[None])

    def couples(self):
        return np.asarray(self.nodes)[None]

    def check(self, where, mesh, kinematics):
        if isinstance(kinematics, Axisymmetric):
            raise ValueError(
                f"fem.problem: {where} would turn a body of revolution about its plane. Use a "
                "solid mesh."
            )
        if (self.axis is None) != (mesh.element.dim == 2):
            raise ValueError(
                f"fem.problem: {where} has axis={self.axis}, need one in space and none in the "
                "plane. Write axis=(0.0, 0.0, 1.0) in space."
            )
        if is_traced(mesh.points):
            return
        X = np.asarray(mesh.points)[np.asarray(self.nodes)]
        if np.ptp(X, axis=0).max() <= 0:
            raise ValueError(
                f"fem.problem: {where} acts on nodes at one place, which cannot turn. Name at "
                "least two."
            )


def mean_rotation(
    X: Float[Array, "nodes dim"],
    x: Float[Array, "nodes dim"],
    axis: Float[Array, "3"] | None = None,
) -> Float[Array, ""]:
    """Angle [rad] about `axis` by which points `X` turn to come closest to `x`, each about
    their centre, in (-pi, pi].

    Args:
        X: Points in the reference configuration [m].
        x: The same points after the motion [m].
        axis: Of the rotation, in space.

    Returns:
        The angle [rad].
    """
    a, b = (p - jnp.mean(p, axis=0, keepdims=True) for p in (X, x))
    if axis is None:
        sine = jnp.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        return jnp.arctan2(sine, jnp.sum(a * b))
    e = axis / jnp.sqrt(jnp.sum(axis**2))
    sine = jnp.sum(jnp.cross(a, b) @ e)
    return jnp.arctan2(sine, jnp.sum(a * b) - jnp.sum((a @ e) * (b @ e)))

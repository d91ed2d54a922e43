"""A torque on a set of nodes, as the potential of their mean rotation."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, optional_real, real
from sorojax.fem.curved import CurvedPart
from sorojax.fem.kinematics import Axisymmetric
from sorojax.fem.loads import AbstractLoad


class Torque(AbstractLoad):
    """Torque `value` [N m] on `nodes` about `axis`, counter-clockwise in the plane.

    It does work on the mean rotation of the nodes about their centre and follows them; the
    forces on the nodes have no sum. `axis`, needed in space, keeps its direction.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    value: Float[Array, ""] = eqx.field(converter=real)
    axis: Float[Array, "3"] | None = eqx.field(converter=optional_real, default=None)
    name: str = eqx.field(static=True, default="torque")
    holds: ClassVar[bool] = False

    def potential(self, problem, u):
        X = problem.mesh.points[self.nodes]
        return -self.value * mean_rotation(X, X + u[self.nodes], self.axis)

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
    their centre, in (-pi, pi]."""
    a, b = (p - jnp.mean(p, axis=0, keepdims=True) for p in (X, x))
    if axis is None:
        sine = jnp.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        return jnp.arctan2(sine, jnp.sum(a * b))
    e = axis / jnp.sqrt(jnp.sum(axis**2))
    sine = jnp.sum(jnp.cross(a, b) @ e)
    return jnp.arctan2(sine, jnp.sum(a * b) - jnp.sum((a @ e) * (b @ e)))

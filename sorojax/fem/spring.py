"""Springs: from node to node, from nodes to the ground, and a bed of linear springs."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, real
from sorojax.fem.checks import check_ids
from sorojax.fem.curved import CurvedPart
from sorojax.fem.loads import AbstractLoad


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
        ends = X[self.ends] if self._to_nodes else jnp.broadcast_to(
            jnp.atleast_2d(self.ends), (self.nodes.size, X.shape[1])
        )  # fmt: skip
        return ends, jnp.sqrt(jnp.sum((X[self.nodes] - ends) ** 2, axis=1))

    def potential(self, problem, u):
        ends, length = self._ends(problem.mesh.points)
        rest = length - self.value
        if self._to_nodes:
            ends = ends + u[self.ends]
        return jnp.sum(_stretch_energy(
            problem.mesh.points[self.nodes] + u[self.nodes] - ends, rest, self.stiffness
        ))  # fmt: skip

    def curved_part(self, problem):
        ends, length = self._ends(problem.mesh.points)
        rest = length - self.value
        stiffness = jnp.broadcast_to(self.stiffness, rest.shape)
        if self._to_nodes:
            groups = jnp.stack([self.nodes, self.ends], axis=1)
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
        _check.positive("fem.problem", f"{where} stiffness", self.stiffness, "N/m",
                        "A spring pulls its ends together.")  # fmt: skip
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

    def _energy(self, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        dim = u.shape[1]
        stiffness, ground = (
            jnp.broadcast_to(a, (dim,))[None] for a in (self.stiffness, self.value)
        )
        return 0.5 * jnp.sum(stiffness * (u - ground) ** 2)

    def potential(self, problem, u):
        return self._energy(u[self.nodes])

    def curved_part(self, problem):
        X = problem.mesh.points[self.nodes]
        return CurvedPart(self.nodes[:, None], lambda x, X: self._energy(x - X[None]), X)

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

"""Supports: which displacements are known, and their values."""

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.jit import once
from sorojax._types import integers, optional_real, real


class AbstractSupport(eqx.Module):
    """Known displacement components of a set of nodes; all of them when `None`.

    `ramped` names the field that grows from zero while a load is stepped up, and that
    follows `simulate(problem, ..., name=values)` where there is a `name`.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        nodes: ClassVar[Int[Array, " nodes"]]
        displacement: ClassVar[Float[Array, "..."]]
        components: ClassVar[tuple[int, ...] | None]
        name: ClassVar[str]
    ramped: ClassVar[str | None] = None


class Fixed(AbstractSupport):
    """`nodes` that do not move; `components=(0,)` lets them slide in the plane x = const, the
    condition of symmetry."""

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    components: tuple[int, ...] | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="fixed")

    @property
    def displacement(self) -> Float[Array, ""]:
        return jnp.zeros((), jnp.result_type(float))


class Prescribed(AbstractSupport):
    """`nodes` moved by `displacement` [m], one vector for all or one per node, with one entry
    for each of the known `components` (0 is x), all of them if omitted."""

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    displacement: Float[Array, "..."] = eqx.field(converter=real)
    components: tuple[int, ...] | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="prescribed")
    ramped: ClassVar[str | None] = "displacement"


class Rotated(AbstractSupport):
    """`nodes` turned by `angle` [rad] about the point `about` [m], in space about the direction
    `axis`, along arcs.

    All their displacements are those of `rotated(points, angle, about, axis)`; `points` [m] are
    where they are in the reference configuration, `mesh.points[nodes]`.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    points: Float[Array, "nodes dim"] = eqx.field(converter=real)
    angle: Float[Array, ""] = eqx.field(converter=real)
    about: Float[Array, " dim"] = eqx.field(converter=real)
    axis: Float[Array, "3"] | None = eqx.field(converter=optional_real, default=None)
    name: str = eqx.field(static=True, default="rotated")
    components: ClassVar[tuple[int, ...] | None] = None
    ramped: ClassVar[str | None] = "angle"

    @property
    def displacement(self) -> Float[Array, "nodes dim"]:
        return rotated(self.points, self.angle, self.about, self.axis)


class Carried(AbstractSupport):
    """`nodes` that a rigid frame carries along: a link of a mechanism that they are fixed to.

    `points` [m] are where they are in the reference configuration, `mesh.points[nodes]`,
    `rest` the pose of the frame there, a homogeneous matrix, by default the identity; `motion`
    is its pose minus that, a matrix too, without its last row, so that zero is rest.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    points: Float[Array, "nodes dim"] = eqx.field(converter=real)
    motion: Float[Array, "dim h"] | None = eqx.field(converter=optional_real, default=None)
    rest: Float[Array, "h h"] | None = eqx.field(converter=optional_real, default=None)
    name: str = eqx.field(static=True, default="carried")
    components: ClassVar[tuple[int, ...] | None] = None
    ramped: ClassVar[str | None] = "motion"

    def __post_init__(self):
        dim = self.points.shape[1]
        if self.motion is None:
            self.motion = jnp.zeros((dim, dim + 1), self.points.dtype)
        if self.rest is None:
            self.rest = jnp.eye(dim + 1, dtype=self.points.dtype)

    @property
    def pose(self) -> Float[Array, "h h"]:
        """Where the frame is, a homogeneous matrix."""
        assert self.rest is not None and self.motion is not None
        return self.rest.at[:-1].add(self.motion)

    def at(self, pose: Float[Array, "h h"]) -> "Carried":
        """The support with its frame at a pose."""
        assert self.rest is not None
        return eqx.tree_at(lambda s: s.motion, self, pose[:-1] - self.rest[:-1])

    @property
    def displacement(self) -> Float[Array, "nodes dim"]:
        assert self.rest is not None and self.motion is not None
        turn, place = self.rest[:-1, :-1], self.rest[:-1, -1]
        inside = (self.points - place[None]) @ turn  # in the frame
        return inside @ self.motion[:, :-1].T + self.motion[:, -1][None]


def rotated(
    points: Float[Array, "nodes dim"],
    angle: Float[Array, ""] | float,
    about: Float[Array, " dim"],
    axis: Float[Array, "3"] | None = None,
) -> Float[Array, "nodes dim"]:
    """Displacement [m] of `points` [m] that turn by `angle` [rad] about the point `about`,
    counter-clockwise in the plane, about the direction `axis` in space.

    Differentiable; `Prescribed(nodes, rotated(mesh.points[nodes], angle, about))` holds nodes
    there, `Rotated` also takes them along the arc while the load is stepped up.

    Args:
        points: In the reference configuration [m].
        angle: Angle [rad].
        about: A point that stays [m].
        axis: Direction of the rotation, in space.

    Returns:
        Displacement of each point [m].

    Raises:
        ValueError: If a point in space has no axis, or one in the plane has one.
    """
    points, angle, about, axis = real(points), real(angle), real(about), optional_real(axis)
    if (axis is None) != (points.shape[-1] == 2):
        raise ValueError(
            f"fem.rotated: got points of dimension {points.shape[-1]} and axis={axis}, need an "
            "axis in space and none in the plane. Write axis=(0.0, 0.0, 1.0) in space."
        )
    arm = points - about[None]
    if axis is None:
        across = jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)
        return jnp.sin(angle) * across - (1 - jnp.cos(angle)) * arm
    direction = jnp.broadcast_to(axis / jnp.sqrt(jnp.sum(axis**2)), arm.shape)
    across = jnp.cross(direction, arm)
    return jnp.sin(angle) * across + (1 - jnp.cos(angle)) * jnp.cross(direction, across)


def known_components(support: AbstractSupport, dim: int) -> tuple[int, ...]:
    return tuple(range(dim)) if support.components is None else support.components


def known_dofs(supports: tuple[AbstractSupport, ...], num_nodes: int, dim: int) -> np.ndarray:
    """Mask of the unknowns that supports decide (host array)."""
    mask = np.zeros((num_nodes, dim), bool)
    for support in supports:
        for component in known_components(support, dim):
            mask[np.asarray(support.nodes), component] = True
    return mask.ravel()


@once
def known_values(
    supports: tuple[AbstractSupport, ...], num_nodes: int, dim: int
) -> Float[Array, " dofs"]:
    """Displacements that supports decide [m], zero elsewhere; differentiable."""
    values = jnp.zeros((num_nodes, dim), jnp.result_type(float))
    for support in supports:
        for column, component in enumerate(known_components(support, dim)):
            moved = support.displacement
            entry = moved if moved.ndim == 0 else moved[..., column]
            values = values.at[support.nodes, component].set(entry)
    return values.ravel()

"""A set of nodes that moves as a rigid body, held together by stiff ties."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import Numbers, integers, optional_real, real
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.material.hyperelastic import small_strain_young_modulus
from sorojax.mesh.mesh import Mesh

_STIFFNESS = 1e4  # times that of the material around


class Rigid(AbstractLoad):
    """`nodes` moves as one rigid body: `rigid(mesh, nodes)` makes it.

    Each node is tied, by a spring of `stiffness` [N/m], to where an affine map of a few
    `leaders` puts it, and stiff bars keep the leaders at their distances; both are exactly
    at rest in every rigid motion. `value` is a growth of the part [-], its thermal strain.
    """

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    leaders: Int[Array, " leaders"] = eqx.field(converter=integers)
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="rigid")

    def _energy(self, x, data):
        """One node, then the leaders; each node carries its share of the bars."""
        weights, rest = data
        leaders = x[1:]
        gap = x[0] - leaders[0] - weights @ (leaders[1:] - leaders[0][None])
        first, second = np.triu_indices(leaders.shape[0], 1)
        bars = leaders[first] - leaders[second]
        square = rest * (1 + self.value) ** 2
        # Green strain of a bar times its length: close to the elongation, and smooth
        strain = (jnp.sum(bars**2, axis=1) - square) / (2 * jnp.sqrt(square))
        share = jnp.asarray(len(first) / self.nodes.size, x.dtype)
        assert self.stiffness is not None  # `problem` fills it in
        return 0.5 * self.stiffness * (jnp.sum(gap**2) + share * jnp.sum(strain**2))

    def _data(self, problem):
        X = problem.mesh.points
        origin, base = X[self.leaders[0]], X[self.leaders]
        arms = base[1:] - origin[None]
        away = X[self.nodes] - origin[None]
        weights = jnp.linalg.solve(arms @ arms.T, arms @ away.T).T
        first, second = np.triu_indices(base.shape[0], 1)
        rest = jnp.sum((base[first] - base[second]) ** 2, axis=1)
        return weights, jnp.broadcast_to(rest, (self.nodes.size, rest.size))

    def _groups(self, xp):
        leaders = xp.broadcast_to(self.leaders, (self.nodes.size, self.leaders.size))
        return xp.concatenate([xp.asarray(self.nodes)[:, None], leaders], axis=1)

    def curved_part(self, problem):
        return CurvedPart(self._groups(jnp), self._energy, self._data(problem))

    def couples(self):
        return self._groups(np)

    def completed(self, mesh, material, kinematics):
        if self.stiffness is not None:
            return self
        modulus = jnp.max(small_strain_young_modulus(material))
        length = jnp.mean(jnp.ptp(mesh.points[mesh.cells], axis=1))
        if mesh.element.dim == 2:
            middle = tuple(jnp.mean(mesh.points, axis=0))
            length = jnp.asarray(kinematics.depth(middle))
        return eqx.tree_at(
            lambda load: load.stiffness,
            self,
            _STIFFNESS * modulus * length,
            is_leaf=lambda leaf: leaf is None,
        )

    def check(self, where, mesh, kinematics):
        if self.stiffness is not None:
            _check.positive(
                "fem.problem",
                f"{where} stiffness",
                self.stiffness,
                "N/m",
                "Leave it out for 10^4 times that of the material.",
            )


def rigid(
    mesh: Mesh,
    nodes: Int[np.ndarray, " nodes"],
    *,
    stiffness: Numbers | None = None,
    name: str = "rigid",
) -> Rigid:
    """A term that makes `nodes` move as one rigid body.

    The body may still stretch by its load over `stiffness`; the default, 10^4 times
    Young's modulus times the size of a cell (times the depth in the plane), leaves about
    10^-4 of the strain beside it.

    Args:
        mesh: The mesh.
        nodes: Node numbers, for example those of a glued plate.
        stiffness: Of the tie of one node [N/m].
        name: Name of the term.

    Returns:
        One of the loads of a problem.

    Raises:
        ValueError: If fewer than two nodes are named, or all are at one place.
    """
    nodes = np.unique(np.asarray(nodes, int))
    if nodes.size < 2 or nodes.min() < 0 or nodes.max() >= mesh.num_nodes:
        raise ValueError(
            f"fem.rigid: got {nodes.size} nodes of 0 to {mesh.num_nodes - 1} "
            f"({nodes[:5].tolist()}), need at least two of this mesh. Select them on it."
        )
    leaders = _spread(np.asarray(mesh.points)[nodes])
    if len(leaders) < 2:
        raise ValueError("fem.rigid: all nodes are at one place, which is rigid already.")
    return Rigid(nodes, nodes[leaders], stiffness, name=name)


def _spread(X: np.ndarray) -> list[int]:
    """Points whose affine span is that of all, each the farthest from those before."""
    chosen = [int(np.argmax(((X - X.mean(axis=0)) ** 2).sum(axis=1)))]
    away = X - X[chosen[0]]
    size = np.ptp(X, axis=0).max()
    while len(chosen) <= X.shape[1]:
        distance = np.linalg.norm(away, axis=1)
        farthest = int(np.argmax(distance))
        if distance[farthest] <= 1e-9 * size:
            break
        chosen.append(farthest)
        along = away[farthest] / distance[farthest]
        away = away - np.outer(away @ along, along)
    return chosen

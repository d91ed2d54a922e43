"""A pressure that seeps through a design: full in the void that a source reaches, gone
behind a wall of solid.

The body is taken as porous, its permeability and the drainage of its solid part smooth
functions of density, so that the field and the walls that it presses on are differentiable
in a design. With p the share of the pressure of the sources,

    div(K(d) grad p) = D(d) p,   K = 1 - (1 - tight) H(d),   D = (ln r / depth)^2 tight H(d),

and in a solid wall the share falls to r = `remainder` within `depth`.

Reference: Kumar, Frouws, Langelaar, "Topology optimization of fluidic pressure-loaded
structures and compliant mechanisms using the Darcy method", Struct. Multidisc. Optim. 61,
2020.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._types import real
from sorojax.design.filters import heaviside_projection
from sorojax.design.void_pressure import cell_gradients
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.fem.points import quadrature_points
from sorojax.fem.space import Space
from sorojax.math import sparse
from sorojax.mesh.mesh import Mesh


class Darcy(eqx.Module):
    """Seepage through the cells of a mesh, by `darcy`.

    Called with densities it returns the share of the pressure at every node, for
    `void_pressure(mesh, share, value, per="node")`; one factorisation, and one
    back-substitution for a gradient.

    Attributes:
        threshold, sharpness: Of the step H from void to solid, in `heaviside_projection`.
        tight: Permeability of the solid over that of the void.
        depth: Of a wall behind which `remainder` of the pressure is left [m].
    """

    system: sparse.SparseSymmetric
    conduction: Float[Array, "cells nodes nodes"]
    storage: Float[Array, "cells nodes nodes"]
    cells: Int[Array, "cells nodes"]
    known: Bool[Array, " nodes"]
    given: Float[Array, " nodes"]
    depth: Float[Array, ""] = eqx.field(converter=real)
    threshold: Float[Array, ""] = eqx.field(converter=real, default=0.3)
    sharpness: Float[Array, ""] = eqx.field(converter=real, default=8.0)
    tight: Float[Array, ""] = eqx.field(converter=real, default=1e-7)
    remainder: Float[Array, ""] = eqx.field(converter=real, default=0.1)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " nodes"]:
        solid = heaviside_projection(density, self.sharpness, self.threshold)
        permeable = 1 - (1 - self.tight) * solid
        drained = (jnp.log(self.remainder) / self.depth) ** 2 * self.tight * solid
        return _pressure(self, permeable, drained)


@jax.custom_jvp
def _pressure(seep: Darcy, permeable, drained) -> Float[Array, " nodes"]:
    matrix = _values(seep, permeable, drained)
    right = -sparse.product(seep.system, matrix, seep.given)
    return _answer(seep, matrix, right) + seep.given


def _pressure_derivative(primals, tangents):
    seep, *factors = primals
    seep_dot, *factors_dot = tangents
    matrix, p = _values(*primals), _pressure(*primals)
    own, right = p[seep.cells], jnp.zeros_like(p)
    parts = (seep.conduction, seep.storage)
    parts_dot = (seep_dot.conduction, seep_dot.storage)
    given_dot = jnp.zeros_like(p)
    if not isinstance(seep_dot.given, SymbolicZero):
        given_dot = seep_dot.given
        right = right - sparse.product(seep.system, matrix, given_dot)
    for part, part_dot, factor, factor_dot in zip(
        parts, parts_dot, factors, factors_dot, strict=True
    ):
        # cell by cell: the matrix itself is not differentiated
        if not isinstance(factor_dot, SymbolicZero):
            flux = jnp.sum(part * own[:, None], axis=2)
            right = right.at[seep.cells].add(-factor_dot[:, None] * flux)
        if not isinstance(part_dot, SymbolicZero):
            flux = jnp.sum(part_dot * own[:, None], axis=2)
            right = right.at[seep.cells].add(-factor[:, None] * flux)
    return p, _answer(seep, matrix, right) + given_dot


_pressure.defjvp(_pressure_derivative, symbolic_zeros=True)


def _values(seep: Darcy, permeable, drained) -> Float[Array, " nnz"]:
    flow = permeable[:, None, None] * seep.conduction
    return sparse.assemble(seep.system, flow + drained[:, None, None] * seep.storage)


def _answer(seep: Darcy, matrix, right) -> Float[Array, " nodes"]:
    right = jnp.where(seep.known, jnp.zeros_like(right), right)
    return sparse.solve(seep.system, sparse.fix(seep.system, matrix, seep.known), right)


def darcy(
    mesh: Mesh,
    space: Space,
    kinematics: AbstractKinematics,
    *,
    sources: Int[Any, " nodes"],
    drains: Int[Any, " nodes"] = (),
    depth: float,
    **settings: float,
) -> Darcy:
    """The seepage problem of a mesh.

    Args:
        mesh: The cells.
        space: That of the body, `fem.space(mesh)` or `problem.space`.
        kinematics: That of the body.
        sources: Nodes that have the pressure.
        drains: Nodes without pressure: the parts of the edge that lie in the open.
        depth: See `Darcy`; two cells are usual [m].
        **settings: `threshold`, `sharpness`, `tight` and `remainder` of `Darcy`.

    Raises:
        ValueError: If there are no sources or a node is a source and a drain.
    """
    _check.positive("darcy", "depth", depth, "m", "Two cells are usual.")
    sources, drains = np.asarray(sources, int).ravel(), np.asarray(drains, int).ravel()
    both = np.intersect1d(sources, drains).size
    if not sources.size or both:
        raise ValueError(
            f"darcy: got {sources.size} sources, {both} of them drains, need at least one "
            "source and none that is a drain. Select the nodes of the inlet."
        )
    given = np.zeros(mesh.num_nodes)
    given[sources] = 1.0
    points = quadrature_points(mesh, kinematics)
    G = cell_gradients(space, kinematics, mesh.points)[..., : mesh.element.dim]
    values = points.tables.values
    N = values[np.asarray(points.kinds)] if points.kinds is not None else values
    N = jnp.broadcast_to(jnp.asarray(N), (mesh.num_cells, *values.shape[1:]))
    V = points.volumes.T
    return Darcy(
        sparse.from_cells(mesh.num_nodes, np.asarray(mesh.cells)),
        jnp.einsum("cqai,cqbi,cq->cab", G, G, V),
        jnp.einsum("cqa,cqb,cq->cab", N, N, V),
        jnp.asarray(mesh.cells, jnp.int32),
        jnp.asarray(np.isin(np.arange(mesh.num_nodes), np.concatenate([sources, drains]))),
        jnp.asarray(given),
        depth,
        **settings,
    )

"""Shape gradients and volumes of the quadrature points, in blocks of cells."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.formulation import AbstractFormulation, modes
from sorojax.fem.kinematics import AbstractKinematics, identity
from sorojax.fem.polygon import exact_areas, polygon_sums
from sorojax.fem.space import Space, lanes
from sorojax.fem.tables import quadrature_tables
from sorojax.fem.tensor import Entries, inverse
from sorojax.material.kinematics import Tensor, determinant
from sorojax.mesh.elements import PolyN


class Geometry(NamedTuple):
    """Gradients of the shape functions, volumes and pressure functions of the points.

    In a body of revolution the third column of a gradient is the shape function over the
    radius.
    """

    gradients: Float[Array, "blocks quad cell_nodes columns lanes"]
    volumes: Float[Array, "blocks quad lanes"]
    modes: Float[Array, "blocks modes quad lanes"] | None


@jax.jit
def geometry(
    space: Space,
    kinematics: AbstractKinematics,
    formulation: AbstractFormulation,
    points: Float[Array, "nodes dim"],
) -> Geometry:
    """Shape gradients [1/m] and quadrature volumes [m^3] of the cells at `points`."""
    tables = quadrature_tables(space.element)
    dim = space.dim

    def block(arrays):
        cells, kinds = arrays
        x = lanes(points, cells)
        N, slopes, weights = (_of_kinds(jnp.asarray(table), kinds) for table in tables)
        jac = jnp.einsum("iae,qade->idqe", x, slopes)
        full = three([[jac[i, d] for d in range(dim)] for i in range(dim)])
        J, back = determinant(full), inverse(full)
        gradients = [
            functools.reduce(
                jnp.add, (slopes[:, :, d] * back[d][j][:, None] for d in range(dim))
            )
            for j in range(dim)
        ]
        areas = J * weights
        position = jnp.einsum("iae,qae->iqe", x, N)
        if isinstance(space.element, PolyN):
            sums = polygon_sums(x, kinds, kinematics)
            areas = exact_areas(sums, position, areas)
            for j, side in enumerate(sums.sides):
                exact = side - sums.hoop(j) * jnp.sum(areas[:, None] * N, axis=0)
                share = sums.shares(position, areas)
                mean = jnp.sum(share[:, None] * gradients[j], axis=0)
                gradients[j] += (exact / sums.measure - mean)[None]
        if kinematics.num_columns > dim:
            gradients.append(N / position[0][:, None])
        volumes = areas * kinematics.depth(tuple(position))
        return jnp.stack(gradients, axis=2), volumes, modes(formulation, position, volumes)

    return Geometry(*jax.lax.map(block, (space.cells, space.kinds)))


def _of_kinds(table, kinds):
    """The table of every lane, with the lane axis last (of length 1 if all are alike)."""
    if kinds is None:
        return jnp.moveaxis(table, 0, -1)
    return jnp.moveaxis(table[kinds], 0, -1)


def three(rows) -> Tensor:
    """A 2x2 or 3x3 matrix as a tensor."""
    if len(rows) == 3:
        return tuple(tuple(row) for row in rows)  # type: ignore[return-value]
    return ((*rows[0], 0.0), (*rows[1], 0.0), (0.0, 0.0, 1.0))


def gradient_entries(
    kinematics: AbstractKinematics,
    u: Float[Array, "dim cell_nodes lanes"],
    gradients: Float[Array, "quad cell_nodes columns lanes"],
) -> Entries:
    """Slopes of `u` at the quadrature points of a block, entry by entry of F."""
    G = jnp.moveaxis(gradients, 2, 0)
    slopes = functools.reduce(
        jnp.add, (u[:, None, None, a] * G[None, :, :, a] for a in range(u.shape[1]))
    )
    return jnp.stack([slopes[s.component, s.column] for s in kinematics.slots])


def deformation_gradient(kinematics: AbstractKinematics, u, gradients) -> Entries:
    """Kept entries of F = I + Grad u at the quadrature points of a block."""
    slopes = gradient_entries(kinematics, u, gradients)
    rest = jnp.asarray(identity(kinematics), slopes.dtype)
    return slopes + rest[:, None, None]

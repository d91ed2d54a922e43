"""Shape gradients and volumes of the quadrature points, in blocks of cells."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax.fem.formulation import AbstractFormulation, modes
from sorojax.fem.kinematics import AbstractKinematics, identity
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
        if isinstance(space.element, PolyN):
            gradients, areas = _consistent(x, kinds, gradients, areas)
        position = jnp.einsum("iae,qae->iqe", x, N)
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


def _consistent(x, kinds, gradients, areas):
    """Polygons: areas and gradients whose sums over a cell are those of its boundary."""
    area, boundary = polygon_boundary(x, kinds)
    areas = areas * (area / jnp.sum(areas, axis=0, keepdims=True))
    fixed = []
    for gradient, exact in zip(gradients, boundary, strict=True):
        mean = jnp.sum(areas[:, None] * gradient, axis=0)
        fixed.append(gradient + ((exact - mean) / area)[None])
    return fixed, areas


def polygon_boundary(
    x: Float[Array, "2 cell_nodes lanes"], kinds: Int[Array, " lanes"]
) -> tuple[Float[Array, "1 lanes"], tuple[Float[Array, "cell_nodes lanes"], ...]]:
    """Area of polygons [m^2], and integrals of shape function times normal [m].

    The quadrature does not integrate the rational functions exactly; corrected by these
    sums a linear displacement is an equilibrium.

    Reference: Talischi, Pereira, Menezes, Paulino, "Gradient correction for polygonal and
    polyhedral finite elements", IJNME 102, 2015.
    """
    number = jnp.arange(x.shape[1])[:, None]
    count = kinds[None]
    ahead = jnp.where(number + 1 < count, number + 1, jnp.zeros_like(number))
    behind = jnp.where(number > 0, number - 1, count - 1)
    after, before = (jnp.take_along_axis(x, at[None], axis=1) for at in (ahead, behind))
    zero = jnp.zeros_like(x[0])
    turn = jnp.where(number < count, x[0] * after[1] - x[1] * after[0], zero)
    side = [jnp.where(number < count, half, zero) for half in (after - before) / 2]
    return jnp.sum(turn, axis=0, keepdims=True) / 2, (side[1], -side[0])


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

"""How far motion has spoilt a mesh, and when to build a new one."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.mesh.elements import Tet4, Tet10, Tri3, Tri6
from sorojax.mesh.mesh import Mesh


class Distortion(NamedTuple):
    """Worst cell of a moved mesh.

    Attributes:
        size_ratio: Least area (volume) of a cell over that before; negative if inverted.
        shape_ratio: Least shape number over that before; 1 where nothing changed.
        remesh: Whether a cell is smaller than 0.2 or poorer in shape than 0.4 of before.
    """

    size_ratio: Float[Array, ""]
    shape_ratio: Float[Array, ""]
    remesh: Bool[Array, ""]


def distortion(mesh: Mesh, moved: Mesh) -> Distortion:
    """Compare `moved` with `mesh`, of the same cells; may be traced.

    The shape number of a simplex is its size over that of an equilateral one with the
    same mean square edge.
    """
    if not isinstance(mesh.element, Tri3 | Tri6 | Tet4 | Tet10):
        raise ValueError(
            f"distortion: got {mesh.element.name} cells, need triangles or tetrahedra."
        )
    if mesh.cells.shape != moved.cells.shape:
        raise ValueError(
            f"distortion: the meshes have {mesh.num_cells} and {moved.num_cells} cells, need "
            "one mesh and the same mesh moved."
        )
    size, shape = _size_and_shape(mesh)
    new_size, new_shape = _size_and_shape(moved)
    size_ratio, shape_ratio = jnp.min(new_size / size), jnp.min(new_shape / shape)
    return Distortion(size_ratio, shape_ratio, (size_ratio < 0.2) | (shape_ratio < 0.4))


def _size_and_shape(mesh: Mesh) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    dim = mesh.element.dim
    x = mesh.points[mesh.cells[:, : dim + 1]]
    sides = x[:, 1:] - x[:, :1]
    pairs = [(i, j) for i in range(dim + 1) for j in range(i)]
    square = sum(jnp.sum((x[:, i] - x[:, j]) ** 2, axis=1) for i, j in pairs) / len(pairs)
    if dim == 2:
        size = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
        return size, size / square
    size = jnp.sum(sides[:, 0] * jnp.cross(sides[:, 1], sides[:, 2]), axis=1)
    return size, size / square**1.5

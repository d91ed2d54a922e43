"""How far motion has spoilt a mesh, and when to build a new one."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax.mesh.elements import AbstractElement, PolyN
from sorojax.mesh.harmonic import linear_element
from sorojax.mesh.mesh import Mesh

_SIMPLICES = {
    3: ((0, 1, 2),),
    (2, 4): ((0, 1, 3), (1, 2, 0), (2, 3, 1), (3, 0, 2)),
    (3, 4): ((0, 1, 2, 3),),
    8: ((0, 1, 3, 4), (1, 2, 0, 5), (2, 3, 1, 6), (3, 0, 2, 7),
        (4, 7, 5, 0), (5, 4, 6, 1), (6, 5, 7, 2), (7, 6, 4, 3)),
}  # fmt: skip


class Distortion(NamedTuple):
    """Worst cell of a moved mesh.

    Attributes:
        size_ratio: Least area (volume) of a cell over that before; negative if inverted.
            Of quadrilaterals and hexahedra every corner counts.
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
    if isinstance(mesh.element, PolyN):
        raise ValueError(
            f"distortion: got {mesh.element.name} cells, need triangles, quadrilaterals, "
            "tetrahedra or hexahedra. Build polygons anew with polymesher."
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


def corner_simplices(element: AbstractElement) -> tuple[tuple[int, ...], ...]:
    """The simplex of the sides at each corner of a linear cell; one for a simplex."""
    n = element.num_corners
    return _SIMPLICES[n if n in _SIMPLICES else (element.dim, n)]


def least_corner(x: np.ndarray, element: AbstractElement) -> np.ndarray:
    """Least det dx/dxi at the corners `x` (cells, corners, dim) of linear cells."""
    sizes = [_size(x[:, list(s)], np) for s in corner_simplices(element)]
    return np.min(np.stack(sizes), axis=0)


def _size(x: Any, numpy: Any) -> Any:
    """Doubled area or sixfold volume of simplices with corners `x`."""
    a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    if x.shape[1] == 3:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return numpy.sum(a * numpy.cross(b, x[:, 3] - x[:, 0]), axis=1)


def _size_and_shape(mesh: Mesh) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    corners = mesh.points[mesh.cells[:, : mesh.element.num_corners]]
    sizes, shapes = [], []
    for simplex in corner_simplices(linear_element(mesh.element)):
        x = corners[:, jnp.asarray(simplex)]
        pairs = [(i, j) for i in range(len(simplex)) for j in range(i)]
        square = sum(jnp.sum((x[:, i] - x[:, j]) ** 2, axis=1) for i, j in pairs)
        size = _size(x, jnp)
        sizes.append(size)
        shapes.append(size / (square / len(pairs)) ** (mesh.element.dim / 2))
    return jnp.stack(sizes), jnp.stack(shapes)

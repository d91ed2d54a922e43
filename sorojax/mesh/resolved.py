"""Whether a mesh has seen all of its shape: walls between sample points are missed."""

import numpy as np

from sorojax.math.spatial import KDTree
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import CHUNK, land, values, values_and_gradients

_THIN = 0.25  # of the size: least thickness of a wall of a solid
_FACING = -0.9  # cosine between the normals on both sides of a wall


def check_walls(where: str, shape: AbstractSdf, points, facets, size: Sizes) -> None:
    """Raise if a wall behind `facets` is much thinner than the cells.

    Cells across such a wall are valid, but their nodes would not follow its two sides.
    """
    x = points[facets]
    middle = land(shape, x.mean(axis=1), 1)
    n = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
    length = size(middle)
    f, g = values_and_gradients(shape, middle - 0.5 * _THIN * length[:, None] * n)
    g /= np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-9)
    thin = np.flatnonzero(((g * n).sum(axis=1) < _FACING) & (np.abs(f) < 0.5 * _THIN * length))
    if len(thin):
        least = thin[np.argmax(f[thin] / length[thin])]
        wall = max(0.5 * _THIN * length[least] - f[least], 0.0)
        raise ValueError(
            f"{where}: a wall near {middle[least]} m is about {wall:.2g} m thick, need "
            f"{_THIN:g} of a `size` of {length[least]:g} m or more. Lower `size`, or thicken "
            "the wall."
        )


def check_resolved(
    where: str, shape: AbstractSdf, nodes: np.ndarray, size: Sizes, lower, upper
) -> None:
    """Raise if points inside `shape` have a surface near them that has no `nodes`.

    Random points of the box are tested, so a wall that fills less than about a
    thousandth of it may pass.
    """
    p = lower + (upper - lower) * np.random.default_rng(0).random((CHUNK, len(lower)))
    f = values(shape, p)
    if not np.all(np.isfinite(f)):
        raise ValueError(
            f"{where}: the field of the shape is not finite at {p[~np.isfinite(f)][0]} m. "
            "Check its parameters for NaN."
        )
    p, f = p[f < 0], f[f < 0]
    tree = KDTree(nodes)
    p = p[tree.query(p)[0] > np.abs(f) + 0.8 * size(p)]
    landed = land(shape, p, 6) if len(p) else p
    length = size(landed)
    off = np.abs(values(shape, landed))
    lost = np.flatnonzero((tree.query(landed)[0] > length) & (off < 1e-6 * length))
    if len(lost):
        at, length = landed[lost[0]], length[lost[0]]
        raise ValueError(
            f"{where}: a wall near {at} m is thinner than a `size` of {length:g} m can "
            "see. Lower `size` to a few times the thinnest wall or less, or thicken it."
        )

"""Whether a mesh has seen all of its shape: walls between sample points are missed."""

import numpy as np

from sorojax.math.spatial import KDTree
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import CHUNK, land, values


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

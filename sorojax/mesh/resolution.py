"""Whether a mesh resolves all of its shape, and which walls are too thin where it does not."""

from typing import NoReturn

import numpy as np

from sorojax.math.host import KDTree
from sorojax.mesh.plane.outline import Outline
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import CHUNK, land, normals, unit, values, values_and_gradients

_THIN = 0.25  # of the size: least thickness of a wall of a solid
_FACING = -0.9  # cosine between the normals on both sides of a wall
_OPPOSED = -0.5  # the same of a wall that is named, which need not have parallel sides
_BULGE = 0.15  # of an edge: distance to it of what it stands for
_RAYS = 49  # directions in which the thickness is measured
_STEPS = 64  # of a ray on either side
_DEPTH = 0.05  # of the way between two sides: least depth half way
_PLACES = 24  # places of which the thinnest is named


class NotResolved(ValueError):
    """Cells do not fit a shape.

    Attributes:
        thin: Whether that is explained by a wall or a gap thinner than half of the size.
    """

    def __init__(self, message: str, thin: bool = True):
        super().__init__(message)
        self.thin = thin


def check_walls(where: str, shape: AbstractSdf, points, facets, size: Sizes) -> None:
    """Raise if a wall behind `facets` is much thinner than the cells.

    Cells across such a wall are valid, but their nodes would not follow its two sides.
    """
    x = points[facets]
    middle = land(shape, x.mean(axis=1), 1)
    n = unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]))
    length = size(middle)
    f, g = values_and_gradients(shape, middle - 0.5 * _THIN * length[:, None] * n)
    facing = (unit(g) * n).sum(axis=1) < _FACING
    thin = np.flatnonzero(facing & (np.abs(f) < 0.5 * _THIN * length))
    if len(thin):
        # beside a chamfer the place may belong to another side: rays tell
        worst = thin[np.argsort(-f[thin] / length[thin])][:_PLACES]
        _, at, wall = thinnest(shape, middle[worst], size.largest)
        least = float(size(at[None])[0])
        if wall < _THIN * least:
            raise NotResolved(
                f"{where}: a wall near {at} m is about {wall:.2g} m thick, need {_THIN:g} of a "
                f"`size` of {least:g} m or more. Lower `size`, or thicken the wall."
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
        raise_thin(where, (shape,), landed[lost], size)


def unseen(shape: AbstractSdf, lines: Outline, size: Sizes, lower, upper) -> np.ndarray:
    """Points (n, 2) [m] of the surface of a plane shape that the boundary edges of `lines`
    pass by.

    Every point of the surface has a node of a grid nearby with a small field: from these
    nodes the surface is sought.
    """
    pitch = max(size.smallest, size.largest / 8) / 2
    axes = [np.arange(a + pitch / 3, b, pitch) for a, b in zip(lower, upper, strict=True)]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    p = land(shape, p[np.abs(values(shape, p)) < 0.75 * pitch], 6)
    p = p[np.abs(values(shape, p)) < 1e-6 * pitch]
    edges = lines.edges[lines.owner == 0]
    if not len(p) or not len(edges):
        return p
    a, b = lines.points[edges[:, 0]], lines.points[edges[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    near = KDTree((a + b) / 2).query(p, k=min(8, len(edges)))[1].reshape(len(p), -1)
    start, way = a[near], (b - a)[near]
    share = ((p[:, None] - start) * way).sum(axis=2) / np.maximum(length[near] ** 2, 1e-300)
    gap = p[:, None] - start - np.clip(share, 0, 1)[..., None] * way
    off = np.linalg.norm(gap, axis=2) - _BULGE * length[near]
    return p[off.min(axis=1) > 0.01 * pitch]


def bulging(fields: tuple[AbstractSdf, ...], lines: Outline, size: Sizes) -> bool:
    """Whether the zero set leaves an edge of `lines` by more than a bend may: at a corner that
    was not found."""
    middle = lines.points[lines.edges].mean(axis=1)
    off = np.zeros(len(middle))
    for i, field in enumerate(fields):
        mine = lines.owner == i
        f, g = values_and_gradients(field, middle[mine])
        off[mine] = np.abs(f) / np.maximum(np.linalg.norm(g, axis=1), 0.5)
    return bool((off > _BULGE * lines.lengths + 0.01 * size.smallest).any())


def raise_thin(
    where: str, fields: tuple[AbstractSdf, ...], places: np.ndarray, size: Sizes
) -> NoReturn:
    """Raise an error that names the thinnest wall or gap of any of the `fields` at some of the
    `places` [m]."""
    places = places[:: -(-len(places) // _PLACES)]
    found = (thinnest(field, places, size.largest) for field in fields)
    name, at, thick = min(found, key=lambda one: one[2])
    length = float(size(at[None])[0])
    place = ", ".join(f"{x:.4g}" for x in np.round(at / length, 6) * length)
    if thick >= length / 2:
        read = (
            " Read from a file? Look at sdf.surface_report, and where it finds no fault, take "
            "io.mesh_surface(part, size, order=2)."
        )
        read = read if len(at) == 3 else ""
        raise NotResolved(
            f"{where}: cells of {length:g} m cannot follow the surface near ({place}) m, where "
            f"the thinnest {name} is about {thick:.2g} m thick. Lower `size`, round it, or let "
            "shapes that are joined or cut out overlap: two that end on one line leave a skin "
            f"without thickness.{read}",
            thin=False,
        )
    raise NotResolved(
        f"{where}: a {name} near ({place}) m is about {thick:.2g} m thick, need about half of "
        f"the `size` of {length:g} m or more. Lower `size`, or thicken the {name}."
    )


def raise_if_thin(where: str, shape: AbstractSdf, lower, upper, size: Sizes) -> None:
    """Raise as `raise_thin` if there is a surface where no inside was found."""
    p = lower + (upper - lower) * np.random.default_rng(0).random((CHUNK, len(lower)))
    p = land(shape, p)
    p = p[np.abs(values(shape, p)) < 1e-9 * size.smallest]
    if len(p):
        raise_thin(where, (shape,), p, size)


def thinnest(shape: AbstractSdf, places: np.ndarray, reach: float):
    """ "wall" or "gap", the place, and the thickness [m] of what is thinnest at `places`
    (n, dim) [m]: the shortest way between surfaces that face each other along rays."""
    ways = _directions(shape.dim)
    # as fine as the thinnest beside the place, as far as `reach`
    steps = reach * np.sinh(np.linspace(-6, 6, 2 * _STEPS + 1)) / np.sinh(6)
    rays = places[:, None, None] + steps[None, None, :, None] * ways[None, :, None, :]
    f = values(shape, rays.reshape(-1, shape.dim)).reshape(len(places), len(ways), -1)
    row, way, step = np.nonzero((f[..., :-1] < 0) != (f[..., 1:] < 0))
    share = f[row, way, step] / (f[row, way, step] - f[row, way, step + 1])
    far = steps[step] + share * (steps[step + 1] - steps[step])
    hit = places[row] + far[:, None] * ways[way]
    g = normals(shape, hit)
    same = (row[1:] == row[:-1]) & (way[1:] == way[:-1])
    facing = np.flatnonzero(same & ((g[1:] * g[:-1]).sum(axis=1) < _OPPOSED))
    thick, middle = np.diff(far)[facing], (hit[:-1] + hit[1:])[facing] / 2
    # along the surface itself rounding makes crossings, with no depth between them
    depth = values(shape, middle)
    thick[np.abs(depth) < _DEPTH * thick] = np.inf
    if not np.isfinite(thick).any():
        return "wall", places[0], 2 * float(np.abs(f).max(axis=(1, 2))[0])
    least = int(np.argmin(thick))
    return ("wall" if depth[least] < 0 else "gap"), middle[least], float(thick[least])


def _directions(dim: int) -> np.ndarray:
    """Unit vectors spread over half a circle or half a ball."""
    k = np.arange(_RAYS) + 0.5
    if dim == 2:
        angle = np.pi * k / _RAYS
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = k / _RAYS
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)

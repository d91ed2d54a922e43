"""Meshes of polygons and of pictures."""

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax._types import Numbers
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.plane.triangulate import triangulate
from sorojax.mesh.sizes import SizeFunction
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.shapes.plane import Polygon

_MOST_CORNERS = 5000


def from_polygon(
    outer: Float[np.ndarray, "corners 2"],
    holes: tuple[Float[np.ndarray, "corners 2"], ...] = (),
    *,
    size: float | SizeFunction,
    order: int = 1,
) -> Mesh:
    """Triangles inside a polygon [m] with holes; every corner becomes a node.

    Raises:
        ValueError: If a ring has fewer than 3 corners, or rings touch or cross.
    """
    rings = [_ring(r) for r in (outer, *holes)]
    _check_simple(rings)
    shape: AbstractSdf = Polygon(rings[0])
    for hole in rings[1:]:
        shape = shape - Polygon(hole)
    return triangulate(shape, size=size, order=order)


def from_image(
    image: Float[np.ndarray, "rows columns"],
    *,
    pixel: float,
    size: float | SizeFunction,
    order: int = 1,
    level: float | None = None,
    smooth: float = 0.35,
) -> Mesh:
    """Triangles inside the bright part of a picture; x to the right, y up from its foot.

    The outline runs at the grey `level` between pixels, so an anti-aliased picture gives
    it to a fraction of a pixel.

    Args:
        image: Grey levels; for a dark body pass `-image`.
        pixel: Side of a pixel [m].
        size: Wanted length of the sides [m].
        order: 1 for `Tri3`, 2 for `Tri6`.
        level: Grey level of the outline; midway between darkest and brightest if omitted.
        smooth: Largest distance of the outline from the contour [pixels].
    """
    return triangulate(
        image_shape(image, pixel=pixel, level=level, smooth=smooth), size=size, order=order
    )


def image_shape(
    image: Numbers, *, pixel: float, level: float | None = None, smooth: float = 0.35
) -> AbstractSdf:
    """The bright part of a picture as polygons minus their holes."""
    from skimage.measure import approximate_polygon, find_contours

    image = np.asarray(image, dtype=float)
    _check.shape("from_image", "image", image, (None, None), "Give grey levels, not colours.")
    _check.positive("from_image", "pixel", pixel, "m", "Give the side of a pixel.")
    _check.finite("from_image", "image", image, "Replace missing pixels.")
    low, high = float(image.min()), float(image.max())
    level = (low + high) / 2 if level is None else level
    if not low < level < high:
        raise ValueError(
            f"from_image: the outline at grey {level:g} does not exist, levels run from "
            f"{low:g} to {high:g}. Pass a `level` between them."
        )
    padded = np.pad(image, 1, constant_values=low)
    rings = []
    for contour in find_contours(padded, level):
        ring = approximate_polygon(contour, smooth)[:-1]
        if len(ring) >= 3:
            rings.append(pixel * np.stack([ring[:, 1] - 0.5, len(image) - ring[:, 0] + 0.5], 1))
    rings.sort(key=lambda r: -abs(_area(r)))
    _check_simple(rings)
    first = np.sign(_area(rings[0]))
    shape: AbstractSdf = Polygon(rings[0])
    for ring in rings[1:]:
        part = Polygon(ring)
        shape = shape | part if np.sign(_area(ring)) == first else shape - part
    return shape


def _area(x: np.ndarray) -> float:
    y = np.roll(x, -1, axis=0)
    return float((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / 2)


def _ring(corners) -> np.ndarray:
    ring = np.asarray(corners, dtype=float)
    _check.shape("from_polygon", "corners", ring, (None, 2), "One row per corner.")
    _check.finite("from_polygon", "corners", ring, "Remove or correct them.")
    if len(ring) > 1 and np.array_equal(ring[0], ring[-1]):
        ring = ring[:-1]
    if len(ring) < 3:
        raise ValueError(f"from_polygon: a ring has {len(ring)} corners, need at least 3.")
    return ring


def _check_simple(rings: list[np.ndarray]) -> None:
    """Raise where two sides of the rings touch or cross."""
    a = np.concatenate(rings)
    if len(a) > _MOST_CORNERS:
        raise ValueError(
            f"from_polygon: the rings have {len(a)} corners, at most {_MOST_CORNERS} are "
            "allowed. Simplify them first."
        )
    b = np.concatenate([np.roll(r, -1, axis=0) for r in rings])
    after = np.concatenate([np.roll(np.arange(len(r)), -1) + s for r, s in _starts(rings)])
    for i in range(len(a)):
        side = (_turn(a[i], b[i], a), _turn(a[i], b[i], b))
        back = (_turn(a, b, a[i]), _turn(a, b, b[i]))
        hit = (side[0] * side[1] <= 0) & (back[0] * back[1] <= 0)
        flat = (side[0] == 0) & (side[1] == 0)
        hit &= ~flat | _overlap(a[i], b[i], a, b)
        hit[[i, after[i], int(np.flatnonzero(after == i)[0])]] = False
        if hit.any():
            raise ValueError(
                f"from_polygon: the side from {a[i]} to {b[i]} m touches or crosses the one "
                f"from {a[hit][0]} to {b[hit][0]} m. Separate them, or split the polygon."
            )


def _starts(rings):
    start = 0
    for ring in rings:
        yield ring, start
        start += len(ring)


def _turn(a, b, p):
    u, v = b - a, p - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _overlap(p, q, a, b):
    """Whether boxes of sides in one line overlap."""
    low, high = np.minimum(p, q), np.maximum(p, q)
    return ((np.maximum(a, b) >= low) & (np.minimum(a, b) <= high)).all(axis=1)

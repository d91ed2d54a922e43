"""Regions between closed outlines, and text drawn by them."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.bars import segment_square
from sorojax.sdf.base import Box
from sorojax.sdf.nearest import scan_rows, take
from sorojax.sdf.scalar import segment_side
from sorojax.sdf.shapes2d import AbstractPlaneShape
from sorojax.sdf.simple import touching_edges

_SIZE = 64.0


class Outlines(AbstractPlaneShape):
    """Region between closed outlines: one within another is a hole, by the even-odd rule.

    Outline k takes the rows of `vertices` [m] from `starts[k]` to the next; outlines may
    not touch. A gradient costs one edge, however many there are.
    """

    vertices: Float[Array, "corners 2"] = eqx.field(converter=real)
    starts: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self):
        _check.shape("Outlines", "vertices", self.vertices, (None, 2), "One row per corner.")
        lengths = np.diff([*self.starts, self.vertices.shape[0]])
        if not self.starts or self.starts[0] != 0 or lengths.min() < 3:
            raise ValueError(
                f"Outlines: `starts` is {self.starts} for {self.vertices.shape[0]} corners, "
                "need outlines of at least 3 corners from row 0. Use `outlines` to join loops."
            )

    def distance(self, x, y):
        following = np.arange(1, self.vertices.shape[0] + 1)
        following[np.array([*self.starts[1:], len(following)]) - 1] = self.starts
        table = (self.vertices, self.vertices[following])
        square, cross = lambda row, *x: segment_square(x, *row), _crossing
        index, crossings = scan_rows(square, table, (x, y), cross)
        inside = jnp.round(crossings) % 2 == 1
        side = segment_side(x, y, *take(table, index))
        outward = jnp.where(jax.lax.stop_gradient(side) < 0, inside, ~inside)
        return jnp.where(outward, side, -side)

    def bounding_box(self) -> Box:
        return jnp.min(self.vertices, axis=0), jnp.max(self.vertices, axis=0)


def _crossing(row: tuple[Array, Array], x: Array, y: Array) -> Array:
    """One where the ray to the right of a point crosses the edge, zero elsewhere."""
    (ax, ay), (bx, by) = row
    right = (bx - ax) * (y - ay) - (x - ax) * (by - ay)
    right = jnp.where(by > ay, right, -right) > 0
    return (((ay > y) != (by > y)) & right).astype(x.dtype)


def outlines(loops: Sequence[Numbers]) -> Outlines:
    """The region between closed `loops`, each an array of corners (n, 2) [m]."""
    loops = [real(loop) for loop in loops]
    if not loops:
        raise ValueError("outlines: got no loop, need at least one. Give arrays of corners.")
    for i, loop in enumerate(loops):
        edges = touching_edges(np.asarray(loop)) if _check.is_concrete(loop) else None
        if edges is not None:
            raise ValueError(
                f"outlines: edges {edges[0]} and {edges[1]} of loop {i} touch, need simple "
                "loops. Put its corners in order, or cut the loop in two."
            )
    starts = np.cumsum([0, *(loop.shape[0] for loop in loops[:-1])])
    return Outlines(jnp.concatenate(loops), tuple(int(i) for i in starts))


def text(line: str, height: Numbers, font: str = "DejaVu Sans") -> Outlines:
    """One `line` of text from the origin along x, as the polygons of its letters.

    Args:
        line: What to write.
        height: Size of the type, its em [m]; capitals are about 0.73 of it.
        font: Family of the font, as matplotlib finds it.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    _check.positive("text", "height", height, "m", "Give the size of the type.")
    if not line.strip():
        raise ValueError(f"text: {line!r} has no outline, need letters. Write something.")
    # The size sets how finely matplotlib breaks curves into edges.
    path = TextPath((0, 0), line, size=_SIZE, prop=FontProperties(family=font))
    loops = [_thinned(loop) / _SIZE for loop in path.to_polygons(closed_only=True)]
    height = real(height)
    return outlines([height * jnp.asarray(loop, height.dtype) for loop in loops])


def _thinned(loop) -> np.ndarray:
    """Corners of a closed loop, without the repeated end and repeated points."""
    loop = np.asarray(loop, dtype=float)[:-1]
    apart = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1) > 1e-9
    return loop[apart]

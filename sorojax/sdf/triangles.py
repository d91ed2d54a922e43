"""One triangle in space: distance, side and solid angle at separate coordinate arrays."""

import jax.numpy as jnp
from jaxtyping import Array

from sorojax.sdf.bars import segment_square
from sorojax.sdf.scalar import clip, minimum, quotient, root

Vector = tuple[Array, ...]  # x, y, z
_ON_EDGE = 1024  # of rounding, of a side: points that near to an edge are on it


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    )  # fmt: skip


def over(p: Vector, a: Vector, b: Vector, c: Vector, slack: float = 0.0) -> tuple[Array, Array]:
    """Height of p over the plane of a triangle, and whether its foot is on the triangle, or
    beside it by at most `slack` of its sides."""
    n = cross(minus(b, a), minus(c, a))
    square = dot(n, n)
    within = None
    for start, end in ((a, b), (b, c), (c, a)):
        e = minus(end, start)
        beyond = -slack * dot(e, e) * root(square) if slack else 0.0
        side = dot(cross(e, minus(p, start)), n) >= beyond
        within = side if within is None else within & side
    height = quotient(dot(n, minus(p, a)), root(square) + jnp.zeros_like(p[0]))
    return height, within & (square > 0)


def triangle_square(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Square of the distance to a triangle [m^2]."""
    height, within = over(p, a, b, c)
    edges = [segment_square(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    return jnp.where(within, height * height, minimum(edges[0], minimum(edges[1], edges[2])))


def triangle_side(p: Vector, a: Vector, b: Vector, c: Vector, inside: Array) -> Array:
    """Signed distance to the nearest triangle; over its face it has a slope at zero too, and
    on an edge that of one of the faces beside it."""
    height, within = over(p, a, b, c, _ON_EDGE * float(jnp.finfo(p[0].dtype).eps))
    edges = [segment_square(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    far = root(minimum(edges[0], minimum(edges[1], edges[2])))
    return jnp.where(within, height, jnp.where(inside, -far, far))


def foot(p: Vector, a: Vector, b: Vector, c: Vector) -> tuple[Vector, Array, Array]:
    """Closest point of a triangle, and the edge and the corner it lies on (or -1).

    Edge k runs from corner k to the next.
    """
    height, within = over(p, a, b, c)
    n = cross(minus(b, a), minus(c, a))
    up = quotient(height, root(dot(n, n)))
    best = tuple(x - up * k for x, k in zip(p, n, strict=True))
    square = jnp.where(within, height * height, jnp.full_like(height, jnp.inf))
    nowhere = jnp.full(height.shape, -1)
    edge = corner = nowhere
    for k, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        e = minus(end, start)
        t = clip(quotient(dot(minus(p, start), e), dot(e, e)), 0.0, 1.0)
        at = tuple(s + t * d for s, d in zip(start, e, strict=True))
        gap = minus(p, at)
        closer = ~within & (dot(gap, gap) < square)
        square = jnp.where(closer, dot(gap, gap), square)
        best = tuple(jnp.where(closer, u, v) for u, v in zip(at, best, strict=True))
        at_end = jnp.where(t >= 1, (k + 1) % 3, nowhere)
        edge = jnp.where(closer, jnp.where((t > 0) & (t < 1), k, nowhere), edge)
        corner = jnp.where(closer, jnp.where(t <= 0, k, at_end), corner)
    return best, edge, corner


def solid_angle(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Signed solid angle of a triangle seen from p [sr] (Van Oosterom and Strackee)."""
    a, b, c = minus(a, p), minus(b, p), minus(c, p)
    la, lb, lc = (root(dot(v, v)) for v in (a, b, c))
    triple = dot(a, cross(b, c))
    rest = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return 2 * jnp.arctan2(triple, rest)

"""Where the vertices of dual contouring lie: the points nearest to sets of planes."""

import jax
import jax.numpy as jnp
import numpy as np

_PULL = 0.02  # weight that holds a vertex at the mean crossing, against 1 per plane
_STEPS = 3
_PIECE = 1 << 15
_ROWS, _COLUMNS = np.triu_indices(3)


def place(
    points: np.ndarray, normals: np.ndarray, quads: np.ndarray, alone: np.ndarray
) -> np.ndarray:
    """Vertices (n, 3) nearest to the planes of the crossings that `quads` give them.

    Directions that no plane fixes keep the mean of the crossings. Repeated steps of a
    damped problem leave no trace of the damping where planes meet at an edge or corner.
    Vertices that are not `alone` in their cell stay at the mean, which keeps them apart.
    """
    total = _gathered(points, normals, quads, len(alone))
    vertices = np.empty((len(alone), 3))
    for start in range(0, len(alone), _PIECE):
        piece = slice(start, start + _PIECE)
        vertices[piece] = _kernel(_nearest, total[piece], alone[piece])
    return vertices


def _kernel(function, *rows) -> np.ndarray:
    """`function` of arrays padded to one length, so that it is compiled once."""
    count = len(rows[0])
    if count < _PIECE:
        rows = tuple(
            np.concatenate([r, np.repeat(r[-1:], _PIECE - count, axis=0)]) for r in rows
        )
    return np.asarray(function(*(jnp.asarray(r) for r in rows)))[:count]


def _gathered(points, normals, quads, count: int) -> np.ndarray:
    """Sums (count, 13) over the crossings of a vertex: 1, x, n (n . x), n n in six."""
    from scipy.sparse import csc_array

    total = np.zeros((count, 13))
    for start in range(0, len(quads), _PIECE):
        piece = slice(start, start + _PIECE)
        q = quads[piece]
        row = _kernel(_features, points[piece], normals[piece])
        # Neighbours in space are neighbours in number: a piece fills a short range.
        low, high = int(q.min()), int(q.max()) + 1
        ends = np.arange(0, q.size + 1, 4, dtype=np.int32)
        data = (np.ones(q.size), (q - low).ravel(), ends)
        total[low:high] += csc_array(data, shape=(high - low, len(q))) @ row
    return total


@jax.jit
def _features(x, n):
    n = n.astype(x.dtype)
    level = n[:, 0] * x[:, 0] + n[:, 1] * x[:, 1] + n[:, 2] * x[:, 2]
    columns = [jnp.ones_like(level), *x.T, *(n[:, i] * level for i in range(3))]
    columns += [n[:, i] * n[:, j] for i, j in zip(_ROWS, _COLUMNS, strict=True)]
    return jnp.stack(columns, axis=1)


@jax.jit
def _nearest(total, alone):
    """Minimum of the squared distances to the planes, by steps that damp ever less."""
    number, *columns = total.T
    mean, right, square = columns[:3], columns[3:6], columns[6:]
    damped = [m + (_PULL if i in (0, 3, 5) else 0.0) * number for i, m in enumerate(square)]
    inverse = _inverse(*damped)
    mean = [m / number for m in mean]
    x = mean
    for _ in range(_STEPS):
        rest = [r - s for r, s in zip(right, _times(square, x), strict=True)]
        x = [a + b for a, b in zip(x, _times(inverse, rest), strict=True)]
    return jnp.stack([jnp.where(alone, a, b) for a, b in zip(x, mean, strict=True)], axis=1)


def _times(m, x):
    """Symmetric matrix of six entries times a vector."""
    a, b, c = x
    return (
        m[0] * a + m[1] * b + m[2] * c,
        m[1] * a + m[3] * b + m[4] * c,
        m[2] * a + m[4] * b + m[5] * c,
    )


def _inverse(xx, xy, xz, yy, yz, zz):
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    adjugate = (a, b, c, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy)
    determinant = xx * a + xy * b + xz * c
    return [entry / determinant for entry in adjugate]

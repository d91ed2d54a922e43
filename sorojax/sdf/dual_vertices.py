"""Where the vertices of dual contouring lie: the points nearest to sets of planes."""

import jax
import jax.numpy as jnp
import numpy as np

MARGIN = 0.02  # cells: vertices stay off cell walls, so that none coincide in float32
_PULL = 0.02  # weight that holds a vertex at the mean crossing, against 1 per plane
_STEPS = 3
_PIECE = 1 << 13
_PAIRS = list(zip(*np.triu_indices(3), strict=True))
# By axis of a grid edge: the four cells around it, counter-clockwise, begin so far before it.
SHIFTS = np.array(
    [
        [np.roll([0, d, e], axis) for d, e in ((1, 1), (0, 1), (0, 0), (1, 0))]
        for axis in range(3)
    ],
    np.float32,
)
SUMS = 16  # 1, x, n, n (n . x), n n in six


def gathered(
    offset: np.ndarray, normal: np.ndarray, shift: np.ndarray, quads: np.ndarray, total
) -> None:
    """Add planes to the sums (vertices, 16) of the vertices they belong to.

    Args:
        offset: (n, 3) points of the planes [cells].
        normal: (n, 3) unit normals.
        shift: (n,) rows of `SHIFTS`: how far each of the four cells begins before there.
        quads: (n, 4) vertices in these cells.
        total: Sums as seen from the corners of the vertices' cells.
    """
    from scipy.sparse import csc_array

    for start in range(0, len(quads), _PIECE):
        piece = slice(start, start + _PIECE)
        q = quads[piece]
        # Neighbours in space are neighbours in number: a piece fills a short range.
        low, high = int(q.min()), int(q.max()) + 1
        row = padded(_features, offset[piece], normal[piece], shift[piece])
        ends = np.arange(q.size + 1, dtype=np.int32)
        data = (np.ones(q.size, np.float32), (q - low).ravel(), ends)
        total[low:high] += csc_array(data, shape=(high - low, q.size)) @ row.reshape(-1, SUMS)


def padded(function, *rows) -> np.ndarray:
    """`function` of up to 8192 rows, brought to that length so that it is compiled once."""
    count = len(rows[0])
    if count < _PIECE:
        rows = tuple(
            np.concatenate([r, np.repeat(r[-1:], _PIECE - count, axis=0)]) for r in rows
        )
    return np.asarray(function(*rows))[:count]


@jax.jit
def _features(x, n, shift):
    """Rows (planes, 4, 16) of what is summed."""
    shift = jnp.asarray(SHIFTS)[shift]
    x = [x[:, None, i] + shift[:, :, i] for i in range(3)]
    n = [jnp.broadcast_to(n[:, None, i], x[0].shape) for i in range(3)]
    level = n[0] * x[0] + n[1] * x[1] + n[2] * x[2]
    columns = [jnp.ones_like(level), *x, *n, *(part * level for part in n)]
    return jnp.stack(columns + [n[i] * n[j] for i, j in _PAIRS], axis=2)


def place(total: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) in shares of their cells, nearest to the planes summed in `total`.

    Directions that no plane fixes keep the mean of the crossings. Repeated steps of a
    damped problem leave no trace of the damping where planes meet at an edge or corner.
    Vertices that are not `alone` in their cell stay at the mean, which keeps them apart.
    """
    found = np.empty((len(total), 3), np.float32)
    for start in range(0, len(total), _PIECE):
        piece = slice(start, start + _PIECE)
        found[piece] = padded(_nearest, total[piece], alone[piece])
    return found


@jax.jit
def _nearest(total, alone):
    """Minimum of the squared distances to the planes, by steps that damp ever less."""
    number, *columns = total.T
    columns = [column / number for column in columns]
    mean, right, square = columns[:3], columns[6:9], columns[9:]
    damped = [m + (_PULL if i in (0, 3, 5) else 0.0) for i, m in enumerate(square)]
    inverse = _inverse(*damped)
    x = mean
    for _ in range(_STEPS):
        rest = [r - s for r, s in zip(right, _times(square, x), strict=True)]
        x = [a + b for a, b in zip(x, _times(inverse, rest), strict=True)]
    found = [jnp.where(alone, a, b) for a, b in zip(x, mean, strict=True)]
    return jnp.clip(jnp.stack(found, axis=1), MARGIN, 1 - MARGIN)


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

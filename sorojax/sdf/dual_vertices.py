"""Where the vertices of dual contouring lie: the points nearest to sets of planes."""

import jax
import jax.numpy as jnp
import numpy as np


MARGIN = 0.02  # cells: vertices stay off cell walls, so that none coincide in float32
_PULL = 0.02  # weight that holds a vertex at the mean crossing, against 1 per plane
_STEPS = 3
_PIECE = 1 << 13
_ROWS, _COLUMNS = np.triu_indices(3)
SUMS = 16  # 1, x, n, n (n . x), n n in six


def gathered(points: np.ndarray, normals: np.ndarray, quads: np.ndarray, total) -> None:
    """Add planes with `points` [cells] and `normals` to the sums of the vertices `quads`."""
    from scipy.sparse import csc_array

    for start in range(0, len(quads), _PIECE):
        piece = slice(start, start + _PIECE)
        q = quads[piece]
        # Neighbours in space are neighbours in number: a piece fills a short range.
        low, high = int(q.min()), int(q.max()) + 1
        ends = np.arange(0, q.size + 1, 4, dtype=np.int32)
        data = (np.ones(q.size), (q - low).ravel(), ends)
        spread = csc_array(data, shape=(high - low, len(q)))
        total[low:high] += spread @ _features(points[piece], normals[piece])


def _features(x: np.ndarray, n: np.ndarray) -> np.ndarray:
    row = np.empty((len(x), SUMS))
    row[:, 0], row[:, 1:4], row[:, 4:7] = 1, x, n
    level = np.einsum("ij,ij->i", x, n, dtype=float)
    np.multiply(row[:, 4:7], level[:, None], out=row[:, 7:10])
    for k, (i, j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
        np.multiply(row[:, 4 + i], row[:, 4 + j], out=row[:, 10 + k])
    return row


def place(total: np.ndarray, corner: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) [cells] nearest to the planes summed in `total`, inside their cells.

    Directions that no plane fixes keep the mean of the crossings. Repeated steps of a
    damped problem leave no trace of the damping where planes meet at an edge or corner.
    Vertices that are not `alone` in their cell stay at the mean, which keeps them apart.

    Args:
        total: (n, 16) sums over the crossings of each vertex.
        corner: (n, 3) first nodes of their cells.
        alone: (n,) whether no other vertex shares the cell.
    """
    vertices = np.empty((len(total), 3))
    for start in range(0, len(total), _PIECE):
        piece = slice(start, start + _PIECE)
        t, low = total[piece], corner[piece]
        rows = (_local(t, low), alone[piece])
        pad = _PIECE - len(low)
        if pad:
            rows = tuple(np.concatenate([r, np.repeat(r[-1:], pad, axis=0)]) for r in rows)
        vertices[piece] = low + np.asarray(_nearest(*rows))[: len(low)]
    return vertices


def _local(total: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Mean crossing, right side and matrix of each vertex as seen from its cell's corner."""
    rows = np.empty((len(total), 12), np.float32)
    share = 1 / total[:, :1]
    rows[:, :3] = total[:, 1:4] * share - corner
    square = total[:, 10:].T
    moved = _times(square, corner.T)
    for k in range(3):
        rows[:, 3 + k] = (total[:, 7 + k] - moved[k]) * share[:, 0]
    rows[:, 6:] = total[:, 10:] * share
    return rows


@jax.jit
def _nearest(rows, alone):
    """Minimum of the squared distances to the planes, by steps that damp ever less."""
    columns = list(rows.T)
    mean, right, square = columns[:3], columns[3:6], columns[6:]
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



"""Where the vertices of dual contouring lie: the points nearest to sets of planes."""

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
    count = len(alone)
    corners = [np.ascontiguousarray(quads[:, k]) for k in range(4)]

    def gather(weight):
        found = np.bincount(corners[0], weight, count)
        for corner in corners[1:]:
            found += np.bincount(corner, weight, count)
        return found

    number = gather(np.ones(len(points)))
    mean = np.stack([gather(points[:, i]) for i in range(3)], axis=-1) / number[:, None]
    level = (normals * points).sum(axis=1)
    right = np.stack([gather(normals[:, i] * level) for i in range(3)], axis=-1)
    pairs = zip(_ROWS, _COLUMNS, strict=True)
    square = np.stack([gather(normals[:, i] * normals[:, j]) for i, j in pairs], axis=-1)
    for start in range(0, count, _PIECE):
        piece = slice(start, start + _PIECE)
        near = _nearest(mean[piece], square[piece], right[piece], number[piece])
        mean[piece] = np.where(alone[piece, None], near, mean[piece])
    return mean


def _nearest(x, square, right, number):
    damped = square.copy()
    damped[:, [0, 3, 5]] += _PULL * number[:, None]
    inverse = _inverse(damped)
    for _ in range(_STEPS):
        x = x + _times(inverse, right - _times(square, x))
    return x


def _times(m, x):
    """Symmetric matrices (n, 6) times vectors (n, 3)."""
    a, b, c = x.T
    return np.stack(
        [
            m[:, 0] * a + m[:, 1] * b + m[:, 2] * c,
            m[:, 1] * a + m[:, 3] * b + m[:, 4] * c,
            m[:, 2] * a + m[:, 4] * b + m[:, 5] * c,
        ],
        axis=-1,
    )


def _inverse(m):
    xx, xy, xz, yy, yz, zz = m.T
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    adjugate = (a, b, c, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy)
    return np.stack(adjugate, axis=-1) / (xx * a + xy * b + xz * c)[:, None]

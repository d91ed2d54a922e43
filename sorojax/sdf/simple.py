"""Whether a polygon touches itself."""

import numpy as np


def touching_edges(vertices: np.ndarray) -> tuple[int, int] | None:
    """Two edges of a closed polygon that meet away from a shared corner, or None."""
    a, b = vertices, np.roll(vertices, -1, axis=0)
    count = len(a)
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    for i in range(count):
        later = np.arange(i + 1, count)
        near = np.all((lower[later] <= upper[i]) & (upper[later] >= lower[i]), axis=1)
        for j in later[near]:
            if _meet(a[i], b[i], a[j], b[j], next_to=j == i + 1 or (i == 0 and j == count - 1)):
                return i, int(j)
    return None


def _meet(a, b, c, d, next_to: bool) -> bool:
    if next_to:
        # Neighbours share a corner; they touch elsewhere where one folds back on the other.
        first, second = b - a, d - c
        return abs(_cross(first, second)) == 0 and first @ second < 0
    sides = (
        _cross(b - a, c - a),
        _cross(b - a, d - a),
        _cross(d - c, a - c),
        _cross(d - c, b - c),
    )
    return sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0


def _cross(u, v) -> float:
    return float(u[0] * v[1] - u[1] * v[0])

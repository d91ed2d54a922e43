"""The solid of the SDF cases: a ball in a cube with three bores, and its numbers in NumPy."""

import numpy as np

POINTS = 2**20


def solid():
    from sorojax import sdf

    rounded = sdf.Sphere([0, 0, 0], 1) & sdf.Box([-0.75] * 3, [0.75] * 3)
    return rounded - sdf.union(*(sdf.InfiniteCylinder(0.5, axis) for axis in "xyz"))


def points(dtype) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.2, 1.2, (POINTS, 3)).astype(dtype)


def in_numpy(p: np.ndarray) -> np.ndarray:
    """The same expression on whole arrays."""
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    ball = np.sqrt(x * x + y * y + z * z) - 1
    a, b, c = np.abs(x) - 0.75, np.abs(y) - 0.75, np.abs(z) - 0.75
    inner = np.minimum(np.maximum(a, np.maximum(b, c)), 0)
    a, b, c = np.maximum(a, 0), np.maximum(b, 0), np.maximum(c, 0)
    cube = inner + np.sqrt(a * a + b * b + c * c)
    bores = np.minimum(
        np.sqrt(y * y + z * z), np.minimum(np.sqrt(x * x + z * z), np.sqrt(x * x + y * y))
    )
    return np.maximum(np.maximum(ball, cube), 0.5 - bores)

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
    """The same expression written out by hand on coordinate arrays."""
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


def in_numpy_nodes(p: np.ndarray) -> np.ndarray:
    """The same tree node by node on (n, 3) arrays, as libraries of NumPy functions do it."""

    def length(a):
        return np.linalg.norm(a, axis=1)

    def sphere(p):
        return length(p) - 1

    def box(p):
        q = np.abs(p) - p.dtype.type(0.75)
        return length(np.maximum(q, 0)) + np.minimum(np.amax(q, axis=1), 0)

    def bores(p):
        a, b, c = (length(p[:, axes]) - p.dtype.type(0.5) for axes in ([1, 2], [0, 2], [0, 1]))
        return np.minimum(np.minimum(a, b), c)

    return np.maximum(np.maximum(sphere(p), box(p)), -bores(p))

"""Rotation of a frame whose curvature varies along a cell, by a Magnus expansion."""

import numpy as np

from sorojax.math.quaternion import Vector, cross

# Coefficients of the expansion (rows) from the moments B_j, h^-j times the integral of
# (s - s_mid)^j kappa(s) over a cell of length h, for j = 0, 1, 2 (columns).
FROM_MOMENTS = np.array([[9 / 4, 0.0, -15.0], [0.0, 12.0, 0.0], [-15.0, 0.0, 180.0]])


def rotation_vector(coefficients: tuple[Vector, Vector, Vector]) -> Vector:
    """Rotation vector of the solution of R' = R hat(kappa) over one cell, order 6.

    Args:
        coefficients: `FROM_MOMENTS` times the moments of the curvature, each as three
            components [rad].

    Reference:
        Blanes, Casas, Oteo, Ros, The Magnus expansion, Physics Reports 470, 2009;
        the bracket has the sign of right multiplication.
    """
    a1, a2, a3 = coefficients
    c1 = cross(a2, a1)
    c2 = cross(tuple(a + c / 2 for a, c in zip(a3, c1, strict=True)), a1)  # type: ignore[arg-type]
    right = tuple(a - c / 30 for a, c in zip(a2, c2, strict=True))
    left = tuple(c - 20 * a - b for a, b, c in zip(a1, a3, c1, strict=True))
    turn = cross(right, left)  # type: ignore[arg-type]
    x, y, z = (a + b / 12 + c / 240 for a, b, c in zip(a1, a3, turn, strict=True))
    return x, y, z

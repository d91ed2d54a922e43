"""Rotation of a frame whose curvature varies along a cell, by a Magnus expansion."""

from sorojax.math.quaternion import Vector, cross


def rotation_vector(moments: tuple[Vector, Vector, Vector]) -> Vector:
    """Rotation vector of the solution of R' = R hat(kappa) over one cell, order 6.

    Args:
        moments: B_j = h^-j times the integral of (s - s_mid)^j kappa(s) over a cell of
            length h, for j = 0, 1, 2, each as three components [rad].

    Reference:
        Blanes, Casas, Oteo, Ros, The Magnus expansion, Physics Reports 470, 2009;
        the bracket has the sign of right multiplication.
    """
    b0, b1, b2 = moments
    a1 = _combine((9 / 4, b0), (-15.0, b2))
    a2 = _combine((12.0, b1))
    a3 = _combine((-15.0, b0), (180.0, b2))
    c1 = cross(a2, a1)
    c2 = _combine((-1 / 60, cross(_combine((2.0, a3), (1.0, c1)), a1)))
    left = _combine((-20.0, a1), (-1.0, a3), (1.0, c1))
    right = _combine((1.0, a2), (1.0, c2))
    return _combine((1.0, a1), (1 / 12, a3), (1 / 240, cross(right, left)))


def _combine(*terms: tuple[float, Vector]) -> Vector:
    x, y, z = (sum(weight * vector[i] for weight, vector in terms) for i in range(3))
    return (x, y, z)  # type: ignore[return-value]

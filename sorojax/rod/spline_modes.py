"""B-splines: local, positive modes of any smoothness."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.rod.basis import AbstractModes, StrainBasis, each_count, merged


class BSpline(AbstractModes):
    """Clamped B-splines of one `degree`; they are positive and sum to 1.

    Attributes:
        knots: Inner knots, rising inside (0, 1); one that is repeated lowers the
            smoothness there, degree + 1 times lets the strain jump.
        degree: 0 or more; the splines have degree - 1 derivatives at a simple knot.

    Reference:
        de Boor, A Practical Guide to Splines, 2001, chapter IX.
    """

    knots: tuple[float, ...] = eqx.field(static=True)
    degree: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        if self.degree < 0:
            raise ValueError(f"BSpline: `degree` is {self.degree}, need 0 or more. 3 is usual.")
        knots = np.asarray(self.knots, float)
        repeats = np.unique(knots, return_counts=True)[1].max(initial=0)
        inside = np.all((knots > 0) & (knots < 1)) and np.all(np.diff(knots) >= 0)
        if not inside or repeats > self.degree + 1:
            raise ValueError(
                f"BSpline: the inner knots are {knots.tolist()}, need numbers that rise inside "
                f"(0, 1), none more than degree + 1 = {self.degree + 1} times. The ends are "
                "added for you."
            )

    @property
    def count(self) -> int:
        return len(self.knots) + self.degree + 1

    @property
    def breaks(self) -> tuple[float, ...]:
        return merged(self.knots)

    @property
    def least(self) -> int:
        return self.degree + 1

    @property
    def resolution(self) -> int:
        spans = len(self.breaks) + 1
        return max(4, self.degree + 2, -(-8 // spans))

    def __call__(self, s):
        xp = jnp if isinstance(s, jax.Array) else np
        p = self.degree
        t = np.concatenate([np.zeros(p + 1), self.knots, np.ones(p + 1)]).tolist()
        rows = [self._indicator(s, t[k], t[k + 1]) for k in range(len(t) - 1)]
        for d in range(1, p + 1):
            rows = [
                _rise(s, t[k], t[k + d]) * rows[k]
                + (1 - _rise(s, t[k + 1], t[k + d + 1])) * rows[k + 1]
                for k in range(len(rows) - 1)
            ]
        return xp.stack(rows, axis=1)

    def _indicator(self, s, low: float, high: float):
        if low == high:
            return s * 0
        inside = (s >= low if low > 0 else s == s) & (s < high if high < 1 else s == s)
        return inside.astype(s.dtype)


def _rise(s, low: float, high: float):
    """From 0 to 1 between two knots; a spline between equal knots is zero already."""
    return s * 0 if low == high else (s - low) / (high - low)


def bspline(
    *, degree: int = 3, knots: Sequence[float] | None = None, **modes: int
) -> StrainBasis:
    """Clamped B-splines per strain: `bspline(kappa_y=6, kappa_z=6, degree=3)`.

    Args:
        degree: Polynomial degree between knots.
        knots: Inner knots in (0, 1); equally spaced by default.
        modes: Number of splines per strain, inner knots + degree + 1.

    Raises:
        ValueError: If a number of splines does not fit degree and knots.
    """
    basis = {}
    for name, count in each_count("bspline", modes).items():
        inner = count - degree - 1
        if inner < 0 or (knots is not None and inner != len(knots)):
            given = "" if knots is None else f" and {len(knots)} inner knots"
            need = degree + 1 + (0 if knots is None else len(knots))
            raise ValueError(
                f"bspline: `{name}` asks for {count} splines of degree {degree}{given}, need "
                f"{need}{' or more' if knots is None else ''}. Change the count or `degree`."
            )
        own = np.arange(1, inner + 1) / (inner + 1) if knots is None else knots
        basis[name] = BSpline(knots=tuple(float(k) for k in own), degree=degree)
    return StrainBasis(basis)

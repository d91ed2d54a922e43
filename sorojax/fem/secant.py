"""Quasi-Newton steps: a kept factor, corrected by what the last iterations taught.

A contact that closes or opens changes the tangent by little in rank. The BFGS updates of an
old factor follow it for one back-substitution and a few scalar products each.

References:
    Matthies, Strang, "The solution of nonlinear finite element equations", Int. J. Num.
    Meth. Eng. 14, 1979.
    Nocedal, Wright, Numerical Optimization, 2006, algorithm 7.4.
"""

from collections import deque

import numpy as np
from jaxtyping import Float

from sorojax.math.sparse import Factor

_MOST = 12
_FLAT = 1e-12  # curvature along a pair, over the product of the norms, to be of use

Vector = Float[np.ndarray, " dofs"]


class Secants:
    """Pairs of steps [m] and changes of the residual [N], the newest last."""

    def __init__(self):
        self._pairs: deque[tuple[Vector, Vector, float]] = deque(maxlen=_MOST)

    def clear(self) -> None:
        self._pairs.clear()

    def add(self, move: Vector, change: Vector) -> None:
        """Learn from a step, unless the energy curves downwards along it."""
        curvature = float(move @ change)
        if curvature > _FLAT * float(np.sqrt((move @ move) * (change @ change))):
            self._pairs.append((move, change, 1 / curvature))

    def solve(self, factor: Factor, rhs: Vector) -> Vector:
        """The step for `rhs`: that of `factor` where no pair knows better."""
        rest, shares = rhs.copy(), []
        for move, change, scale in reversed(self._pairs):
            share = scale * float(move @ rest)
            rest -= share * change
            shares.append(share)
        step = factor.solve(rest)
        for (move, change, scale), share in zip(self._pairs, reversed(shares), strict=True):
            step += (share - scale * float(change @ step)) * move
        return step

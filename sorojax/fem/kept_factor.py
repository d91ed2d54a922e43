"""When the factor of an earlier iteration solves for a step of Newton's method."""

import numpy as np
from jaxtyping import Bool, Float

from sorojax.fem.linear import Neighbour
from sorojax.math import sparse

#: Movements of the body, relative to its displacement, since the factor was made: within the
#: first the tangent has the signs of its eigenvalues, up to the second a probe asks for them.
_SAME, _NEAR = 1e-3, 0.1
#: Unknowns from which on a factor costs much more than the back-substitutions, without and
#: with a probe; in 3-D factors are dense.
_WORTH, _WORTH_PROBING, _WORTH_PROBING_3D = 2_000, 60_000, 6_000
_SHARE = 0.03  # of the tolerance of the residual that an inexact step may leave
_QUADRATIC = 3e-3  # error of a step that Newton's own exceeds, relative to residual over load


class KeptFactor:
    """The last factor of one solve, and the displacement [m] that it belongs to."""

    def __init__(self, known: Bool[np.ndarray, " dofs"], dim: int, tolerance: float):
        size = known.size
        least = _WORTH_PROBING_3D if dim == 3 else _WORTH_PROBING
        self._reach = _NEAR if size >= least else _SAME if size >= _WORTH else 0.0
        self._known, self._tolerance = known, tolerance
        self._factor: sparse.Factor | None = None
        self._u = self._probe = np.zeros(0)

    def renew(self, factor: sparse.Factor | None, u: Float[np.ndarray, "nodes dim"]) -> None:
        """Keep `factor` of the tangent at `u`, if it is one of a stable state."""
        if factor is not None and self._reach > 0:
            self._factor = factor if factor.negative_eigenvalues == 0 else None
            self._u, self._probe = u, np.zeros(0)

    def near(
        self, u: Float[np.ndarray, "nodes dim"], ratio: float, size: float
    ) -> Neighbour | None:
        """What to solve with at `u`, where the residual is `ratio` of the load and the last
        step was `size` of the displacement; 0 where no eigenvalues are asked for."""
        if self._factor is None or not 0 < ratio < np.inf:
            return None
        largest = np.abs(u).max()
        moved = np.abs(u - self._u).max()
        if not moved <= self._reach * largest:
            return None
        start = None
        if (
            size > 0 and moved > _SAME * largest
        ):  # as large as the step to come, and in every mode
            start = size * size * largest * self._modes(self._factor)
        tolerance = max(min(_SHARE * self._tolerance / ratio, 1e-2), _QUADRATIC * ratio)
        return Neighbour(self._factor, start, min(tolerance, 1e-2))

    def _modes(self, factor: sparse.Factor) -> np.ndarray:
        """A displacement in which soft modes are large, one at most."""
        if not self._probe.size:
            random = np.random.default_rng(0).standard_normal(self._known.size)
            probe = factor.solve(np.where(self._known, 0.0, random))
            self._probe = probe / np.abs(probe).max()
        return self._probe

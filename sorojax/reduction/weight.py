"""The weight of a solid on the rod that stands in for it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import Numbers, real
from sorojax.fem.mass import lumped_mass
from sorojax.fem.problem import Problem
from sorojax.reduction.curve import Line
from sorojax.rod import AbstractForce, points

_STATIONS = 24


class OffsetWeight(AbstractForce):
    """Weight of a planar rod whose mass lies beside its line, evenly along it.

    Attributes:
        mass: In all [kg].
        arm: From the line to the mass, along the second director [m].
        acceleration: [m/s^2].
    """

    mass: Float[Array, ""] = eqx.field(converter=real)
    arm: Float[Array, ""] = eqx.field(converter=real)
    acceleration: Float[Array, "2"] = eqx.field(converter=real)

    def __call__(self, t, motion):
        at = points(motion, (np.arange(_STATIONS) + 0.5) / _STATIONS)
        away = self.arm * at.directors[:, :, 1]
        load = jnp.broadcast_to(self.mass / _STATIONS * self.acceleration, away.shape)
        turn = away[:, 0] * load[:, 1] - away[:, 1] * load[:, 0]
        return at.generalised(load, turn[:, None])


def offset_weight(problem: Problem, line: Line, acceleration: Numbers) -> OffsetWeight:
    """The weight of a planar solid about a straight line in it.

    Args:
        problem: The solid, with a density.
        line: Of the rod.
        acceleration: Of gravity [m/s^2].
    """
    shares = np.asarray(lumped_mass(problem)).reshape(-1, 2)[:, 0]
    start, end = np.asarray(line.start), np.asarray(line.end)
    along = (end - start) / np.linalg.norm(end - start)
    middle = shares @ np.asarray(problem.mesh.points) / shares.sum() - start
    return OffsetWeight(shares.sum(), along[0] * middle[1] - along[1] * middle[0], acceleration)

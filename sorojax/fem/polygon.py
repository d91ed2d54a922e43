"""Sums over polygons that their quadrature has to get right.

The shape functions of a polygon are rational, so no rule integrates them exactly. Corrected
by integrals over its straight sides a linear displacement is an equilibrium.

Reference: Talischi, Pereira, Menezes, Paulino, "Gradient correction for polygonal and
polyhedral finite elements", IJNME 102, 2015.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric


class PolygonSums(NamedTuple):
    """Area [m^2], first moments [m^3] and, by axis, the integrals of each shape function
    times the normal over the sides of a polygon.

    In a body of revolution area and sides are weighted by the radius, `measure` [m^3] and
    `sides` [m^2], as the volumes of its points are.
    """

    area: Float[Array, "1 lanes"]
    moments: Float[Array, "2 1 lanes"]
    measure: Float[Array, "1 lanes"]
    sides: tuple[Float[Array, "cell_nodes lanes"], Float[Array, "cell_nodes lanes"]]
    revolved: bool

    def hoop(self, axis: int) -> float:
        """Share of the shape functions themselves in the mean slope: r N has the slope
        r dN/dr + N."""
        return 1.0 if self.revolved and axis == 0 else 0.0

    def shares(self, position, areas):
        """Weights of the points of a cell in the mean slope; they add up to one."""
        return areas * (position[0] if self.revolved else 1.0) / self.measure


def polygon_sums(
    x: Float[Array, "2 cell_nodes lanes"],
    kinds: Int[Array, " lanes"],
    kinematics: AbstractKinematics,
) -> PolygonSums:
    """Sums of polygons with `kinds` corners; further entries of `x` are repeats."""
    number = jnp.arange(x.shape[1])[:, None]
    count = kinds[None]
    ahead = jnp.where(number + 1 < count, number + 1, jnp.zeros_like(number))
    behind = jnp.where(number > 0, number - 1, count - 1)
    after, before = (jnp.take_along_axis(x, at[None], axis=1) for at in (ahead, behind))
    real = number < count
    zero = jnp.zeros_like(x[0])
    turn = jnp.where(real, x[0] * after[1] - x[1] * after[0], zero) / 2
    area = jnp.sum(turn, axis=0, keepdims=True)
    moments = jnp.sum(turn[None] * (x + after), axis=1, keepdims=True) / 3
    revolved = isinstance(kinematics, Axisymmetric)
    one = jnp.ones_like(zero)
    # mean of radius times shape function over the side ahead and the one behind
    here, there = (
        ((2 * x[0] + other[0]) / 6 if revolved else one / 2) for other in (after, before)
    )
    side = [
        jnp.where(real, here * (after - x)[k] + there * (x - before)[k], zero) for k in range(2)
    ]
    measure = moments[0] if revolved else area
    return PolygonSums(area, moments, measure, (side[1], -side[0]), revolved)


def exact_areas(
    sums: PolygonSums,
    position: Float[Array, "2 quad lanes"],
    areas: Float[Array, "quad lanes"],
) -> Float[Array, "quad lanes"]:
    """Areas of the points of a cell with the sum of the polygon; in a body of revolution
    with its first moments too."""
    areas = areas * (sums.area / jnp.sum(areas, axis=0, keepdims=True))
    if not sums.revolved:
        return areas
    centre = jnp.sum(areas[None] * position, axis=1, keepdims=True) / sums.area[None]
    away = position - centre
    a, b, d = (
        jnp.sum(areas * away[i] * away[k], axis=0, keepdims=True)
        for i, k in ((0, 0), (0, 1), (1, 1))
    )
    p, q = sums.moments - sums.area[None] * centre
    det = a * d - b * b
    tilt = ((d * p - b * q) / det, (a * q - b * p) / det)
    return areas * (1 + tilt[0] * away[0] + tilt[1] * away[1])

"""The planar actuator: two round bellows side by side between two plates."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.robots.parts import Bellows, Placed, pipe
from sorojax.sdf import AbstractSdf, Box
from sorojax.units import mm


@displayed
class PlanarActuator(eqx.Module):
    """Dimensions [m]; the bellows stand along z at x = -spacing/2 and spacing/2.

    Unequal pressures bend it in the plane of x and z, equal ones stretch it; it takes
    -10 to 50 kPa. Each bellows has a port of its own through the lower plate.
    """

    bellows: Bellows = eqx.field(default_factory=Bellows)
    spacing: Float[Array, ""] = eqx.field(converter=real, default=26 * mm)
    plate_thickness: Float[Array, ""] = eqx.field(converter=real, default=4 * mm)
    port_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)

    def __check_init__(self):
        for name in ("spacing", "plate_thickness", "port_radius"):
            _check.between(
                "PlanarActuator", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip
        if _check.is_concrete(self.spacing) and _check.is_concrete(self.bellows.outer_radius):
            between = float(self.spacing - 2 * self.bellows.outer_radius)
            if between <= 0:
                raise ValueError(
                    f"PlanarActuator: the bellows overlap by {-between * 1e3:.3g} mm, need a "
                    "gap. Make `spacing` larger than two outer radii."
                )

    def _both(self, part: AbstractSdf) -> AbstractSdf:
        sides = jnp.stack([-self.spacing / 2, self.spacing / 2])
        zero = jnp.zeros_like(sides)
        return Placed(part, zero, jnp.stack([sides, zero, zero], axis=-1))

    def chambers(self) -> AbstractSdf:
        """The air of both bellows with their ports."""
        b, zero = self.bellows, jnp.zeros_like(self.spacing)
        start = jnp.stack([zero, zero, -2 * self.plate_thickness])
        port = pipe(self.port_radius, start, 2 * self.plate_thickness + b.cap + b.pitch / 2, 2)
        return self._both(b.chamber() | port)

    def plates(self) -> AbstractSdf:
        """The two end plates, each overlapping half a cap."""
        b, t = self.bellows, self.plate_thickness
        x, y = self.spacing / 2 + b.outer_radius, b.outer_radius
        low, high = -t + b.cap / 2, b.length + t - b.cap / 2
        return Box([-x, -y, low], [x, y, b.cap / 2], self.fillet) | Box(
            [-x, -y, b.length - b.cap / 2], [x, y, high], self.fillet
        )

    def body(self) -> AbstractSdf:
        """What is printed."""
        return (self._both(self.bellows.solid()) | self.plates()) - self.chambers()

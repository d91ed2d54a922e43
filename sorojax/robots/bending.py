"""The bending actuator: a row of box-shaped bellows on a layer that does not stretch."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.robots.parts import pipe
from sorojax.sdf import AbstractSdf, Box, repeat
from sorojax.units import mm


@displayed
class BendingActuator(eqx.Module):
    """Dimensions [m]; x runs along the actuator, z points from its base to its bellows.

    One channel through necks between the bellows joins all chambers and opens at the end
    x = 0. Every wall of the air is `wall_thickness` or more. Printed in an 80 Shore A
    elastomer it takes -10 to 100 kPa.
    """

    width: Float[Array, ""] = eqx.field(converter=real, default=20 * mm)
    height: Float[Array, ""] = eqx.field(converter=real, default=18 * mm)
    base: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    pitch: Float[Array, ""] = eqx.field(converter=real, default=10 * mm)
    gap: Float[Array, ""] = eqx.field(converter=real, default=1.6 * mm)
    wall_thickness: Float[Array, ""] = eqx.field(converter=real, default=1.6 * mm)
    channel_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=0.8 * mm)
    num_bellows: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        for name in ("width", "height", "base", "pitch", "gap", "wall_thickness"):
            _check.between(
                "BendingActuator", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip
        if _check.is_concrete(self.pitch) and _check.is_concrete(self.wall_thickness):
            hollow = float(self.pitch - self.gap - 2 * self.wall_thickness)
            if hollow <= 0:
                raise ValueError(
                    f"BendingActuator: chambers are {hollow * 1e3:.3g} mm long, need above "
                    "zero. Make `wall_thickness` or `gap` smaller or `pitch` larger."
                )

    @property
    def length(self) -> Float[Array, ""]:
        return self.num_bellows * self.pitch

    def chambers(self) -> AbstractSdf:
        """The air: chambers, the channel that joins them and its opening."""
        w, side = self.wall_thickness, self.width / 2 - self.wall_thickness
        first = Box(
            [self.gap / 2 + w, -side, self.base + w],
            [self.pitch - self.gap / 2 - w, side, self.height - w],
        )
        zero = jnp.zeros_like(side)
        start = jnp.stack([-self.pitch, zero, self.base + w + self.channel_radius])
        channel = pipe(self.channel_radius, start, self.length + self.pitch / 2, 0)
        return repeat(first, [self.pitch, 0.0, 0.0], self.num_bellows, separate=True) | channel

    def solid(self) -> AbstractSdf:
        """The actuator without its hollows."""
        half, zero = self.width / 2, jnp.zeros_like(self.width)
        block = Box(
            [self.gap / 2, -half, zero], [self.pitch - self.gap / 2, half, self.height],
            self.fillet,
        )  # fmt: skip
        slab = Box([zero, -half, zero], [self.length, half, self.base], self.fillet)
        quarter, w = self.width / 4, self.wall_thickness
        neck = Box(
            [self.gap / 2, -quarter, self.base / 2],
            [self.length - self.gap / 2, quarter, self.base + 2 * (w + self.channel_radius)],
        )
        row = repeat(block, [self.pitch, 0.0, 0.0], self.num_bellows, separate=True)
        return row | slab | neck

    def body(self) -> AbstractSdf:
        """What is printed."""
        return self.solid() - self.chambers()

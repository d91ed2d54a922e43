"""A soft finger: a round bellows with a spine on one side and a rounded tip."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.robots.parts import Bellows
from sorojax.sdf import AbstractSdf, Box, Sphere, translate
from sorojax.units import mm


@displayed
class Finger(eqx.Module):
    """Dimensions [m]; it stands on z = 0 and bends towards its spine at -x."""

    bellows: Bellows = eqx.field(default_factory=lambda: Bellows(
        outer_radius=9 * mm, inner_radius=5.6 * mm, pitch=8 * mm, fold_height=4.8 * mm,
        wall_thickness=1.2 * mm, cap=2.5 * mm, fillet=1.2 * mm, num_folds=9,
    ))  # fmt: skip
    tip_radius: Float[Array, ""] = eqx.field(converter=real, default=7.5 * mm)
    spine_width: Float[Array, ""] = eqx.field(converter=real, default=9 * mm)
    spine_thickness: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)

    def __check_init__(self):
        for name in ("tip_radius", "spine_width", "spine_thickness"):
            _check.between(
                "Finger", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip

    @property
    def length(self) -> Float[Array, ""]:
        """From the foot to the end of the tip."""
        return self.bellows.length + self.tip_radius

    def chamber(self) -> AbstractSdf:
        """The air in the bellows."""
        return self.bellows.chamber()

    def solid(self) -> AbstractSdf:
        """The finger without its hollow."""
        b, zero = self.bellows, jnp.zeros_like(self.tip_radius)
        tip = translate(
            Sphere([0.0, 0.0, 0.0], self.tip_radius), jnp.stack([zero, zero, b.length])
        )
        half = self.spine_width / 2
        outside = -b.outer_radius - self.spine_thickness / 3
        end = b.length - b.cap - b.pitch / 2
        spine = Box(
            [outside, -half, zero], [outside + self.spine_thickness, half, end],
            self.spine_thickness / 4,
        )  # fmt: skip
        return b.solid() | tip | spine

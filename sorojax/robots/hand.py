"""The hand: a palm with five soft fingers, each with an air supply of its own."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.robots.finger import Finger
from sorojax.robots.parts import Bellows, LaidAlong, Placed, pipe
from sorojax.sdf import AbstractSdf, Box, rotate, translate
from sorojax.units import deg, mm


@displayed
class Hand(eqx.Module):
    """Dimensions [m] and angles [rad] of a left hand, palm down, fingers along y.

    About 190 x 100 x 40 mm: fingers of 90 mm, a thumb of 80 mm. The fingers bend towards
    -z and take -10 to 60 kPa; their ports open on the back of the hand.
    """

    finger: Finger = eqx.field(default_factory=lambda: Finger(bellows=Bellows(
        outer_radius=9 * mm, inner_radius=5.6 * mm, pitch=8.6 * mm, fold_height=5 * mm,
        wall_thickness=1.2 * mm, cap=2.5 * mm, fillet=1.2 * mm, num_folds=9,
    ), tip_radius=7.6 * mm))  # fmt: skip
    thumb: Finger = eqx.field(default_factory=lambda: Finger(bellows=Bellows(
        outer_radius=9 * mm, inner_radius=5.6 * mm, pitch=8.4 * mm, fold_height=5 * mm,
        wall_thickness=1.2 * mm, cap=2.5 * mm, fillet=1.2 * mm, num_folds=8,
    ), tip_radius=7.8 * mm))  # fmt: skip
    palm_width: Float[Array, ""] = eqx.field(converter=real, default=90 * mm)
    palm_length: Float[Array, ""] = eqx.field(converter=real, default=114 * mm)
    palm_thickness: Float[Array, ""] = eqx.field(converter=real, default=26 * mm)
    palm_fillet: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    socket_depth: Float[Array, ""] = eqx.field(converter=real, default=14 * mm)
    finger_spacing: Float[Array, ""] = eqx.field(converter=real, default=22.5 * mm)
    splay: Float[Array, ""] = eqx.field(converter=real, default=2 * deg)
    thumb_angle: Float[Array, ""] = eqx.field(converter=real, default=50 * deg)
    thumb_height: Float[Array, ""] = eqx.field(converter=real, default=40 * mm)
    port_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)

    def __check_init__(self):
        for name in ("palm_width", "palm_length", "palm_thickness", "finger_spacing"):
            _check.between(
                "Hand", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 90 * mm.",
            )  # fmt: skip

    def places(self) -> dict[str, tuple[Float[Array, "3"], Float[Array, ""]]]:
        """Where each finger has its foot [m], and its angle about z [rad]."""
        number = jnp.arange(4).astype(self.palm_width.dtype) - 1.5
        zero = jnp.zeros_like(self.palm_width)
        foot = self.palm_length - self.socket_depth
        side = self.palm_width / 2 - self.socket_depth
        found = {"thumb": (jnp.stack([side, self.thumb_height, zero]), -self.thumb_angle)}
        for k, name in ((3, "index"), (2, "middle"), (1, "ring"), (0, "little")):
            place = jnp.stack([number[k] * self.finger_spacing, foot, zero])
            found[name] = (place, -number[k] * self.splay)
        return found

    def _each(self, finger_part: AbstractSdf, thumb_part: AbstractSdf) -> AbstractSdf:
        """Parts of a standing finger and thumb, where the five of them belong."""
        places = self.places()
        place, angle = places.pop("thumb")
        feet, angles = (jnp.stack(column) for column in zip(*places.values(), strict=True))
        # Laid along y, the spine of a standing finger comes to lie at -z.
        fingers = Placed(LaidAlong(finger_part, 1), angles, feet)
        return fingers | translate(rotate(LaidAlong(thumb_part, 1), angle), place)

    def fingers(self) -> AbstractSdf:
        """The four fingers and the thumb without their hollows."""
        return self._each(self.finger.solid(), self.thumb.solid())

    def palm(self) -> AbstractSdf:
        """The base that holds the fingers."""
        x, z = self.palm_width / 2, self.palm_thickness / 2
        zero = jnp.zeros_like(x)
        return Box([-x, zero, -z], [x, self.palm_length, z], self.palm_fillet)

    def _supply(self, finger: Finger) -> AbstractSdf:
        """Chamber of an upright finger and its port, which leaves towards +x."""
        foot = finger.bellows.cap + finger.bellows.pitch / 2
        zero = jnp.zeros_like(foot)
        port = pipe(self.port_radius, jnp.stack([zero, zero, foot]), self.palm_thickness, 0)
        return finger.chamber() | port

    def chambers(self) -> AbstractSdf:
        """The air of all fingers with their ports."""
        return self._each(self._supply(self.finger), self._supply(self.thumb))

    def body(self) -> AbstractSdf:
        """What is printed, in one piece."""
        return (self.palm() | self.fingers()) - self.chambers()

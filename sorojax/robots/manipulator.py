"""The manipulator: three round bellows around a hollow core, with a three-finger gripper."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.robots.finger import Finger
from sorojax.robots.parts import Bellows, Placed, pipe
from sorojax.sdf import AbstractSdf, translate, union
from sorojax.sdf.solids import Cylinder, Torus
from sorojax.units import mm


@displayed
class Manipulator(eqx.Module):
    """Dimensions [m]; it stands along z, its gripper on top.

    Each bellows has a port through the lower plate and takes -10 to 30 kPa. A ring in the
    upper plate feeds the gripper (-30 to 60 kPa) from the hollow core, which also holds
    cables. The gripper closes around objects of 40 mm.
    """

    bellows: Bellows = eqx.field(default_factory=lambda: Bellows(
        outer_radius=13 * mm, inner_radius=8 * mm, num_folds=9,
    ))  # fmt: skip
    finger: Finger = eqx.field(default_factory=lambda: Finger(bellows=Bellows(
        outer_radius=8 * mm, inner_radius=5 * mm, pitch=8 * mm, fold_height=4.8 * mm,
        wall_thickness=1.2 * mm, cap=2.5 * mm, fillet=1.2 * mm, num_folds=5,
    ), tip_radius=6.5 * mm))  # fmt: skip
    center_distance: Float[Array, ""] = eqx.field(converter=real, default=20 * mm)
    finger_distance: Float[Array, ""] = eqx.field(converter=real, default=28 * mm)
    plate_radius: Float[Array, ""] = eqx.field(converter=real, default=37 * mm)
    plate_thickness: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    core_radius: Float[Array, ""] = eqx.field(converter=real, default=4 * mm)
    port_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)

    def __check_init__(self):
        for name in ("center_distance", "finger_distance", "plate_radius", "core_radius"):
            _check.between(
                "Manipulator", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 20 * mm.",
            )  # fmt: skip
        radius = self.bellows.outer_radius
        if _check.is_concrete(self.center_distance) and _check.is_concrete(radius):
            between = float(self.center_distance * 3**0.5 - 2 * radius)
            if between <= 0:
                raise ValueError(
                    f"Manipulator: the bellows overlap by {-between * 1e3:.3g} mm, need a gap. "
                    "Make `center_distance` larger or the bellows thinner."
                )

    @property
    def length(self) -> Float[Array, ""]:
        """Height of the upper plate's upper side."""
        return self.bellows.length - self.bellows.cap / 2 + self.plate_thickness

    @property
    def finger_foot(self) -> Float[Array, ""]:
        """Height of the feet of the fingers: half of their caps lies in the plate."""
        return self.length - self.finger.bellows.cap / 2

    def _around(self, part: AbstractSdf, distance, height, phase: float) -> AbstractSdf:
        """Three copies of `part`, moved outwards along x and up, then turned about z."""
        angles = real(phase + 2 * np.pi / 3 * np.arange(3))
        up = jnp.zeros_like(angles) + height
        offsets = [distance * jnp.cos(angles), distance * jnp.sin(angles), up]
        return Placed(part, angles, jnp.stack(offsets, axis=-1))

    def _bellows_air(self) -> AbstractSdf:
        b, t = self.bellows, self.plate_thickness
        zero = jnp.zeros_like(t)
        port = pipe(self.port_radius, jnp.stack([zero, zero, -2 * t]), 2 * t + 2 * b.cap, 2)
        return self._around(b.chamber() | port, self.center_distance, 0.0, 0.0)

    def _gripper_air(self) -> AbstractSdf:
        """Chambers of the fingers, the ring below them and its way to the core."""
        cap, zero = self.finger.bellows.cap, jnp.zeros_like(self.core_radius)
        ring_height = self.length - self.plate_thickness / 2
        ring = translate(
            Torus(self.finger_distance, self.port_radius), jnp.stack([zero, zero, ring_height])
        )
        down = ring_height - self.finger_foot
        riser = pipe(self.port_radius, jnp.stack([zero, zero, down]), 2 * cap - down, 2)
        fingers = self._around(
            self.finger.chamber() | riser, self.finger_distance, self.finger_foot, np.pi / 3
        )
        inlet = pipe(
            self.port_radius, jnp.stack([zero, zero, ring_height]), self.finger_distance, 0
        )
        return fingers | ring | inlet

    def chambers(self) -> AbstractSdf:
        """The air of the bellows and of the gripper with their ports."""
        return self._bellows_air() | self._gripper_air()

    def plates(self) -> AbstractSdf:
        """The two end plates; half of each outer cap lies in them."""
        t, zero = self.plate_thickness, jnp.zeros_like(self.plate_thickness)
        plate = Cylinder(self.plate_radius, t, self.fillet)
        low, high = self.bellows.cap / 2 - t / 2, self.length - t / 2
        return union(*(translate(plate, jnp.stack([zero, zero, z])) for z in (low, high)))

    def body(self) -> AbstractSdf:
        """What is printed."""
        zero = jnp.zeros_like(self.core_radius)
        bellows = self._around(self.bellows.solid(), self.center_distance, 0.0, 0.0)
        fingers = self._around(
            self.finger.solid(), self.finger_distance, self.finger_foot, np.pi / 3
        )
        below = jnp.stack([zero, zero, -2 * self.plate_thickness])
        core = pipe(self.core_radius, below, self.length + 4 * self.plate_thickness, 2)
        return (bellows | fingers | self.plates()) - core - self.chambers()

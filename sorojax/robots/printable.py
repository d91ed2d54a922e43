"""Printable robots: round bellows, finger, hand, manipulator, planar and bending actuator."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.sdf import (
    AbstractSdf,
    Box,
    Rectangle,
    SmoothUnion,
    Sphere,
    offset,
    repeat,
    rotate,
    translate,
    union,
)
from sorojax.sdf.base import minimum
from sorojax.sdf.operations.booleans import hull
from sorojax.sdf.operations.lift import revolve
from sorojax.sdf.operations.transform import AbstractWrapped
from sorojax.sdf.shapes.solid import Cylinder, Torus
from sorojax.units import deg, mm

# Parts that the printable robots share: round bellows, and shapes laid along an axis.


def check_metres(robot: eqx.Module, *names: str) -> None:
    """Raise a `ValueError` unless the named lengths are above zero and below a metre."""
    for name in names:
        do = "Lengths are in metres: write 2 * mm."
        _check.between(type(robot).__name__, name, getattr(robot, name), 0.0, 1.0, "m", do)


@displayed
class Bellows(eqx.Module):
    """A round bellows standing on z = 0, closed at both ends [m].

    `num_folds` folds of `outer_radius` stand `pitch` apart on a tube of `inner_radius`;
    each is `fold_height` high, and `fillet` is the width over which it blends into the tube;
    the wall is at least `wall_thickness` everywhere, the ends are `cap` thick.
    """

    outer_radius: Float[Array, ""] = eqx.field(converter=real, default=12 * mm)
    inner_radius: Float[Array, ""] = eqx.field(converter=real, default=7 * mm)
    pitch: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    fold_height: Float[Array, ""] = eqx.field(converter=real, default=4.8 * mm)
    wall_thickness: Float[Array, ""] = eqx.field(converter=real, default=1.2 * mm)
    cap: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    num_folds: int = eqx.field(static=True, default=7)

    def __check_init__(self):
        check_metres(self, "outer_radius", "inner_radius", "pitch", "wall_thickness", "cap")
        do = "Choose `fold_height` between two walls and the pitch."
        hollow = self.fold_height - 2 * self.wall_thickness
        _check.positive("Bellows", "fold_height - 2 wall_thickness", hollow, "m", do)
        apart = self.pitch - self.fold_height
        _check.positive("Bellows", "pitch - fold_height", apart, "m", do)

    @property
    def length(self) -> Float[Array, ""]:
        return self.num_folds * self.pitch + 2 * self.cap

    def _profile(self) -> AbstractSdf:
        """Half section and its mirror image: x is the radius, y the height."""
        middle = self.cap + self.pitch / 2
        half = self.fold_height / 2
        fold = Rectangle(
            [-self.outer_radius, middle - half], [self.outer_radius, middle + half], 0.9 * half
        )
        zero = jnp.zeros_like(self.length)
        tube = Rectangle([-self.inner_radius, zero], [self.inner_radius, self.length])
        folds = repeat(fold, [0.0, self.pitch], self.num_folds, separate=True)
        return SmoothUnion(folds, tube, self.fillet)

    def solid(self) -> AbstractSdf:
        """The bellows without its hollow."""
        return revolve(self._profile())

    def chamber(self) -> AbstractSdf:
        """The hollow."""
        wide = 2 * self.outer_radius
        between = Rectangle([-wide, self.cap], [wide, self.length - self.cap])
        return revolve(offset(self._profile(), -self.wall_thickness) & between)


class LaidAlong(AbstractWrapped):
    """`shape` turned so that its z axis lies along `axis` (0: x, 1: y) of the world."""

    shape: AbstractSdf
    axis: int = eqx.field(static=True)

    @property
    def exactness(self):
        return self.shape.exactness

    def distance(self, *x):
        return self.shape.distance(*(x[(self.axis + 1 + i) % 3] for i in range(3)))

    def level_box(self, level):
        lower, upper = self.shape.level_box(level)
        return jnp.roll(lower, self.axis + 1), jnp.roll(upper, self.axis + 1)


class Placed(AbstractWrapped):
    """Copies of `shape`, each turned about z by an angle [rad] and then moved [m].

    One evaluation over a leading axis: the program stays as small as one copy.
    """

    shape: AbstractSdf
    angles: Float[Array, " copies"] = eqx.field(converter=real)
    offsets: Float[Array, "copies 3"] = eqx.field(converter=real)

    def distance(self, x, y, z):
        wide = (-1,) + (1,) * x.ndim
        c, s = jnp.cos(self.angles).reshape(wide), jnp.sin(self.angles).reshape(wide)
        dx, dy, dz = (
            a[None] - self.offsets[:, i].reshape(wide) for i, a in enumerate((x, y, z))
        )
        copies = self.shape.distance(c * dx + s * dy, c * dy - s * dx, dz)
        return functools.reduce(minimum, (copies[k] for k in range(len(self.angles))))

    def level_box(self, level):
        copies = [
            translate(rotate(self.shape, a), o).level_box(level)
            for a, o in zip(self.angles, self.offsets, strict=True)
        ]
        return hull(copies, jnp.minimum, jnp.maximum)


def pipe(radius, start, length, axis: int) -> AbstractSdf:
    """A cylinder [m] from `start` that runs `length` along `axis`, backwards if negative."""
    start, length = real(start), real(length)
    upright = Cylinder(radius, jnp.abs(length))
    turned = upright if axis == 2 else LaidAlong(upright, axis)
    along = jnp.zeros(3, start.dtype).at[axis].set(length / 2)
    return translate(turned, start + along)


# A soft finger: a round bellows with a spine on one side and a rounded tip.


_slim = functools.partial(
    Bellows, outer_radius=9 * mm, inner_radius=5.6 * mm, cap=2.5 * mm, fillet=1.2 * mm
)


@displayed
class Finger(eqx.Module):
    """Dimensions [m]; it stands on z = 0 and bends towards its spine at -x.

    Attributes:
        bellows: What bends.
        tip_radius: Of the ball at its end.
        spine_width, spine_thickness: Of the bar along its folds, along y and x.
    """

    bellows: Bellows = eqx.field(default_factory=lambda: _slim(num_folds=9))
    tip_radius: Float[Array, ""] = eqx.field(converter=real, default=7.5 * mm)
    spine_width: Float[Array, ""] = eqx.field(converter=real, default=9 * mm)
    spine_thickness: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)

    def __check_init__(self):
        check_metres(self, "tip_radius", "spine_width", "spine_thickness")

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
            [outside, -half, zero],
            [outside + self.spine_thickness, half, end],
            self.spine_thickness / 4,
        )
        return b.solid() | tip | spine

    def along_x(self) -> AbstractSdf:
        """The solid finger from the origin along x, as rods carry it: a positive curvature
        about z bends it towards its spine, which lies at +y."""
        return LaidAlong(rotate(self.solid(), np.pi), 0)


# The hand: a palm with five soft fingers, each with an air supply of its own


@displayed
class Hand(eqx.Module):
    """Dimensions [m] and angles [rad] of a left hand, palm down, fingers along y.

    About 190 x 100 x 40 mm: fingers of 90 mm, a thumb of 80 mm. The fingers bend towards
    -z and take -10 to 60 kPa; their ports open on the back of the hand.

    Attributes:
        finger, thumb: Each of the four fingers, and the thumb.
        palm_width, palm_length, palm_thickness: Of the palm along x, y and z.
        palm_fillet: Radius of its edges.
        socket_depth: How deep the feet of all five lie in the palm.
        finger_spacing: From one finger to the next.
        splay: Angle between neighbouring fingers.
        thumb_angle: Between thumb and y.
        thumb_height: Where its foot is, along y.
        port_radius: Of the ports of the chambers.
    """

    finger: Finger = eqx.field(
        default_factory=lambda: Finger(
            bellows=_slim(pitch=8.6 * mm, fold_height=5 * mm, num_folds=9), tip_radius=7.6 * mm
        )
    )
    thumb: Finger = eqx.field(
        default_factory=lambda: Finger(
            bellows=_slim(pitch=8.4 * mm, fold_height=5 * mm, num_folds=8), tip_radius=7.8 * mm
        )
    )
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
        check_metres(self, "palm_width", "palm_length", "palm_thickness", "finger_spacing")

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
        """The printed shape, in one piece."""
        return (self.palm() | self.fingers()) - self.chambers()


# The manipulator: three round bellows around a hollow core, with a three-finger gripper


@displayed
class Manipulator(eqx.Module):
    """Dimensions [m]; it stands along z, its gripper on top.

    Each bellows has a port through the lower plate and takes -10 to 30 kPa. A ring in the
    upper plate feeds the gripper (-30 to 60 kPa) from the hollow core, which also holds
    cables. The gripper closes around objects of 40 mm.

    Attributes:
        bellows, finger: Each of the three of the arm, and each of the three of its gripper.
        center_distance, finger_distance: From z to the axes of the bellows and of the fingers.
        plate_radius, plate_thickness: Of both plates.
        core_radius: Of the hole along z.
        port_radius: Of the ports, and of the ring and its inlets.
        fillet: Radius of the edges of the plates.
    """

    bellows: Bellows = eqx.field(
        default_factory=lambda: Bellows(outer_radius=13 * mm, inner_radius=8 * mm, num_folds=9)
    )
    finger: Finger = eqx.field(
        default_factory=lambda: Finger(
            bellows=_slim(outer_radius=8 * mm, inner_radius=5 * mm, num_folds=5),
            tip_radius=6.5 * mm,
        )
    )
    center_distance: Float[Array, ""] = eqx.field(converter=real, default=20 * mm)
    finger_distance: Float[Array, ""] = eqx.field(converter=real, default=28 * mm)
    plate_radius: Float[Array, ""] = eqx.field(converter=real, default=37 * mm)
    plate_thickness: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    core_radius: Float[Array, ""] = eqx.field(converter=real, default=4 * mm)
    port_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)

    def __check_init__(self):
        check_metres(self, "center_distance", "finger_distance", "plate_radius", "core_radius")
        between = self.center_distance * 3**0.5 - 2 * self.bellows.outer_radius
        do = "Or the bellows overlap: make `center_distance` larger or them thinner."
        _check.positive("Manipulator", "distance between bellows", between, "m", do)

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
        """The printed shape."""
        zero = jnp.zeros_like(self.core_radius)
        bellows = self._around(self.bellows.solid(), self.center_distance, 0.0, 0.0)
        fingers = self._around(
            self.finger.solid(), self.finger_distance, self.finger_foot, np.pi / 3
        )
        below = jnp.stack([zero, zero, -2 * self.plate_thickness])
        core = pipe(self.core_radius, below, self.length + 4 * self.plate_thickness, 2)
        return (bellows | fingers | self.plates()) - core - self.chambers()


# The planar actuator: two round bellows side by side between two plates


@displayed
class PlanarActuator(eqx.Module):
    """Dimensions [m]; the bellows stand along z at x = -spacing/2 and spacing/2.

    Unequal pressures bend it in the plane of x and z, equal ones stretch it; it takes
    -10 to 50 kPa. Each bellows has a port of its own through the lower plate.

    Attributes:
        bellows: Each of the two.
        spacing: Between their axes.
        plate_thickness: Of the two end plates.
        port_radius: Of the ports.
        fillet: Radius of the edges of the plates.
    """

    bellows: Bellows = eqx.field(default_factory=Bellows)
    spacing: Float[Array, ""] = eqx.field(converter=real, default=26 * mm)
    plate_thickness: Float[Array, ""] = eqx.field(converter=real, default=4 * mm)
    port_radius: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)

    def __check_init__(self):
        check_metres(self, "spacing", "plate_thickness", "port_radius")
        between = self.spacing - 2 * self.bellows.outer_radius
        do = "Or the bellows overlap: make `spacing` larger than two outer radii."
        _check.positive("PlanarActuator", "distance between bellows", between, "m", do)

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
        """The printed shape."""
        return (self._both(self.bellows.solid()) | self.plates()) - self.chambers()


# The bending actuator: a row of box-shaped bellows on a layer that does not stretch


@displayed
class BendingActuator(eqx.Module):
    """Dimensions [m]; x runs along the actuator, z points from its base to its bellows.

    One channel through necks between the bellows joins all chambers and opens at the end
    x = 0. Every wall of the air is `wall_thickness` or more. Printed in an 80 Shore A
    elastomer it takes -10 to 100 kPa.

    Attributes:
        width, height: Along y and z.
        base: Thickness of the layer below the bellows.
        pitch: From one bellows to the next.
        gap: Between the outsides of two.
        channel_radius: Of the channel.
        fillet: Radius of the outer edges.
        num_bellows: How many there are.
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
        check_metres(self, "width", "height", "base", "pitch", "gap", "wall_thickness")
        hollow = self.pitch - self.gap - 2 * self.wall_thickness
        do = "So long the chambers are: make walls or `gap` smaller or `pitch` larger."
        _check.positive("BendingActuator", "pitch - gap - 2 wall_thickness", hollow, "m", do)

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
            [self.gap / 2, -half, zero],
            [self.pitch - self.gap / 2, half, self.height],
            self.fillet,
        )
        slab = Box([zero, -half, zero], [self.length, half, self.base], self.fillet)
        quarter, w = self.width / 4, self.wall_thickness
        neck = Box(
            [self.gap / 2, -quarter, self.base / 2],
            [self.length - self.gap / 2, quarter, self.base + 2 * (w + self.channel_radius)],
        )
        row = repeat(block, [self.pitch, 0.0, 0.0], self.num_bellows, separate=True)
        return row | slab | neck

    def body(self) -> AbstractSdf:
        """The printed shape."""
        return self.solid() - self.chambers()

"""Plane bending actuators: bellows on a strain-limiting layer, and a PneuNet."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, fem, mesh
from sorojax._display import displayed
from sorojax._types import Numbers, real
from sorojax.material import AbstractHyperelastic
from sorojax.robots.printable import check_metres
from sorojax.sdf import AbstractSdf, HalfPlane, Rectangle, repeat
from sorojax.units import mm


@displayed
class BellowsActuator(eqx.Module):
    """Dimensions of the side view [m]; x runs along the actuator from its clamp.

    `num_bellows` bellows of `bellow_width` stand `gap` apart behind a solid block, `clamp`
    long. Each holds one chamber of `chamber_height` inside walls of `wall_thickness` and below
    a roof, `roof` thick; under the chambers lies a base, `base` thick, whose lowest
    `layer_thickness` is the strain-limiting layer. All concave and chamber corners are rounded
    by `fillet`. The defaults are those of a bending actuator of 66 x 15 mm with five bellows.
    """

    wall_thickness: Float[Array, ""] = eqx.field(converter=real, default=2 * mm)
    bellow_width: Float[Array, ""] = eqx.field(converter=real, default=10 * mm)
    gap: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    clamp: Float[Array, ""] = eqx.field(converter=real, default=4 * mm)
    base: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    chamber_height: Float[Array, ""] = eqx.field(converter=real, default=10 * mm)
    roof: Float[Array, ""] = eqx.field(converter=real, default=2 * mm)
    layer_thickness: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1 * mm)
    num_bellows: int = eqx.field(static=True, default=5)

    def __check_init__(self):
        check_metres(self, "wall_thickness", "bellow_width", "gap", "base", "roof", "fillet")
        left = self.bellow_width - 2 * self.wall_thickness - 2 * self.fillet
        name = "bellow_width - 2 wall_thickness - 2 fillet"
        do = "A chamber holds at least two fillets: thinner walls or wider bellows."
        _check.not_negative("BellowsActuator", name, left, "m", do)
        if self.num_bellows < 1:
            raise ValueError(
                f"BellowsActuator: got {self.num_bellows} bellows, need one or more."
            )

    @property
    def pitch(self) -> Float[Array, ""]:
        return self.bellow_width + self.gap

    @property
    def length(self) -> Float[Array, ""]:
        return self.clamp + self.num_bellows * self.pitch - self.gap

    @property
    def height(self) -> Float[Array, ""]:
        return self.base + self.chamber_height + self.roof

    def back(self, bellow: int) -> Float[Array, "2 2"]:
        """Both ends of the upper side of a bellow, counted from the clamp from 0 on [m]."""
        if not 0 <= bellow < self.num_bellows:
            raise ValueError(
                f"BellowsActuator.back: got bellow {bellow}, need 0 to {self.num_bellows - 1}. "
                "They count from the clamp."
            )
        left = self.clamp + bellow * self.pitch
        x = jnp.stack([left, left + self.bellow_width])
        return jnp.stack([x, jnp.broadcast_to(self.height, x.shape)], axis=1)

    def chambers(self) -> AbstractSdf:
        """The air chambers."""
        left = self.clamp + self.wall_thickness
        right = self.clamp + self.bellow_width - self.wall_thickness
        first = Rectangle(
            [left, self.base], [right, self.base + self.chamber_height], self.fillet
        )
        return repeat(first, [self.pitch, 0.0], self.num_bellows, separate=True)

    def notches(self) -> AbstractSdf:
        """The gaps between the bellows, open at the top."""
        left = self.clamp + self.bellow_width
        first = Rectangle([left, self.base], [left + self.gap, 2 * self.height], self.fillet)
        return repeat(first, [self.pitch, 0.0], self.num_bellows - 1, separate=True)

    def body(self) -> AbstractSdf:
        """The rubber."""
        zero = jnp.zeros_like(self.length)
        block = Rectangle([zero, zero], [self.length, self.height])
        return block - self.notches() - self.chambers()

    def layer(self) -> AbstractSdf:
        """The strain-limiting layer and everything below it."""
        return HalfPlane([0.0, self.layer_thickness], [0.0, 1.0])


# A PneuNet: upright air chambers between slots whose walls come to touch, on a thin layer.
#
# Reference: Mosadegh et al., "Pneumatic networks for soft robotics that actuate rapidly",
# Adv. Funct. Mater. 24, 2014.


@displayed
class PneuNet(eqx.Module):
    """Dimensions of the side view [m]; x runs along it from its clamp, y is 0 underneath.

    Narrow slots part the chambers above `notch`; under air neighbouring walls meet, and the
    upper side grows longer than the lower one. A flat strip goes on beyond the last chamber.
    The defaults are 117 x 20 mm with 14 chambers.

    Attributes:
        pitch: From one chamber to the next.
        first: Where the middle of the first one is, along x.
        chamber_width, slot_width: Of a chamber and of a slot, along x.
        layer: Height of the strain-limiting layer.
        floor, roof: Where chambers begin and end in height; the strip is as high as the floor.
        notch: Where slots begin in height.
        height: Of the whole.
        end: From the middle of the last chamber to the strip.
        strip: Length of the strip.
        num_chambers: How many there are.
    """

    pitch: Float[Array, ""] = eqx.field(converter=real, default=7.47 * mm)
    first: Float[Array, ""] = eqx.field(converter=real, default=7.2 * mm)
    chamber_width: Float[Array, ""] = eqx.field(converter=real, default=1.84 * mm)
    slot_width: Float[Array, ""] = eqx.field(converter=real, default=0.55 * mm)
    layer: Float[Array, ""] = eqx.field(converter=real, default=1.75 * mm)
    floor: Float[Array, ""] = eqx.field(converter=real, default=3.54 * mm)
    notch: Float[Array, ""] = eqx.field(converter=real, default=10.9 * mm)
    roof: Float[Array, ""] = eqx.field(converter=real, default=17.49 * mm)
    height: Float[Array, ""] = eqx.field(converter=real, default=20 * mm)
    end: Float[Array, ""] = eqx.field(converter=real, default=6.7 * mm)
    strip: Float[Array, ""] = eqx.field(converter=real, default=5.7 * mm)
    num_chambers: int = eqx.field(static=True, default=14)

    def __check_init__(self):
        check_metres(self, "pitch", "chamber_width", "slot_width", "height")
        walls = self.pitch - self.chamber_width - self.slot_width
        name, do = (
            "pitch - chamber_width - slot_width",
            "Widen the pitch, for walls above zero.",
        )
        _check.positive("PneuNet", name, walls, "m", do)
        levels = (0.0, self.layer, self.floor, self.notch, self.roof, self.height)
        do = "They have to be rising levels: order layer, floor, notch, roof and height."
        _check.positive("PneuNet", "steps between levels", jnp.diff(real(levels)), "m", do)
        if self.num_chambers < 2:
            raise ValueError(f"PneuNet: got {self.num_chambers} chambers, need two or more.")

    @property
    def length(self) -> Float[Array, ""]:
        """With the strip at its end [m]."""
        return self._last + self.strip

    @property
    def middles(self) -> Float[Array, " chambers"]:
        """Where the chambers are [m]."""
        return self.first + self.pitch * jnp.arange(self.num_chambers, dtype=self.pitch.dtype)

    @property
    def _last(self) -> Float[Array, ""]:
        return self.first + (self.num_chambers - 1) * self.pitch + self.end

    def chambers(self) -> AbstractSdf:
        """The air."""
        left = self.first - self.chamber_width / 2
        return self._row(left, self.chamber_width, self.floor, self.roof, self.num_chambers)

    def slots(self) -> AbstractSdf:
        """The gaps between the chambers, open at the top."""
        left = self.first + (self.pitch - self.slot_width) / 2
        top = 1.05 * self.height
        return self._row(left, self.slot_width, self.notch, top, self.num_chambers - 1)

    def _row(self, left, width, low, high, count: int) -> AbstractSdf:
        one = Rectangle(jnp.stack([left, low]), jnp.stack([left + width, high]))
        step = jnp.stack([self.pitch, jnp.zeros_like(self.pitch)])
        return repeat(one, step, count, separate=True)

    def body(self) -> AbstractSdf:
        """The rubber."""
        zero = jnp.zeros((2,), self.pitch.dtype)
        block = Rectangle(zero, jnp.stack([self._last, self.height]))
        foot = Rectangle(zero, jnp.stack([self.length, self.floor]))
        return (block | foot) - self.chambers() - self.slots()


def pneunet_mesh(pneunet: PneuNet) -> mesh.Mesh:
    """Quad8 cells between the lines of the drawing, two across a wall; region "layer".

    Args:
        pneunet: Its dimensions.

    Returns:
        The mesh, points [m].
    """
    x = np.asarray(pneunet.middles)
    half, pitch = float(pneunet.chamber_width) / 2, float(pneunet.pitch)
    slot, gap = x[:-1] + pitch / 2, float(pneunet.slot_width) / 2
    inner = [x + far for size in (half, pitch / 3.1) for far in (-size, size)]
    last, length = float(pneunet.first + x[-1] - x[0] + pneunet.end), float(pneunet.length)
    ends = [0.0, 0.43 * float(pneunet.first), last, length]
    layer, floor, notch, roof, height = (
        float(getattr(pneunet, name)) for name in ("layer", "floor", "notch", "roof", "height")
    )
    upper = np.linspace(notch, roof, 4)[1:], [(roof + height) / 2, height]
    y = np.concatenate([[0, layer], np.linspace(floor, notch, 4), *upper])
    lines = np.unique(np.concatenate([*inner, slot - gap, slot + gap, ends]))
    grid = mesh.between_lines(lines, y, element=mesh.Quad8())
    made = mesh.submesh(grid, mesh.cells_inside(grid, pneunet.body()))
    below = mesh.cells_where(made, lambda p: p[1] < layer)
    return mesh.Mesh(made.points, made.cells, made.element, regions={"layer": below})


# Both as boundary value problems on their side views


def bellows_problem(
    actuator: BellowsActuator | PneuNet,
    cells: mesh.Mesh,
    rubber: AbstractHyperelastic,
    *,
    depth: float = 20 * mm,
    gravity: Numbers | None = None,
    pushed: Sequence[int] = (),
    formulation: fem.Displacement | fem.LinearPressure | None = None,
) -> fem.Problem:
    """A bellows actuator or PneuNet as a boundary value problem on its side view.

    In plane strain, clamped at its left end, with a pressure called "air" [Pa] in all chambers.

    Args:
        actuator: Its dimensions [m]; concrete.
        cells: The mesh, of `mesh.triangulate(actuator.body(), ...)` or of `pneunet_mesh`.
        rubber: One material, or one with a value per cell.
        depth: Width across the plane of the side view [m].
        gravity: Acceleration (x, y) [m/s^2], a load called "gravity"; no weight by default.
        pushed: Numbers of bellows, counted from the clamp from 0 on, whose backs carry forces
            called "push_0", "push_2" and so on [N], zero to begin with; none by default, and
            none on a PneuNet.
        formulation: As of `fem.problem`, whose default it has.

    Returns:
        The problem.

    Raises:
        ValueError: If there is no such bellow, or as `fem.problem`.

    Example:
        >>> actuator = robots.BellowsActuator(num_bellows=2)
        >>> cells = mesh.enrich(mesh.triangulate(actuator.body(), size=3 * mm, order=2))
        >>> rubber = presets.dragon_skin_30()
        >>> problem = robots.bellows_problem(actuator, cells, rubber, pushed=[1])
        >>> [load.name for load in problem.loads]
        ['air', 'push_1']
    """
    if pushed and not isinstance(actuator, BellowsActuator):
        raise ValueError(
            f"bellows_problem: got pushed={list(pushed)} with a PneuNet, which has no bellows. "
            "Leave `pushed` out, and add a fem.Force on nodes of your own."
        )
    loads: list[Any] = [fem.Pressure(mesh.facets_on(cells, actuator.chambers()), name="air")]
    if gravity is not None:
        loads.append(fem.Gravity(gravity))
    for k in pushed:
        assert isinstance(actuator, BellowsActuator)
        nodes = mesh.nodes_on_line(cells, *actuator.back(k))
        loads.append(fem.Force(nodes, [0.0, 0.0], name=f"push_{k}"))
    clamped = mesh.nodes_where(cells, lambda p: p[0] < 1e-9)
    return fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(depth),
        supports=(fem.Fixed(clamped),),
        loads=tuple(loads),
        formulation=formulation,
    )

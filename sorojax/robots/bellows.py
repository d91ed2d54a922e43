"""A planar bellows actuator: a row of air chambers on a strain-limiting layer."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check, fem, mesh
from sorojax._display import displayed
from sorojax._types import Numbers, real
from sorojax.material import AbstractHyperelastic
from sorojax.sdf import AbstractSdf, HalfPlane, Rectangle, repeat
from sorojax.units import mm


@displayed
class BellowsActuator(eqx.Module):
    """Dimensions of the side view [m]; x runs along the actuator from its clamp.

    Bellows of `bellow_width` stand `gap` apart behind a solid clamp block. Each holds one
    chamber inside walls of `wall_thickness` and a roof; below the chambers lies a base
    whose lowest `layer_thickness` is the strain-limiting layer. All concave and chamber
    corners are rounded by `fillet`. The defaults are those of a bending actuator of
    66 x 15 mm with five bellows.
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
        for name in ("wall_thickness", "bellow_width", "gap", "base", "roof", "fillet"):
            _check.between(
                "BellowsActuator", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip
        if _check.is_concrete(self.wall_thickness) and _check.is_concrete(self.bellow_width):
            width = float(self.bellow_width - 2 * self.wall_thickness)
            if width < 2 * float(self.fillet):
                raise ValueError(
                    f"BellowsActuator: walls leave a chamber {width * 1e3:.3g} mm wide, need "
                    f"at least two fillets ({2e3 * float(self.fillet):.3g} mm). Make the "
                    "walls thinner or the bellows wider."
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


# The bellows actuator as a boundary value problem on its cross-section


def bellows_problem(
    actuator: BellowsActuator,
    cells: mesh.Mesh,
    rubber: AbstractHyperelastic,
    *,
    depth: float = 20 * mm,
    gravity: Numbers | None = None,
    pushed: Sequence[int] = (),
    formulation: fem.Displacement | fem.LinearPressure | None = None,
) -> fem.Problem:
    """A bellows actuator as a boundary value problem on its side view, in plane strain.

    It is clamped at its left end, with a pressure called "air" [Pa] in all chambers.

    Args:
        actuator: Its dimensions [m]; concrete.
        cells: The mesh, of `mesh.triangulate(actuator.body(), ...)`.
        rubber: One material, or one with a value per cell.
        depth: Width across the plane of the side view [m].
        gravity: Acceleration (x, y) [m/s^2], a load called "gravity"; no weight by default.
        pushed: Numbers of bellows, counted from the clamp from 0 on, whose backs carry forces
            called "push_0", "push_2" and so on [N], zero to begin with; none by default.
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
    loads: list[Any] = [fem.Pressure(mesh.facets_on(cells, actuator.chambers()), name="air")]
    if gravity is not None:
        loads.append(fem.Gravity(gravity))
    for k in pushed:
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

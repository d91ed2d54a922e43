"""A passive walker: pairs of springy legs under one spine, walking down a slope by itself.

Reference: Suzumori, Saito, "Micro rubber structure realizing multi-legged passive walking",
IROS 2008.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, fem, mesh
from sorojax._display import displayed
from sorojax._types import real
from sorojax.material import AbstractHyperelastic, neo_hookean
from sorojax.sdf import AbstractSdf, Capsule, HalfPlane, Rectangle, repeat, rotate, translate
from sorojax.units import MPa, deg, mm


@displayed
class Walker(eqx.Module):
    """Dimensions of the side view [m]; x runs along the spine, y is 0 under the feet.

    From each of `num_pairs` apexes, `spacing` apart on the spine, two legs lead down at 45
    degrees to feet `reach` away. Each leg carries a toe at a right angle that points inwards
    and stands on the floor as well. Square weights stand on a corner midway between pairs.
    """

    spacing: Float[Array, ""] = eqx.field(converter=real, default=27.5 * mm)
    reach: Float[Array, ""] = eqx.field(converter=real, default=11.8 * mm)
    leg_width: Float[Array, ""] = eqx.field(converter=real, default=1.35 * mm)
    toe_start: Float[Array, ""] = eqx.field(converter=real, default=0.63)
    spine_thickness: Float[Array, ""] = eqx.field(converter=real, default=1.26 * mm)
    weight_diagonal: Float[Array, ""] = eqx.field(converter=real, default=6.5 * mm)
    num_pairs: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        for name in ("spacing", "reach", "leg_width", "spine_thickness", "weight_diagonal"):
            _check.between(
                "Walker", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip
        _check.between("Walker", "toe_start", self.toe_start, 0.0, 1.0, "",
                       "Give the share of the leg above its toe.")  # fmt: skip

    @property
    def apex_height(self) -> Float[Array, ""]:
        """Height of the spine over the floor [m]."""
        return self.reach + self.leg_width / 2

    def apexes(self) -> Float[Array, "pairs 2"]:
        """Where the legs of each pair meet [m]; the first pair is that at x = 0."""
        x = self.spacing * jnp.arange(self.num_pairs, dtype=self.spacing.dtype)
        return jnp.stack([x, jnp.broadcast_to(self.apex_height, x.shape)], axis=1)

    def pair(self) -> AbstractSdf:
        """The two legs of the first pair with their toes."""
        top, half, down = self.apex_height, self.leg_width / 2, self.reach
        zero, part = jnp.zeros_like(down), self.toe_start * down
        bars = None
        for side in (-1.0, 1.0):
            leg = Capsule(jnp.stack([zero, top]), jnp.stack([side * down, top - down]), half)
            toe = Capsule(
                jnp.stack([side * part, top - part]),
                jnp.stack([side * (2 * part - down), top - down]),
                half,
            )
            bars = leg | toe if bars is None else bars | leg | toe
        assert bars is not None
        return bars

    def body(self) -> AbstractSdf:
        """The rubber."""
        n, top, zero = self.num_pairs, self.apex_height, jnp.zeros_like(self.spacing)
        step = jnp.stack([self.spacing, zero])
        side = self.weight_diagonal / jnp.sqrt(2.0)
        weight = rotate(Rectangle([-side / 2, -side / 2], [side / 2, side / 2]), 45 * deg)
        first = translate(weight, jnp.stack([self.spacing / 2, top]))
        spine = Capsule(
            jnp.stack([zero, top]),
            jnp.stack([(n - 1) * self.spacing, top]),
            self.spine_thickness / 2,
        )
        body = repeat(self.pair(), step, n, separate=True) | spine
        return body | repeat(first, step, n - 1, separate=True) if n > 1 else body

    def bottoms(self) -> Float[Array, "feet 2"]:
        """Lowest points of feet and toes [m]."""
        inner = (2 * self.toe_start - 1) * self.reach
        x = jnp.stack([-self.reach, -inner, inner, self.reach])
        x = (self.apexes()[:, :1] + x[None]).ravel()
        return jnp.stack([x, jnp.zeros_like(x)], axis=1)


def walker_rubber() -> AbstractHyperelastic:
    """The rubber of the walker, heavy with metal powder."""
    return neo_hookean(young_modulus=1.2 * MPa, poisson_ratio=0.49, density=3600.0)


def pair_angles(
    walker: Walker, cells: mesh.Mesh, displacements: Float[Array, "times nodes 2"]
) -> Float[Array, "times pairs"]:
    """Angle between the two legs of every pair [rad], of the straight lines from the apex to
    the feet; 90 degrees at rest."""
    down = float(walker.reach)
    found = []
    for apex in np.asarray(walker.apexes()):
        places = [apex, apex + [-down, -down], apex + [down, -down]]
        at = jnp.asarray([mesh.nearest_node(cells, place) for place in places])
        top, left, right = jnp.moveaxis((cells.points[None] + displacements)[:, at], 1, 0)
        a, b = left - top, right - top
        across = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        found.append(jnp.arctan2(across, jnp.sum(a * b, axis=1)))
    return jnp.stack(found, axis=1)


def walker_problem(
    walker: Walker,
    *,
    size: float,
    rubber: AbstractHyperelastic | None = None,
    slope: float = 30 * deg,
    friction: float = 0.7,
    depth: float = 10 * mm,
    stiffness: float = 1e9,
    friction_velocity: float = 20 * mm,
) -> fem.Problem:
    """The walker on a floor that falls towards positive x, free to move: loads "gravity" and
    "floor". The floor is drawn level, gravity leans.

    Args:
        walker: Its dimensions; concrete.
        size: Length of the sides of its triangles [m], half of it at the feet.
        rubber: `walker_rubber()` when omitted.
        slope: Angle of the floor [rad].
        friction: Coulomb coefficient of feet and floor [-]. On 30 degrees the gait is regular
            with 0.7 and a viscosity of the rubber of 800 Pa s; other pairs hop or settle.
        depth: Width across the plane of the side view [m].
        stiffness: Of the contact with the floor [Pa/m]: round feet sink in by some 0.01 mm.
        friction_velocity: Of the dashpot of friction [m/s]; feet move at 0.5 m/s.
    """
    feet = np.asarray(walker.bottoms())

    def size_at(p):
        away = np.sqrt(((p[:, None] - feet[None]) ** 2).sum(axis=2)).min(axis=1)
        return np.clip(size / 2 + 0.3 * (away - size), size / 2, size)

    cells = mesh.triangulate(walker.body(), size=size_at, order=2)
    low = float(walker.leg_width) / 2

    def underside(p):
        return p[1] < low

    rubber = walker_rubber() if rubber is None else rubber
    pull = 9.81 * jnp.stack([jnp.sin(real(slope)), -jnp.cos(real(slope))])
    floor = fem.Contact(
        mesh.facets_where(cells, underside), HalfPlane([0.0, 0.0], [0.0, 1.0]), stiffness,
        friction=friction, friction_velocity=friction_velocity, name="floor",
    )  # fmt: skip
    return fem.problem(
        mesh.enrich(cells), rubber, kinematics=fem.PlaneStrain(depth), supports=(),
        loads=(fem.Gravity(pull), floor), free=True,
    )  # fmt: skip

"""Robots that move on: a crawler by its air, and a walker down a slope.

Reference: Shepherd et al., "Multigait soft robot", PNAS 108, 2011.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, fem, mesh
from sorojax._display import displayed
from sorojax._types import real
from sorojax.contact import AbstractFriction
from sorojax.material import AbstractHyperelastic, by_region, neo_hookean
from sorojax.robots.printable import check_metres
from sorojax.sdf import (
    AbstractSdf,
    Capsule,
    HalfPlane,
    Rectangle,
    repeat,
    rotate,
    translate,
    union,
)
from sorojax.units import MPa, deg, kPa, mm

PORTS = ("rear", "middle", "front")
_PORTS = {1: PORTS[1:2], 2: PORTS[::2], 3: PORTS}  # by the number of groups


@displayed
class Crawler(eqx.Module):
    """Dimensions of the side view [m]; x runs along the crawler, y is 0 where it stands.

    Groups of chambers stand `group_spacing` apart, each with a port of its own. Under
    air a group gets longer on top but not in its sole, the lowest `sole_thickness`, and
    arches its back. The defaults are 150 x 12 mm with 3 x 11 chambers, without feet.

    Attributes:
        length, height: Of the body.
        base: Thickness of the rubber below the chambers, with the sole.
        chamber_width, chamber_height: Of a chamber.
        wall_thickness: Between the chambers of a group.
        foot_height: Of feet of the material of the sole, under both ends of the body and
            between the groups.
        num_chambers: Of a group.
        num_groups: 1 (port "middle"), 2 ("rear", "front") or 3 (all).
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=150 * mm)
    height: Float[Array, ""] = eqx.field(converter=real, default=12 * mm)
    base: Float[Array, ""] = eqx.field(converter=real, default=2.83 * mm)
    sole_thickness: Float[Array, ""] = eqx.field(converter=real, default=2 * mm)
    chamber_width: Float[Array, ""] = eqx.field(converter=real, default=3.22 * mm)
    chamber_height: Float[Array, ""] = eqx.field(converter=real, default=8.4 * mm)
    wall_thickness: Float[Array, ""] = eqx.field(converter=real, default=0.85 * mm)
    group_spacing: Float[Array, ""] = eqx.field(converter=real, default=50.5 * mm)
    foot_height: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    num_chambers: int = eqx.field(static=True, default=11)
    num_groups: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        check_metres(
            self, "height", "base", "sole_thickness", "chamber_width", "wall_thickness"
        )
        if self.num_groups not in _PORTS:
            raise ValueError(
                f"Crawler: got {self.num_groups} for `num_groups`, need 1, 2 or 3. "
                "Use `num_chambers` for longer groups."
            )
        left = {
            "height of the roof": self.height - self.base - self.chamber_height,
            "distance between groups": self.group_spacing - self.group_length,
            "length of both ends": 2 * self._first,
        }
        for name, size in left.items():
            do = "Make chambers smaller or the body larger."
            _check.positive("Crawler", name, size, "m", do)
        do = "Lengths are in metres: write 2 * mm."
        _check.not_negative("Crawler", "foot_height", self.foot_height, "m", do)

    @property
    def group_length(self) -> Float[Array, ""]:
        """From the first to the last chamber of a group, both included [m]."""
        return self.num_chambers * (self.chamber_width + self.wall_thickness) - (
            self.wall_thickness
        )

    @property
    def ports(self) -> tuple[str, ...]:
        """Names of the pressures of its groups."""
        return _PORTS[self.num_groups]

    @property
    def _first(self) -> Float[Array, ""]:
        """Where the first group begins [m]."""
        between = (self.num_groups - 1) * self.group_spacing
        return (self.length - between - self.group_length) / 2

    def chambers(self, group: int) -> AbstractSdf:
        """The air of a group: 0 at the rear, and on towards the front."""
        left = self._first + group * self.group_spacing
        low = self.foot_height + self.base
        first = Rectangle([0.0 * left, low], [self.chamber_width, low + self.chamber_height])
        pitch = jnp.stack([self.chamber_width + self.wall_thickness, 0.0 * left])
        row = repeat(first, pitch, self.num_chambers, separate=True)
        return translate(row, jnp.stack([left, 0.0 * left]))

    def sole(self) -> AbstractSdf:
        """The stiff layer and everything below it."""
        top = self.foot_height + self.sole_thickness
        return HalfPlane([0.0 * top, top], [0.0, 1.0])

    def feet(self) -> Float[Array, "feet 2"]:
        """From where to where each foot reaches along x [m]: below the blocks of rubber at
        both ends and between the groups."""
        numbers = jnp.arange(self.num_groups, dtype=self.length.dtype)
        lefts = self._first + self.group_spacing * numbers
        ends = jnp.stack([0.0 * self.length, self.length])
        starts = jnp.concatenate([ends[:1], lefts + self.group_length])
        return jnp.stack([starts, jnp.concatenate([lefts, ends[1:]])], axis=1)

    def body(self) -> AbstractSdf:
        """The rubber."""
        low, zero = self.foot_height, jnp.zeros_like(self.length)
        into = low + self.sole_thickness / 2  # shapes that end on one line leave a skin
        feet = (Rectangle([left, zero], [right, into]) for left, right in self.feet())
        rubber = union(Rectangle([zero, low], [self.length, low + self.height]), *feet)
        for group in range(self.num_groups):
            rubber = rubber - self.chambers(group)
        return rubber


def crawler_rubbers() -> tuple[AbstractHyperelastic, AbstractHyperelastic]:
    """A soft rubber for the body, and one five times as stiff for the sole.

    Returns:
        Rubber of the body, rubber of the sole.
    """
    return (
        neo_hookean(young_modulus=0.2 * MPa, poisson_ratio=0.4, density=1070.0),
        neo_hookean(young_modulus=1 * MPa, poisson_ratio=0.4, density=1070.0),
    )


def crawler_mesh(crawler: Crawler, size: float, across: int = 1) -> mesh.Mesh:
    """Quad8 cells of about `size` [m] between the lines of the drawing, `across` or more
    across every wall; region "sole".

    Raises:
        ValueError: If the size is not above zero.
    """
    _check.positive("crawler_mesh", "size", size, "m", "Take the width of a chamber / 3.")
    inner = 2 * crawler.num_chambers  # walls of the chambers of a group
    pitch = float(crawler.chamber_width + crawler.wall_thickness)
    start = float(crawler._first) + pitch * np.arange(crawler.num_chambers)
    group = np.stack([start, start + float(crawler.chamber_width)], axis=1).ravel()
    spacing = float(crawler.group_spacing)
    walls = [group + k * spacing for k in range(crawler.num_groups)]
    x = _divided(np.concatenate([[0.0], *walls, [float(crawler.length)]]), size, across)
    heights = crawler.sole_thickness, crawler.base, crawler.base + crawler.chamber_height
    low = float(crawler.foot_height)
    sole, base, top = (low + float(height) for height in heights)
    marks = np.unique([0.0, low, sole, base, top, low + float(crawler.height)])
    y = _divided(marks, size, across)
    grid = mesh.between_lines(x, y, element=mesh.Quad8())
    middle = np.asarray(grid.points)[np.asarray(grid.cells)[:, :4]].mean(axis=1)
    number = np.searchsorted(np.concatenate(walls), middle[:, 0])
    in_group = (number % inner) % 2 == 1
    hollow = in_group & (middle[:, 1] > base) & (middle[:, 1] < top)
    below = (number % inner != 0) & (middle[:, 1] < low)  # a group, whose feet are beside it
    left = ~(hollow | below)
    made = mesh.submesh(grid, np.flatnonzero(left))
    stiff = np.flatnonzero(middle[left, 1] < sole)
    return mesh.Mesh(made.points, made.cells, made.element, regions={"sole": stiff})


def _divided(lines: np.ndarray, size: float, least: int) -> np.ndarray:
    """`lines` [m] with more between them, at most about `size` apart."""
    counts = np.maximum(least, np.round(np.diff(lines) / size).astype(int))
    at = zip(lines[:-1], lines[1:], counts, strict=True)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in at]
    return np.concatenate([*parts, lines[-1:]])


def crawler_problem(
    crawler: Crawler,
    *,
    size: float,
    across: int = 1,
    rubbers: tuple[AbstractHyperelastic, AbstractHyperelastic] | None = None,
    friction: AbstractFriction | float = 0.6,
    depth: float = 40 * mm,
    stiffness: float = 2e8,
) -> fem.Problem:
    """The crawler on a flat floor, free to move: loads "gravity", "floor" and the pressures of
    its ports [Pa]. The floor holds up its whole underside, feet and what is between them.

    Args:
        crawler: Its dimensions; concrete.
        size: Length of the sides of its cells [m].
        across: Cells across a wall at least.
        rubbers: Of body and sole, of one class; `crawler_rubbers()` when omitted.
        friction: Of crawler and floor: a law, or the coefficient [-] of Coulomb's.
        depth: Width across the plane of the side view [m].
        stiffness: Of the contact with the floor [Pa/m]. It carries a body so light that the
            default of `fem.Contact` would be a thousand times more than needed.

    Returns:
        The problem, for `fem.simulate`.
    """
    cells = crawler_mesh(crawler, size, across)
    soft, stiff = crawler_rubbers() if rubbers is None else rubbers
    rubber = by_region(cells.num_cells, cells.regions, soft, {"sole": stiff})
    side, low = float(crawler.length), float(crawler.foot_height)

    def outside(p):
        """The underside; without feet both ends, too."""
        ends = (p[0] < 1e-6 * side) | (p[0] > (1 - 1e-6) * side)
        return (p[1] < low + 1e-6 * side) | (ends & (low == 0))

    air = tuple(
        fem.Pressure(mesh.facets_on(cells, crawler.chambers(k)), name=name)
        for k, name in enumerate(crawler.ports)
    )
    floor = fem.Contact(
        mesh.facets_where(cells, outside),
        HalfPlane([0.0, 0.0], [0.0, 1.0]),
        stiffness,
        friction=friction,
        name="floor",
    )
    return fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(depth),
        supports=(),
        loads=(fem.Gravity(), *air, floor),
        free=True,
    )


def crawler_gait(
    amplitude: float | Float[Array, ""] = 15 * kPa,
    frequency: float | Float[Array, ""] = 2.5,
    lag: float | Float[Array, ""] = jnp.pi / 3,
    *,
    ports: Sequence[str] = PORTS,
) -> dict[str, Any]:
    """Pressures [Pa] of the ports, functions of time [s], for
    `fem.simulate(problem, ..., **gait)`.

    Positive half waves of a sine of `frequency` [Hz], each port `lag` [rad] after the one
    before it, from the rear to the front.

    Args:
        amplitude: Highest pressure [Pa].
        frequency: Of the gait [Hz].
        lag: Between neighbouring ports [rad].
        ports: Of the crawler, from the rear to the front.

    Returns:
        A function of time by the name of each port.
    """
    amplitude, frequency, lag = real(amplitude), real(frequency), real(lag)

    def pressure(k: int):
        def at(t):
            wave = jnp.sin(2 * jnp.pi * frequency * t - k * lag)
            return amplitude * jnp.maximum(wave, jnp.zeros_like(wave))

        return at

    return {name: pressure(k) for k, name in enumerate(ports)}


# The rhythm of legs


_SLOWEST = 8.0  # Hz: below it bodies sway


class Gait(NamedTuple):
    """Of the second half of a record of angles.

    Attributes:
        frequencies: Strongest of every pair [Hz].
        lags: Phase of every pair behind the first [rad], in the two halves of that.
        repeats: Correlation of a period with the one before: 1 if it is the same.
    """

    frequencies: Float[np.ndarray, " pairs"]
    lags: Float[np.ndarray, "2 pairs"]
    repeats: float

    @property
    def drift(self) -> Float[np.ndarray, " pairs"]:
        """Change of the lags from half to half [rad]."""
        return (self.lags[1] - self.lags[0] + np.pi) % (2 * np.pi) - np.pi


def gait(times: Float[np.ndarray, " times"], angles: Float[np.ndarray, "times pairs"]) -> Gait:
    """Rhythm of legs from their angles [rad] at evenly spaced `times` [s].

    Args:
        times: Evenly spaced [s].
        angles: Of each pair of legs [rad].

    Returns:
        Frequency and lag of every pair, and how alike periods are.

    Raises:
        ValueError: If half the record is shorter than 0.15 s.
    """
    times, angles = np.asarray(times), np.asarray(angles)
    late = len(times) // 2
    t, waves = times[late:], angles[late:] - angles[late:].mean(axis=0)
    if not t[-1] - t[0] > 1.2 / _SLOWEST:
        raise ValueError(
            f"gait: half the record is {t[-1] - t[0]:.3g} s, need {1.2 / _SLOWEST:.3g} s. "
            "Simulate longer."
        )
    step, size = times[1] - times[0], 32 * len(t)
    power = np.abs(np.fft.rfft(waves * np.hanning(len(t))[:, None], size, axis=0))
    at = np.fft.rfftfreq(size, step)
    power[at < _SLOWEST] = 0
    found = at[power.argmax(axis=0)]
    period = round(1 / found[0] / step)
    count = max(1, len(t) // 2 // period) * period
    turned = waves * np.exp(-2j * np.pi * found[0] * t)[:, None]
    phases = np.stack([part.sum(axis=0) for part in (turned[:count], turned[-count:])])
    before, after = waves[:-period], waves[period:]
    same = (before * after).sum() / np.sqrt((before**2).sum() * (after**2).sum())
    return Gait(found, np.angle(phases[:, :1] / phases), float(same))


# A passive walker: pairs of springy legs under one spine, walking down a slope by itself.
#
# Reference: Suzumori, Saito, "Micro rubber structure realizing multi-legged passive walking",
# IROS 2008.


@displayed
class Walker(eqx.Module):
    """Dimensions of the side view [m]; x runs along the spine, y is 0 under the feet.

    From each of `num_pairs` apexes, `spacing` apart on the spine, two legs lead down at 45
    degrees to feet `reach` away. Each leg carries a toe at a right angle that points inwards
    and stands on the floor as well. Square weights stand on a corner midway between pairs.

    Attributes:
        leg_width: Of legs and toes.
        toe_start: Share of the leg above its toe [-].
        spine_thickness: Of the spine.
        weight_diagonal: Of the square weights.
    """

    spacing: Float[Array, ""] = eqx.field(converter=real, default=27.5 * mm)
    reach: Float[Array, ""] = eqx.field(converter=real, default=11.8 * mm)
    leg_width: Float[Array, ""] = eqx.field(converter=real, default=1.35 * mm)
    toe_start: Float[Array, ""] = eqx.field(converter=real, default=0.63)
    spine_thickness: Float[Array, ""] = eqx.field(converter=real, default=1.26 * mm)
    weight_diagonal: Float[Array, ""] = eqx.field(converter=real, default=6.5 * mm)
    num_pairs: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        check_metres(
            self, "spacing", "reach", "leg_width", "spine_thickness", "weight_diagonal"
        )
        do = "Give the share of the leg above its toe."
        _check.between("Walker", "toe_start", self.toe_start, 0.0, 1.0, "", do)

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
        bars = []
        for side in (-1.0, 1.0):
            foot = jnp.stack([side * (2 * part - down), top - down])
            bars += [
                Capsule(jnp.stack([zero, top]), jnp.stack([side * down, top - down]), half),
                Capsule(jnp.stack([side * part, top - part]), foot, half),
            ]
        return union(*bars)

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
    """The rubber of the walker, heavy with metal powder.

    Returns:
        The material.
    """
    return neo_hookean(young_modulus=1.2 * MPa, poisson_ratio=0.49, density=3600.0)


def pair_angles(
    walker: Walker, cells: mesh.Mesh, displacements: Float[Array, "times nodes 2"]
) -> Float[Array, "times pairs"]:
    """Angle between the two legs of every pair [rad], of the straight lines from the apex to
    the feet; 90 degrees at rest.

    Args:
        walker: Its dimensions.
        cells: Its mesh.
        displacements: Of the nodes at each time [m].

    Returns:
        Angles [rad].
    """
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

    Returns:
        The problem, for `fem.simulate`.
    """
    feet = np.asarray(walker.bottoms())

    def size_at(p):
        away = np.sqrt(((p[:, None] - feet[None]) ** 2).sum(axis=2)).min(axis=1)
        return np.clip(size / 2 + 0.3 * (away - size), size / 2, size)

    cells = mesh.triangulate(walker.body(), size=size_at, order=2)
    low = float(walker.leg_width) / 2
    rubber = walker_rubber() if rubber is None else rubber
    pull = 9.81 * jnp.stack([jnp.sin(real(slope)), -jnp.cos(real(slope))])
    floor = fem.Contact(
        mesh.facets_where(cells, lambda p: p[1] < low),
        HalfPlane([0.0, 0.0], [0.0, 1.0]),
        stiffness,
        friction=friction,
        friction_velocity=friction_velocity,
        name="floor",
    )
    return fem.problem(
        mesh.enrich(cells),
        rubber,
        kinematics=fem.PlaneStrain(depth),
        supports=(),
        loads=(fem.Gravity(pull), floor),
        free=True,
    )

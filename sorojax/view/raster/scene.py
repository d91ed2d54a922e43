"""A scene to draw: surfaces, lines, arrows and dots [m], without a drawing library.

Functions that know the nouns of other packages make a `Scene`; `plane` draws it with
matplotlib, `solid` shades it in space.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sorojax.view import style


@dataclass(frozen=True, eq=False)
class Scale:
    """Which colours values have.

    Attributes:
        label: Name of the values with their unit.
        low, high: Limits; values beyond have the colour of the limit.
        extend: At which ends there are such values: `neither`, `min`, `max` or `both`.
        colours: Name of a colour map of matplotlib.
    """

    label: str
    low: float
    high: float
    extend: str = "neither"
    colours: str = style.FIELD

    def table(self) -> Float[np.ndarray, "256 3"]:
        """Red, green and blue in [0, 1] from the lower to the upper limit."""
        from matplotlib import colormaps

        return colormaps[self.colours](np.linspace(0, 1, 256))[:, :3].astype(np.float32)


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in the plane or in space.

    Attributes:
        points: Corners [m].
        triangles: Their numbers, counter-clockwise from outside.
        colour: Of all of it, or one row of red, green, blue per triangle.
        values: One per point or per triangle, coloured by the scale of the scene.
        wire: Which sides (0-1, 1-2, 2-0) are sides of cells, drawn as thin lines.
        opacity: Below 1 what is behind shows through.
        name: For the legend.
    """

    points: Float[np.ndarray, "points dim"]
    triangles: Int[np.ndarray, "triangles 3"]
    colour: Any = style.BODY
    values: Float[np.ndarray, " values"] | None = None
    wire: Bool[np.ndarray, "triangles 3"] | None = None
    opacity: float = 1.0
    name: str = ""

    @property
    def corner_values(self) -> Float[np.ndarray, "triangles 3"]:
        """Values at the corners of the triangles."""
        values = np.asarray(self.values, float)
        if self.has_values_per_triangle:
            return np.repeat(values[:, None], 3, axis=1)
        return values[np.asarray(self.triangles)]

    @property
    def has_values_per_triangle(self) -> bool:
        count = 0 if self.values is None else len(self.values)
        return count == len(self.triangles) or count != len(self.points)

    @property
    def sides(self) -> Int[np.ndarray, "sides 2"]:
        """Points that the lines of `wire` join."""
        if self.wire is None:
            return np.zeros((0, 2), int)
        triangles, wire = np.asarray(self.triangles), np.asarray(self.wire, bool)
        ends = [triangles[wire[:, k]][:, [k, (k + 1) % 3]] for k in range(3)]
        return np.unique(np.sort(np.concatenate(ends), axis=1), axis=0)


@dataclass(frozen=True, eq=False)
class Lines:
    """`runs` of points, each an array (points, dim) [m], in one `colour`; `width` is in points
    of print, they may be `dashed`, and `name` is for the legend."""

    runs: Sequence[Float[np.ndarray, "points dim"]]
    colour: str = style.INK
    width: float = 1.0
    dashed: bool = False
    name: str = ""


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows that start at `starts` [m]; their `vectors` [m] are drawn to scale, in one
    `colour`, and `name` is for the legend."""

    starts: Float[np.ndarray, "arrows dim"]
    vectors: Float[np.ndarray, "arrows dim"]
    colour: str = style.LOAD
    name: str = ""


@dataclass(frozen=True, eq=False)
class Dots:
    """Marks at `points` [m] of `size` points of print, in one `colour`; `name` is for the
    legend."""

    points: Float[np.ndarray, "dots dim"]
    colour: str = style.INK
    size: float = 4.0
    name: str = ""


Part = Surface | Lines | Arrows | Dots


@dataclass(frozen=True, eq=False)
class Scene:
    """What a picture shows.

    Attributes:
        parts: In the order they are drawn.
        scale: Of their values, if they have any.
        title: Heading of the picture.
        note: Small print at its edge.
        extent: Lower and upper corner [m] of what must be in it, of the parts by default.
    """

    parts: tuple[Part, ...]
    scale: Scale | None = None
    title: str = ""
    note: str = ""
    extent: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def dim(self) -> int:
        return corners_of(self.parts[0]).shape[1]

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m] of what must be in the picture."""
        return self.extent or box_of(self.parts)


def corners_of(part: Part) -> Float[np.ndarray, "points dim"]:
    """All points that a part reaches."""
    if isinstance(part, Lines):
        return np.concatenate([np.asarray(run) for run in part.runs])
    if isinstance(part, Arrows):
        return np.concatenate([part.starts, part.starts + part.vectors])
    return part.points


def box_of(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box around all parts [m]."""
    points = np.concatenate([corners_of(part) for part in parts])
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        raise ValueError(
            "view: nothing to draw, every point is NaN or infinite. Look at the status of the "
            "result."
        )
    return points.min(axis=0), points.max(axis=0)


def merge_scenes(*scenes: Scene, title: str = "") -> Scene:
    """One scene of the parts of all, with the first scale that one of them has.

    Args:
        *scenes: From `scene_of`.
        title: Of the scene.

    Returns:
        The scene.
    """
    parts = tuple(part for scene in scenes for part in scene.parts)
    scale = next((scene.scale for scene in scenes if scene.scale is not None), None)
    return Scene(parts, scale, title or next((s.title for s in scenes if s.title), ""))


def joint_extent(scenes: Sequence[Scene]) -> list[Scene]:
    """The scenes with one box and one scale, so that they compare."""
    extent = box_around([scene.box for scene in scenes])
    return [replace(scene, extent=extent) for scene in scenes]


def box_around(boxes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box around boxes."""
    lower, upper = zip(*boxes, strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)


def robust_scale(
    label: str,
    values: Sequence[Float[np.ndarray, " values"]],
    *,
    limits: tuple[float, float] | None = None,
    cut: float = 99.5,
) -> Scale:
    """One scale for all `values`; a peak above the percentile `cut` is cut, with a note."""
    flat = np.concatenate([np.ravel(v) for v in values])
    flat = flat[np.isfinite(flat)]
    if limits is not None:
        low, high = map(float, limits)
        return Scale(label, low, high, _extend(flat, low, high))
    if not flat.size:
        return Scale(label, 0.0, 1.0)
    low, high = float(flat.min()), float(np.percentile(flat, cut))
    if low < 0 < high and min(-low, high) > 0.05 * max(-low, high):
        most = max(-float(np.percentile(flat, 100 - cut)), high)
        return Scale(label, -most, most, _extend(flat, -most, most), style.SIGNED)
    if low >= 0 and low < 0.5 * high:
        low = 0.0
    if high - low <= 1e-9 * max(abs(high), abs(low)):
        return Scale(label, low, low + max(1.0, abs(low)))
    return Scale(label, low, high, "max" if flat.max() > high else "neither")


def _extend(values: np.ndarray, low: float, high: float) -> str:
    """Which ends of a scale `values` go beyond, as matplotlib names them."""
    below, above = np.any(values < low), np.any(values > high)
    return ("both" if above else "min") if below else ("max" if above else "neither")


# Values with their unit, and the unit that makes their numbers short


class Coloured(NamedTuple):
    """Values per node or per cell in SI units, their name, and what they are measured in."""

    values: Float[np.ndarray, " values"]
    name: str
    unit: str


_STEPS = {
    "Pa": ((1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "um")),
    "J/m^3": ((1e6, "MJ/m$^3$"), (1e3, "kJ/m$^3$"), (1.0, "J/m$^3$")),
}


def readable(rows: list[Coloured]) -> tuple[list[np.ndarray], str]:
    """The values of all rows in one unit that gives short numbers, and the label."""
    first = rows[0]
    if first.unit not in _STEPS:
        unit = f" [{first.unit}]" if first.unit else ""
        return [row.values for row in rows], f"{first.name}{unit}"
    flat = np.concatenate([np.ravel(row.values) for row in rows])
    largest = float(np.max(np.abs(flat[np.isfinite(flat)]), initial=0.0))
    factor, unit = _step(largest / 2, first.unit)
    return [row.values / factor for row in rows], f"{first.name} [{unit}]"


def short(value: float, unit: str) -> str:
    """A number with its unit: 12500 Pa as `12.5 kPa`."""
    factor, name = _step(abs(value), unit) if unit in _STEPS else (1.0, unit)
    return f"{value / factor:.3g} {name}".strip()


def _step(value: float, unit: str) -> tuple[float, str]:
    """The largest unit of which `value` has at least one, its size first."""
    steps = _STEPS[unit]
    return next((s for s in steps if value >= s[0]), steps[-1] if value else steps[1])

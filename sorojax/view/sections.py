"""Outlines of cross-sections, found again from the constants that a rod keeps of them."""

import math

import numpy as np
from jaxtyping import Float

from sorojax.math.quadrature import interpolation_rows
from sorojax.rod import Rod, Section
from sorojax.sdf import AbstractSdf, contour
from sorojax.sdf.sample import finite_box

_CORNERS = 48
_CLOSE = 2e-3

Outlines = Float[np.ndarray, "stations corners 2"]


def outlines_of(
    rod: Rod, s: Float[np.ndarray, " stations"], shape: AbstractSdf | None = None
) -> tuple[Outlines, Outlines | None]:
    """Outer outline and hole of the section at each `s`, corners (y, z) [m].

    A disc, tube, ellipse, rectangle or squircle is found exactly from area, second moments
    and torsion constant; any other section is drawn as the ellipse of its second moments,
    unless its `shape` is given, whose hole is drawn if it has just one.
    """
    section = rod.section
    count = len(s)
    if shape is not None:
        return _drawn(shape, count)
    names = ("area", "second_moment_y", "second_moment_z", "torsion_constant")
    area, about_y, about_z, torsion = (_along(rod, getattr(section, name), s) for name in names)
    return _from_constants(area, about_y, about_z, torsion)


def section_outline(section: Section) -> tuple[np.ndarray, np.ndarray | None]:
    """Outline and hole of a section; of the middle node if it varies."""
    names = ("area", "second_moment_y", "second_moment_z", "torsion_constant")
    rows = (np.atleast_1d(np.asarray(getattr(section, name), float)) for name in names)
    outer, hole = _from_constants(*(row[[len(row) // 2]] for row in rows))
    return outer[0], None if hole is None else hole[0]


def _along(rod: Rod, value, s: np.ndarray) -> np.ndarray:
    value = np.asarray(value, float)
    if value.ndim == 0:
        return np.full(len(s), float(value))
    return np.asarray(interpolation_rows(rod.quadrature, s)) @ value


def _from_constants(area, about_y, about_z, torsion) -> tuple[Outlines, Outlines | None]:
    y, z = 2 * np.sqrt(about_z / area), 2 * np.sqrt(about_y / area)  # semi-axes of an ellipse
    kind = _kind(*(float(np.median(v)) for v in (area, about_y, about_z, torsion)))
    if kind == "rectangle":
        high, wide = np.sqrt(12 * about_z / area), np.sqrt(12 * about_y / area)
        square = _square() / 2
        return square[None] * np.stack([high, wide], axis=1)[:, None], None
    ring = _ring()
    if kind == "tube":
        mean, half = 2 * about_z / area, area / (2 * math.pi)
        outer = ring[None] * np.sqrt(mean + half)[:, None, None]
        return outer, ring[None] * np.sqrt(np.maximum(mean - half, 0))[:, None, None]
    if kind == "squircle":
        power = _power(float(np.median(about_z / area**2)))
        shape = _superellipse(power)
        size = np.sqrt(area / _shoelace(shape))
        return shape[None] * size[:, None, None], None
    return ring[None] * np.stack([y, z], axis=1)[:, None], None


def _kind(area: float, about_y: float, about_z: float, torsion: float) -> str:
    y, z = 2 * math.sqrt(about_z / area), 2 * math.sqrt(about_y / area)
    if abs(math.pi * y * z / area - 1) < _CLOSE:
        return "ellipse"
    if abs(12 * math.sqrt(about_y * about_z) / area**2 - 1) < _CLOSE:
        return "rectangle"
    if abs(about_y / about_z - 1) > _CLOSE:
        return "other"
    if abs(torsion / (2 * about_z) - 1) < _CLOSE:
        return "tube"
    return "squircle" if about_z / area**2 < 1 / 12 else "other"


def _ring(count: int = _CORNERS) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _square(count: int = _CORNERS) -> np.ndarray:
    """The square of side 2, its corners among the points."""
    at = np.linspace(-1, 1, count // 4, endpoint=False)
    one = np.ones_like(at)
    sides = [(one, at), (-at, one), (-one, -at), (at, -one)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _superellipse(power: float) -> np.ndarray:
    ring = _ring()
    return np.sign(ring) * np.abs(ring) ** (2 / power)  # dense where it is round


def _power(ratio: float) -> float:
    """Power of the superellipse whose second moment over its squared area is `ratio`."""

    def found(n: float) -> float:
        def integral(a: float, b: float) -> float:
            log = math.lgamma(a / n) + math.lgamma(b / n) - math.lgamma((a + b) / n + 1)
            return 4 / n**2 * math.exp(log)

        return integral(3.0, 1.0) / integral(1.0, 1.0) ** 2

    low, high = 2.0, 50.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if found(middle) < ratio else (low, middle)
    return (low + high) / 2


def _shoelace(ring: np.ndarray) -> float:
    y, z = ring.T
    return 0.5 * float(np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z))


def _drawn(shape: AbstractSdf, count: int) -> tuple[Outlines, Outlines | None]:
    lower, upper = finite_box("view.show", shape, 2)
    curves = [c.points for c in contour(shape, float(np.max(upper - lower)) / 60) if c.closed]
    curves = sorted(curves, key=lambda ring: -abs(_shoelace(ring)))
    outer = curves[0] if _shoelace(curves[0]) > 0 else curves[0][::-1]
    if len(curves) != 2:
        return np.broadcast_to(outer, (count, *outer.shape)), None
    corners = max(len(outer), len(curves[1]))
    outer, hole = _even(outer, corners), _even(curves[1], corners)
    hole = hole if _shoelace(hole) > 0 else hole[::-1]
    turn = np.argmin(np.linalg.norm(hole - outer[0], axis=1))
    hole = np.roll(hole, -turn, axis=0)
    size = (count, *outer.shape)
    return np.broadcast_to(outer, size), np.broadcast_to(hole, size)


def _even(ring: np.ndarray, count: int) -> np.ndarray:
    """`count` points at equal distances along a closed ring, from its first point on."""
    closed = np.concatenate([ring, ring[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = s[-1] * np.arange(count) / count
    return np.stack([np.interp(at, s, closed[:, k]) for k in range(2)], axis=1)

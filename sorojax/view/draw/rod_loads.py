"""Loads on rods: threads through them, and forces where they touch something."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from sorojax import rod as R
from sorojax._jax.jit import once
from sorojax.rod import Assembly, Rod, Section
from sorojax.rod.forces.tendons import Thread, ThreadChambers
from sorojax.sdf import AbstractSdf, contour
from sorojax.sdf.sampling import finite_box
from sorojax.view import style
from sorojax.view.draw.shapes import obstacle_part
from sorojax.view.raster.glyphs import area_of, circle, line_tube
from sorojax.view.raster.scene import Arrows, Lines, Part, Surface, short
from sorojax.view.rigging.rig import constant_along

_LENGTH = 0.25  # of the body, that of the longest arrow


class Drawn(NamedTuple):
    """A thread to draw: where it is in the section along the rod, how thick, what it is."""

    start: float
    stop: float
    place: Float[np.ndarray, "points 2"]
    radius: float | None
    colour: str
    name: str


class Acting(NamedTuple):
    """Threads by the name of their part, contacts with theirs; "" where there is one rod."""

    threads: dict[str, list[Drawn]]
    contacts: list[tuple[str, Any]]
    pairs: list[Any]


def acting(model: Rod | Assembly, forces: Sequence[Any]) -> Acting:
    """Those of `forces` that have a place to be drawn at."""
    threads: dict[str, list[Drawn]] = {}
    contacts, pairs = [], []
    for force in forces:
        part, inner = part_and_force(force)
        if isinstance(inner, R.PairForce):
            pairs.append(inner)
        elif isinstance(inner, R.AbstractContact):
            contacts.append((part, inner))
        elif isinstance(model, Rod) or part:
            body = model if isinstance(model, Rod) else model[part].body
            if isinstance(body, Rod):
                threads.setdefault(part, []).extend(_threads(body, inner))
    return Acting(threads, contacts, pairs)


def part_and_force(force: Any) -> tuple[str, Any]:
    """The name of the part that a force acts on, "" where it names none, and the force."""
    return (force.part, force.force) if isinstance(force, R.PartForce) else ("", force)


def _threads(body: Rod, force: Any) -> list[Drawn]:
    if isinstance(force, R.Tendons):
        names = ["tendon"] * len(force.routes)
        if force.tension is not None and not callable(force.tension):
            names = [f"tendon: {short(float(pull), 'N')}" for pull in force.tension]
        return [_tendon(route, name) for route, name in zip(force.routes, names, strict=True)]
    chamber, pressure = force, None
    if isinstance(force, R.Pressurised):
        chamber, pressure = force.chamber, np.atleast_1d(np.asarray(force.pressure))
    if not isinstance(chamber, ThreadChambers):
        return []
    found = []
    for k, (thread, area) in enumerate(zip(chamber.threads, chamber.areas, strict=True)):
        radius = float(np.sqrt(area / np.pi))
        name = "chamber" if pressure is None else f"chamber: {short(float(pressure[k]), 'Pa')}"
        found.append(_chamber(body, thread, radius, _heat(pressure, k), name))
    return found


def _tendon(route: R.AbstractRoute, name: str) -> Drawn:
    place = np.asarray(_places(route, jnp.linspace(route.start, route.stop, 61)))
    return Drawn(route.start, route.stop, place, None, style.COLOURS[3], name)


@once
def _places(route, s):
    return jax.vmap(route.offset)(s)


def _chamber(body: Rod, thread: Thread, radius: float, colour: str, name: str) -> Drawn:
    """The place of a chamber, from how bending changes its length; what no mode of the rod
    moves is taken as zero."""
    # d tangent / d q = kappa rows x (0, y, z) in the columns of curvature modes
    kappa, rows = np.asarray(thread.curvature_rows), np.asarray(thread.tangent_rows)
    slope = np.moveaxis(rows, 1, 2)  # points, dof, 3
    bend = np.moveaxis(kappa, 1, 2)
    along_y, along_z = np.cross(bend, [0.0, 1.0, 0.0]), np.cross(bend, [0.0, 0.0, 1.0])
    start, span = float(thread.start / body.length), float(thread.span / body.length)
    places = []
    for k in range(len(kappa)):
        matrix = np.stack([along_y[k].ravel(), along_z[k].ravel()], axis=1)
        places.append(np.linalg.lstsq(matrix, slope[k].ravel(), rcond=1e-9)[0])
    return Drawn(start, start + span, np.array(places), radius, colour, name)


def _heat(pressure: np.ndarray | None, k: int) -> str:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    if pressure is None:
        return style.COLOURS[5]
    largest = max(float(np.max(np.abs(pressure))), 1e-12)
    return to_hex(colormaps["OrRd"](0.25 + 0.6 * abs(float(pressure[k])) / largest))


def thread_parts(body: Rod, threads: Sequence[Drawn], pose, s: np.ndarray) -> list[Part]:
    """Threads through a rod whose sections are at `pose`."""
    parts: list[Part] = []
    dim = pose.shape[1] - 1
    for thread in threads:
        at = np.linspace(thread.start, thread.stop, 61)
        place = _resampled(thread.place, len(at))
        nearest = np.clip(np.searchsorted(s, at), 1, len(s) - 1)
        share = (at - s[nearest - 1]) / (s[nearest] - s[nearest - 1])
        both = pose[nearest - 1] + share[:, None, None] * (pose[nearest] - pose[nearest - 1])
        line = both[:, :dim, dim] + np.einsum(
            "sij,sj->si", both[:, :dim, 1:dim], place[:, : dim - 1]
        )
        if thread.radius is None or dim == 2:
            width = 2.0 if thread.radius is None else 4.0
            parts.append(Lines([line], thread.colour, width, name=thread.name))
        else:
            points, triangles = line_tube(line, thread.radius, corners=16)
            parts.append(Surface(points, triangles, thread.colour, name=thread.name))
    return parts


def _resampled(place: np.ndarray, count: int) -> np.ndarray:
    at, given = np.linspace(0, 1, count), np.linspace(0, 1, len(place))
    return np.stack([np.interp(at, given, place[:, k]) for k in range(2)], axis=1)


def contact_parts(model: Rod | Assembly, q: np.ndarray, found: Acting) -> list[Part]:
    """Arrows where a rod is pushed, on one scale, and the obstacles that push."""
    if not found.contacts and not found.pairs:
        return []
    pushed, parts = [], []
    for part, contact in found.contacts:
        at, force = (np.asarray(x) for x in _pushes(model, jnp.asarray(q), part, contact))
        pushed.append((at, force))
        if isinstance(contact, R.ObstacleContact):
            size = size_of(model)
            parts += obstacle_part(contact.obstacle, at, size)
    for pair in found.pairs:
        if isinstance(pair.force, R.RodContact):
            for at, force in _meets(model, jnp.asarray(q), pair):
                pushed.append((np.asarray(at), np.asarray(force)))
    starts = np.concatenate([at for at, _ in pushed])
    forces = np.concatenate([force for _, force in pushed])
    size = np.linalg.norm(forces, axis=1)
    if not size.max(initial=0.0) > 0:
        return parts
    kept = size > 1e-3 * size.max()
    vectors = forces[kept] * (_LENGTH * size_of(model) / size.max())
    name = f"contact, {short(float(np.linalg.norm(forces.sum(axis=0))), 'N')} in all"
    return [*parts, Arrows(starts[kept], vectors, style.LOAD, name)]


def size_of(model: Rod | Assembly) -> float:
    """Length of the rod, or of the longest one [m]."""
    if isinstance(model, Rod):
        return float(model.length)
    rods = [part.body for part in model.parts if isinstance(part.body, Rod)]
    return max((float(body.length) for body in rods), default=0.1)


@once
def _pushes(model, q, part: str, contact):
    """Points of contact [m] and the normal forces there [N]."""
    moment = R.motion(model, q)
    if isinstance(model, Assembly):
        moment = R.part_motion(moment, model.names.index(part))
    touch = contact.touch(moment)
    return _normal_force(touch, contact.law)


@once
def _meets(model, q, pair):
    moment = R.motion(model, q)
    first, second = (
        R.part_motion(moment, model.names.index(k)) for k in (pair.first, pair.second)
    )
    return [_normal_force(t, pair.force.law) for t in pair.force.touches(first, second)]


def _normal_force(touch, law):
    force = (touch.weights * law.pressure(touch.gap))[:, None] * touch.normal
    side = touch.sides[0]
    return side.points.position + side.arm, force


# Outlines of cross-sections, found again from the constants that a rod keeps of them


_CONSTANTS = ("area", "second_moment_y", "second_moment_z", "torsion_constant")
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
    if shape is not None:
        return _drawn(shape, len(s))
    return _from_constants(*(constant_along(rod, name, s) for name in _CONSTANTS))


def section_outline(section: Section) -> tuple[np.ndarray, np.ndarray | None]:
    """Outline and hole of a section; of the middle node if it varies."""
    rows = (np.atleast_1d(np.asarray(getattr(section, name), float)) for name in _CONSTANTS)
    outer, hole = _from_constants(*(row[[len(row) // 2]] for row in rows))
    return outer[0], None if hole is None else hole[0]


def _from_constants(area, about_y, about_z, torsion) -> tuple[Outlines, Outlines | None]:
    y, z = 2 * np.sqrt(about_z / area), 2 * np.sqrt(about_y / area)  # semi-axes of an ellipse
    kind = _kind(*(float(np.median(v)) for v in (area, about_y, about_z, torsion)))
    if kind == "rectangle":
        high, wide = np.sqrt(12 * about_z / area), np.sqrt(12 * about_y / area)
        square = _square() / 2
        return square[None] * np.stack([high, wide], axis=1)[:, None], None
    ring = circle(_CORNERS)
    if kind == "tube":
        mean, half = 2 * about_z / area, area / (2 * math.pi)
        outer = ring[None] * np.sqrt(mean + half)[:, None, None]
        return outer, ring[None] * np.sqrt(np.maximum(mean - half, 0))[:, None, None]
    if kind == "squircle":
        power = _power(float(np.median(about_z / area**2)))
        shape = _superellipse(power)
        size = np.sqrt(area / area_of(shape))
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


def _square(count: int = _CORNERS) -> np.ndarray:
    """The square of side 2, its corners among the points."""
    at = np.linspace(-1, 1, count // 4, endpoint=False)
    one = np.ones_like(at)
    sides = [(one, at), (-at, one), (-one, -at), (at, -one)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _superellipse(power: float) -> np.ndarray:
    ring = circle(_CORNERS)
    return np.sign(ring) * np.abs(ring) ** (2 / power)  # dense where it is round


def _power(ratio: float) -> float:
    """Power of the superellipse whose second moment over its squared area is `ratio`."""

    def found(n: float) -> float:
        def integral(a: float, b: float) -> float:
            log = math.lgamma(a / n) + math.lgamma(b / n) - math.lgamma((a + b) / n + 1)
            return 4 / n**2 * math.exp(log)

        return integral(3.0, 1.0) / integral(1.0, 1.0) ** 2

    least, most = 2.0, 50.0
    ratio = float(np.clip(ratio, found(least), found(most)))
    return brentq(lambda power: found(power) - ratio, least, most)  # type: ignore[return-value]


def _drawn(shape: AbstractSdf, count: int) -> tuple[Outlines, Outlines | None]:
    lower, upper = finite_box("view.show", shape, 2)
    curves = [c.points for c in contour(shape, float(np.max(upper - lower)) / 60) if c.closed]
    curves = sorted(curves, key=lambda ring: -abs(area_of(ring)))
    outer = curves[0] if area_of(curves[0]) > 0 else curves[0][::-1]
    if len(curves) != 2:
        return np.broadcast_to(outer, (count, *outer.shape)), None
    corners = max(len(outer), len(curves[1]))
    outer, hole = _even(outer, corners), _even(curves[1], corners)
    hole = hole if area_of(hole) > 0 else hole[::-1]
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

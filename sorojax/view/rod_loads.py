"""What acts on rods: threads through them, and forces where they touch something."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import rod as R
from sorojax.rod import Assembly, Rod
from sorojax.rod.routing import Thread
from sorojax.view import style
from sorojax.view.glyphs import line_tube
from sorojax.view.quantity import short
from sorojax.view.scene import Arrows, Lines, Part, Surface
from sorojax.view.shapes import obstacle_part

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
    """What of `forces` has a place to be drawn at."""
    threads: dict[str, list[Drawn]] = {}
    contacts, pairs = [], []
    for force in forces:
        part, inner = (force.part, force.force) if isinstance(force, R.On) else ("", force)
        if isinstance(inner, R.Between):
            pairs.append(inner)
        elif isinstance(inner, R.AbstractContact):
            contacts.append((part, inner))
        elif isinstance(model, Rod) or part:
            body = model if isinstance(model, Rod) else model[part].body
            if isinstance(body, Rod):
                threads.setdefault(part, []).extend(_threads(body, inner))
    return Acting(threads, contacts, pairs)


def _threads(body: Rod, force: Any) -> list[Drawn]:
    if isinstance(force, R.Tendons):
        tension = None if callable(force.tension) else np.asarray(force.tension)
        return [
            _routed(route, style.COLOURS[3], None,
                    "tendon" if tension is None else f"tendon: {short(float(tension[k]), 'N')}")
            for k, route in enumerate(force.routes)
        ]  # fmt: skip
    chamber, pressure = force, None
    if isinstance(force, R.Pressurised):
        chamber, pressure = force.chamber, np.atleast_1d(np.asarray(force.pressure))
    if not isinstance(chamber, R.ThreadChambers):
        return []
    found = []
    for k, (thread, area) in enumerate(zip(chamber.threads, chamber.areas, strict=True)):
        radius = float(np.sqrt(area / np.pi))
        name = "chamber" if pressure is None else f"chamber: {short(float(pressure[k]), 'Pa')}"
        found.append(_chamber(body, thread, radius, _heat(pressure, k), name))
    return found


def _routed(route: R.AbstractRoute, colour: str, radius: float | None, name: str) -> Drawn:
    s = jnp.linspace(route.start, route.stop, 61)
    place = np.asarray(_places(route, s))
    return Drawn(route.start, route.stop, place, radius, colour, name)


@eqx.filter_jit
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
    share = float(thread.span / body.length)
    places = []
    for k in range(len(kappa)):
        matrix = np.stack([along_y[k].ravel(), along_z[k].ravel()], axis=1)
        places.append(np.linalg.lstsq(matrix, slope[k].ravel(), rcond=1e-9)[0])
    return Drawn(0.0, share, np.array(places), radius, colour, name)


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
        line = both[:, :dim, dim] + np.einsum("sij,sj->si", both[:, :dim, 1:dim],
                                              place[:, : dim - 1])  # fmt: skip
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


@eqx.filter_jit
def _pushes(model, q, part: str, contact):
    """Points of contact [m] and the normal forces there [N]."""
    moment = R.motion(model, q)
    if isinstance(model, Assembly):
        moment = R.part_motion(moment, model.names.index(part))
    touch = contact.touch(moment)
    return _normal_force(touch, contact.law)


@eqx.filter_jit
def _meets(model, q, pair):
    from sorojax.rod.rod_contact import touches

    moment = R.motion(model, q)
    first, second = (
        R.part_motion(moment, model.names.index(k)) for k in (pair.first, pair.second)
    )
    return [_normal_force(t, pair.force.law) for t in touches(pair.force, first, second)]


def _normal_force(touch, law):
    force = (touch.weights * law.pressure(touch.gap))[:, None] * touch.normal
    side = touch.sides[0]
    return side.points.position + side.arm, force

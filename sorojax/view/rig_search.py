"""Which section of which part carries a point."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.math.spatial import KDTree
from sorojax.rod import Assembly, Rod
from sorojax.view.rig_frames import Place, carry, position_columns

_MOST = 4
_LEAST_SHARE = 1e-3
_TURNS = 12

Points = Float[np.ndarray, "points dim"]


class Held(NamedTuple):
    """Pairs of a point and a part that carries it.

    Attributes:
        point, part: Which.
        s: Where on the part, in [0, 1].
        weight: Share [-]; those of a point add up to one.
        main: Whether it is the first of its point.
    """

    point: Int[np.ndarray, " pairs"]
    part: Int[np.ndarray, " pairs"]
    s: Float[np.ndarray, " pairs"]
    weight: Float[np.ndarray, " pairs"]
    main: Bool[np.ndarray, " pairs"]


def search(
    points: Points,
    model: Rod | Assembly,
    table: Float[np.ndarray, "frames columns"],
    where: tuple[Place, ...],
    names: tuple[str, ...] | None,
    blend: float | None,
) -> Held:
    """The parts that carry each point, by distance."""
    chosen = _chosen(where, names)
    width = _radius(model) if blend is None else float(blend)
    found = [_nearest(points, model, table, where, k) for k in chosen]
    s, distance = (np.stack(columns) for columns in zip(*found, strict=True))
    weight = _weights(distance, width)
    point, nth = np.nonzero(weight.T)
    main = nth == np.argmax(weight, axis=0)[point]
    part = np.array(chosen)[nth]
    return Held(point, part, s[nth, point], weight[nth, point], main)


def _chosen(where: tuple[Place, ...], names: tuple[str, ...] | None) -> list[int]:
    known = [place.name for place in where]
    if names is None:
        return list(range(len(known)))
    if not names or (wrong := sorted(set(names) - set(known))):
        got = wrong if names else "none"
        raise ValueError(f"bind: got parts {got}, need some of {known}.")
    return [known.index(name) for name in names]


def _radius(model: Rod | Assembly) -> float:
    """Radius of the disc of the largest section [m]."""
    rods = [model] if isinstance(model, Rod) else [part.body for part in model.parts]
    areas = [float(np.max(np.asarray(r.section.area))) for r in rods if isinstance(r, Rod)]
    return float(np.sqrt(max(areas, default=0.0) / np.pi))


def _weights(
    distance: Float[np.ndarray, "parts points"], width: float
) -> Float[np.ndarray, "parts points"]:
    """Shares that fall smoothly to zero where a part is `width` further away than the
    nearest."""
    far = distance - distance.min(axis=0)
    if width > 0:
        t = np.clip(far / width, 0, 1)
        share = (1 - t) ** 2 * (1 + 2 * t)
    else:
        share = np.zeros_like(distance)
        share[np.argmin(distance, axis=0), np.arange(distance.shape[1])] = 1
    if len(share) > _MOST:
        share = np.where(share >= np.sort(share, axis=0)[-_MOST], share, 0)
    share = np.where(share >= _LEAST_SHARE, share, 0)
    return share / share.sum(axis=0)


def _nearest(points: Points, model, table, where: tuple[Place, ...], index: int):
    """Where on a part each point is bound, and how far from it."""
    place = where[index]
    if place.count > 1:
        return _on_rod(points, table[place.first : place.first + place.count])
    return np.zeros(len(points)), _to_link(points, model, table, where, index)


def _on_rod(points: Points, table: Float[np.ndarray, "stations columns"]):
    """The section in whose plane a point lies, near the nearest station."""
    centres = table[:, position_columns(points.shape[1])]
    station = KDTree(centres).query(points)[1].astype(points.dtype)
    best, gap = _settled(jnp.asarray(table), jnp.asarray(station), jnp.asarray(points.T))
    return np.asarray(best) / (len(table) - 1), np.asarray(gap)


@jax.jit
def _settled(table: Array, station: Array, points: Float[Array, "dim points"]):
    """Places near the stations where the points lie in the section, and their distances."""
    last, at = len(table) - 1, tuple(points)
    centres = table[:, position_columns(len(at))]
    length = jnp.mean(jnp.sqrt(jnp.sum(jnp.diff(centres, axis=0) ** 2, axis=1)))

    def frames(best):
        left = jnp.clip(jnp.floor(best).astype(jnp.int32), 0, last - 1)
        return tuple(table[left].T), best - left.astype(best.dtype)

    def turn(_, best):
        columns, fraction = frames(best)
        middle = carry(columns, fraction)
        ahead = carry(columns, fraction, (jnp.ones_like(best), *(0 * best,) * (len(at) - 1)))
        step = sum((a - m) * (p - m) for a, m, p in zip(ahead, middle, at, strict=True))
        # Not the whole step: it overshoots far outside a strongly bent rod.
        best = jnp.clip(best + 0.8 * step / length, station - 1.5, station + 1.5)
        return jnp.clip(best, 0, last)

    best = jax.lax.fori_loop(0, _TURNS, turn, station)
    middle = carry(*frames(best))
    return best, jnp.sqrt(sum((p - m) ** 2 for p, m in zip(at, middle, strict=True)))


def _to_link(points: Points, model, table, where: tuple[Place, ...], index: int):
    """Distance to the lines from the frame of a link to the joints on it."""
    at = position_columns(points.shape[1])
    centre = table[where[index].first, at]
    least = np.linalg.norm(points - centre, axis=1)
    for other, part in zip(where, model.parts, strict=True):
        if part.on != where[index].name:
            continue
        line = table[other.first, at] - centre
        if (size := line @ line) > 0:
            share = np.clip((points - centre) @ line / size, 0, 1)
            gap = points - centre - share[:, None] * line
            least = np.minimum(least, np.linalg.norm(gap, axis=1))
    return least

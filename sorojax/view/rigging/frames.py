"""Frames of a model at one moment, and what lies between two of them.

Between two stations of a rod the strain is taken as constant, so that a section lies at
`pose exp(fraction twist)`: exact for constant strain, second order in the distance otherwise.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._jax.jit import once
from sorojax.math.host import KDTree
from sorojax.math.lie import SE2, SE3, homogeneous, logarithm
from sorojax.rod import Assembly, Rod, forward_kinematics

Components = Sequence[Array]


class Place(NamedTuple):
    """Frames of one part in a table of frames: the first, and how many."""

    name: str
    first: int
    count: int


def places(model: Rod | Assembly, stations: int) -> tuple[Place, ...]:
    """Where the parts of `model` have their frames: `stations` for a rod, one for a link."""
    if isinstance(model, Rod):
        return (Place("rod", 0, stations),)
    found, first = [], 0
    for name, part in zip(model.names, model.parts, strict=True):
        count = stations if isinstance(part.body, Rod) else 1
        found.append(Place(name, first, count))
        first += count
    return tuple(found)


def frame_table(
    model: Rod | Assembly,
    q: Float[Array, " coordinates"],
    stations: int,
    dim: int,
    base: Float[Array, "h h"] | None = None,
) -> Float[Array, "frames columns"]:
    """All frames, a row each, as `carry` reads them: where a frame is and how it goes on.

    Args:
        model: The rod or assembly.
        q: Its coordinates.
        stations: Frames along a rod, evenly spaced.
        dim: 2 or 3; a planar model may move points in space, parallel to its plane.
        base: Pose of the base of the model in the world, homogeneous [m].
    """
    s = jnp.linspace(0.0, 1.0, stations, dtype=q.dtype)
    found = forward_kinematics(model, q, s)
    parts = list(found.values()) if isinstance(found, dict) else [found]
    poses = _based(_lifted(jnp.concatenate(parts), dim), base)
    ends = np.cumsum([len(part) for part in parts]) - 1
    return pose_rows(poses, ends)


compiled_table = once(frame_table)


def position_columns(dim: int) -> slice:
    """Where a row of the table holds the position of its frame."""
    return slice(dim * dim, dim * (dim + 1))


def pose_rows(
    poses: Float[Array, "points h h"], ends: Int[np.ndarray, " ends"]
) -> Float[Array, "points columns"]:
    """Rows of a table from poses, each going on to the next, but not those at `ends`."""
    dim = poses.shape[1] - 1
    rotation, position = poses[:, :dim, :dim], poses[:, :dim, dim]
    group = SE2() if dim == 2 else SE3()
    after = np.arange(1, len(poses) + 1)
    after[ends] = ends
    back = jnp.swapaxes(rotation, 1, 2)
    shift = (back @ (position[after] - position)[:, :, None])[:, :, 0]
    twist = jax.vmap(functools.partial(logarithm, group))(
        homogeneous(back @ rotation[after], shift)
    )
    turn = tuple(twist[:, : group.rotation_dim].T)
    along = tuple(twist[:, group.rotation_dim :].T)
    swept = _cross(turn, along)
    paths = [_turned(rotation, v) for v in (along, swept, _cross(turn, swept))]
    columns = [rotation.reshape(len(poses), -1), position, jnp.stack(turn, axis=1), *paths]
    return jnp.concatenate(columns, axis=1)


def carry(
    columns: Components, fraction: Array, local: Components | None = None
) -> tuple[Array, ...]:
    """World coordinates of points with `local` places in the sections at `fraction` of the
    way from a frame to the next; of the middles of the sections if omitted.

    All are components, of shapes that broadcast; `columns` are those of the table.
    """
    dim = {13: 2, 24: 3}[len(columns)]
    end = dim * (dim + 1)
    rotation, position = columns[: dim * dim], columns[dim * dim : end]
    turn = columns[end : len(columns) - 3 * dim]
    paths = columns[len(columns) - 3 * dim :]
    f = fraction
    square = f * f * sum(w * w for w in turn)
    versine = f * f * _series(square, _VERSINE)
    residue = f * f * f * _series(square, _RESIDUE)
    moved = [
        position[k] + f * paths[k] + versine * paths[dim + k] + residue * paths[2 * dim + k]
        for k in range(dim)
    ]
    if local is None:
        return tuple(moved)
    sine = f * _series(square, _SINE)
    across = _cross(turn, local)
    twice = _cross(turn, across)
    own = [x + sine * y + versine * z for x, y, z in zip(local, across, twice, strict=True)]
    return tuple(
        moved[k] + sum(rotation[dim * k + i] * own[i] for i in range(dim)) for k in range(dim)
    )


def placed_in(columns: Components, fraction: Array, points: Components) -> tuple[Array, ...]:
    """The `local` places that `carry` takes to `points`."""
    dim = len(points)
    one, zero = jnp.ones_like(fraction), jnp.zeros_like(fraction)
    middle = carry(columns, fraction)
    arm = [p - m for p, m in zip(points, middle, strict=True)]
    found = []
    for i in range(dim):
        director = carry(columns, fraction, [one if k == i else zero for k in range(dim)])
        found.append(sum((director[k] - middle[k]) * arm[k] for k in range(dim)))
    return tuple(found)


# sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 in powers of t^2, to 1e-9 at t = 1
_SINE = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
_VERSINE = (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)
_RESIDUE = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)


def _series(x: Array, coefficients: tuple[float, ...]) -> Array:
    total = coefficients[-1] * x + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total = total * x + coefficient
    return total


def _turned(rotation: Float[Array, "points dim dim"], vector: Components) -> Array:
    return (rotation @ jnp.stack(vector, axis=1)[:, :, None])[:, :, 0]


def _lifted(poses: Float[Array, "points h h"], dim: int) -> Float[Array, "points h h"]:
    """Poses of a plane as poses in space."""
    own = poses.shape[1] - 1
    if own == dim:
        return poses
    if own > dim:
        raise ValueError(
            "skin: got plane points for a spatial model, need points of three coordinates."
        )
    count = len(poses)
    rotation = jnp.zeros((count, 3, 3), poses.dtype)
    rotation = rotation.at[:, :2, :2].set(poses[:, :2, :2]).at[:, 2, 2].set(1)
    return homogeneous(rotation, jnp.pad(poses[:, :2, 2], ((0, 0), (0, 1))))


def _based(poses, base: Array | None):
    if base is None:
        return poses
    do = "Give a homogeneous matrix of the frame of the points."
    _check.shape("skin", "base", base, poses.shape[1:], do)
    return base.astype(poses.dtype)[None] @ poses


def _cross(turn: Components, v: Components) -> tuple[Array, ...]:
    """The rate of v when it turns with `turn`, one number in a plane."""
    if len(v) == 2:
        return (-turn[0] * v[1], turn[0] * v[0])
    return (
        turn[1] * v[2] - turn[2] * v[1],
        turn[2] * v[0] - turn[0] * v[2],
        turn[0] * v[1] - turn[1] * v[0],
    )


# Which section of which part carries a point


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

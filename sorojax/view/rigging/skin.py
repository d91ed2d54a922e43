"""Skinning: surfaces carried by the sections of rods and by rigid links.

Every point is bound to the nearest section of a rod or to a link, at a place that stays the
same in the frame there; near a branch several parts share it by smooth weights. Points of
one interval between two frames are kept together in rows of `_LANES`, so that a frame is
read once per row and not per point.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.compiled import jit_public
from sorojax.rod import Assembly, Rod, rest
from sorojax.view.rigging.frames import (
    Held,
    Place,
    carry,
    compiled_table,
    frame_table,
    placed_in,
    places,
    search,
)

_LANES = 32


class Skin(eqx.Module):
    """Points bound to a model.

    Attributes:
        frame: The frame before the points of each row.
        fraction: How far from there to the next frame, in [0, 1].
        local: Place of a point in the frame there [m].
        weight: Share of the part in the point [-], or None if every point has one part.
        order: For each point the place of its main part in the rows.
        more: For each point the places of its other parts, or of a lane without weight.
        base: Pose of the base of the model in the frame of the points.
        stations: Frames along a rod.
    """

    frame: Int[Array, " rows"]
    fraction: Float[Array, "rows lanes"]
    local: Float[Array, "dim rows lanes"]
    weight: Float[Array, "rows lanes"] | None
    order: Int[Array, " points"]
    more: Int[Array, "others points"]
    base: Float[Array, "h h"] | None = eqx.field(converter=optional_real)
    stations: int = eqx.field(static=True)

    @property
    def num_points(self) -> int:
        return self.order.shape[0]


def bind(
    points: Float[Any, "points dim"],
    model: Rod | Assembly,
    q: Float[Any, " coordinates"] | None = None,
    *,
    base: Float[Any, "h h"] | None = None,
    parts: tuple[str, ...] | None = None,
    blend: float | None = None,
    stations: int = 65,
) -> Skin:
    """Bind points to the nearest sections of a rod, or of the parts of an assembly.

    A point behind the base or beyond the tip of a rod moves rigidly with that end. A link
    reaches from its frame to the joints on it. Points in space may be bound to a planar
    model: they keep their third coordinate.

    Args:
        points: In the reference configuration, e.g. the vertices of an STL file [m].
        model: The rod or assembly.
        q: Coordinates in the reference configuration; those at rest if omitted.
        base: Pose of the base of the model in the frame of the points, homogeneous [m];
            the same frame if omitted.
        parts: Names of the parts that may carry a point; all if omitted.
        blend: Width over which two parts share a point [m]; the radius of the thickest
            rod if omitted.
        stations: Frames along a rod; the surface is smooth between them.

    Returns:
        The bound points, for `deform`.

    Raises:
        ValueError: If a shape or a name does not fit.
    """
    where = "bind"
    points = np.asarray(real(points))
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
        raise ValueError(
            f"{where}: `points` has shape {points.shape}, need (points, 2) or (points, 3) with "
            "one point at least. Give vertices in metres."
        )
    _check.finite(where, "points", points, "Repair the surface first.")
    if stations < 3:
        raise ValueError(f"{where}: `stations` is {stations}, need 3 or more. 65 are usual.")
    q = rest(model) if q is None else real(q)
    base = None if base is None else real(base)
    table = np.asarray(compiled_table(model, q, stations, points.shape[1], base))
    held = search(points, model, table, places(model, stations), parts, blend)
    return hold(points, table, places(model, stations), held, base, stations)


def hold(
    points: Float[np.ndarray, "points dim"],
    table: Float[np.ndarray, "frames columns"],
    where: tuple[Place, ...],
    held: Held,
    base: Float[Array, "h h"] | None,
    stations: int,
) -> Skin:
    """The skin of points whose sections and weights are known."""
    starts = np.array([place.first for place in where])[held.part]
    last = np.array([place.count for place in where])[held.part] - 1
    at = np.clip(held.s, 0, 1) * last
    step = np.minimum(np.floor(at).astype(int), np.maximum(last - 1, 0))
    left, fraction = starts + step, at - step
    row, lane, frames = _rows(left)
    shared = not np.all(held.main)
    if shared:
        frames = np.append(frames, 0)  # a row without weight
    size = (len(frames), _LANES)
    local = _local(table[left].T, fraction, points[held.point].T)
    slots = row * _LANES + lane
    order = np.zeros(len(points), int)
    order[held.point[held.main]] = slots[held.main]
    more = _others(held, slots, len(points), len(frames) * _LANES - 1)
    return Skin(
        frame=jnp.asarray(frames, jnp.int32),
        fraction=_spread(size, row, lane, fraction),
        local=jnp.stack([_spread(size, row, lane, np.asarray(x)) for x in local]),
        weight=_spread(size, row, lane, held.weight) if shared else None,
        order=jnp.asarray(order, jnp.int32),
        more=jnp.asarray(more, jnp.int32),
        base=base,
        stations=stations,
    )


@jit_public
def deform(
    skin: Skin, model: Rod | Assembly, q: Float[Array, " coordinates"]
) -> Float[Array, "points dim"]:
    """Where the bound points are at coordinates `q` [m].

    Sections stay flat and keep their size. Differentiable in `q`, in the leaves of the
    model and in `skin.local`. Map over times with `jax.lax.map`.

    Args:
        skin: From `bind`.
        model: The rod or assembly.
        q: Coordinates.

    Returns:
        Points [m].
    """
    table = frame_table(model, q, skin.stations, skin.local.shape[0], skin.base)
    return carried(skin, table)


def carried(skin: Skin, table: Float[Array, "frames columns"]) -> Float[Array, "points dim"]:
    """Where the bound points are when the frames are those of `frame_table`."""
    columns = tuple(table[skin.frame].T[:, :, None])

    def rows() -> tuple[Array, ...]:
        fraction = skin.fraction.astype(table.dtype)
        moved = carry(columns, fraction, tuple(skin.local.astype(table.dtype)))
        if skin.weight is None:
            return moved
        return tuple(skin.weight.astype(table.dtype) * x for x in moved)

    def nowhere() -> tuple[Array, ...]:
        return (jnp.full(skin.fraction.shape, jnp.nan, table.dtype),) * skin.local.shape[0]

    # A branch that is always taken: XLA would otherwise merge the vectorised loop over rows
    # with the next step and compute every coordinate alone, three times as slow.
    moved = jax.lax.cond(skin.fraction[0, 0] >= 0, rows, nowhere)
    flat = jnp.stack([x.reshape(-1) for x in moved], axis=1)
    found = flat[skin.order]
    for other in skin.more:
        found = found + flat[other]
    return found


def _others(held: Held, slots, num_points: int, empty: int) -> Int[np.ndarray, "others points"]:
    """Slots of the parts of each point beside its main one, `empty` where there is none."""
    point, slot = held.point[~held.main], slots[~held.main]  # points in rising order
    _, first, count = np.unique(point, return_index=True, return_counts=True)
    found = np.full((count.max(initial=0), num_points), empty)
    found[np.arange(len(point)) - np.repeat(first, count), point] = slot
    return found


@jax.jit
def _local(columns, fraction, points) -> Float[Array, "dim entries"]:
    return jnp.stack(placed_in(tuple(columns), fraction, tuple(points)))


def _rows(left: Int[np.ndarray, " entries"]):
    """Row and lane of each entry, and the frame of each row: one frame per row."""
    order = np.argsort(left, kind="stable")
    frames, first, count = np.unique(left[order], return_index=True, return_counts=True)
    rows = -(-count // _LANES)
    start = np.cumsum(rows) - rows
    within = np.arange(len(left)) - np.repeat(first, count)
    row, lane = np.zeros(len(left), int), np.zeros(len(left), int)
    row[order] = np.repeat(start, count) + within // _LANES
    lane[order] = within % _LANES
    return row, lane, np.repeat(frames, rows)


def _spread(size, row, lane, values) -> Float[Array, "rows lanes"]:
    full = np.zeros(size, values.dtype)
    full[row, lane] = values
    return jnp.asarray(full)

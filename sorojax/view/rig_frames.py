"""Frames of a model at one moment, and what lies between two of them.

Between two stations of a rod the strain is taken as constant, so that a section lies at
`pose exp(fraction twist)`: exact for constant strain, second order in the distance otherwise.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.logarithm import logarithm
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


compiled_table = eqx.filter_jit(frame_table)


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
    """What turning with `turn`, one number in a plane, does to v."""
    if len(v) == 2:
        return (-turn[0] * v[1], turn[0] * v[0])
    return (
        turn[1] * v[2] - turn[2] * v[1],
        turn[2] * v[0] - turn[0] * v[2],
        turn[0] * v[1] - turn[1] * v[0],
    )

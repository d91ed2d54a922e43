"""Plane scenes as solid ones, and scenes brought to another place."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.view.raster.plane import rim
from sorojax.view.raster.scene import Arrows, Dots, Lines, Part, Scene, Surface


def extrude(scene: Scene, depth: float) -> Scene:
    """A plane scene as the solid that it is the side view of: x stays, y becomes z.

    Bodies in plane strain or plane stress are drawn so with the thickness that they have.
    Surfaces get a back and walls with the values of their rim, lines a copy at the back;
    arrows and dots lie in the middle.

    Args:
        scene: In the plane, as `scene_of` gives it.
        depth: Of the body across the plane, half of it on either side [m].

    Returns:
        A solid scene with the scale and heading of the plane one.

    Raises:
        ValueError: If the scene is solid already, or the depth is not above zero.

    Example:
        >>> plate = view.scene_of(mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1)))
        >>> lower, upper = view.extrude(plate, 20 * mm).box
        >>> print(1e3 * (upper - lower))
        [40. 20. 10.]
    """
    if scene.dim != 2:
        raise ValueError(
            "view.extrude: the scene is solid already, need a plane one. Leave `extrude` out."
        )
    _check.positive("view.extrude", "depth", depth, "m", "Lengths are in metres: 20 * mm.")
    extent = None
    if scene.extent is not None:
        lower, upper = (_at(corner[None], 0.0)[0] for corner in scene.extent)
        half = np.array([0.0, depth / 2, 0.0])
        extent = lower - half, upper + half
    parts = tuple(_solid(part, depth) for part in scene.parts)
    return replace(scene, parts=parts, extent=extent)


def place(scene: Scene, pose: Float[Any, "4 4"], colour: str | None = None) -> Scene:
    """A solid scene where `pose` takes it, all of it in `colour` if one is given.

    Args:
        scene: As it was drawn.
        pose: Homogeneous matrix from the old to the new coordinates [m].
        colour: As matplotlib takes it.

    Returns:
        The scene there.

    Raises:
        ValueError: If the scene is plane, or the pose is not 4 x 4.

    Example:
        >>> ball = view.scene_of(sdf.Sphere([0, 0, 0], 10 * mm))
        >>> lifted = view.place(ball, robots.pose_below(-30 * mm), "tab:blue")
        >>> print(np.round(1e3 * lifted.box[0]))
        [-10. -10.  20.]
    """
    if scene.dim != 3:
        raise ValueError("view.place: the scene is plane, need a solid one. Call view.extrude.")
    pose = np.asarray(pose, float)
    look = {} if colour is None else {"colour": colour}
    parts = tuple(replace(part, **_placed(part, pose), **look) for part in scene.parts)
    return replace(scene, parts=parts, extent=None)


def _placed(part: Part, pose: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """What changes of a part."""
    turn, shift = pose[:3, :3].T, pose[:3, 3]
    if isinstance(part, Lines):
        return {"runs": [np.asarray(run) @ turn + shift for run in part.runs]}
    if isinstance(part, Arrows):
        return {"starts": part.starts @ turn + shift, "vectors": part.vectors @ turn}
    return {"points": np.asarray(part.points) @ turn + shift}


def _at(points: Float[np.ndarray, "points 2"], place: float) -> Float[np.ndarray, "points 3"]:
    points = np.asarray(points, float)
    return np.stack([points[:, 0], np.full(len(points), place), points[:, 1]], axis=1)


def _solid(part: Part, depth: float) -> Part:
    front, back = -depth / 2, depth / 2
    if isinstance(part, Surface):
        return _block(part, front, back)
    if isinstance(part, Lines):
        runs = [_at(run, place) for place in (front, back) for run in part.runs]
        return replace(part, runs=runs)
    if isinstance(part, Arrows):
        return replace(part, starts=_at(part.starts, 0.0), vectors=_at(part.vectors, 0.0))
    assert isinstance(part, Dots)
    return replace(part, points=_at(part.points, 0.0))


def _block(part: Surface, front: float, back: float) -> Surface:
    """Front, back and walls. Triangles run counter-clockwise in the plane, and so they do for
    who looks along y at the front."""
    count, triangles = len(part.points), np.asarray(part.triangles)
    points = np.concatenate([_at(part.points, front), _at(part.points, back)])
    a, b = rim(triangles).T  # the body on the left of a to b
    walls = np.concatenate(
        [np.stack([a, a + count, b], axis=1), np.stack([b, a + count, b + count], axis=1)]
    )
    faces = np.concatenate([triangles, triangles[:, [0, 2, 1]] + count, walls])
    owner = np.concatenate([np.tile(np.arange(len(triangles)), 2), _beside(triangles, a, b)])
    values, colour, wire = part.values, part.colour, part.wire
    if values is not None:
        values = np.asarray(values)
        values = values[owner] if part.has_values_per_triangle else np.tile(values, 2)
    if not isinstance(colour, str):
        colour = np.asarray(colour)[owner]
    if wire is not None:
        wire = np.asarray(wire)
        bare = np.zeros((len(walls), 3), bool)
        wire = np.concatenate([wire, wire[:, [2, 1, 0]], bare])
    return replace(
        part, points=points, triangles=faces, values=values, colour=colour, wire=wire
    )


def _beside(triangles: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The triangle with the side from `a` to `b`, for both triangles of the wall there."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    size = int(triangles.max(initial=0)) + 1
    keys = sides @ np.array([size, 1])
    order = np.argsort(keys)
    found = order[np.searchsorted(keys, a * size + b, sorter=order)] % len(triangles)
    return np.tile(found, 2)

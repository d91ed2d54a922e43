"""Actors of a film for the web: surfaces with a place, a shape or a colour per frame."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax.fem import Problem, Solution, Trajectory
from sorojax.fem.equilibrium.solve import Path
from sorojax.mesh import Mesh
from sorojax.sdf import Surface
from sorojax.view import style
from sorojax.view.draw.meshes import shell
from sorojax.view.rigging.rig import Rig, pose

NodalField = Callable[[Problem, Float[Array, "nodes dim"]], Float[Array, " nodes"]]


class Actor(NamedTuple):
    """A surface through all frames.

    Attributes:
        triangles: Rows of points.
        points: In every frame, or once if the surface keeps its shape [m].
        poses: Homogeneous matrices that place it in every frame [m], or None.
        values: A number per point in every frame, or once, that colours it, or None.
        colour: As "#rrggbb", where there are no values.
        name: Shown in viewers that list objects.
    """

    triangles: Int[np.ndarray, "triangles 3"]
    points: Float[np.ndarray, "frames points 3"]
    poses: Float[np.ndarray, "frames 4 4"] | None = None
    values: Float[np.ndarray, "frames points"] | None = None
    colour: str = style.BODY
    name: str = "body"

    @property
    def num_frames(self) -> int:
        """Frames that it tells apart; 1 if it stands still."""
        parts = (self.points, self.poses, self.values)
        return max(len(part) for part in parts if part is not None)


def actor(
    thing: Any,
    *,
    q: Float[Any, "*frames coordinates"] | None = None,
    poses: Float[Any, "frames 4 4"] | None = None,
    displacements: Float[Any, "frames nodes dim"] | None = None,
    field: NodalField | None = None,
    values: Float[Any, "*frames points"] | None = None,
    colour: str = style.BODY,
    name: str = "body",
) -> Actor:
    """An actor from a noun of the framework.

    Args:
        thing: A `Rig` with `q`; a solution, path or motion of `fem`, with `field`; a mesh
            with `displacements`; a surface (vertices, triangles) with `poses`.
        q: Coordinates of a rig, one row per frame.
        poses: Poses of a rigid body, homogeneous, one per frame [m].
        displacements: Of the nodes of a mesh in every frame [m].
        field: `field(problem, u)` gives the value at every node of a result of `fem`.
        values: Values at the points (the nodes, for a mesh or a result of `fem`).
        colour: As "#rrggbb".
        name: Shown in viewers that list objects.

    Returns:
        What `to_html` and `to_glb` take.

    Raises:
        TypeError: If there is no way to draw `thing`.
        ValueError: If shapes do not fit or numbers are not finite.
    """
    if isinstance(thing, Rig):
        points = np.asarray(pose(thing, q))
        triangles = np.asarray(thing.triangles)
    elif isinstance(thing, Path | Trajectory | Solution):
        return _of_result(thing, field, values, colour, name)
    elif isinstance(thing, Mesh):
        moved = np.zeros((1, *thing.points.shape)) if displacements is None else displacements
        return _of_mesh(thing, np.asarray(moved), values, colour, name)
    elif isinstance(thing, Surface | tuple) and len(thing) == 2:
        points, triangles = (np.asarray(part) for part in thing)
    else:
        raise TypeError(
            f"actor: got a {type(thing).__name__}, need a Rig, a result of fem, a mesh or a "
            "surface. Bind a rod or an assembly to a surface with view.rig."
        )
    return checked(Actor(triangles, points, poses, values, colour, name))  # type: ignore[arg-type]


def checked(made: Actor) -> Actor:
    """The actor with arrays of three axes, its shapes and numbers seen to fit."""
    where = f"actor `{made.name}`"
    points = np.asarray(made.points, float)
    points = points[None] if points.ndim == 2 else points
    if points.ndim != 3 or points.shape[2] not in (2, 3) or not points.size:
        raise ValueError(
            f"{where}: points have shape {points.shape}, need (frames, points, 3). Give "
            "vertices in metres."
        )
    points = np.pad(points, ((0, 0), (0, 0), (0, 3 - points.shape[2])))
    triangles = np.asarray(made.triangles)
    _check.shape(where, "triangles", triangles, (None, 3), "Give rows of vertices.")
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= points.shape[1]:
        raise ValueError(
            f"{where}: got {len(triangles)} triangles that must name some of {points.shape[1]} "
            "points. Give triangles and vertices of one surface."
        )
    poses, values = made.poses, made.values
    _check.finite(where, "points", points, "Cut the motion where it failed.")
    if poses is not None:
        poses = np.asarray(poses, float)
        _check.shape(where, "poses", poses, (None, 4, 4), "Give homogeneous matrices.")
        _check.finite(where, "poses", poses, "Cut the motion where it failed.")
    if values is not None:
        values = np.atleast_2d(np.asarray(values, float))
        do = "Give one number per point."
        _check.shape(where, "values", values, (None, points.shape[1]), do)
        _check.finite(where, "values", values, "Cut the motion where it failed.")
    found = made._replace(triangles=triangles, points=points, poses=poses, values=values)
    counts = {len(part) for part in (points, poses, values) if part is not None} - {1}
    if len(counts) > 1:
        raise ValueError(
            f"{where}: points, poses and values have {sorted(counts)} frames, need one number "
            "of frames, or one frame for what does not change."
        )
    return found


def _of_result(result, field: NodalField | None, values, colour: str, name: str) -> Actor:
    """The surface of a body that was solved for."""
    single = isinstance(result, Solution)
    u = result.displacement[None] if single else result.displacements
    if field is not None:
        values = np.stack([np.asarray(field(result.problem, each)) for each in u])
    return _of_mesh(result.problem.mesh, np.asarray(u), values, colour, name)


def _of_mesh(mesh: Mesh, u: np.ndarray, values, colour: str, name: str) -> Actor:
    nodes, triangles = mesh_triangles(mesh)
    u = u[None] if u.ndim == 2 else u
    _check.shape("actor", "displacements", u, (None, *mesh.points.shape), "Give one per node.")
    points = np.asarray(mesh.points)[nodes] + u[:, nodes]
    if values is not None:
        values = np.atleast_2d(np.asarray(values, float))
        _check.shape("actor", "values", values, (None, mesh.num_nodes), "Give one per node.")
        values = values[:, nodes]
    return checked(Actor(triangles, points, None, values, colour, name))


def mesh_triangles(
    mesh: Mesh,
) -> tuple[Int[np.ndarray, " nodes"], Int[np.ndarray, "triangles 3"]]:
    """Nodes on the surface of a mesh, and flat triangles of them that face outwards; all
    nodes of a plane mesh."""
    nodes, rows = np.unique(shell(mesh).triangles, return_inverse=True)
    return nodes, rows.reshape(-1, 3)

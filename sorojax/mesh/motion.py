"""Node positions as a differentiable function of a shape, on a fixed topology."""

from collections import OrderedDict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import is_traced
from sorojax.math import sparse
from sorojax.mesh.elements import Tri3, Tri6
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.outline_plan import OutlinePlan, plan_outline
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.query import _shape_tangent, project, value_and_gradient

Fields = tuple[AbstractSdf, ...]
_ZOOMS = (0.3, 0.03, 3e-3, 1e-4, 1e-6)  # of an edge: where a corner's sides are seen


def move(
    mesh: Mesh, shape: AbstractSdf, *, interfaces: tuple[AbstractSdf, ...] = ()
) -> Mesh:
    """`mesh` with its nodes moved to fit `shape`, differentiable in the parameters.

    Boundary and interface nodes move onto the new zero sets: corners to where their
    sides meet, the others from the shifted place between their corners to the closest
    point. Interior nodes follow by one Laplace solve with the stiffness of `mesh`;
    interior sides stay straight. A mesh moved to its own shape stays as it is.

    The topology does not change: corners should move by less than a third of an edge
    length per call from the mesh given, or `triangulate` anew.

    Args:
        mesh: A concrete mesh from `triangulate`.
        shape: The new shape, of the same structure; may be traced.
        interfaces: The new interfaces, in the order given to `triangulate`.

    Raises:
        ValueError: If the mesh is traced, not made of triangles, or has other interfaces.
    """
    if is_traced(mesh):
        raise ValueError(
            "move: the mesh is traced, need concrete points and cells. Build it outside jit "
            "and trace only the parameters of the shape."
        )
    if not isinstance(mesh.element, Tri3 | Tri6):
        raise ValueError(f"move: got {mesh.element.name} cells, need Tri3 or Tri6.")
    plan, filling = _prepared(mesh, len(interfaces))
    displacement = _outline_displacement((shape, *interfaces), plan, mesh.points)
    points = mesh.points + filling.spread(displacement)
    return eqx.tree_at(lambda m: m.points, mesh, points)


class _Filling:
    """Spreads displacements of the outline over the inside."""

    def __init__(self, mesh: Mesh, plan: OutlinePlan):
        cells = np.asarray(mesh.cells)
        vertices = np.unique(cells[:, :3])
        number = np.full(mesh.num_nodes, -1)
        number[vertices] = np.arange(len(vertices))
        outline = np.concatenate([plan.corners, *(curve.nodes for curve in plan.curves)])
        on_outline = np.zeros(mesh.num_nodes, bool)
        on_outline[outline] = True
        self.system = sparse.from_cells(len(vertices), number[cells[:, :3]])
        stiffness = _laplace(np.asarray(mesh.points)[cells[:, :3]])
        self.values = sparse.assemble(self.system, jnp.asarray(stiffness))
        self.held = jnp.asarray(on_outline[vertices])
        self.fixed_values = sparse.fix(self.system, self.values, self.held)
        self.vertices = jnp.asarray(vertices)
        ends, middles = _straight_middles(mesh, on_outline)
        self.ends, self.middles = jnp.asarray(ends), jnp.asarray(middles)

    def spread(self, displacement: Float[Array, "nodes 2"]) -> Float[Array, "nodes 2"]:
        """Displacement of all nodes from that of the outline (zero elsewhere)."""

        def one(known):
            pull = -sparse.product(self.system, self.values, known)
            pull = jnp.where(self.held, jnp.zeros_like(pull), pull)
            return known + sparse.solve(self.system, self.fixed_values, pull)

        inside = jax.vmap(one, 1, 1)(displacement[self.vertices])
        everywhere = displacement.at[self.vertices].set(inside)
        between = everywhere[self.ends].mean(axis=1)
        return everywhere.at[self.middles].set(between)


def _laplace(x: np.ndarray) -> np.ndarray:
    """Stiffness of the Laplace operator on linear triangles."""
    side = np.roll(x, -2, axis=1) - np.roll(x, -1, axis=1)  # opposite to each corner
    doubled = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
    return np.einsum("cid,cjd->cij", side, side) / (2 * np.abs(doubled))[:, None, None]


def _straight_middles(mesh: Mesh, on_outline: np.ndarray):
    """Ends and number of the mid-side nodes that are not on the outline."""
    if mesh.element.order == 1:
        return np.zeros((0, 2), int), np.zeros(0, int)
    cells = np.asarray(mesh.cells)
    sides = np.concatenate([cells[:, list(facet)] for facet in mesh.element.facets])
    sides = sides[np.unique(sides[:, 2], return_index=True)[1]]
    sides = sides[~on_outline[sides[:, 2]]]
    return sides[:, :2], sides[:, 2]


_recent: OrderedDict[tuple[int, int, int], Any] = OrderedDict()


def _prepared(mesh: Mesh, num_interfaces: int) -> tuple[OutlinePlan, _Filling]:
    """Plan and factorised filling of `mesh`, kept for the last few meshes."""
    key = (id(mesh.points), id(mesh.cells), num_interfaces)
    if key not in _recent:
        # Concrete work, also when called under the user's trace.
        with jax.ensure_compile_time_eval():
            plan = plan_outline(mesh, num_interfaces)
            # The arrays are kept alive, so that their ids stay theirs.
            _recent[key] = (plan, _Filling(mesh, plan), mesh.points, mesh.cells)
        if len(_recent) > 4:
            _recent.popitem(last=False)
    _recent.move_to_end(key)
    return _recent[key][:2]


@eqx.filter_jit
def _outline_displacement(
    fields: Fields, plan: OutlinePlan, points: Float[Array, "nodes 2"]
) -> Float[Array, "nodes 2"]:
    moved = jnp.zeros_like(points)
    start = points[plan.corners]
    shift = jnp.zeros((1, 2), points.dtype)
    if len(plan.corners):
        shift = _meeting_points(fields, plan, start) - start
        moved = moved.at[plan.corners].set(shift)
    for field, curve in zip(fields, plan.curves, strict=True):
        guess = jnp.sum(curve.share[..., None] * shift[curve.between], axis=1)
        x = points[curve.nodes]
        moved = moved.at[curve.nodes].set(project(field, x + guess) - x)
    return moved


@eqx.filter_custom_jvp
def _meeting_points(
    fields: Fields, plan: OutlinePlan, start: Float[Array, "corners 2"]
) -> Float[Array, "corners 2"]:
    """Where the sides of each corner meet, looked at from nearer and nearer."""
    zooms = jnp.asarray(_ZOOMS, start.dtype)

    def closer(i, x):
        normals, levels, beside, _ = _sides_near(fields, plan, x, zooms[i])
        return x + _least_squares(normals, levels, beside, len(x))

    return jax.lax.fori_loop(0, len(_ZOOMS), closer, start)


@_meeting_points.def_jvp
def _meeting_points_jvp(primals, tangents):
    fields, plan, start = primals
    x = _meeting_points(fields, plan, start)
    zoom = jnp.asarray(_ZOOMS[-1], start.dtype)
    normals, _, beside, seen = _sides_near(fields, plan, x, zoom)

    def fields_at(fields):
        pairs = [value_and_gradient(f, p) for f, p in zip(fields, seen, strict=True)]
        return tuple(value for value, _ in pairs)

    slopes = [
        jnp.sqrt(jnp.sum(value_and_gradient(f, p)[1] ** 2, axis=1))
        for f, p in zip(fields, seen, strict=True)
    ]
    f_dot = jnp.concatenate(_shape_tangent(fields_at, fields, tangents[0]))
    speed = -f_dot / jnp.concatenate(slopes)
    return x, _least_squares(normals, speed, beside, len(x))


def _sides_near(fields: Fields, plan: OutlinePlan, x, zoom):
    """Normals of the sides beside the corners `x`, and how far x is from their lines."""
    normals, levels, seen = [], [], []
    for field, curve in zip(fields, plan.curves, strict=True):
        at = x[curve.beside]
        p = at + zoom * curve.along
        for _ in range(3):
            f, g = value_and_gradient(field, p)
            p = p - (f / jnp.sum(g * g, axis=1))[:, None] * g
        _, g = value_and_gradient(field, p)
        n = g / jnp.sqrt(jnp.sum(g * g, axis=1, keepdims=True))
        normals.append(n)
        levels.append(jnp.sum(n * (p - at), axis=1))
        seen.append(p)
    beside = jnp.concatenate([curve.beside for curve in plan.curves])
    return jnp.concatenate(normals), jnp.concatenate(levels), beside, tuple(seen)


def _least_squares(normals, levels, beside, count: int) -> Float[Array, "corners 2"]:
    """Step s of each corner with n . s = level for all of its sides."""
    outer = normals[:, :, None] * normals[:, None, :]
    matrix = jnp.zeros((count, 2, 2), normals.dtype).at[beside].add(outer)
    rhs = jnp.zeros((count, 2), normals.dtype).at[beside].add(normals * levels[:, None])
    return jnp.linalg.solve(matrix, rhs[..., None])[..., 0]

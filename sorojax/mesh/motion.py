"""Node positions as a differentiable function of a shape, on a fixed topology."""

from collections import OrderedDict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._types import integers, is_traced
from sorojax.math import sparse
from sorojax.mesh.elements import Tri3, Tri6
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.outline_plan import OutlinePlan, plan_outline
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.query import project, shape_tangent, value_and_gradient
from sorojax.sdf.surface import cross

Fields = tuple[AbstractSdf, ...]
_ZOOMS = (0.9, 0.3, 0.03, 3e-3, 1e-4, 1e-6)  # of an edge: where a corner's sides are seen


def move(mesh: Mesh, shape: AbstractSdf, *, interfaces: tuple[AbstractSdf, ...] = ()) -> Mesh:
    """`mesh` with its nodes moved to fit `shape`, differentiable in the parameters.

    Boundary and interface nodes move onto the new zero sets: corners to where their
    sides meet, the others from the shifted place between their corners to the closest
    point. Interior nodes follow by one Laplace solve with the stiffness of `mesh`;
    interior sides stay straight. A mesh moved to its own shape stays as it is.

    The topology does not change: corners should move by less than half of the edges
    beside them from where they are in `mesh`; beyond that, `triangulate` anew.

    Args:
        mesh: A concrete mesh from `triangulate`.
        shape: The new shape, of the same structure; may be traced.
        interfaces: The new interfaces, in the order given to `triangulate`.

    Raises:
        ValueError: If the mesh is traced, not made of triangles, has other interfaces, or
            (outside a trace) if a cell would turn inside out.
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
    points = mesh.points + _spread(filling, displacement)
    if not is_traced(points):
        _check_upright(np.asarray(points), np.asarray(mesh.cells))
    return eqx.tree_at(lambda m: m.points, mesh, points)


def _check_upright(points: np.ndarray, cells: np.ndarray) -> None:
    a, b, c = (points[cells[:, i]] for i in range(3))
    doubled = cross(b - a, c - a)
    if not np.all(doubled > 0):
        where = points[cells[np.argmin(np.nan_to_num(doubled, nan=-np.inf))]].mean(axis=0)
        raise ValueError(
            f"move: a cell turns inside out near {where} m: the shape changes by more than "
            "this mesh can follow. Change it less, or triangulate the new shape."
        )


class _Filling(eqx.Module):
    """The Laplace problem that spreads displacements of the outline over the inside."""

    system: sparse.SparseSymmetric
    values: Float[Array, " nnz"]
    fixed_values: Float[Array, " nnz"]
    held: Bool[Array, " vertices"]
    vertices: Int[Array, " vertices"] = eqx.field(converter=integers)
    ends: Int[Array, "middles 2"] = eqx.field(converter=integers)
    middles: Int[Array, " middles"] = eqx.field(converter=integers)


def _filling(mesh: Mesh, plan: OutlinePlan) -> _Filling:
    cells = np.asarray(mesh.cells)
    vertices = np.unique(cells[:, :3])
    number = np.full(mesh.num_nodes, -1)
    number[vertices] = np.arange(len(vertices))
    on_outline = np.zeros(mesh.num_nodes, bool)
    on_outline[np.concatenate([plan.corners, *(c.nodes for c in plan.curves)])] = True
    system = sparse.from_cells(len(vertices), number[cells[:, :3]])
    stiffness = jnp.asarray(_laplace(np.asarray(mesh.points)[cells[:, :3]]))
    held = jnp.asarray(on_outline[vertices])
    values, fixed_values = _assembled(system, stiffness, held)
    return _Filling(
        system, values, fixed_values, held, vertices, *_straight_middles(mesh, on_outline)
    )


@eqx.filter_jit
def _assembled(system, stiffness, held):
    values = sparse.assemble(system, stiffness)
    return values, sparse.fix(system, values, held)


@eqx.filter_jit
def _spread(
    filling: _Filling, displacement: Float[Array, "nodes 2"]
) -> Float[Array, "nodes 2"]:
    """Displacement of all nodes from that of the outline (zero elsewhere)."""
    system, held = filling.system, filling.held

    def one(known):
        pull = -sparse.product(system, filling.values, known)
        pull = jnp.where(held, jnp.zeros_like(pull), pull)
        return known + sparse.solve(system, filling.fixed_values, pull)

    inside = jax.vmap(one, 1, 1)(displacement[filling.vertices])
    everywhere = displacement.at[filling.vertices].set(inside)
    between = everywhere[filling.ends].mean(axis=1)
    return everywhere.at[filling.middles].set(between)


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
            _recent[key] = (plan, _filling(mesh, plan), mesh.points, mesh.cells)
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
        normals, levels, _, beside, _ = _sides_near(fields, plan, x, zooms[i])
        return x + _least_squares(normals, levels, beside, len(x))

    return jax.lax.fori_loop(0, len(_ZOOMS), closer, start)


@_meeting_points.def_jvp
def _meeting_points_jvp(primals, tangents):
    fields, plan, start = primals
    x = _meeting_points(fields, plan, start)
    zoom = jnp.asarray(_ZOOMS[-1], start.dtype)
    normals, _, slopes, beside, seen = _sides_near(fields, plan, x, zoom)

    def fields_at(fields):
        return tuple(f(p) for f, p in zip(fields, seen, strict=True))

    f_dot = jnp.concatenate(shape_tangent(fields_at, fields, tangents[0]))
    return x, _least_squares(normals, -f_dot / slopes, beside, len(x))


def _sides_near(fields: Fields, plan: OutlinePlan, x, zoom):
    """Sides beside the corners `x`: normal, how far x is from its line, slope, place."""
    sides, seen = [], []
    for field, curve in zip(fields, plan.curves, strict=True):
        at = x[curve.beside]

        def land(_, p, field=field):
            f, g = value_and_gradient(field, p)
            return p - (f / jnp.sum(g * g, axis=1))[:, None] * g

        p = jax.lax.fori_loop(0, 3, land, at + zoom * curve.along)
        _, g = value_and_gradient(field, p)
        slope = jnp.sqrt(jnp.sum(g * g, axis=1))
        n = g / slope[:, None]
        sides.append((n, jnp.sum(n * (p - at), axis=1), slope, curve.beside))
        seen.append(p)
    return *(jnp.concatenate(part) for part in zip(*sides, strict=True)), tuple(seen)


def _least_squares(normals, levels, beside, count: int) -> Float[Array, "corners 2"]:
    """Step s of each corner with n . s = level for all of its sides."""
    outer = normals[:, :, None] * normals[:, None, :]
    matrix = jnp.zeros((count, 2, 2), normals.dtype).at[beside].add(outer)
    rhs = jnp.zeros((count, 2), normals.dtype).at[beside].add(normals * levels[:, None])
    return jnp.linalg.solve(matrix, rhs[..., None])[..., 0]

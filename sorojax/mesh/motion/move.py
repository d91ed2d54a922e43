"""Node positions as a differentiable function of a shape on a fixed topology, and whether the
boundary of a mesh can follow its shape, and did.
"""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._types import integers, real
from sorojax.mesh.elements.base import facet_corners, nodes as reference_nodes, shape_functions
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.motion import shifts
from sorojax.mesh.motion.boundary import (
    ZOOMS,
    BoundaryPlan,
    Sides,
    meet,
    normals_near,
    settle,
    slide,
)
from sorojax.mesh.motion.plan import (
    Harmonic,
    carried,
    harmonic,
    laplace_cells,
    laplace_graph,
    plan_outline,
    plan_surface,
    spread,
)
from sorojax.mesh.quality import least_corner
from sorojax.mesh.resolution import raise_thin
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values_and_gradients

_OFF = 1e-3  # of an edge: distance from the zero set of a node that was to be on it
_FAR = 0.25  # of an edge: motion of a corner beyond which its sides may be taken for others
_ROUNDS = 5  # of taking nodes from ridges
_LOST = 0.5  # of the size: how far a sharp node may settle from where it is
_ROUND = 0.9986  # cosine of 3 degrees: sides that meet at less are one, seen close by


def movable(where: str, fields: tuple[AbstractSdf, ...], mesh: Mesh, size: Sizes) -> Mesh:
    """A solid mesh whose corners and ridge nodes settle where they are.

    Their sides are looked at from the facets beside them: where these are as long as a wall
    is thick, another surface is seen, and `move` would take it for theirs. Such nodes of the
    boundary count as those of a chamfer: they stay, and are no longer in "ridges" and
    "corners". Where interfaces meet the boundary there is an error.
    """
    for _ in range(_ROUNDS):
        lost = _unsettled(fields, mesh, size)
        if not len(lost):
            return mesh
        names = ("ridges", "corners")
        kept = {k: np.setdiff1d(mesh.node_sets[k], lost) for k in names if k in mesh.node_sets}
        fewer = eqx.tree_at(lambda m: m.node_sets, mesh, {**mesh.node_sets, **kept})
        if all(len(kept[k]) == len(mesh.node_sets[k]) for k in kept):
            break
        mesh = fewer
    raise_thin(where, fields, np.asarray(mesh.points)[lost], size)


def _unsettled(fields: tuple[AbstractSdf, ...], mesh: Mesh, size: Sizes) -> np.ndarray:
    """Corners and ridge nodes that do not settle where they are."""
    plan = plan_surface(mesh, len(fields) - 1).plan
    sharp = np.asarray(plan.sharp)
    x = np.asarray(mesh.points)[sharp]
    count = [len(own.beside) for own in plan.fields]
    sides = Sides(
        np.concatenate([own.beside for own in plan.fields]).astype(int),
        np.repeat(np.arange(len(fields)), count),
        np.concatenate([own.along for own in plan.fields]),
    )
    found = settle(fields, x, sides, ZOOMS, np.asarray(plan.ridge), np.asarray(plan.tangent))
    off = np.linalg.norm(found - x, axis=1) / size(x)
    return sharp[~(off < _LOST) | ~_meeting(fields, found, sides)]


def _meeting(fields: tuple[AbstractSdf, ...], x: np.ndarray, sides: Sides) -> np.ndarray:
    """Whether the sides of each point are more than one, seen from close by."""
    normal = normals_near(fields, x, sides, ZOOMS[-3])[0]
    mean = np.zeros_like(x)
    np.add.at(mean, sides.point, normal)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    apart = np.ones(len(x))
    np.minimum.at(apart, sides.point, (normal * mean[sides.point]).sum(axis=1))
    return apart < _ROUND


def check_followed(
    plan: BoundaryPlan, fields: tuple[AbstractSdf, ...], mesh: Mesh, moved, stages: int
) -> None:
    """Raise if nodes of the boundary missed their zero sets; warn if corners went far."""
    before, edge = np.asarray(mesh.points), _edges(mesh)
    for field, own in zip(fields, plan.fields, strict=True):
        nodes = np.concatenate([own.nodes, np.unique(np.asarray(plan.sharp)[own.beside])])
        f, g = values_and_gradients(field, moved[nodes])
        off = np.abs(f) / np.maximum(np.linalg.norm(g, axis=1), 1e-3)
        lost = np.flatnonzero(~(off < _OFF * edge[nodes]))
        if len(lost):
            raise ValueError(
                f"move: {len(lost)} nodes miss the new surface, the first near "
                f"{moved[nodes[lost[0]]]} m by {off[lost[0]]:.2g} m: the shape changes by more "
                "than this mesh can follow. Give the drawing `before` and more `stages`, or "
                "mesh the new shape."
            )
    sharp = np.asarray(plan.sharp)
    share = np.linalg.norm(moved[sharp] - before[sharp], axis=1) / edge[sharp] / stages
    if share.max(initial=0) > _FAR:
        _check.warn(
            f"move: a corner or ridge near {before[sharp[share.argmax()]]} m moves by "
            f"{share.max():.2f} of the edges beside it, need {_FAR:g} or less for certain "
            "derivatives. Give the drawing `before` and more `stages`, or mesh the new shape."
        )


def _edges(mesh: Mesh) -> np.ndarray:
    """Shortest side of the boundary beside each node [m]; infinite off the boundary."""
    points, count = np.asarray(mesh.points), facet_corners(mesh.element)
    groups = [boundary_facets(mesh)]
    groups += [np.asarray(f) for n, f in mesh.facet_sets.items() if n.startswith("interface_")]
    facets = np.concatenate(groups)
    corners = facets[:, :count]
    length = np.linalg.norm(points[np.roll(corners, -1, axis=1)] - points[corners], axis=2)
    shortest = np.full(len(points), np.inf)
    np.minimum.at(shortest, facets, np.repeat(length.min(axis=1)[:, None], facets.shape[1], 1))
    return shortest


# Node positions as a differentiable function of a shape, on a fixed topology


def move(
    mesh: Mesh,
    shape: AbstractSdf,
    *,
    interfaces: tuple[AbstractSdf, ...] = (),
    before: AbstractSdf | tuple[AbstractSdf, ...] | None = None,
    stages: int = 4,
) -> Mesh:
    """`mesh` with its nodes moved to fit `shape`, differentiable in the parameters of `shape`.

    Corners move to where their sides meet, nodes on the ridges of a solid stay on both
    sides. The others move along the normal of `mesh` onto the surface, and along it so that
    the sides between them change least: round parts are carried along. Interior nodes follow
    by one Laplace solve with the stiffness of `mesh`; straight sides stay straight. A mesh
    moved to its own shape stays as it is. Derivatives are those of the implicit function
    f(x) = 0 on the boundary.

    The topology does not change: corners may move by a quarter of the edges beside them
    from where they are in `mesh`, and normals turn by less than a right angle. A warning
    says when corners go farther, and nodes that miss the new surface are refused, also under
    `jax.grad`; under `jit` and `vmap` check `distortion` to see when to mesh again. With the
    drawing `before`, nodes go there through drawings in between, and that far in each.

    Args:
        mesh: A concrete mesh whose boundary nodes lie on the zero set, as `triangulate`
            and `tetrahedralise` make it; node sets "corners" and "ridges" are used where
            it has them, sharp turns of the boundary otherwise.
        shape: The new shape, of the same structure; may be traced.
        interfaces: The new interfaces, in the order given to the mesher; none by default.
        before: The shape that the mesh was made from, with interfaces a tuple of it and them;
            of the same structure, so that its numbers can change step by step.
        stages: Number of these steps; of use with `before` only.

    Returns:
        The same cells and sets with new points [m].

    Raises:
        ValueError: If the mesh is traced, made of polygons, has other interfaces, or
            (outside `jit`, `vmap`) if a cell would turn inside out or a node miss the surface;
            if `before` is another kind of drawing than the new one.

    Example:
        >>> cells = mesh.triangulate(sdf.Rectangle([0, 0], [40 * mm, 10 * mm]), size=5 * mm)
        >>> wider = mesh.move(cells, sdf.Rectangle([0, 0], [40 * mm, 11 * mm]))
        >>> print(f"{float(wider.points[:, 1].max()) / mm:.1f} mm")
        11.0 mm
    """
    if is_traced(mesh):
        raise ValueError(
            "move: the mesh is traced, need concrete points and cells. Build it outside jit "
            "and trace only the parameters of the shape."
        )
    if isinstance(mesh.element, PolyN):
        raise ValueError(
            f"move: got {mesh.element.name} cells, need triangles, quadrilaterals, "
            "tetrahedra or hexahedra. Mesh with triangulate."
        )
    fields = (shape, *interfaces)
    if any(field.dim != mesh.element.dim for field in fields):
        raise ValueError(
            f"move: the mesh is {mesh.element.dim}-D, the fields are "
            f"{[field.dim for field in fields]}-D. Pass the shape it was made from."
        )
    motion = _prepared(mesh, len(interfaces))
    way = [fields] if before is None else _between(before, fields, stages)
    points = moved_points(motion, way, mesh.points)
    points = _checked(points, fields, _Check(mesh, motion.border, len(way)))
    return eqx.tree_at(lambda m: m.points, mesh, points)


class _Check(eqx.Module):
    """What the points of a moved mesh are compared with."""

    mesh: Mesh
    plan: BoundaryPlan
    stages: int = eqx.field(static=True)


@eqx.filter_custom_jvp
def _checked(points: Array, fields: tuple[AbstractSdf, ...], by: _Check) -> Array:
    """The same points, refused where they are known and cells or nodes went wrong."""
    if not is_traced((points, fields)):
        with evaluated_now():
            _check_upright(np.asarray(points), by.mesh)
            check_followed(by.plan, fields, by.mesh, np.asarray(points), by.stages)
    return points


@_checked.def_jvp
def _checked_jvp(primals, tangents):
    return _checked(*primals), tangents[0]


def _between(before, fields: tuple[AbstractSdf, ...], stages: int) -> list:
    """Drawings whose numbers go from those of `before` to those of `fields`."""
    start = before if isinstance(before, tuple) else (before,)
    moving, rest = eqx.partition((start, fields), eqx.is_inexact_array)
    shapes = [[jnp.shape(x) for x in jax.tree.leaves(own)] for own in moving]
    kinds = [jax.tree.structure(own) for own in moving]
    if kinds[0] != kinds[1] or shapes[0] != shapes[1]:
        raise ValueError(
            "move: `before` is another kind of drawing than the new one, need the same with "
            "other numbers. Draw both by one function, the interfaces in one order."
        )
    if stages < 1:
        raise ValueError(f"move: got {stages} `stages`, need 1 or more. Four are usual.")

    def at(share: float):
        return jax.tree.map(lambda a, b: (1 - share) * a + share * b, *moving)

    shares = np.arange(1, stages) / stages
    return [*(eqx.combine(at(share), rest[1]) for share in shares), fields]


def _check_upright(points: np.ndarray, mesh: Mesh) -> None:
    corners = np.asarray(mesh.cells)[:, : mesh.element.num_corners]
    least = least_corner(points[corners], mesh.element.linear())
    if not np.all(least > 0):
        where = points[corners[np.argmin(np.nan_to_num(least, nan=-np.inf))]].mean(axis=0)
        do = "triangulate" if mesh.element.dim == 2 else "mesh"
        raise ValueError(
            f"move: a cell turns inside out near {where} m: the shape changes by more than "
            "this mesh can follow. Give the drawing `before` and more `stages`, or "
            f"{do} the new shape."
        )


class _Motion(eqx.Module):
    """The part of a move that no shape enters: plans, Laplace problems, straight sides.

    `middles` are nodes that follow the corners `parents` of a cell with `weights`; those
    in `bent` are put on the surface afterwards.
    """

    border: BoundaryPlan
    ridges: Harmonic | None
    surface: Harmonic | None
    along: Harmonic | None
    frames: Float[Array, "nodes dim dim"] = eqx.field(converter=real)
    inside: Harmonic | None
    middles: Int[Array, " middles"] = eqx.field(converter=integers)
    parents: Int[Array, "middles corners"] = eqx.field(converter=integers)
    weights: Float[Array, "middles corners"] = eqx.field(converter=real)
    bent: Int[Array, " bent"] = eqx.field(converter=integers)


def moved_points(
    motion: _Motion,
    stages: Sequence[tuple[AbstractSdf, ...]],
    points: Float[Array, "nodes dim"],
) -> Float[Array, "nodes dim"]:
    """Points of a mesh after its boundary has followed fields, one stage after the other."""
    shift = jnp.zeros_like(points)
    for fields in stages:
        shift = _boundary_to(motion, fields, points, shift)
    boundary = shift
    if motion.inside is not None:
        shift = spread(motion.inside, shift)
    return shifts.arrived(motion, points, shift, boundary)


def _boundary_to(motion: _Motion, fields: tuple[AbstractSdf, ...], points, shift):
    """Shifts of the boundary from those of the stage before to the surfaces of `fields`."""
    sharp = None
    if len(motion.border.sharp):
        sharp = _met(motion, fields, points, shift)
        for lines in (motion.ridges, motion.surface):
            if lines is None:
                continue
            step = spread(lines, shifts.to_sharp(motion, points, shift, sharp))
            shift = shifts.stepped(motion, shift, step)
            if lines is motion.ridges:
                sharp = _met(motion, fields, points, shift)
    shift = _landed(motion, fields, points, sharp, shift)
    if motion.along is not None:
        components = spread(motion.along, shifts.turned(motion, shift))
        shift = shifts.turned_back(motion, components)
        shift = _landed(motion, fields, points, sharp, shift)
    return shift


def _met(motion: _Motion, fields, points, shift):
    """Where the sharp nodes go."""
    (start,) = shifts.placed(motion, [motion.border.sharp], points, shift)
    return meet(fields, motion.border, start)


def _landed(motion: _Motion, fields, points, sharp, shift):
    """Shifts of the boundary from beside it to the surface."""
    groups = [own.nodes for own in motion.border.fields]
    beside = shifts.placed(motion, groups, points, shift)
    landed = slide(fields, motion.border, tuple(beside))
    return shifts.on_boundary(motion, points, sharp, landed)


def _motion(mesh: Mesh, num_interfaces: int) -> _Motion:
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    element, linear = mesh.element, mesh.element.linear()
    plan = (plan_outline if element.dim == 2 else plan_surface)(mesh, num_interfaces)
    known = np.zeros(mesh.num_nodes, bool)
    known[plan.corners] = True
    ridges = None
    if len(plan.ridges):
        ridges = harmonic(plan.ridges, laplace_graph(points, plan.ridges), known)
    known[np.asarray(plan.plan.sharp)] = True
    surface = harmonic(plan.faces, laplace_graph(points, plan.faces), known)
    along, frames = carried(points, plan)
    for own in plan.plan.fields:
        known[np.asarray(own.nodes)] = True
    corners = cells[:, : element.num_corners]
    inside = harmonic(corners, laplace_cells(points, corners, linear), known)
    others = cells[:, element.num_corners :]
    middles, place = np.unique(others, return_index=True)
    cell, column = np.divmod(place, max(others.shape[1], 1))
    share = shape_functions(linear, reference_nodes(element)[element.num_corners :])
    bent = middles[known[middles]]
    follows = (middles, corners[cell], share[column], bent)
    return _Motion(plan.plan, ridges, surface, along, frames, inside, *follows)


_recent: OrderedDict[tuple[int, int, int], Any] = OrderedDict()


def _prepared(mesh: Mesh, num_interfaces: int) -> _Motion:
    """The plan of `moved_points` for `mesh`, kept for the last few meshes."""
    key = (id(mesh.points), id(mesh.cells), num_interfaces)
    if key not in _recent:
        # Concrete work, also when called under the user's trace.
        with evaluated_now():
            # The arrays are kept alive, so that their ids stay theirs.
            _recent[key] = (_motion(mesh, num_interfaces), mesh.points, mesh.cells)
        if len(_recent) > 4:
            _recent.popitem(last=False)
    _recent.move_to_end(key)
    return _recent[key][0]

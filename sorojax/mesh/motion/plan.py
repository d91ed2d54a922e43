"""Displacements spread from some nodes of a mesh, curve or surface over all others."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import from_host, integers
from sorojax.math.linalg import sparse
from sorojax.math.linear_map import pushed
from sorojax.mesh.elements.base import (
    AbstractElement,
    facet_corners,
    quadrature,
    shape_gradients,
)
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.motion.boundary import BoundaryPlan, FieldPlan
from sorojax.sdf.sampling import connected, unit


class Harmonic(eqx.Module):
    """A Laplace problem on `nodes`, with displacements given where `held`."""

    system: sparse.SparseSymmetric
    values: Float[Array, " nnz"]
    fixed_values: Float[Array, " nnz"]
    held: Bool[Array, " own"]
    nodes: Int[Array, " own"] = eqx.field(converter=integers)


def harmonic(cells: np.ndarray, stiffness: np.ndarray, held: np.ndarray) -> Harmonic | None:
    """The problem on the nodes of `cells` with element matrices `stiffness`.

    Nodes that no `held` one is connected to are held as well; `None` if none is free.
    """
    nodes, number = np.unique(cells, return_inverse=True)
    number = number.reshape(cells.shape)
    fixed = held[nodes] | _adrift(number, held[nodes])
    if fixed.all():
        return None
    system = sparse.from_cells(len(nodes), number)
    values = sparse.assembled_on_host(system, stiffness)
    held_values = sparse.fixed_on_host(system, values, fixed)
    return Harmonic(system, from_host(values), from_host(held_values), from_host(fixed), nodes)


def _adrift(cells: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Nodes in parts without any held node."""
    first = np.repeat(cells[:, :1], cells.shape[1] - 1, axis=1).ravel()
    label = connected(len(held), first, cells[:, 1:].ravel())
    return ~np.isin(label, label[held])


def spread(
    problem: Harmonic, displacement: Float[Array, "nodes dim"]
) -> Float[Array, "nodes dim"]:
    """`displacement`, with that of the free nodes of `problem` made harmonic."""
    if is_traced(problem):
        return _spread(problem, displacement)
    return pushed([displacement], _Spread(problem, displacement))[0]


class _Spread:
    """`spread` as a `LinearMap`: outside `jit` it is solved without a program, as one that
    calls the host would be compiled anew in every process."""

    def __init__(self, problem: Harmonic, like: Float[Array, "nodes dim"]):
        self._problem = problem
        self.inputs = self.outputs = (jax.ShapeDtypeStruct(like.shape, like.dtype),)

    def push(self, *displacements) -> tuple:
        return (_spread(self._problem, *displacements),)

    def pull(self, *changes) -> list:
        return list(jax.linear_transpose(self.push, *self.inputs)(changes))

    def push_now(self, *displacements) -> tuple:
        own, held = self._own(displacements[0])
        pull = self._product(np.where(held, own, 0.0))
        return self._whole(displacements[0], np.where(held, own, -self._solved(pull)))

    def pull_now(self, *changes) -> tuple:
        own, held = self._own(changes[0])
        pull = self._product(self._solved(own))
        return self._whole(changes[0], np.where(held, own - pull, 0.0))

    def _own(self, nodal) -> tuple[np.ndarray, np.ndarray]:
        """Values at the nodes of the problem, and which of these are held."""
        at = np.asarray(self._problem.nodes)
        return np.asarray(nodal)[at], np.asarray(self._problem.held)[:, None]

    def _whole(self, nodal, own: np.ndarray) -> tuple[Array]:
        """`nodal` with the values `own` at the nodes of the problem."""
        whole = np.array(nodal)
        whole[np.asarray(self._problem.nodes)] = own
        return (from_host(whole),)

    def _solved(self, force: np.ndarray) -> np.ndarray:
        """Of the free nodes by `force` on them; zero at the held ones."""
        free = np.where(np.asarray(self._problem.held)[:, None], 0.0, force)
        solver = self._problem.system.solver
        return solver.solve(np.asarray(self._problem.fixed_values), free.T).T

    def _product(self, x: np.ndarray) -> np.ndarray:
        return self._problem.system.solver.product(np.asarray(self._problem.values), x)


@eqx.filter_jit
def _spread(problem: Harmonic, displacement):
    system, held = problem.system, problem.held

    def one(known):
        known = jnp.where(held, known, jnp.zeros_like(known))
        pull = -sparse.product(system, problem.values, known)
        pull = jnp.where(held, jnp.zeros_like(pull), pull)
        return known + sparse.solve(system, problem.fixed_values, pull)

    inside = jax.vmap(one, 1, 1)(displacement[problem.nodes])
    return displacement.at[problem.nodes].set(inside, unique_indices=True)


def laplace_cells(points: np.ndarray, cells: np.ndarray, element: AbstractElement):
    """Stiffness of the Laplace operator on linear cells, (cells, corners, corners)."""
    rule, x = quadrature(element), points[cells]
    total = np.zeros((len(cells), cells.shape[1], cells.shape[1]))
    for slope, weight in zip(shape_gradients(element, rule.points), rule.weights, strict=True):
        jacobian = np.einsum("cai,ad->cid", x, slope)
        det = np.abs(np.linalg.det(jacobian))
        g = slope @ np.linalg.inv(jacobian)
        total += (weight * det)[:, None, None] * np.einsum("cai,cbi->cab", g, g)
    return total


def laplace_graph(points: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Stiffness of springs along the sides of polygons in space (or of single lines).

    A side pulls with one over its length, so a displacement varies linearly along a line.
    """
    count = polygons.shape[1]
    total = np.zeros((len(polygons), count, count))
    for i in range(count if count > 2 else 1):
        j = (i + 1) % count
        length = np.linalg.norm(points[polygons[:, i]] - points[polygons[:, j]], axis=1)
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            total[:, a, b] += sign / np.maximum(length, 1e-300)
    return total


def carried(points: np.ndarray, plan: "Border") -> tuple[Harmonic | None, np.ndarray]:
    """How nodes go along the surface where they are given across it, and their frames.

    Of all displacements u with the given n . u at smooth nodes and the given u at sharp ones,
    the one whose differences along the sides of facets are least: a part that moves without
    changing its form is carried along. The unknowns are components of u in the `frames`
    (nodes, dim, dim) of the nodes, whose first row is the normal.
    """
    count, dim = points.shape
    frames = np.broadcast_to(np.eye(dim), (count, dim, dim)).copy()
    held = np.ones((count, dim), bool)
    for own in plan.plan.fields:
        nodes = np.asarray(own.nodes)
        frames[nodes] = _frames(np.asarray(own.normal))
        held[nodes, 1:] = False
    faces = plan.faces
    turned = np.einsum("faki,fbli->fakbl", frames[faces], frames[faces])
    stiffness = laplace_graph(points, faces)[:, :, None, :, None] * turned
    size = faces.shape[1] * dim
    unknowns = (dim * faces[:, :, None] + np.arange(dim)).reshape(-1, size)
    return harmonic(unknowns, stiffness.reshape(-1, size, size), held.ravel()), frames


def _frames(normal: np.ndarray) -> np.ndarray:
    """Orthonormal rows, the first of which are unit `normal`s."""
    if normal.shape[1] == 2:
        return np.stack([normal, normal[:, ::-1] * [-1.0, 1.0]], axis=1)
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = unit(np.cross(normal, least))
    return np.stack([normal, first, np.cross(normal, first)], axis=1)


# Sides between the facets of a surface: which are sharp, and the patches they bound


CREASE = np.deg2rad(40.0)  # turn between facets that makes a ridge, without a node set
FAINT = np.deg2rad(12.0)  # the same between nodes that are known to lie on ridges


class Sides(NamedTuple):
    """Distinct sides of facets.

    Attributes:
        ends: (sides, 2) nodes.
        sharp: (sides,) whether the normal jumps there, or surfaces meet.
        number: (facets, corners) side that starts at each corner of a facet.
        patch: (facets, corners) which smooth patch around its node a facet belongs to;
            numbers are unique to the node.
    """

    ends: np.ndarray
    sharp: np.ndarray
    number: np.ndarray
    patch: np.ndarray


def facet_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of triangles or quadrilaterals."""
    x = points[faces]
    if faces.shape[1] == 3:
        return unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]))
    return unit(np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]))


def surface_sides(points, faces, owner, known: np.ndarray | None = None) -> Sides:
    """Sides of `faces` (facets, corners), sharp where two owners or more than two facets
    meet, or where normals turn by much; `known` holds the nodes that lie on ridges."""
    count, n = faces.shape[1], len(points)
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys, number = np.unique(
        np.minimum(a, b) * np.int64(n) + np.maximum(a, b), return_inverse=True
    )
    ends = np.stack(np.divmod(keys, n), axis=1)
    order = np.argsort(number, kind="stable")
    start = np.searchsorted(number[order], np.arange(len(keys)))
    paired = np.bincount(number, minlength=len(keys)) == 2
    first, second = order[start[paired]], order[start[paired] + 1]
    normals = facet_normals(points, faces)
    cosine = (normals[first // count] * normals[second // count]).sum(axis=1)
    limit = np.full(len(first), np.cos(CREASE))
    if known is not None:
        limit = np.where(known[ends[paired]].all(axis=1), np.cos(FAINT), np.cos(CREASE))
    smooth = (cosine > limit) & (owner[first // count] == owner[second // count])
    sharp = np.ones(len(keys), bool)
    sharp[np.flatnonzero(paired)[smooth]] = False
    patch = _patches(faces, first[smooth], second[smooth])
    return Sides(ends, sharp, number.reshape(faces.shape), patch)


def _patches(faces: np.ndarray, first, second) -> np.ndarray:
    """Corners of facets joined where two facets share a smooth side."""
    count = faces.shape[1]
    flat = faces.ravel()

    def after(corner):
        return corner // count * count + (corner % count + 1) % count

    turned = flat[first] == flat[after(second)]
    partner = np.where(turned, after(second), second)
    other = np.where(turned, second, after(second))
    pairs = (np.concatenate([first, after(first)]), np.concatenate([partner, other]))
    return connected(flat.size, *pairs).reshape(faces.shape)


# What `move` needs to know about the outline of a plane mesh, worked out on the host


_SHARP = np.deg2rad(50.0)  # turn that makes a corner in a mesh without corner set


class Border(NamedTuple):
    """The plan of a boundary and what its guesses are spread over.

    Attributes:
        plan: For the device.
        corners: Sharp nodes that are not on a ridge.
        ridges: (n, 2) sides along ridges, ends only.
        faces: Facets by their corners, interfaces included.
    """

    plan: BoundaryPlan
    corners: np.ndarray
    ridges: np.ndarray
    faces: np.ndarray


def facet_groups(mesh: Mesh, num_interfaces: int) -> list[np.ndarray]:
    """Facets of the boundary, then of each interface; raises where their number differs."""
    found = sum(name.startswith("interface_") for name in mesh.facet_sets)
    if found != num_interfaces:
        raise ValueError(
            f"move: got {num_interfaces} `interfaces`, the mesh has {found}. Pass the ones "
            "it was made with, in the same order."
        )
    inner = [np.asarray(mesh.facet_sets[f"interface_{i}"]) for i in range(found)]
    return [np.asarray(mesh.facet_sets.get("boundary", boundary_facets(mesh))), *inner]


def plan_outline(mesh: Mesh, num_interfaces: int) -> Border:
    """The plan of a plane mesh."""
    points = np.asarray(mesh.points)
    groups = facet_groups(mesh, num_interfaces)
    if "corners" in mesh.node_sets:
        corners = np.unique(mesh.node_sets["corners"])
    else:
        corners = _sharp_nodes(points, groups[0])
    place = np.full(len(points), -1)
    place[corners] = np.arange(len(corners))
    taken = place >= 0
    fields = []
    for facets in groups:
        path = np.concatenate([facets[:, :1], facets[:, 2:], facets[:, 1:2]], axis=1)
        steps = np.concatenate([path[:, [i, i + 1]] for i in range(path.shape[1] - 1)])
        fields.append(_plan_curve(points, steps, place, taken))
        taken[steps] = True
    empty = np.zeros((0, 2))
    plan = BoundaryPlan(corners, np.zeros(0, int), empty, tuple(fields))
    faces = np.concatenate([facets[:, :2] for facets in groups])
    return Border(plan, corners, empty.astype(int), faces)


def _plan_curve(points, steps, place, taken) -> FieldPlan:
    along = points[steps[:, 1]] - points[steps[:, 0]]
    turned = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal = np.zeros_like(points)
    for end in (0, 1):
        np.add.at(normal, steps[:, end], turned)
    own = np.unique(steps)
    nodes = own[~taken[own]]
    first, last = place[steps[:, 0]], place[steps[:, 1]]
    beside = np.concatenate([first[first >= 0], last[last >= 0]])
    return FieldPlan(
        nodes=nodes,
        normal=unit(normal[nodes]),
        beside=beside,
        along=np.concatenate([along[first >= 0], -along[last >= 0]]),
    )


def _sharp_nodes(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    into = {int(b): points[b] - points[a] for a, b in facets[:, :2]}
    out = {int(a): points[b] - points[a] for a, b in facets[:, :2]}
    nodes = np.array([node for node in into if node in out], dtype=int)
    u, v = (np.array([side[int(n)] for n in nodes]).reshape(-1, 2) for side in (into, out))
    cross = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return nodes[np.abs(np.arctan2(cross, (u * v).sum(axis=1))) > _SHARP]


# What `move` needs to know about the surface of a solid mesh, worked out on the host


_STRAIGHT = 1e-9  # of a side: a mid-side node nearer than that to its middle
_FLAT = 0.06  # least eigenvalue of the sum of n n' at a corner; below it is a ridge


def plan_surface(mesh: Mesh, num_interfaces: int) -> Border:
    """The plan of a solid mesh: smooth nodes, ridge nodes and corners of its surface."""
    points = np.asarray(mesh.points)
    groups = facet_groups(mesh, num_interfaces)
    count = facet_corners(mesh.element)
    facets = np.concatenate(groups)
    owner = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    faces, middles = facets[:, :count], facets[:, count:]
    known = _marked(mesh)
    sides = surface_sides(points, faces, owner, known)
    allowed = _most_sides(mesh, faces, owner, known)
    corners, ridge, tangent, chamfers = _sharp_nodes_of_surface(points, faces, sides, allowed)
    bent = _curved(points, faces, middles)
    on_ridge = bent & sides.sharp[sides.number]
    if bent.any():
        ends = points[np.roll(faces, -1, axis=1)] - points[faces]
        tangent[middles[on_ridge]] = unit(ends[on_ridge])
        ridge = np.concatenate([ridge, np.unique(middles[on_ridge])])
    sharp = np.concatenate([corners, ridge]).astype(int)
    place = np.full(len(points), -1)
    place[sharp] = np.arange(len(sharp))
    taken, fields = place >= 0, []
    for i in range(len(groups)):
        own = owner == i
        patch = np.where(np.isin(sides.patch[own], chamfers), -1, sides.patch[own])
        rows = (faces[own], middles[own], bent[own], patch)
        fields.append(_plan_field(points, *rows, place, taken))
        taken[np.asarray(fields[-1].nodes)] = True
    where = np.arange(len(corners), len(sharp))
    plan = BoundaryPlan(sharp, where, tangent[sharp[where]], tuple(fields))
    return Border(plan, corners, sides.ends[sides.sharp], faces)


def _marked(mesh: Mesh) -> np.ndarray | None:
    """Whether nodes are known to lie on ridges; `None` if the mesh does not say."""
    if "ridges" not in mesh.node_sets:
        return None
    known = np.zeros(mesh.num_nodes, bool)
    for name in ("ridges", "corners"):
        known[np.asarray(mesh.node_sets.get(name, []), int)] = True
    return known


def _most_sides(mesh: Mesh, faces, owner, known: np.ndarray | None) -> np.ndarray:
    """How many sides a node may have: two on a ridge, any number at corners and where surfaces
    meet, else one. Where facets cut an edge off they turn sharply beside nodes of one side."""
    most = np.full(mesh.num_nodes, mesh.num_nodes)
    if known is None:
        return most
    count = np.zeros(mesh.num_nodes, int)
    for i in np.unique(owner):
        count[np.unique(faces[owner == i])] += 1
    single = count < 2
    single[np.asarray(mesh.node_sets.get("corners", []), int)] = False
    most[single] = np.where(known, 2, 1)[single]
    return most


def _sharp_nodes_of_surface(points, faces, sides: Sides, allowed: np.ndarray):
    """Corners, ridge nodes, the direction in which sharp nodes see no side, and the patches
    that are none of the `allowed` number of sides of their node."""
    n = len(points)
    patches, first, number = np.unique(
        sides.patch.ravel(), return_index=True, return_inverse=True
    )
    total = np.zeros((len(patches), 3))
    np.add.at(total, number.ravel(), np.repeat(facet_normals(points, faces), faces.shape[1], 0))
    owner, normal = faces.ravel()[first], unit(total)
    sharp = np.zeros(n, bool)
    sharp[sides.ends[sides.sharp]] = True
    count = np.bincount(owner, minlength=n)
    sharp &= (count > 1) & (allowed > 1)
    chamfer = np.zeros(len(patches), bool)
    for node in np.flatnonzero(sharp & (allowed == 2) & (count > 2)):
        mine = np.flatnonzero(owner == node)
        cosine = normal[mine] @ normal[mine].T
        chamfer[np.delete(mine, np.unravel_index(cosine.argmin(), cosine.shape))] = True
    matrix = np.zeros((n, 3, 3))
    np.add.at(matrix, owner, (normal * ~chamfer[:, None])[:, :, None] * normal[:, None, :])
    nodes = np.flatnonzero(sharp)
    strength, ways = np.linalg.eigh(matrix[nodes])
    tangent = np.zeros_like(points)
    tangent[nodes] = ways[:, :, 0]
    ridge = strength[:, 0] < _FLAT
    return nodes[~ridge], nodes[ridge], tangent, patches[chamfer]


def _curved(points, faces, middles) -> np.ndarray:
    """Whether the mid-side node of each side of a facet lies off its middle."""
    if not middles.shape[1]:
        return np.zeros(faces.shape, bool)
    a, b = points[faces], points[np.roll(faces, -1, axis=1)]
    gap = np.linalg.norm(points[middles[:, : faces.shape[1]]] - (a + b) / 2, axis=2)
    return gap > _STRAIGHT * np.linalg.norm(b - a, axis=2)


def _plan_field(points, faces, middles, bent, patch, place, taken) -> FieldPlan:
    normals, centres = facet_normals(points, faces), points[faces].mean(axis=1)
    total, own = np.zeros_like(points), np.zeros(len(points), bool)
    for column in faces.T:
        np.add.at(total, column, normals)
    own[faces] = True
    rows, columns = np.nonzero(bent)
    if len(rows):
        nodes = middles[rows, columns]
        np.add.at(total, nodes, normals[rows])
        own[nodes] = True
        held = place[nodes] >= 0
        rows, nodes = rows[held], nodes[held]
    else:
        nodes = np.zeros(0, int)
    smooth = np.flatnonzero(own & ~taken)
    row, corner = np.nonzero((place[faces] >= 0) & (patch >= 0))
    # One side per patch around a sharp node, seen towards the middle of its facets.
    which, first, number = np.unique(patch[row, corner], return_index=True, return_inverse=True)
    here = faces[row, corner]
    # Smooth nodes of the patch lie on it for certain; the far side of a facet is next best.
    smooth_ones = place[faces[row]] < 0
    weight = 1e-3 + smooth_ones.sum(axis=1)
    gaps = points[faces[row]] - points[here][:, None]
    towards = (gaps * (smooth_ones[..., None] + 5e-4)).sum(axis=1)
    along = np.zeros((len(which), 3))
    np.add.at(along, number, towards)
    along /= np.bincount(number, weight, len(which))[:, None]
    return FieldPlan(
        nodes=smooth,
        normal=unit(total[smooth]),
        beside=place[np.concatenate([here[first], nodes])],
        along=np.concatenate([along, centres[rows] - points[nodes]]),
    )

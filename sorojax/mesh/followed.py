"""Whether the boundary of a mesh can follow its shape, and whether it did."""

import warnings

import equinox as eqx
import numpy as np

from sorojax.mesh.boundary_motion import ZOOMS, BoundaryPlan
from sorojax.mesh.elements import facet_corners
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.resolved import thinnest
from sorojax.mesh.settle import Sides, settle
from sorojax.mesh.sizes import Sizes
from sorojax.mesh.surface_plan import plan_surface
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import values_and_gradients

_OFF = 1e-3  # of an edge: distance from the zero set of a node that was to be on it
_FAR = 0.25  # of an edge: motion of a corner beyond which its sides may be taken for others
_ROUNDS = 5  # of taking nodes from ridges
_NAMED = 24  # nodes at most of which the thinnest place is named
_LOST = 0.5  # of the size: how far a sharp node may settle from where it is


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
    x = np.asarray(mesh.points)[lost]
    name, at, thick = min(
        (thinnest(field, x[:_NAMED], size.largest) for field in fields), key=lambda f: f[2]
    )
    raise ValueError(
        f"{where}: {len(lost)} nodes of sharp edges are beside a {name}, a layer or a bend "
        f"too narrow for the cells, the thinnest near {at} m about {thick:.2g} m thick. "
        "Lower `size` to the thinnest wall or layer or less, or thicken it."
    )


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
    return sharp[~(off < _LOST)]


def check_followed(
    plan: BoundaryPlan, fields: tuple[AbstractSdf, ...], mesh: Mesh, moved: np.ndarray
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
                "than this mesh can follow. Change it less, or mesh the new shape."
            )
    sharp = np.asarray(plan.sharp)
    share = np.linalg.norm(moved[sharp] - before[sharp], axis=1) / edge[sharp]
    if share.max(initial=0) > _FAR:
        warnings.warn(
            f"move: a corner or ridge near {before[sharp[share.argmax()]]} m moves by "
            f"{share.max():.2f} of the edges beside it, need {_FAR:g} or less for certain "
            "derivatives. Mesh the new shape, or move in smaller steps of a new mesh each.",
            stacklevel=3,
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

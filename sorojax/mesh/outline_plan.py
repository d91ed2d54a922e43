"""What `move` needs to know about the outline of a plane mesh, worked out on the host."""

from typing import NamedTuple

import numpy as np

from sorojax.mesh.boundary_motion import BoundaryPlan, FieldPlan
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.surface_sides import unit

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
        corners = np.asarray(mesh.node_sets["corners"])
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

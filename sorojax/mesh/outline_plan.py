"""What `move` needs to know about the outline of a mesh, worked out once on the host."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import integers, real
from sorojax.mesh.mesh import Mesh, boundary_facets

_SHARP = np.deg2rad(50.0)  # turn that makes a corner in a mesh without corner set


class CurvePlan(eqx.Module):
    """One zero set: its smooth nodes and its edges next to corners.

    A smooth node starts from the displacements of the two corners it lies between,
    `share` of the first and of the second. `beside` lists for every edge end at a
    corner which corner (by place in the corner list) and the vector along the edge.
    """

    nodes: Int[Array, " smooth"] = eqx.field(converter=integers)
    between: Int[Array, "smooth 2"] = eqx.field(converter=integers)
    share: Float[Array, "smooth 2"] = eqx.field(converter=real)
    beside: Int[Array, " ends"] = eqx.field(converter=integers)
    along: Float[Array, "ends 2"] = eqx.field(converter=real)


class OutlinePlan(eqx.Module):
    """Corners and curves; curve 0 is the boundary, curve 1 + i is interface i."""

    corners: Int[Array, " corners"] = eqx.field(converter=integers)
    curves: tuple[CurvePlan, ...]


def plan_outline(mesh: Mesh, num_interfaces: int) -> OutlinePlan:
    """The plan of `mesh`; raises where its interfaces are not those given."""
    found = sum(name.startswith("interface_") for name in mesh.facet_sets)
    if found != num_interfaces:
        raise ValueError(
            f"move: got {num_interfaces} `interfaces`, the mesh has {found}. Pass the ones "
            "it was made with, in the same order."
        )
    points = np.asarray(mesh.points)
    facets = [np.asarray(mesh.facet_sets.get("boundary", boundary_facets(mesh)))]
    facets += [np.asarray(mesh.facet_sets[f"interface_{i}"]) for i in range(found)]
    links = [_links(f) for f in facets]
    if "corners" in mesh.node_sets:
        corners = np.asarray(mesh.node_sets["corners"])
    else:
        corners = _sharp_nodes(points, facets[0])
    place = {int(node): k for k, node in enumerate(corners)}
    taken: set[int] = set(place)
    curves = []
    for link in links:
        curves.append(_plan_curve(points, link, place, taken))
        taken |= set(link)
    return OutlinePlan(corners, tuple(curves))


def _links(facets: np.ndarray) -> dict[int, list[int]]:
    """Neighbours of each node along the curve, mid-side nodes included."""
    link: dict[int, list[int]] = {}
    for a, b, *middle in facets.tolist():
        path = [a, *middle, b]
        for p, q in zip(path[:-1], path[1:], strict=True):
            link.setdefault(p, []).append(q)
            link.setdefault(q, []).append(p)
    return link


def _plan_curve(points, link, place, taken) -> CurvePlan:
    between, share, beside, along = {}, {}, [], []
    for corner in (node for node in link if node in place):
        for after in link[corner]:
            beside.append(place[corner])
            along.append(points[after] - points[corner])
            path = _walk(link, corner, after, place)
            step = np.linalg.norm(np.diff(points[path], axis=0), axis=1)
            arc = np.r_[0, np.cumsum(step)] / step.sum()
            last = place.get(path[-1])
            for node, s in zip(path[1:-1], arc[1:-1], strict=True):
                if last is not None:
                    between[node] = (place[corner], last)
                    share[node] = (1 - s, s)
    nodes = [node for node in link if node not in taken]
    return CurvePlan(
        nodes=np.array(nodes, dtype=int),
        between=np.array([between.get(n, (0, 0)) for n in nodes], int).reshape(-1, 2),
        share=np.array([share.get(n, (0.0, 0.0)) for n in nodes]).reshape(-1, 2),
        beside=np.array(beside, dtype=int),
        along=np.array(along).reshape(-1, 2),
    )


def _walk(link, start: int, after: int, stops) -> list[int]:
    """Nodes from `start` through `after` to the next corner or the end of the curve."""
    path = [start, after]
    while path[-1] not in stops:
        onward = [node for node in link[path[-1]] if node != path[-2]]
        if not onward or onward[0] == start:
            break
        path.append(onward[0])
    return path


def _sharp_nodes(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    into = {int(b): points[b] - points[a] for a, b in facets[:, :2]}
    out = {int(a): points[b] - points[a] for a, b in facets[:, :2]}
    nodes = np.array([node for node in into if node in out], dtype=int)
    u, v = (np.array([side[int(n)] for n in nodes]).reshape(-1, 2) for side in (into, out))
    cross = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return nodes[np.abs(np.arctan2(cross, (u * v).sum(axis=1))) > _SHARP]

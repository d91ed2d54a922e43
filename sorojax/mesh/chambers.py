"""Connected pieces of the boundary: outer surfaces and the chambers they enclose."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from sorojax.mesh.elements import facet_corners
from sorojax.mesh.measure import enclosed_volume
from sorojax.mesh.mesh import Mesh, boundary_facets


class Chambers(NamedTuple):
    """A mesh with its chambers named.

    Attributes:
        mesh: The mesh with facet sets "chamber_0", "chamber_1", ... from left to right.
        volumes: What each encloses [m^3]; in the plane the area [m^2].
    """

    mesh: Mesh
    volumes: dict[str, float]

    def largest(self, count: int = 1) -> Int[np.ndarray, "facets facet_nodes"]:
        """Walls of the `count` largest chambers.

        Raises:
            ValueError: If there are not so many.
        """
        if not 1 <= count <= len(self.volumes):
            raise ValueError(
                f"Chambers.largest: got count={count}, need 1 to {len(self.volumes)}, as many "
                "as there are. Look at `volumes`."
            )
        names = sorted(self.volumes, key=lambda name: self.volumes[name])[-count:]
        return np.concatenate([np.asarray(self.mesh.facet_sets[name]) for name in names])


def boundary_loops(mesh: Mesh) -> list[Int[np.ndarray, "facets facet_nodes"]]:
    """Connected pieces of the boundary; in the plane in order along each loop."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    facets = boundary_facets(mesh)
    corners = facets[:, : facet_corners(mesh.element)]
    rows = np.repeat(corners[:, 0], corners.shape[1] - 1)
    pattern = (np.ones(len(rows)), (rows, corners[:, 1:].ravel()))
    graph = coo_matrix(pattern, shape=(mesh.num_nodes, mesh.num_nodes))
    label = connected_components(graph, directed=False)[1][corners[:, 0]]
    pieces = [facets[label == k] for k in np.unique(label)]
    return [_in_order(p) for p in pieces] if mesh.element.dim == 2 else pieces


def _in_order(loop: np.ndarray) -> np.ndarray:
    after: dict[int, list[int]] = {}
    for k, a in enumerate(loop[:, 0].tolist()):
        after.setdefault(a, []).append(k)
    order = [after[loop[0, 0]].pop()]
    while after.get(int(loop[order[-1], 1])):
        order.append(after[int(loop[order[-1], 1])].pop())
    # Loops that touch in a node stay together, the second after the first.
    rest = np.setdiff1d(np.arange(len(loop)), order)
    return loop[np.concatenate([order, rest]).astype(int)]


def chambers(mesh: Mesh) -> Chambers:
    """Every closed inner loop or surface as a facet set, and the volume it encloses.

    `enclosed_volume(mesh, facets)` gives the same number differentiably.
    """
    points = np.asarray(mesh.points)
    found = []
    for loop in boundary_loops(mesh):
        volume = float(enclosed_volume(mesh, loop))
        if volume > 0:
            found.append((tuple(points[loop].mean(axis=(0, 1)).round(12)), volume, loop))
    found.sort(key=lambda each: each[0])
    names = [f"chamber_{i}" for i in range(len(found))]
    sets = {name: loop for name, (_, _, loop) in zip(names, found, strict=True)}
    volumes = {name: volume for name, (_, volume, _) in zip(names, found, strict=True)}
    named = Mesh(
        mesh.points, mesh.cells, mesh.element, mesh.node_sets, mesh.facet_sets | sets,
        mesh.regions,
    )  # fmt: skip
    return Chambers(named, volumes)

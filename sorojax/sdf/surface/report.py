"""Checks of a triangulated surface, and the volume that it encloses."""

from typing import NamedTuple

import numpy as np

from sorojax.sdf.sampling import connected
from sorojax.sdf.surface.marching import Surface
from sorojax.sdf.trimesh.tree import crossing_triangles, least_wall

_SHELLS = 64  # of which it is sought whether they face the right way


class SurfaceReport(NamedTuple):
    """Findings about a triangle surface.

    Attributes:
        open_edges: (n, 2) vertices of edges with one triangle.
        crowded_edges: (n, 2) vertices of edges with more than two triangles.
        turned_edges: (n, 2) vertices of edges whose two triangles face opposite ways.
        pinched_vertices: Vertices where two sheets touch in one point.
        degenerate: Triangles that repeat a vertex.
        num_shells: Connected parts.
        genus: Number of handles, all shells together; -1 for an open surface.
        crossings: (n, 2) triangles that share no vertex and pass through each other; at most
            1000 of them.
        wall_thickness: Smallest distance [m] through the body along inward normals, between
            sides that face away from each other within 25 degrees; infinite for an open
            surface, and where no such sides are.
        volume: Enclosed volume [m^3], negative where triangles face inwards.
        area: Surface area [m^2].
        inverted_triangles: Triangles of shells that face the wrong way, such as a cavity
            whose normals point into the body: it then counts as filled. Swap two columns of
            these rows. Sought where the surface is closed, without crossings, and has at
            most 64 shells.
    """

    open_edges: np.ndarray
    crowded_edges: np.ndarray
    turned_edges: np.ndarray
    pinched_vertices: np.ndarray
    degenerate: np.ndarray
    num_shells: int
    genus: int
    volume: float
    area: float
    crossings: np.ndarray
    wall_thickness: float
    inverted_triangles: np.ndarray

    def __repr__(self) -> str:
        faults = (
            "open_edges", "crowded_edges", "turned_edges", "pinched_vertices", "degenerate",
            "crossings", "inverted_triangles",
        )  # fmt: skip
        found = [f"{len(getattr(self, f))} {f}" for f in faults if len(getattr(self, f))]
        return (
            f"SurfaceReport: {self.num_shells} shell(s) of genus {self.genus}, volume "
            f"{self.volume:.4g} m^3, area {self.area:.4g} m^2, wall {self.wall_thickness:.4g} "
            f"m\n  {', '.join(found) or 'no fault found'}{self._do()}"
        )

    def _do(self) -> str:
        if len(self.open_edges):
            return (
                "\n  A seam that does not quite close? Read by import_surface(..., weld=...).\n"
                "  Holes? Take mesh_surface."
            )
        return "\n  Crossings: mesh_surface mends them." if len(self.crossings) else ""

    @property
    def watertight(self) -> bool:
        """Whether every edge joins two triangles that face the same way."""
        bad = (self.open_edges, self.crowded_edges, self.turned_edges, self.degenerate)
        return not any(len(found) for found in bad)

    @property
    def printable(self) -> bool:
        """Whether it is manifold and no two triangles pass through each other."""
        return self.manifold and not len(self.crossings)

    @property
    def manifold(self) -> bool:
        """Whether it is watertight and no two sheets touch in a vertex."""
        return self.watertight and not len(self.pinched_vertices)


def surface_report(surface: Surface) -> SurfaceReport:
    """Check a surface: open, crowded and turned edges, inverted shells, genus, volume, area.

    Args:
        surface: Vertices [m] and triangles.

    Returns:
        What was found.

    Raises:
        ValueError: If a triangle names a vertex that is not there, or a vertex is not
            finite.
    """
    vertices, triangles = _checked(surface)
    t = triangles
    degenerate = np.flatnonzero(
        (t[:, 0] == t[:, 1]) | (t[:, 1] == t[:, 2]) | (t[:, 2] == t[:, 0])
    )
    half = np.stack([t, np.roll(t, -1, axis=1)], axis=-1).reshape(-1, 2)
    ordered = np.sort(half, axis=1)
    name = ordered[:, 0] * max(len(vertices), 1) + ordered[:, 1]
    _, first, edge, uses = np.unique(
        name, return_index=True, return_inverse=True, return_counts=True
    )
    balance = np.bincount(edge, np.where(half[:, 0] < half[:, 1], 1, -1), len(first))
    edges = ordered[first]
    turned = edges[(uses == 2) & (balance != 0)]
    shell, used, fans = _parts(t, edge, uses, len(vertices))
    corners = vertices[t]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    euler = used - len(edges) + len(t)
    closed = not np.any(uses != 2)
    shells = shell.max(initial=-1) + 1
    crossings = crossing_triangles(vertices, t)
    simple = closed and not len(turned) and not len(crossings) and shells <= _SHELLS
    return SurfaceReport(
        open_edges=edges[uses == 1],
        crowded_edges=edges[uses > 2],
        turned_edges=turned,
        pinched_vertices=np.flatnonzero(fans > 1),
        degenerate=degenerate,
        num_shells=shells,
        genus=shells - euler // 2 if closed else -1,
        volume=float((corners.mean(axis=1) * normal).sum() / 3),
        area=float(np.sqrt((normal * normal).sum(axis=1)).sum()),
        crossings=crossings,
        wall_thickness=least_wall(vertices, t) if closed and len(t) else np.inf,
        inverted_triangles=_inverted(corners, shell, shells) if simple else np.zeros(0, int),
    )


def _checked(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.asarray(surface.vertices, dtype=float).reshape(-1, 3)
    triangles = np.asarray(surface.triangles).astype(np.int64).reshape(-1, 3)
    wrong = ((triangles < 0) | (triangles >= len(vertices))).any(axis=1)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"surface_report: triangle {row} is {triangles[row].tolist()}, need rows of the "
            f"{len(vertices)} vertices. Read the file again or rebuild the surface."
        )
    lost = ~np.isfinite(vertices).all(axis=1)
    if lost.any():
        raise ValueError(
            f"surface_report: {int(lost.sum())} vertices are not finite, the first is number "
            f"{int(np.flatnonzero(lost)[0])}. Remove them or rebuild the surface."
        )
    return vertices, triangles


def _inverted(corners: np.ndarray, shell: np.ndarray, shells: int) -> np.ndarray:
    """Triangles of shells whose volume has not the sign of their depth: even depths are
    outsides, odd ones cavities."""
    parts = [corners[shell == k] for k in range(shells)]
    low = np.array([part.min(axis=(0, 1)) for part in parts]).reshape(-1, 3)
    high = np.array([part.max(axis=(0, 1)) for part in parts]).reshape(-1, 3)
    wrong = np.zeros(shells, dtype=bool)
    for k, part in enumerate(parts):
        around = np.flatnonzero(((low < low[k]) & (high > high[k])).all(axis=1))
        depth = sum(abs(_turns(part[0].mean(axis=0), parts[j])) > 0.5 for j in around)
        a, b, c = np.moveaxis(part - low[k], 1, 0)
        wrong[k] = ((a * np.cross(b, c)).sum() > 0) == (depth % 2 == 1)
    return np.flatnonzero(wrong[shell])


def _turns(p: np.ndarray, corners: np.ndarray) -> float:
    """How often closed triangles go around a point (Van Oosterom and Strackee)."""
    a, b, c = np.moveaxis(corners - p, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    ab, bc, ca = ((u * v).sum(axis=1) for u, v in ((a, b), (b, c), (c, a)))
    triple = (a * np.cross(b, c)).sum(axis=1)
    return np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi)


def _parts(t, edge, uses, count) -> tuple[np.ndarray, int, np.ndarray]:
    """Shell of each triangle, number of vertices used, of triangle fans around each vertex."""
    # Corners of triangles, joined to the same corner of the triangle across an edge.
    corner = np.arange(3 * len(t)).reshape(-1, 3)
    order = np.argsort(edge, kind="stable")
    pair = order[np.isin(edge[order], np.flatnonzero(uses == 2))].reshape(-1, 2)
    row, side = np.divmod(pair, 3)
    ends = [corner[row[:, k], side[:, k]] for k in (0, 1)]
    tails = [corner[row[:, k], (side[:, k] + 1) % 3] for k in (0, 1)]
    flat = t.ravel()
    same = flat[ends[0]] == flat[ends[1]]
    join = np.concatenate(
        [
            np.stack([ends[0], np.where(same, ends[1], tails[1])]),
            np.stack([tails[0], np.where(same, tails[1], ends[1])]),
        ],
        axis=1,
    )
    firsts = np.unique(connected(flat.size, *join), return_index=True)[1]
    fans = np.bincount(flat[firsts], minlength=count)
    shell = np.unique(connected(len(t), *row.T), return_inverse=True)[1]
    return shell, len(np.unique(flat)), fans

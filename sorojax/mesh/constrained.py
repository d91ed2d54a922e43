"""Triangles of points that keep given edges, and those inside a closed outline of them.

Edges that a Delaunay triangulation lacks are put in by exchanging diagonals (Sloan, A fast
algorithm for generating constrained Delaunay triangulations, 1993).
"""

from collections import deque

import numpy as np

from sorojax.math.spatial import Delaunay
from sorojax.mesh.outline import Outline


class Missing(Exception):
    """Edges that cannot be sides of triangles, as they meet others.

    Attributes:
        edges: Their rows in the outline.
    """

    def __init__(self, edges: list[int]):
        super().__init__(f"outline edges {edges} meet others")
        self.edges = edges


def constrained(points: np.ndarray, lines: Outline) -> np.ndarray:
    """Counter-clockwise triangles inside `lines`, every edge of which is a side.

    `points` (n, 2) [m] are those of `lines` and others.

    Raises:
        Missing: If edges of the outline cross, or points lie on them.
    """
    middle, reach = points.mean(axis=0), 8 * np.ptp(points, axis=0).max()
    around = middle + reach * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    sides = _Sides(np.concatenate([points, around]))
    lost = [k for k, (a, b) in enumerate(lines.edges.tolist()) if not sides.insert(a, b)]
    if not lost:
        ways = sides.of
        lost = [
            k
            for k, (a, b) in enumerate(lines.edges.tolist())
            if (a, b) not in ways or (b, a) not in ways
        ]
    if lost:
        raise Missing(lost)
    return _inside(sides.of, lines)


class _Sides:
    """A triangulation as the corner opposite to each directed side."""

    def __init__(self, points: np.ndarray):
        cells = Delaunay(points).simplices
        x = points[cells]
        a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        turned = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
        cells = np.where(turned[:, None], cells[:, [0, 2, 1]], cells)
        self.points, self.of = points.tolist(), {}
        self.beside: list[set[int]] = [set() for _ in points]
        for cell in cells.tolist():
            self._add(*cell)

    def _add(self, a: int, b: int, c: int) -> None:
        for u, v, w in ((a, b, c), (b, c, a), (c, a, b)):
            self.of[u, v] = w
            self.beside[u].add(v)

    def _remove(self, a: int, b: int, c: int) -> None:
        for u, v in ((a, b), (b, c), (c, a)):
            del self.of[u, v]
            self.beside[u].discard(v)

    def _turn(self, a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = self.points[a], self.points[b], self.points[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    def _cross(self, a: int, b: int, u: int, v: int) -> bool:
        """Whether the open segments a b and u v cross."""
        one = self._turn(a, b, u) * self._turn(a, b, v)
        return one < 0 and self._turn(u, v, a) * self._turn(u, v, b) < 0

    def insert(self, a: int, b: int) -> bool:
        """Make a b a side; false if a point lies on it."""
        if (a, b) in self.of or (b, a) in self.of:
            return True
        crossed = self._crossed(a, b)
        if crossed is None:
            return False
        waiting, turns = deque(crossed), 0
        while waiting:
            turns += 1
            if turns > 50 * (len(crossed) + 10):
                return False
            u, v = waiting.popleft()
            p, q = self.of[u, v], self.of[v, u]
            if not self._cross(p, q, u, v):
                waiting.append((u, v))
                continue
            self._remove(u, v, p)
            self._remove(v, u, q)
            self._add(p, q, v)
            self._add(q, p, u)
            if {p, q} != {a, b} and self._cross(a, b, p, q):
                waiting.append((p, q))
        return (a, b) in self.of or (b, a) in self.of

    def _crossed(self, a: int, b: int) -> list[tuple[int, int]] | None:
        """Sides that a b passes through, from `a` on."""
        for u in self.beside[a]:
            v = self.of[a, u]
            if self._cross(a, b, u, v):
                break
        else:
            return None
        crossed = [(u, v)]
        while True:
            w = self.of.get((v, u))
            if w is None:
                return None
            if w == b:
                return crossed
            if self._cross(a, b, u, w):
                v = w
            elif self._cross(a, b, w, v):
                u = w
            else:
                return None
            crossed.append((u, v))


def _inside(of: dict, lines: Outline) -> np.ndarray:
    """Triangles on the left of the boundary, spread over all sides but those of it."""
    ways = [tuple(edge) for edge in lines.edges[lines.owner == 0].tolist()]
    wall = {*ways, *((b, a) for a, b in ways)}
    found, waiting = set(), list(ways)
    while waiting:
        a, b = waiting.pop()
        cell = _cell(of, a, b)
        if cell not in found:
            found.add(cell)
            rest = ((cell[0], cell[1]), (cell[1], cell[2]), (cell[2], cell[0]))
            waiting += [(v, u) for u, v in rest if (u, v) not in wall and (v, u) in of]
    rows = np.flatnonzero(lines.owner == 0)
    leaks = [int(k) for k, (a, b) in zip(rows, ways, strict=True) if _cell(of, b, a) in found]
    if leaks:
        raise Missing(leaks)
    return np.array(sorted(found), dtype=int).reshape(-1, 3)


def _cell(of: dict, a: int, b: int) -> tuple[int, int, int]:
    """The triangle on the left of a b, its least corner first."""
    c = of[a, b]
    return (a, b, c) if a < min(b, c) else (b, c, a) if b < c else (c, a, b)

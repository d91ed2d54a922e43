"""Triangles inside a closed outline: hexagonal seeds, smoothed over Delaunay triangles, better
places for the inner nodes of the worst triangles, and edges of the outline put in by
exchanging diagonals.

Reference: Sloan, A fast algorithm for generating constrained Delaunay triangulations,
Computers & Structures 47, 1993.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sorojax._progress import report
from sorojax.math.host import Delaunay, KDTree
from sorojax.mesh.plane.outline import _GRADING, Outline
from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values
from sorojax.sdf.surface.marching import cross

# Nodes of poor cells moved to better places, in the plane and in space


class Mover(NamedTuple):
    """How nodes of poor cells are moved.

    Attributes:
        label: Of progress messages.
        measure: How bad cells are by their corners (cells, corners, dim).
        enough: Cells no worse than that are left alone.
        rank: Which nodes come first, by the worst of their cells and random numbers.
        ways: Unit vectors (ways, dim) along which a node is tried away from its place.
        steps: How far, in mean lengths of the edges beside it.
    """

    label: str
    measure: Callable[[np.ndarray], np.ndarray]
    enough: float
    rank: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ways: np.ndarray
    steps: tuple[float, float]


def relocate(
    mover: Mover,
    points: np.ndarray,
    cells: np.ndarray,
    fixed: np.ndarray,
    rounds: int,
    hold: Callable[..., None] | None = None,
) -> np.ndarray:
    """`points` with nodes of poor simplices, but the `fixed` ones, moved where that helps.

    In each round a set of nodes without common cells is moved, each to the best of a few
    places, once `hold(places, movers, reach, row, ball)` has put these where nodes may be.
    """
    points, order = points.copy(), np.argsort(cells.ravel(), kind="stable")
    start = np.searchsorted(cells.ravel()[order], np.arange(len(points) + 1))
    bad = mover.measure(points[cells])
    for turn in range(rounds):
        movers = _independent(mover, cells, bad, fixed, turn)
        if not len(movers):
            report(mover.label, rounds, rounds)
            break
        count = start[movers + 1] - start[movers]
        row = np.repeat(np.arange(len(movers)), count)
        offset = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        ball = order[start[movers][row] + offset] // cells.shape[1]
        places, reach = _places(mover, points, cells[ball], row, movers, count)
        if hold is not None:
            hold(places, movers, reach, row, cells[ball])
        x, lines = points[cells[ball]], np.arange(len(movers))
        at = np.argmax(cells[ball] == movers[row][:, None], axis=1)
        worst = np.full(places.shape[:2], -np.inf)
        for k in range(len(places)):
            x[np.arange(len(ball)), at] = places[k, row]
            np.maximum.at(worst[k], row, mover.measure(x))
        best = worst.argmin(axis=0)
        better = worst[best, lines] < worst[0] - 1e-9
        points[movers[better]] = places[best, lines][better]
        bad[ball] = mover.measure(points[cells[ball]])
        report(mover.label, turn + 1, rounds, moved=int(better.sum()))
    return points


def _independent(mover: Mover, cells, bad, fixed: np.ndarray, turn: int) -> np.ndarray:
    """Nodes of the worst cells, no two in one cell; other ones at every turn."""
    rng = np.random.default_rng(turn)  # only breaks ties: the result is reproducible
    worst, poor = np.full(len(fixed), -np.inf), bad > mover.enough
    np.maximum.at(worst, cells[poor].ravel(), np.repeat(bad[poor], cells.shape[1]))
    ranked = mover.rank(worst, rng.random(len(fixed)))
    score = np.where(np.isfinite(worst) & ~fixed, ranked, 0.0)
    top = score[cells].max(axis=1)
    beaten = np.zeros(len(fixed), bool)
    beaten[cells[(score[cells] < top[:, None]) & (top > 0)[:, None]]] = True
    return np.flatnonzero((score > 0) & ~beaten)


def _places(mover: Mover, points, ball, row, movers, count) -> tuple[np.ndarray, np.ndarray]:
    """Places to try (tries, movers, dim), the first where the node is, and the mean length
    (movers, 1) of the edges beside it."""
    here, others = points[movers], (ball.shape[1] - 1) * count[:, None]
    total, reach = np.zeros_like(here), np.zeros((len(here), 1))
    np.add.at(total, row, points[ball].sum(axis=1) - here[row])
    gaps = np.linalg.norm(points[ball] - here[row][:, None], axis=2)
    np.add.at(reach, row, gaps.sum(axis=1, keepdims=True))
    mean, reach = total / others, reach / others
    tries = [here, mean, (here + mean) / 2]
    tries += [here + step * reach * way for step in mover.steps for way in mover.ways]
    return np.stack(tries), reach


# Triangles: their angles, and how their nodes are moved


_WAYS = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)


def least_angles(x: np.ndarray) -> np.ndarray:
    """Smallest angle [rad] of triangles with corners `x` (cells, 3, 2); negative where a
    triangle is turned over."""
    out, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    return np.arctan2(cross(out, back), (out * back).sum(axis=2)).min(axis=1)


def polish(points, cells, fixed: int, enough: float, rounds: int) -> np.ndarray:
    """`points` with the nodes (the first `fixed` excepted) of triangles with an angle below
    `enough` [rad] moved to the best of a few places, where that helps."""

    def rank(worst, random):
        return (worst + enough) * (1 + random)

    mover = Mover("triangulate", lambda x: -least_angles(x), -enough, rank, _WAYS, (0.06, 0.15))
    return relocate(mover, points, cells, np.arange(len(points)) < fixed, rounds)


# Triangles of points that keep given edges, and those inside a closed outline of them


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
        turned = doubled_areas(points[cells]) < 0
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


# Interior points of a plane mesh: hexagonal seeds smoothed over Delaunay triangles


_GOOD = np.deg2rad(33.0)  # angle above which a triangle is left alone
_CLEAR = 0.45  # of the local size: least distance of an interior point to the outline


class SizeField:
    """Wanted edge length [m]: that of the outline near it, `size` far from it."""

    def __init__(self, lines: Outline, size: Sizes):
        total = np.zeros(len(lines.points))
        count = np.zeros(len(lines.points))
        for end in (0, 1):
            np.add.at(total, lines.edges[:, end], lines.lengths)
            np.add.at(count, lines.edges[:, end], 1)
        self.local = np.minimum(total / count, size.largest)
        self.sizes, self.size = size, size.largest
        self.tree = KDTree(lines.points)

    def __call__(self, p: np.ndarray) -> np.ndarray:
        distance, near = self.tree.query(p, k=min(6, self.tree.n))
        distance, near = np.atleast_2d(distance), np.atleast_2d(near)
        grown = self.local[near] + _GRADING * np.maximum(distance - self.local[near], 0)
        return np.minimum(grown.min(axis=1), self.sizes(p))


class Guard:
    """Keeps interior points out of the circles over the edges of the outline."""

    def __init__(self, lines: Outline):
        self.middle = lines.points[lines.edges].mean(axis=1)
        self.radius = 0.55 * lines.lengths
        self.tree = KDTree(self.middle)

    def push(self, p: np.ndarray) -> np.ndarray:
        """`p` moved to the nearest circle where it lies inside one."""
        k = min(4, self.tree.n)
        distance, near = self.tree.query(p, k=k)
        distance, near = distance.reshape(len(p), k), near.reshape(len(p), k)
        depth = self.radius[near] - distance
        worst = depth.argmax(axis=1)
        rows = np.arange(len(p))
        depth, near = depth[rows, worst], near[rows, worst]
        away = p - self.middle[near]
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
        return p + np.maximum(depth, 0)[:, None] * away


def triangles(shape: AbstractSdf, points: np.ndarray, size: float) -> np.ndarray:
    """Delaunay triangles of `points` whose centre lies inside `shape`."""
    cells = Delaunay(points).simplices
    corners = points[cells]
    doubled = doubled_areas(corners)
    # Points in line give triangles without area along straight sides.
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    solid = np.abs(doubled) > 1e-6 * longest**2
    cells, doubled = cells[solid], doubled[solid]
    inside = values(shape, points[cells].mean(axis=1)) < -1e-9 * size
    cells, doubled = cells[inside], doubled[inside]
    return np.where((doubled > 0)[:, None], cells, cells[:, ::-1])


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles whose `corners` (cells, 3, 2) come first; negative where
    they run clockwise."""
    return cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def fill(
    shape: AbstractSdf, lines: Outline, sizes: Sizes, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points (those of `lines` first) and triangles of the inside of `shape`.

    Raises:
        Missing: If edges of the outline cross.
    """
    wanted, guard, size = SizeField(lines, sizes), Guard(lines), sizes.smallest
    fixed = len(lines.points)
    points = np.concatenate([lines.points, _seeds(shape, lines, wanted, guard)])
    cells = np.zeros((0, 3), int)
    for i in range(iterations):
        # Every other step keeps the triangles: they change little and cost most.
        if i % 2 == 0 or i <= 3:
            cells = triangles(shape, points, size)
        if i in (3, 6) and i + 2 < iterations:
            points = _adapt(points, cells, fixed, wanted)
            cells = triangles(shape, points, size)
        points = _smooth(shape, points, cells, fixed, wanted, guard)
    cells = triangles(shape, points, size)
    if not _whole(lines, points, cells):
        cells = constrained(points, lines)
    used, numbers = np.unique(cells, return_inverse=True)
    cells = numbers.reshape(cells.shape)
    return polish(points[used], cells, fixed, _GOOD, 2 * iterations), cells


def _whole(lines: Outline, points: np.ndarray, cells: np.ndarray) -> bool:
    """Whether every edge of the outline is a side: once on the boundary, else twice."""
    sides = np.sort(np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]), 1)
    keys, count = np.unique(sides @ [len(points), 1], return_counts=True)
    want = np.sort(lines.edges, axis=1) @ [len(points), 1]
    slot = np.minimum(np.searchsorted(keys, want), len(keys) - 1)
    good = (keys[slot] == want) & (count[slot] == np.where(lines.owner == 0, 1, 2))
    used = len(cells) and np.isin(np.arange(len(lines.points)), cells).all()
    return bool(used and good.all() and (count == 1).sum() == (lines.owner == 0).sum())


def _seeds(shape, lines: Outline, wanted: SizeField, guard: Guard) -> np.ndarray:
    """Hexagonal lattices, each where its spacing fits the wanted size, finest first."""
    lower, upper = lines.points.min(axis=0), lines.points.max(axis=0)
    ratio = wanted.size / min(wanted.local.min(), wanted.sizes.smallest)
    levels = max(0, int(np.ceil(np.log(ratio) / np.log(1.5) - 0.3)))
    kept = np.zeros((0, 2))
    for level in range(levels, -1, -1):
        spacing = wanted.size / 1.5**level
        if spacing > 0.8 * wanted.sizes.smallest:
            p = _hexagons(lower, upper, spacing)
        else:  # only beside edges of the outline that are so short
            reach = (1.25 / _GRADING + 1) * spacing
            p = _hexagons(
                lower, upper, spacing, lines.points[wanted.local < 1.25 * spacing], reach
            )
        p = p[values(shape, p) < -_CLEAR * spacing]
        h = wanted(p) if len(p) else np.zeros(0)
        fits = h > spacing * (0.82 if level < levels else 0.0)
        if level:
            fits &= h <= spacing * 1.23
        p, h = p[fits], h[fits]
        others = KDTree(np.concatenate([lines.points, kept]))
        p = p[others.query(p)[0] > 0.62 * h] if len(p) else p
        kept = np.concatenate([kept, p])
    moved = guard.push(kept) if len(kept) else kept
    return kept[np.linalg.norm(moved - kept, axis=1) < 1e-12 * wanted.size]


def _hexagons(lower, upper, spacing: float, near=None, reach: float = 0.0) -> np.ndarray:
    """A hexagonal lattice over a box; with `near` (n, 2), only within about `reach` of it."""
    high = np.sqrt(0.75)
    count = np.ceil((upper - lower) / spacing / [1, high]).astype(int) + 1
    # Centred, so that a symmetric shape gets nearly symmetric seeds.
    most = np.array([count[0] - 1 + 0.5 * (count[1] > 1), (count[1] - 1) * high])
    start = (lower + upper) / 2 - spacing * most / 2
    if near is None:
        i, j = np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing="ij")
        ij = np.stack([i, j], axis=-1).reshape(-1, 2)
    else:
        here = np.unique(np.round((near - start) / spacing / [1, high]).astype(int), axis=0)
        wide = int(np.ceil(reach / spacing / high)) + 1
        block = np.stack(np.meshgrid(*[np.arange(-wide, wide + 1)] * 2), axis=-1)
        ij = np.unique((here[:, None] + block.reshape(-1, 2)).reshape(-1, 2), axis=0)
        ij = ij[((ij >= 0) & (ij < count)).all(axis=1)]
    grid = np.stack([ij[:, 0] + 0.5 * (ij[:, 1] % 2), ij[:, 1] * high], axis=-1)
    return start + spacing * grid


def _sides(cells: np.ndarray) -> np.ndarray:
    pairs = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _adapt(points, cells, fixed: int, wanted: SizeField) -> np.ndarray:
    """Drop one end of interior sides far too short, add middles of sides far too long."""
    sides = _sides(cells)
    ends = points[sides]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    ratio = length / wanted(ends.mean(axis=1))
    short = np.unique(sides[(ratio < 0.6) & (sides[:, 1] >= fixed), 1])
    long = (ratio > 1.55) & (sides[:, 1] >= fixed)
    keep = np.setdiff1d(np.arange(len(points)), short)
    return np.concatenate([points[keep], ends[long].mean(axis=1)])


def _smooth(shape, points, cells, fixed: int, wanted: SizeField, guard: Guard):
    """One step towards an optimal Delaunay triangulation graded by the wanted size."""
    corners = points[cells]
    center, area = _circumcenters(corners), doubled_areas(corners) / 2
    middle = corners.mean(axis=1)
    h = wanted(middle)
    far = ~(np.linalg.norm(center - middle, axis=1) <= 0.6 * h)  # or without area
    center = np.where(far[:, None], middle, center)
    weight = np.maximum(area, 0) / h**3  # cells that were kept may have turned over
    total = np.bincount(cells.ravel(), np.repeat(weight, 3), len(points))
    new = (
        np.stack(
            [
                np.bincount(cells.ravel(), np.repeat(weight * center[:, k], 3), len(points))
                for k in (0, 1)
            ],
            axis=-1,
        )
        / np.maximum(total, 1e-300)[:, None]
    )
    new = guard.push(new)
    count = np.maximum(np.bincount(cells.ravel(), minlength=len(points)), 1)
    around = np.bincount(cells.ravel(), np.repeat(h, 3), len(points)) / count
    keep = (total == 0) | (values(shape, new) > -0.2 * around)
    keep[:fixed] = True
    return np.where(keep[:, None], points, new)


def _circumcenters(corners: np.ndarray) -> np.ndarray:
    a = corners[:, 0]
    b, c = corners[:, 1] - a, corners[:, 2] - a
    doubled = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    bb, cc = (b * b).sum(axis=1), (c * c).sum(axis=1)
    x = (c[:, 1] * bb - b[:, 1] * cc) / doubled
    return a + np.stack([x, (b[:, 0] * cc - c[:, 0] * bb) / doubled], axis=-1)

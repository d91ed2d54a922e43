"""Polygons with holes split into convex ones, without new points.

Holes are joined to the outside by bridges, ears are cut off, and triangles are merged
again where the result is convex (Hertel and Mehlhorn, 1983).
"""

import numpy as np

_FLAT = 1e-12


def convex_parts(points: np.ndarray, loops: list[list[int]]) -> list[list[int]]:
    """Convex cells, counter-clockwise, of the piece inside `loops`, the outer one first."""
    if len(loops) == 1 and is_convex(points, loops[0]):
        return [loops[0]]
    ring = loops[0]
    for hole in sorted(loops[1:], key=lambda h: -points[h, 0].max()):
        ring = _bridged(points, ring, hole)
    return _merged(points, _ears(points, ring))


def is_convex(points: np.ndarray, ring: list[int]) -> bool:
    x = points[ring]
    into, out = x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
    turn = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
    return bool((turn >= -_FLAT * np.ptp(x, axis=0).max() ** 2).all())


def _turn(points, a: int, b: int, c: int) -> float:
    u, v = points[b] - points[a], points[c] - points[a]
    return float(u[0] * v[1] - u[1] * v[0])


def _bridged(points, ring: list[int], hole: list[int]) -> list[int]:
    """One ring that runs into the hole and back over the shortest free bridge."""
    pairs = [(i, j) for i in range(len(ring)) for j in range(len(hole))]
    pairs.sort(key=lambda ij: float(((points[ring[ij[0]]] - points[hole[ij[1]]]) ** 2).sum()))
    sides = [*zip(ring, ring[1:] + ring[:1], strict=True)]
    sides += [*zip(hole, hole[1:] + hole[:1], strict=True)]
    for i, j in pairs:
        a, b = ring[i], hole[j]
        if not any(_cross(points, a, b, c, d) for c, d in sides):
            return ring[: i + 1] + hole[j:] + hole[: j + 1] + ring[i:]
    return ring


def _cross(points, a: int, b: int, c: int, d: int) -> bool:
    if {a, b} & {c, d}:
        return False
    first = _turn(points, a, b, c) * _turn(points, a, b, d)
    return first < 0 and _turn(points, c, d, a) * _turn(points, c, d, b) < 0


def _ears(points, ring: list[int]) -> list[list[int]]:
    ring, triangles = list(ring), []
    least = _FLAT * float(np.ptp(points[ring], axis=0).max()) ** 2
    while len(ring) > 3:
        n, best = len(ring), None
        for i in range(n):
            a, b, c = ring[i - 1], ring[i], ring[(i + 1) % n]
            turn = _turn(points, a, b, c)
            if turn > least and not _blocked(points, ring, a, b, c):
                sides = points[[a, b, c]] - points[[b, c, a]]
                shape = turn / float((sides**2).sum())
                if best is None or shape > best[0]:
                    best = (shape, i)
        if best is None:
            break  # flat remains have no area
        i = best[1]
        triangles.append([ring[i - 1], ring[i], ring[(i + 1) % n]])
        del ring[i]
    if len(ring) == 3 and _turn(points, *ring) > least:
        triangles.append(ring)
    return triangles


def _blocked(points, ring, a: int, b: int, c: int) -> bool:
    p = points[[k for k in ring if k not in (a, b, c)]]
    inside = np.ones(len(p), bool)
    for u, v in ((a, b), (b, c), (c, a)):
        edge, to = points[v] - points[u], p - points[u]
        inside &= edge[0] * to[:, 1] - edge[1] * to[:, 0] >= 0
    return bool(inside.any())


def _merged(points, parts: list[list[int]]) -> list[list[int]]:
    """Parts joined over common sides, longest first, while they stay convex."""
    owner = {}
    for k, part in enumerate(parts):
        for a, b in zip(part, part[1:] + part[:1], strict=True):
            owner[a, b] = k
    inner = [(a, b) for a, b in owner if a < b and (b, a) in owner]
    inner.sort(key=lambda e: -float(((points[e[0]] - points[e[1]]) ** 2).sum()))
    for a, b in inner:
        i, j = owner[a, b], owner[b, a]
        if i == j:
            continue
        one, two = parts[i], parts[j]
        p, q = one.index(b), two.index(a)
        joined = (one[p:] + one[:p]) + (two[q:] + two[:q])[1:-1]
        if len(set(joined)) == len(joined) and is_convex(points, joined):
            parts[i], parts[j] = joined, []
            for u, v in zip(joined, joined[1:] + joined[:1], strict=True):
                owner[u, v] = i
    return [part for part in parts if part]

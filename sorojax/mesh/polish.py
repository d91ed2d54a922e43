"""Better places for the inner nodes of the worst triangles, on a fixed topology."""

import numpy as np

from sorojax._progress import report

_STEPS = (0.06, 0.15)  # of the sides: how far a node is tried away from its place
_WAYS = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)


def least_angles(x: np.ndarray) -> np.ndarray:
    """Smallest angle [rad] of triangles with corners `x` (cells, 3, 2); negative where a
    triangle is turned over."""
    out, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    turn = out[..., 0] * back[..., 1] - out[..., 1] * back[..., 0]
    angle = np.arctan2(turn, (out * back).sum(axis=2))
    return angle.min(axis=1)


def polish(points, cells, fixed: int, enough: float, rounds: int) -> np.ndarray:
    """`points` with the nodes (the first `fixed` excepted) of triangles with an angle below
    `enough` [rad] moved to the best of a few places, where that helps."""
    points, n = points.copy(), len(points)
    order = np.argsort(cells.ravel(), kind="stable")
    owner, start = order // 3, np.searchsorted(cells.ravel()[order], np.arange(n + 1))
    angle = least_angles(points[cells])
    for turn in range(rounds):
        movers = _independent(cells, angle, fixed, enough, turn, n)
        if not len(movers):
            report("triangulate", rounds, rounds)
            break
        count = start[movers + 1] - start[movers]
        row = np.repeat(np.arange(len(movers)), count)
        offset = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        ball = owner[start[movers][row] + offset]
        places = _places(points, cells[ball], row, movers, count)
        x = points[cells[ball]]
        at = np.argmax(cells[ball] == movers[row][:, None], axis=1)
        least = np.full(places.shape[:2], np.inf)
        for k in range(len(places)):
            x[np.arange(len(ball)), at] = places[k, row]
            np.minimum.at(least[k], row, least_angles(x))
        best, lines = least.argmax(axis=0), np.arange(len(movers))
        better = least[best, lines] > least[0] + 1e-9
        points[movers[better]] = places[best, lines][better]
        angle[ball] = least_angles(points[cells[ball]])
        report("triangulate", turn + 1, rounds, moved=int(better.sum()))
    return points


def _independent(cells, angle, fixed: int, enough: float, turn: int, n: int) -> np.ndarray:
    """Inner nodes of the worst triangles, no two in one; other ones at every turn."""
    rng = np.random.default_rng(turn)  # only breaks ties: the result is reproducible
    score = np.zeros(n)
    poor = np.flatnonzero(angle < enough)
    np.maximum.at(score, cells[poor].ravel(), np.repeat(enough - angle[poor], 3))
    score = np.where(score > 0, score * (1 + rng.random(n)), 0.0)
    score[:fixed] = 0.0
    top = score[cells].max(axis=1)
    beaten = np.zeros(n, bool)
    beaten[cells[(score[cells] < top[:, None]) & (top > 0)[:, None]]] = True
    return np.flatnonzero((score > 0) & ~beaten)


def _places(points, ball_cells, row, movers, count) -> np.ndarray:
    """Places to try, (tries, movers, 2); the first is where the node is."""
    here = points[movers]
    total, reach = np.zeros_like(here), np.zeros(len(here))
    np.add.at(total, row, points[ball_cells].sum(axis=1) - here[row])
    gaps = np.linalg.norm(points[ball_cells] - here[row][:, None], axis=2).sum(axis=1)
    np.add.at(reach, row, gaps)
    mean, reach = total / (2 * count)[:, None], (reach / (2 * count))[:, None]
    tries = [here, mean, (here + mean) / 2]
    tries += [here + s * reach * way for s in _STEPS for way in _WAYS]
    return np.stack(tries)

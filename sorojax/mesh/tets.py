"""Numbers of tetrahedra, and better places for the nodes of the worst ones."""

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import values_and_gradients

_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))  # opposite to each corner, outward
_STEPS = (0.08, 0.2)  # of the pitch: how far a node is tried away from its place


def signed_volumes(x: np.ndarray) -> np.ndarray:
    """Volumes [m^3] of tetrahedra with corners `x` (cells, 4, 3)."""
    a, b, c = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], x[:, 3] - x[:, 0]
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6


def dihedral_cosines(x: np.ndarray) -> np.ndarray:
    """Cosines of the six dihedral angles, (cells, 6)."""
    normals = []
    for i, j, k in _FACES:
        n = np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i])
        normals.append(n / np.maximum(np.sqrt((n * n).sum(axis=1)), 1e-300)[:, None])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    return np.stack([-(normals[i] * normals[j]).sum(axis=1) for i, j in pairs], axis=1)


def badness(x: np.ndarray) -> np.ndarray:
    """Largest |cos| of the dihedral angles; 2 for a cell without positive volume.

    It is 1/3 for the regular tetrahedron and near 1 where an angle is near 0 or pi.
    """
    worst = np.abs(dihedral_cosines(x)).max(axis=1)
    return np.where(signed_volumes(x) > 0, worst, 2.0)


def improve(
    shape: AbstractSdf, points, cells, skin, pitch: float, rounds: int, enough: float
) -> np.ndarray:
    """`points` with the nodes of cells worse than `enough` [rad] moved where that helps.

    In each round a set of nodes without common cells is moved, each to the best of a
    few places; nodes of the surface stay on it.
    """
    points, limit = points.copy(), np.cos(enough)
    owner = np.argsort(cells.ravel(), kind="stable") // 4
    start = np.searchsorted(np.sort(cells.ravel()), np.arange(len(points) + 1))
    bad = badness(points[cells])
    for i in range(rounds):
        movers = _independent(cells, bad, limit, i, len(points))
        if not len(movers):
            break
        ball, row = _balls(owner, start, movers)
        places = _places(shape, points, cells[ball], row, movers, skin, pitch)
        worst = np.zeros(places.shape[:2])
        x = points[cells[ball]]
        at = np.argmax(cells[ball] == movers[row][:, None], axis=1)
        lines = np.arange(len(ball))
        for k in range(places.shape[0]):
            x[lines, at] = places[k, row]
            np.maximum.at(worst[k], row, badness(x))
        best = worst.argmin(axis=0)
        better = worst[best, np.arange(len(movers))] < worst[0] - 1e-9
        points[movers[better]] = places[best, np.arange(len(movers))][better]
        bad[ball] = badness(points[cells[ball]])
    return points


def _independent(cells, bad, limit: float, turn: int, count: int) -> np.ndarray:
    """Nodes of the worst cells, no two in one cell; other ones at every turn."""
    rng = np.random.default_rng(turn)  # only breaks ties: the result is reproducible
    score = np.zeros(count)
    poor = np.flatnonzero(bad > limit)
    np.maximum.at(score, cells[poor].ravel(), np.repeat(bad[poor], 4))
    score = np.where(score > 0, score + 0.2 * rng.random(count), 0.0)
    top = score[cells].max(axis=1)
    beaten = np.zeros(count, bool)
    lower = (score[cells] < top[:, None]) & (top > 0)[:, None]
    beaten[cells[lower]] = True
    return np.flatnonzero((score > 0) & ~beaten)


def _balls(owner, start, movers):
    """Cells around each mover in one list, and which mover each belongs to."""
    count = start[movers + 1] - start[movers]
    row = np.repeat(np.arange(len(movers)), count)
    offset = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    return owner[start[movers][row] + offset], row


def _places(shape, points, ball_cells, row, movers, skin, pitch: float) -> np.ndarray:
    """Places to try, (tries, movers, 3); the first is where the node is."""
    here = points[movers]
    total = np.zeros_like(here)
    np.add.at(total, row, points[ball_cells].sum(axis=1) - here[row])
    mean = total / (3 * np.bincount(row, minlength=len(movers)))[:, None]
    tries = [here, here + 0.5 * (mean - here), mean]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    tries += [here + s * pitch * axis for s in _STEPS for axis in axes]
    places = np.stack(tries)
    on = skin[movers]
    moved = places[1:, on].reshape(-1, 3)
    for _ in range(3 if len(moved) else 0):
        f, g = values_and_gradients(shape, moved)
        moved = moved - (f / np.maximum((g * g).sum(axis=1), 1e-12))[:, None] * g
    places[1:, on] = moved.reshape(len(tries) - 1, -1, 3)
    return places


def radius_ratios(x: np.ndarray) -> np.ndarray:
    """Three times the inscribed over the circumscribed radius, 1 for regular cells."""
    a, b, c = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], x[:, 3] - x[:, 0]
    volume = np.abs(signed_volumes(x))
    faces = sum(
        np.linalg.norm(np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i]), axis=1) / 2
        for i, j, k in _FACES
    )
    turns = ((a, b, c), (b, c, a), (c, a, b))
    center = sum((u * u).sum(axis=1)[:, None] * np.cross(v, w) for u, v, w in turns)
    circum = np.linalg.norm(center, axis=1) / np.maximum(12 * volume, 1e-300)
    return 9 * volume / (faces * circum)

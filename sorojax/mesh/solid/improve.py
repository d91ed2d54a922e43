"""Removal of flat tetrahedra at the surface, which exchanges a diagonal of the surface."""

from typing import NamedTuple

import numpy as np

from sorojax._progress import report
from sorojax.mesh.motion.boundary import normals_near, settle
from sorojax.mesh.solid.lattice import badness, dihedral_cosines
from sorojax.mesh.solid.ridges import Features
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values, values_and_gradients

_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))  # opposite to each corner
_FLAT = np.cos(np.deg2rad(178.0))  # cosine of the angle between two faces that are one plane


def peel(points, cells, skin: np.ndarray, poor: float, rounds: int = 4) -> np.ndarray:
    """`cells` without those of nodes on the surface alone that are flatter than `poor`
    [rad], where two of their faces are on the surface and lie in one plane."""
    for _ in range(rounds):
        poorest = np.abs(dihedral_cosines(points[cells])).max(axis=1) > np.cos(poor)
        flat = np.flatnonzero(skin[cells].all(axis=1) & poorest)
        if not len(flat):
            return cells
        gone = _removable(points, cells, flat)
        if not len(gone):
            return cells
        cells = np.delete(cells, gone, axis=0)
    return cells


def _removable(points, cells, flat) -> list[int]:
    faces = np.sort(np.concatenate([cells[:, list(f)] for f in _FACES]), axis=1)
    rows = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
    single = (np.bincount(rows) == 1)[rows].reshape(4, -1).T
    outer = np.sort(faces[single.T.ravel()], axis=1)
    sides = {tuple(s) for k in ([0, 1], [1, 2], [0, 2]) for s in outer[:, k].tolist()}
    gone, touched = [], set()
    for cell in flat:
        corners, free = cells[cell], np.flatnonzero(single[cell])
        if len(free) != 2 or touched & set(corners.tolist()):
            continue
        # The new side joins the corners opposite to the two faces.
        new = tuple(sorted(corners[free].tolist()))
        normals = [_normal(points[corners[list(_FACES[k])]]) for k in free]
        if new in sides or normals[0] @ normals[1] < -_FLAT:
            continue
        gone.append(int(cell))
        touched |= set(corners.tolist())
    return gone


def _normal(x: np.ndarray) -> np.ndarray:
    n = np.cross(x[1] - x[0], x[2] - x[0])
    return n / max(float(np.linalg.norm(n)), 1e-300)


# Better places for the nodes of the worst tetrahedra


_STEPS = (0.08, 0.2)  # of the edges: how far a node is tried away from its place
_SAME_SIDE = 0.8  # least cosine between normals before and after: nodes cross no ridge
_LANDED = 1 - 1e-6  # cosine between the slopes before and after a landing beside a ridge
_ABREAST = (0.1, 0.01, 1e-3, 1e-4)  # zooms for nodes that are near their ridge already


class Surface(NamedTuple):
    """What holds nodes: fields, which one a smooth node lies on (or -1), and nodes on
    several sides."""

    fields: tuple[AbstractSdf, ...]
    owner: np.ndarray
    features: Features


def improve(surface: Surface, points, cells, rounds: int, enough: float) -> np.ndarray:
    """`points` with the nodes of cells worse than `enough` [rad] moved where that helps.

    In each round a set of nodes without common cells is moved, each to the best of a
    few places; nodes of the surface stay on it, those of ridges on both sides, and
    corners where they are.
    """
    points, limit = points.copy(), np.cos(enough)
    owner = np.argsort(cells.ravel(), kind="stable") // 4
    start = np.searchsorted(np.sort(cells.ravel()), np.arange(len(points) + 1))
    bad = badness(points[cells])
    for i in range(rounds):
        movers = _independent(cells, bad, limit, i, surface.features.corner)
        if not len(movers):
            report("tetrahedralise", rounds, rounds)
            break
        ball, row = _balls(owner, start, movers)
        places = _places(surface, points, cells[ball], row, movers)
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
        report("tetrahedralise", i + 1, rounds, moved=int(better.sum()))
    return points


def _independent(cells, bad, limit: float, turn: int, fixed: np.ndarray) -> np.ndarray:
    """Nodes of the worst cells, no two in one cell; other ones at every turn."""
    rng = np.random.default_rng(turn)  # only breaks ties: the result is reproducible
    count = len(fixed)
    score = np.zeros(count)
    poor = np.flatnonzero(bad > limit)
    np.maximum.at(score, cells[poor].ravel(), np.repeat(bad[poor], 4))
    score = np.where((score > 0) & ~fixed, score + 0.2 * rng.random(count), 0.0)
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


def _places(surface: Surface, points, ball_cells, row, movers) -> np.ndarray:
    """Places to try, (tries, movers, 3); the first is where the node is."""
    here = points[movers]
    total, reach = np.zeros_like(here), np.zeros(len(here))
    np.add.at(total, row, points[ball_cells].sum(axis=1) - here[row])
    count = np.bincount(row, minlength=len(movers))
    mean = total / (3 * count)[:, None]
    gaps = np.linalg.norm(points[ball_cells] - here[row][:, None], axis=2).sum(axis=1)
    np.add.at(reach, row, gaps)
    reach = (reach / (3 * count))[:, None]
    tries = [here, here + 0.5 * (mean - here), mean]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    tries += [here + s * reach * axis for s in _STEPS for axis in axes]
    places = np.stack(tries)
    ridge = surface.features.ridge[movers]
    beside = np.zeros(len(movers), bool)
    np.logical_or.at(beside, row, surface.features.ridge[ball_cells].any(axis=1))
    for i, field in enumerate(surface.fields):
        _hold_on_skin(field, places, (surface.owner[movers] == i) & ~ridge, beside)
    _hold_on_ridges(surface, places, movers, ridge, reach[:, 0])
    return places


def _hold_on_skin(shape: AbstractSdf, places, on: np.ndarray, beside: np.ndarray) -> None:
    if not on.any():
        return
    moved, tries = places[:, on].reshape(-1, 3), len(places)
    normals = []
    for _ in range(3):
        f, g = values_and_gradients(shape, moved)
        square = np.maximum((g * g).sum(axis=1), 1e-12)
        moved = moved - (f / square)[:, None] * g
        normals.append((g / np.sqrt(square)[:, None]).reshape(tries, -1, 3))
    moved, last = moved.reshape(tries, -1, 3), normals[-1]
    crossed = (last * last[0]).sum(axis=2) < _SAME_SIDE
    # What lands on the ridge itself came from where the slope is that of neither side.
    crossed |= beside[on] & ((last * normals[0]).sum(axis=2) < _LANDED)
    places[1:, on] = np.where(crossed[..., None], places[0, on], moved)[1:]


def _hold_on_ridges(surface: Surface, places, movers, on: np.ndarray, reach) -> None:
    if not on.any():
        return
    tries, count = len(places) - 1, int(on.sum())
    sides = surface.features.sides.of(movers[on], len(surface.owner))
    shift = (np.arange(tries) * count)[:, None]
    all_sides = sides._replace(
        point=(sides.point + shift).ravel(),
        field=np.tile(sides.field, tries),
        along=np.tile(sides.along, (tries, 1)),
    )
    here = places[0, on]
    normals = normals_near(surface.fields, here, sides, 0.1)[0]
    order = np.argsort(sides.point, kind="stable").reshape(count, 2)
    tangent = np.cross(normals[order[:, 0]], normals[order[:, 1]])
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    # Only along the ridge, or both sides would see the same one.
    step = ((places[1:, on] - here) * tangent).sum(axis=2, keepdims=True) * tangent
    start = (here + step).reshape(-1, 3)
    moved = settle(surface.fields, start, all_sides, _ABREAST).reshape(tries, count, 3)
    far = np.linalg.norm(moved - here, axis=2) > 0.5 * reach[on]
    flat = moved.reshape(-1, 3)
    for i in np.unique(sides.field):
        off = np.abs(values(surface.fields[i], flat)).reshape(tries, count)
        off[:, np.setdiff1d(np.arange(count), sides.point[sides.field == i])] = 0.0
        far |= off > 1e-4 * reach[on]
    places[1:, on] = np.where(far[..., None], here, moved)

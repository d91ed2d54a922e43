"""Flat tetrahedra at the surface taken away, as an exchange of a diagonal of the surface."""

import numpy as np

from sorojax.mesh.tet_shape import dihedral_cosines

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

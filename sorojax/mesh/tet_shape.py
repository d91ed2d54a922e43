"""Numbers of tetrahedra: volumes, dihedral angles, radius ratios."""

import numpy as np

_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))  # opposite to each corner, outward


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
    """Largest |cos| of the dihedral angles; 2 to 3 for a cell without positive volume.

    It is 1/3 for the regular tetrahedron and near 1 where an angle is near 0 or pi.
    """
    worst = np.abs(dihedral_cosines(x)).max(axis=1)
    volume = signed_volumes(x)
    good = volume > 0
    if good.all():
        return worst
    # The more inverted the worse, so that moves can lead out of it.
    side = np.linalg.norm(x - x[:, [1, 2, 3, 0]], axis=2).max(axis=1)
    depth = 6 * np.abs(volume) / np.maximum(side, 1e-300) ** 3
    return np.where(good, worst, 3 - 1 / (1 + depth))


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

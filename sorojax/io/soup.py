"""From what a surface file holds to a surface: limits, merged corners, checked indices."""

import numpy as np

from sorojax.sdf import Surface

FARTHEST = 1e9  # file units: anything beyond is damage, not a body


def check_numbers(where: str, points: np.ndarray) -> None:
    """Raise unless every coordinate (in file units) is finite and of a sane size."""
    sane = np.abs(points) <= FARTHEST  # false for NaN as well
    if not sane.all():
        row = int(np.flatnonzero(~sane.all(axis=-1))[0])
        raise ValueError(
            f"{where}: vertex {row} is {points[row].tolist()}, need finite coordinates below "
            f"{FARTHEST:g}. The file is damaged: export it again."
        )


def indexed(where: str, points: np.ndarray, triangles: np.ndarray, unit: float) -> Surface:
    """A surface of vertices and rows of them, checked before any of them is used."""
    check_numbers(where, points)
    if not len(triangles):
        raise ValueError(f"{where}: the file holds no triangle. Check that it is a surface.")
    wrong = ((triangles < 0) | (triangles >= len(points))).any(axis=1)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"{where}: triangle {row} uses vertices {triangles[row].tolist()}, the file has "
            f"{len(points)}. The file is damaged: export it again."
        )
    return Surface(points.astype(float) * unit, triangles.astype(np.int32))


def merged(where: str, corners: np.ndarray, unit: float) -> Surface:
    """A surface of loose triangles (n, 3, 3): equal corners become one vertex."""
    # Minus zero and zero are one place but differ in their bits.
    flat = np.ascontiguousarray(corners.reshape(-1, 3).astype(np.float32) + np.float32(0))
    check_numbers(where, flat)
    rows = flat.view([("", flat.dtype)] * 3).ravel()
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    return indexed(where, flat[first], which.reshape(-1, 3), unit)

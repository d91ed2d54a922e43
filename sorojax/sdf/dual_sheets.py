"""How many sheets of surface pass through a cell, and which cell edges each one cuts.

Around every face the crossings are joined in pairs; the loops that arise are the sheets.
On a face with four crossings the pairs part the inside corners, unless the two cells on
both sides would then each join the pairs to one sheet: such a face makes an edge of four
triangles, so there the pairs part the outside corners instead.

Corner i + 2j + 4k of a cell; edge 4a + d + 2e runs along axis a at offsets d and e along
the axes a + 1 and a + 2; face 2f + s lies across axis f on side s.
"""

import functools

import numpy as np


def _corner(axis: int, along: int, d: int, e: int) -> int:
    """Number of the corner with given offsets along `axis` and the two axes after it."""
    return (along << axis) + (d << (axis + 1) % 3) + (e << (axis + 2) % 3)


def _face_corners(face: int) -> list[tuple[int, tuple[int, int]]]:
    """Corners of a face, each with the two edges of the face that end there."""
    f, side = divmod(face, 2)
    u, w = (f + 1) % 3, (f + 2) % 3
    return [
        (_corner(f, side, d, e), (4 * u + e + 2 * side, 4 * w + side + 2 * d))
        for d in (0, 1)
        for e in (0, 1)
    ]


@functools.cache
def sheets(code: int, flipped: int = 0) -> tuple[tuple[int, ...], int]:
    """Sheet of each of the 12 edges (-1: not cut) and the faces joined on one sheet.

    Args:
        code: Bit c is set where corner c lies inside.
        flipped: Bit f is set where face f parts the outside corners.
    """
    inside = [bool(code >> c & 1) for c in range(8)]
    cut = [
        inside[_corner(a, 0, d, e)] != inside[_corner(a, 1, d, e)]
        for a in range(3)
        for e in (0, 1)
        for d in (0, 1)
    ]
    label = list(range(12))
    crossings = []
    for face in range(6):
        corners = _face_corners(face)
        edges = sorted({e for _, pair in corners for e in pair if cut[e]})
        crossings.append(edges)
        if len(edges) == 4:
            parted = not flipped >> face & 1
            pairs = [pair for corner, pair in corners if inside[corner] == parted]
        else:
            pairs = [tuple(edges)] if edges else []
        for a, b in pairs:
            label = [label[a] if value == label[b] else value for value in label]
    found = sorted({label[e] for e in range(12) if cut[e]})
    number = tuple(found.index(label[e]) if cut[e] else -1 for e in range(12))
    joined = sum(
        1 << face
        for face, edges in enumerate(crossings)
        if len(edges) == 4 and len({label[e] for e in edges}) == 1
    )
    return number, joined


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    rows = [sheets(code) for code in range(256)]
    number = np.array([row[0] for row in rows], dtype=np.int8)
    return number, np.array([row[1] for row in rows], dtype=np.uint8)


def cell_sheets(code: np.ndarray, name: np.ndarray, stride: np.ndarray) -> np.ndarray:
    """Sheet of every cell edge (n, 12), -1 where it is not cut.

    Args:
        code: (n,) bits of the inside corners.
        name: (n,) ascending integers of the cells.
        stride: (3,) what `name` grows by along each axis.
    """
    table, joined = _tables()
    number = table[code]
    doubtful = joined[code]
    flipped: dict[int, int] = {}
    for f in range(3):
        first = np.flatnonzero(doubtful >> (2 * f + 1) & 1)
        second = np.minimum(np.searchsorted(name, name[first] + stride[f]), len(name) - 1)
        both = (name[second] == name[first] + stride[f]) & (doubtful[second] >> (2 * f) & 1 > 0)
        for a, b in zip(first[both].tolist(), second[both].tolist(), strict=True):
            now_a = sheets(int(code[a]), flipped.get(a, 0))[1]
            now_b = sheets(int(code[b]), flipped.get(b, 0))[1]
            if now_a >> (2 * f + 1) & 1 and now_b >> (2 * f) & 1:
                flipped[a] = flipped.get(a, 0) | 1 << (2 * f + 1)
                flipped[b] = flipped.get(b, 0) | 1 << (2 * f)
    for cell, faces in flipped.items():
        number[cell] = sheets(int(code[cell]), faces)[0]
    return number

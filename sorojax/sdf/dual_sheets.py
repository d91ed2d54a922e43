"""How many sheets of surface pass through a cell, and which cell edges each one cuts.

Around every face the crossings are joined in pairs; the loops that arise are the sheets.
On a face with four crossings the field in its middle tells whether the pairs part the inside
corners or the outside ones. Where the two cells on both sides would each join the pairs to one
sheet, the face would make an edge of four triangles, so there the other pairs are taken: that
splits the sheet of either cell, hence comes to an end.

Corner i + 2j + 4k of a cell; edge 4a + d + 2e runs along axis a at offsets d and e along
the axes a + 1 and a + 2; face 2f + s lies across axis f on side s.
"""

import functools
from typing import NamedTuple

import numpy as np


class Sheets(NamedTuple):
    """Sheets of cells.

    Attributes:
        kind: (n,) rows of the tables.
        edges: (kinds, 12) sheet of every cell edge, -1 where it is not cut.
        number: (kinds,) sheets.
    """

    kind: np.ndarray
    edges: np.ndarray
    number: np.ndarray


class Faces(NamedTuple):
    """Faces with four crossings.

    Attributes:
        first: (n,) rows of the cells before them.
        second: (n,) rows of the cells after them.
        axis: (n,) axis they lie across.
    """

    first: np.ndarray
    second: np.ndarray
    axis: np.ndarray


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
def _table() -> np.ndarray:
    return np.array([sheets(code)[0] for code in range(256)], dtype=np.int8)


@functools.cache
def _doubtful() -> np.ndarray:
    """Bits of the first faces along the axes that have four crossings, by code."""
    codes = np.arange(256)
    bits = np.zeros(256, np.uint8)
    for f in range(3):
        a, b, c, d = (
            codes >> _corner(f, 0, *at) & 1 for at in ((0, 0), (0, 1), (1, 1), (1, 0))
        )
        bits |= ((a == c) & (b == d) & (a != b)).astype(np.uint8) << np.uint8(f)
    return bits


def doubtful_faces(code: np.ndarray) -> list[np.ndarray]:
    """By axis, the rows of cells whose first face along it has four crossings."""
    bits = _doubtful()[code]
    return [np.flatnonzero(bits >> np.uint8(f) & 1) for f in range(3)]


def cell_sheets(code: np.ndarray, faces: Faces, inside: np.ndarray) -> Sheets:
    """Sheets of cells with given bits of the inside corners.

    Args:
        code: (n,) bits of the inside corners.
        faces: All faces with four crossings.
        inside: Whether the middle of each face lies inside.
    """
    flipped: dict[int, int] = {}
    rows = [
        (a, b, 1 << 2 * f)
        for a, b, f in zip(*(column.tolist() for column in faces), strict=True)
    ]

    def turn(a, b, low):
        flipped[a] = flipped.get(a, 0) ^ low << 1
        flipped[b] = flipped.get(b, 0) ^ low

    for row, inner in zip(rows, inside.tolist(), strict=True):
        if inner:
            turn(*row)
    own = {row: int(code[row]) for a, b, _ in rows for row in (a, b)}
    changed = True
    while changed:
        changed = False
        for a, b, low in rows:
            one = sheets(own[a], flipped.get(a, 0))[1] & low << 1
            if one and sheets(own[b], flipped.get(b, 0))[1] & low:
                turn(a, b, low)
                changed = True
    return _tabulated(code, flipped)


def _tabulated(code: np.ndarray, flipped: dict[int, int]) -> Sheets:
    kind = code.astype(np.uint16)
    special: dict[tuple[int, int], int] = {}
    for cell, faces in flipped.items():
        if faces:
            kind[cell] = special.setdefault((int(code[cell]), faces), 256 + len(special))
    more = np.array([sheets(*key)[0] for key in special], np.int8).reshape(-1, 12)
    edges = np.concatenate([_table(), more])
    return Sheets(kind, edges, edges.max(axis=1) + np.int8(1))

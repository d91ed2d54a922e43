"""STL: loose triangles without a unit, binary or as text."""

import re
from typing import BinaryIO

import numpy as np

from sorojax.io import soup
from sorojax.sdf import Surface

_HEAD = 80
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")
_START, _END = re.compile(rb"\bfacet\s+normal\b"), re.compile(rb"\bendfacet\b")
_PIECE = 1 << 16


def write(file: BinaryIO, surface: Surface, scale: float) -> None:
    """Binary STL with coordinates times `scale`."""
    count = len(surface.triangles)
    if count >= 2**32:
        raise ValueError(f"export_surface: STL holds below 2^32 triangles, got {count}.")
    # Readers take a file that begins with "solid" for text.
    file.write(b"binary STL of sorojax".ljust(_HEAD) + np.uint32(count).tobytes())
    for corners, normal in _pieces(surface, scale):
        record = np.zeros(len(corners), _RECORD)
        record["corners"], record["normal"] = corners, normal
        file.write(record.tobytes())


def write_text(file: BinaryIO, surface: Surface, scale: float) -> None:
    """STL as text with coordinates times `scale`."""
    facet = "facet normal {} {} {}\nouter loop\n" + 3 * "vertex {} {} {}\n"
    facet += "endloop\nendfacet\n"
    file.write(b"solid sorojax\n")
    for corners, normal in _pieces(surface, scale):
        rows = np.concatenate([normal, corners.reshape(-1, 9)], axis=1)
        text = "".join(facet.format(*(f"{x:.9g}" for x in row)) for row in rows)
        file.write(text.encode())
    file.write(b"endsolid sorojax\n")


def _pieces(surface: Surface, scale: float):
    vertices = (surface.vertices * scale).astype(np.float32)
    for start in range(0, len(surface.triangles), _PIECE):
        corners = vertices[surface.triangles[start : start + _PIECE]]
        a, b, c = corners.astype(float).transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        length = np.sqrt((normal * normal).sum(axis=1, keepdims=True))
        yield corners, (normal / np.where(length > 0, length, 1.0)).astype(np.float32)


def read(data: bytes, where: str, unit: float) -> Surface:
    """Surface of an STL file, told apart by its length, as both kinds may say `solid`."""
    count = int.from_bytes(data[_HEAD : _HEAD + 4], "little")
    need = _HEAD + 4 + count * _RECORD.itemsize
    if len(data) >= _HEAD + 4 and need == len(data):
        records = np.frombuffer(data, _RECORD, count, _HEAD + 4)
        return soup.merged(where, records["corners"], unit)
    start = data[:512].lstrip().lower()
    if start.startswith(b"solid") and b"facet" in data[:4096].lower():
        return _read_text(data, where, unit)
    if start.startswith((b"<", b"{")):
        raise ValueError(
            f"{where}: this is a web page or a document (it begins with "
            f"{data[:24]!r}), need an STL file. Download the file itself, not its page."
        )
    raise ValueError(
        f"{where}: the file declares {count} triangles, which take {need} bytes, and has "
        f"{len(data)}. It is truncated or no STL file: copy or export it again."
    )


def _read_text(data: bytes, where: str, unit: float) -> Surface:
    text = data.lower()
    starts, ends = _places(_START, text), _places(_END, text)
    rows = _places(_VERTEX, text)
    whole = len(starts) == len(ends) and len(rows) == 3 * len(starts)
    if whole:  # three vertices between the ends of each
        order = np.column_stack([starts, rows.reshape(-1, 3), ends]).ravel()
        whole = bool(np.all(np.diff(order) > 0))
    if not (whole and b"endsolid" in text[-4096:]):
        raise ValueError(
            f"{where}: the text STL has {len(starts)} facets, {len(ends)} ends of facets and "
            f"{len(rows)} vertices, need three vertices in each and a last line `endsolid`. It "
            "is truncated: copy or export it again."
        )
    try:
        numbers = (float(x) for match in _VERTEX.finditer(text) for x in match.groups())
        corners = np.fromiter(numbers, np.float64, 9 * len(starts)).reshape(-1, 3, 3)
    except ValueError as error:
        raise ValueError(
            f"{where}: a vertex is no number ({error}). The file is damaged: export it again."
        ) from None
    soup.check_numbers(where, corners.reshape(-1, 3))
    return soup.merged(where, corners, unit)


def _places(pattern: re.Pattern[bytes], text: bytes) -> np.ndarray:
    return np.fromiter((found.start() for found in pattern.finditer(text)), np.int64)

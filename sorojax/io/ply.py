"""PLY: vertices and triangles, binary or as text."""

from typing import BinaryIO, NamedTuple, NoReturn

import numpy as np

from sorojax.io import soup
from sorojax.sdf import Surface

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
_FACE = np.dtype([("count", "u1"), ("rows", "<i4", 3)])


class _Element(NamedTuple):
    name: str
    count: int
    fields: list[tuple[str, str]]
    listed: tuple[str, str] | None


def write(file: BinaryIO, surface: Surface, scale: float, text: bool = False) -> None:
    kind = "ascii" if text else "binary_little_endian"
    header = (
        f"ply\nformat {kind} 1.0\ncomment sorojax\nelement vertex {len(surface.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(surface.triangles)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    file.write(header.encode())
    points = (surface.vertices * scale).astype("<f4")
    if text:
        np.savetxt(file, points, fmt="%.9g")
        np.savetxt(file, surface.triangles, fmt="3 %d %d %d")
        return
    file.write(points.tobytes())
    faces = np.empty(len(surface.triangles), _FACE)
    faces["count"], faces["rows"] = 3, surface.triangles
    file.write(faces.tobytes())


def read(data: bytes, where: str, unit: float) -> Surface:
    """Vertices and triangles; declared counts are compared with the length first."""
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        _refuse(where, f"the file begins with {data[:16]!r}")
    start = data.find(b"\n", end) + 1
    order, elements = _header(data[:end].decode("ascii", "replace"), where)
    body = data[start:]
    if order is None:
        return _read_text(body, elements, where, unit)
    points = faces = None
    offset = 0
    for element in elements:
        if element.name not in ("vertex", "face"):
            break
        record = _record(element, order, where)
        left = len(body) - offset
        if element.count * record.itemsize > left:
            _refuse(
                where, f"{element.count} rows of `{element.name}` take "
                f"{element.count * record.itemsize} bytes, {left} are left"
            )  # fmt: skip
        table = np.frombuffer(body, record, element.count, offset)
        offset += table.nbytes
        if element.name == "vertex":
            points = np.stack([table[axis] for axis in "xyz"], axis=-1).astype(float)
        else:
            if np.any(table["count"] != 3):
                _refuse(where, "a face has not three vertices")
            faces = table["rows"].astype(np.int64)
    if points is None or faces is None:
        _refuse(where, "it has no vertices or no faces")
    return soup.indexed(where, points, faces, unit)


def _refuse(where: str, got: str) -> NoReturn:
    raise ValueError(
        f"{where}: {got}, need a whole PLY file of triangles. Export it again as a "
        "triangle mesh."
    )


def _header(text: str, where: str) -> tuple[str | None, list[_Element]]:
    order, elements = "", []
    for line in text.splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = _ORDER[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), [], None))
            elif words[:2] == ["property", "list"]:
                types = _TYPES[words[2]], _TYPES[words[3]]
                elements[-1] = elements[-1]._replace(listed=types)
            elif words[:1] == ["property"]:
                elements[-1].fields.append((words[2], _TYPES[words[1]]))
        except (KeyError, IndexError, ValueError):
            _refuse(where, f"the header says `{line[:60]}`")
    if order == "" or any(element.count < 0 for element in elements):
        _refuse(where, "the header names no format or a negative count")
    return order, elements


def _record(element: _Element, order: str, where: str) -> np.dtype:
    fields: list[tuple] = [(name, order + kind) for name, kind in element.fields]
    if element.name == "vertex":
        if element.listed or not {"x", "y", "z"} <= {name for name, _ in element.fields}:
            _refuse(where, "the vertices have no x, y and z")
    elif element.listed is None or fields:
        _refuse(where, "the faces are no plain lists of vertices")
    else:
        count, rows = element.listed
        fields = [("count", order + count), ("rows", order + rows, 3)]
    return np.dtype(fields)


def _read_text(body: bytes, elements: list[_Element], where: str, unit: float) -> Surface:
    lines = body.split(b"\n")
    tables, row = {}, 0
    for element in elements:
        if element.count > len(lines) - row:
            _refuse(where, f"{element.count} rows of `{element.name}` are declared")
        tables[element.name] = lines[row : row + element.count]
        row += element.count
    names = [name for e in elements if e.name == "vertex" for name, _ in e.fields]
    if not {"x", "y", "z"} <= set(names) or "face" not in tables:
        _refuse(where, "it has no vertices or no faces")
    columns = [names.index(axis) for axis in "xyz"]
    try:
        points = [[float(line.split()[k]) for k in columns] for line in tables["vertex"]]
        faces = [[int(word) for word in line.split()[:4]] for line in tables["face"]]
    except (ValueError, IndexError):
        _refuse(where, "a row holds no numbers")
    if any(len(face) != 4 or face[0] != 3 for face in faces):
        _refuse(where, "a face has not three vertices")
    triangles = np.array(faces, dtype=np.int64).reshape(-1, 4)[:, 1:]
    return soup.indexed(where, np.array(points, dtype=float).reshape(-1, 3), triangles, unit)

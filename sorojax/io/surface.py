"""Surfaces to and from files; the ending of the name says the format."""

import functools
import io
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn

import numpy as np

from sorojax import _check
from sorojax.io import _files
from sorojax.io.animation import ARRAY, UPRIGHT, Document
from sorojax.math.host import KDTree
from sorojax.sdf import Surface
from sorojax.sdf.sampling import connected
from sorojax.sdf.surface.marching import Curve
from sorojax.units import mm

# 3MF: a zipped model that states its unit


_XML_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_CONTENT_TYPES = (
    _XML_HEAD + '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_LINKS = (
    _XML_HEAD
    + '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
_MODEL = (
    _XML_HEAD + '<model unit="millimeter" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    '<object id="1" type="model"><mesh>\n<vertices>\n'
)
_TAIL = (
    '</triangles>\n</mesh></object></resources><build><item objectid="1"/></build></model>\n'
)


def write_threemf(file: BinaryIO, surface: Surface) -> None:
    """The package, in millimetres."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr("[Content_Types].xml", _CONTENT_TYPES)
        package.writestr("_rels/.rels", _LINKS)
        with package.open("3D/3dmodel.model", "w", force_zip64=True) as raw:
            model = io.BufferedWriter(raw, 1 << 20)  # type: ignore[arg-type]
            model.write(_MODEL.encode())
            np.savetxt(
                model, surface.vertices * 1e3, fmt='<vertex x="%.9g" y="%.9g" z="%.9g"/>'
            )
            model.write(b"</vertices>\n<triangles>\n")
            np.savetxt(model, surface.triangles, fmt='<triangle v1="%d" v2="%d" v3="%d"/>')
            model.write(_TAIL.encode())
            model.flush()


# GLB (binary glTF 2.0): for viewers on the web


def write_glb(file: BinaryIO, surface: Surface) -> None:
    """One mesh in metres, turned so that z points up in viewers, where y does."""
    document = Document()
    position = document.floats(surface.vertices, "VEC3", ends=True, target=ARRAY)
    rows = document.indices(surface.triangles)
    shape = {"attributes": {"POSITION": position}, "indices": rows}
    nodes = [{"mesh": 0, "rotation": UPRIGHT}]
    document.write(file, nodes, [{"primitives": [shape]}])


# SVG: curves of a plane shape, in millimetres


def write_svg(file: BinaryIO, curves: Sequence[Curve]) -> None:
    """One path; y points up, holes stay empty, one user unit is 1 mm."""
    every = 1e3 * np.concatenate([curve.points for curve in curves])
    low, high = every.min(axis=0), every.max(axis=0)
    width, height = high - low
    path = " ".join(_path(1e3 * curve.points, curve.closed) for curve in curves)
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.9g}mm" '
        f'height="{height:.9g}mm" viewBox="{low[0]:.9g} {-high[1]:.9g} {width:.9g} '
        f'{height:.9g}">\n<path fill="#888" fill-rule="evenodd" d="{path}"/>\n</svg>\n'
    )
    file.write(text.encode())


def _path(points: np.ndarray, closed: bool) -> str:
    steps = " L".join(f"{x:.9g} {-y:.9g}" for x, y in points)
    return f"M{steps}" + ("Z" if closed else "")


# From what a surface file holds to a surface: limits, merged corners, checked indices


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


# STL: loose triangles without a unit, binary or as text


_HEAD = 80
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")
_START, _END = re.compile(rb"\bfacet\s+normal\b"), re.compile(rb"\bendfacet\b")
_PIECE = 1 << 16


def write_stl(file: BinaryIO, surface: Surface, scale: float) -> None:
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


def write_stl_text(file: BinaryIO, surface: Surface, scale: float) -> None:
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


def read_stl(data: bytes, where: str, unit: float) -> Surface:
    """Surface of an STL file; its length says which kind it is, as both may say `solid`."""
    count = int.from_bytes(data[_HEAD : _HEAD + 4], "little")
    need = _HEAD + 4 + count * _RECORD.itemsize
    if len(data) >= _HEAD + 4 and need == len(data):
        records = np.frombuffer(data, _RECORD, count, _HEAD + 4)
        return merged(where, records["corners"], unit)
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
    check_numbers(where, corners.reshape(-1, 3))
    return merged(where, corners, unit)


def _places(pattern: re.Pattern[bytes], text: bytes) -> np.ndarray:
    return np.fromiter((found.start() for found in pattern.finditer(text)), np.int64)


# OBJ: vertices and faces as text


def write_obj(file: BinaryIO, surface: Surface, scale: float) -> None:
    file.write(b"# sorojax\n")
    np.savetxt(file, surface.vertices * scale, fmt="v %.9g %.9g %.9g")
    np.savetxt(file, surface.triangles + 1, fmt="f %d %d %d")


def read_obj(data: bytes, where: str, unit: float) -> Surface:
    """Vertices and faces; polygons become fans, everything else is passed over."""
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(data.split(b"\n"), start=1):
        kind, *words = line.split() or [b""]
        try:
            if kind == b"v":
                vertices.append([float(word) for word in words[:3]])
                if len(words) < 3:
                    raise ValueError("fewer than three coordinates")
            elif kind == b"f":
                triangles += _fan([_row(word, len(vertices)) for word in words])
        except ValueError as error:
            raise ValueError(
                f"{where}: line {number} is {line[:60]!r} ({error}), need `v x y z` or "
                "`f a b c`. It is no OBJ file or is damaged: export it again."
            ) from None
    points = np.array(vertices, dtype=float).reshape(-1, 3)
    return indexed(where, points, np.array(triangles, dtype=np.int64).reshape(-1, 3), unit)


def _row(word: bytes, count: int) -> int:
    """Vertex of `a`, `a/b/c` or `-a`, which counts back from the last one."""
    number = int(word.split(b"/")[0])
    if not 0 < abs(number) < 2**31:
        raise ValueError(f"vertex {number}")
    return number - 1 if number > 0 else count + number


def _fan(rows: list[int]) -> list[tuple[int, int, int]]:
    if len(rows) < 3:
        raise ValueError(f"a face of {len(rows)} vertices")
    return [(rows[0], a, b) for a, b in zip(rows[1:], rows[2:], strict=False)]


# PLY: vertices and triangles, binary or as text


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


def write_ply(file: BinaryIO, surface: Surface, scale: float, text: bool = False) -> None:
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


def read_ply(data: bytes, where: str, unit: float) -> Surface:
    """Vertices and triangles; declared counts are compared with the length first."""
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        _refuse(where, f"the file begins with {data[:16]!r}")
    start = data.find(b"\n", end) + 1
    order, elements = _header(data[:end].decode("ascii", "replace"), where)
    body = data[start:]
    if order is None:
        return _read_ply_text(body, elements, where, unit)
    points = faces = None
    offset = 0
    for element in elements:
        if element.name not in ("vertex", "face"):
            break
        record = _record(element, order, where)
        left = len(body) - offset
        if element.count * record.itemsize > left:
            _refuse(
                where,
                f"{element.count} rows of `{element.name}` take "
                f"{element.count * record.itemsize} bytes, {left} are left",
            )
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
    return indexed(where, points, faces, unit)


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


def _read_ply_text(body: bytes, elements: list[_Element], where: str, unit: float) -> Surface:
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
    return indexed(where, np.array(points, dtype=float).reshape(-1, 3), triangles, unit)


# Surfaces to and from files; the ending of the name says the format.


_READERS = {".stl": read_stl, ".obj": read_obj, ".ply": read_ply}
_SMALLEST, _LARGEST = 1e-3, 100.0  # m, of a part whose unit is not given
_WRITTEN = (".stl", ".obj", ".ply", ".3mf", ".glb")


def export_surface(
    path: str | os.PathLike,
    surface: Surface,
    *,
    text: bool = False,
    unit: float = mm,
    root: str | os.PathLike | None = None,
) -> Path:
    """Write a surface as STL, OBJ, PLY, 3MF or GLB, whole or not at all.

    Args:
        path: File name; its ending gives the format.
        surface: Triangles [m].
        text: Write STL or PLY as text, which is about five times larger.
        unit: What 1 in an STL, OBJ or PLY file means [m]; these formats state no unit and
            printers take millimetres. 3MF is in millimetres and GLB in metres by definition.
        root: Folder that the file must lie in, links followed.

    Returns:
        The file.

    Raises:
        ValueError: If the surface is empty, not finite or names vertices that are not
            there, the format is unknown, or the path leaves `root`.
    """
    where = "export_surface"
    file = _files.inside(where, path, root)
    kind = _ending(where, file.suffix, _WRITTEN)
    checked = _checked(where, surface)
    _check.positive(where, "unit", unit, "m", "Write unit=sorojax.units.mm.")
    writers = {
        ".stl": functools.partial(write_stl_text if text else write_stl, scale=1 / unit),
        ".obj": functools.partial(write_obj, scale=1 / unit),
        ".ply": functools.partial(write_ply, scale=1 / unit, text=text),
        ".3mf": write_threemf,
        ".glb": write_glb,
    }
    _files.write(file, lambda stream: writers[kind](stream, surface=checked))
    return file


def export_contour(
    path: str | os.PathLike,
    curves: Sequence[Curve],
    *,
    root: str | os.PathLike | None = None,
) -> None:
    """Write the curves of `sdf.contour` as SVG in millimetres, whole or not at all.

    Args:
        path: File name.
        curves: From `sdf.contour` [m].
        root: Folder that the file must lie in.
    """
    where = "export_contour"
    file = _files.inside(where, path, root)
    _ending(where, file.suffix, (".svg",))
    if not sum(len(curve.points) for curve in curves):
        raise ValueError(
            f"{where}: no curves, need at least one. Pass sdf.contour(shape, size)."
        )
    for curve in curves:
        _check.finite(where, "curves", curve.points, "Check the parameters of the shape.")
    _files.write(file, lambda stream: write_svg(stream, curves))


def import_surface(
    path: str | os.PathLike,
    *,
    unit: float | None = None,
    weld: float = 0.0,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> Surface:
    """Read an STL, OBJ or PLY file; equal corners of an STL become one vertex.

    The file is compared with what it declares before memory is taken. Whether the surface
    is closed is for `sdf.surface_report` to say.

    Args:
        path: File name; its ending gives the format.
        unit: What 1 in the file means [m]. By default a millimetre, and a surface whose
            longest side is then not between 1 mm and 100 m is refused.
        weld: Vertices nearer than that become one [m], for seams that do not quite close;
            triangles that vanish by it are left out. A tenth of the shortest edge is safe.
        root: Folder that the file must lie in, links followed; any by default.
        max_bytes: Larger files are refused unread.

    Returns:
        Vertices [m] and triangles.

    Raises:
        ValueError: If the file is no surface, truncated, damaged or too large, of a size
            that needs its unit, or the path leaves `root`.

    Example:
        >>> ball = sdf.isosurface(sdf.Sphere([0, 0, 0], 10 * mm), size=2 * mm)
        >>> _ = io.export_surface("ball.stl", ball)  # in millimetres
        >>> len(io.import_surface("ball.stl").triangles) == len(ball.triangles)
        True
    """
    file = _files.inside("import_surface", path, root)
    kind = _ending("import_surface", file.suffix, tuple(_READERS))
    scale = mm if unit is None else unit
    _check.positive("import_surface", "unit", scale, "m", "Write unit=sorojax.units.mm.")
    _check.not_negative("import_surface", "weld", weld, "m", "Leave it out to keep all.")
    data = _files.read("import_surface", file, max_bytes)
    surface = _READERS[kind](data, f"import_surface: {file.name}", scale)
    if unit is None:
        _check_size(file.name, surface)
    return _welded(file.name, surface, weld) if weld else surface


def _welded(name: str, surface: Surface, distance: float) -> Surface:
    """Chains of vertices nearer than `distance` become their first vertex."""
    vertices, triangles = surface
    corners = vertices[triangles]
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))
    if distance > side / 2:
        raise ValueError(
            f"import_surface: {name}: `weld` is {distance:g} m, need at most half of a usual "
            f"edge, {side:.3g} m. Give it in metres, just above the gaps of the seam."
        )
    pairs = KDTree(vertices).query_pairs(distance, output_type="ndarray")
    group = connected(len(vertices), *pairs.T)
    _, first, number = np.unique(group, return_index=True, return_inverse=True)
    rows = number[triangles].astype(np.int32)
    whole = (rows != np.roll(rows, 1, axis=1)).all(axis=1)
    return Surface(vertices[first], rows[whole])


def _check_size(name: str, surface: Surface) -> None:
    """Refuse what most likely is not in millimetres."""
    longest = float(np.max(np.ptp(surface.vertices, axis=0)))
    if not _SMALLEST <= longest <= _LARGEST:
        raise ValueError(
            f"import_surface: {name}: its longest side is {longest / mm:.3g} in the file, in "
            f"millimetres {longest:.3g} m, need {_SMALLEST:g} to {_LARGEST:g} m. Give the unit "
            "of the file: unit=1.0 for metres, 0.0254 for inches, 1e-3 if it is millimetres."
        )


def _ending(where: str, suffix: str, known: tuple[str, ...]) -> str:
    if suffix.lower() not in known:
        raise ValueError(
            f"{where}: the file name ends in `{suffix}`, need one of {', '.join(known)}."
            + (" Curves are written by export_contour." if suffix.lower() == ".svg" else "")
        )
    return suffix.lower()


def _checked(where: str, surface: Surface) -> Surface:
    vertices = np.asarray(surface.vertices, dtype=float).reshape(-1, 3)
    triangles = np.asarray(surface.triangles).reshape(-1, 3)
    if not len(triangles):
        raise ValueError(f"{where}: the surface has no triangle, need one at least.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"{where}: triangles use vertices {triangles.min()} to {triangles.max()}, the "
            f"surface has {len(vertices)}. Build it again with sdf.isosurface."
        )
    _check.finite(where, "vertices", vertices, "Build the surface with sdf.isosurface.")
    return Surface(vertices, triangles)

"""OBJ: vertices and faces as text."""

from typing import BinaryIO

import numpy as np

from sorojax.io import soup
from sorojax.sdf import Surface


def write(file: BinaryIO, surface: Surface, scale: float) -> None:
    file.write(b"# sorojax\n")
    np.savetxt(file, surface.vertices * scale, fmt="v %.9g %.9g %.9g")
    np.savetxt(file, surface.triangles + 1, fmt="f %d %d %d")


def read(data: bytes, where: str, unit: float) -> Surface:
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
    return soup.indexed(where, points, np.array(triangles, dtype=np.int64).reshape(-1, 3), unit)


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

"""Surfaces to and from files; the ending of the name says the format."""

import functools
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sorojax import _check
from sorojax.io import (
    _files,
    formats,
)
from sorojax.sdf import Curve, Surface
from sorojax.units import mm

_READERS = {".stl": formats.read_stl, ".obj": formats.read_obj, ".ply": formats.read_ply}
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
        ".stl": functools.partial(
            formats.write_stl_text if text else formats.write_stl, scale=1 / unit
        ),
        ".obj": functools.partial(formats.write_obj, scale=1 / unit),
        ".ply": functools.partial(formats.write_ply, scale=1 / unit, text=text),
        ".3mf": formats.write_threemf,
        ".glb": formats.write_glb,
    }
    _files.write(file, lambda stream: writers[kind](stream, surface=checked))
    return file


def export_contour(
    path: str | os.PathLike,
    curves: Sequence[Curve],
    *,
    root: str | os.PathLike | None = None,
) -> None:
    """Write the curves of `sdf.contour` as SVG in millimetres, whole or not at all."""
    where = "export_contour"
    file = _files.inside(where, path, root)
    _ending(where, file.suffix, (".svg",))
    if not sum(len(curve.points) for curve in curves):
        raise ValueError(
            f"{where}: no curves, need at least one. Pass sdf.contour(shape, size)."
        )
    for curve in curves:
        _check.finite(where, "curves", curve.points, "Check the parameters of the shape.")
    _files.write(file, lambda stream: formats.write_svg(stream, curves))


def import_surface(
    path: str | os.PathLike,
    *,
    unit: float | None = None,
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
    data = _files.read("import_surface", file, max_bytes)
    surface = _READERS[kind](data, f"import_surface: {file.name}", scale)
    if unit is None:
        _check_size(file.name, surface)
    return surface


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

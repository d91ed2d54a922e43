"""The printable robots as written to STL and read back: closed, free of crossings, thick
enough, of the volume of their drawing."""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row
from sorojax import io, robots, sdf
from sorojax.units import mm

SIZE = 0.5 * mm
RESOLUTION = 256  # of the quadrature of the drawing, along its longest side
VOLUME_BAR = 5e-3
MOST_LOST = 0.02  # of a wall, wherever the cells would allow more
STL = 2e-8  # m, rounding of a coordinate of 0.2 m in single precision, on both sides
#: Thinnest wall asked for, and the smallest radius of a wall that bulges [m]: of its folds, 0.9
#: of half their heights.
WALLS = {
    robots.BendingActuator: (1.6 * mm, np.inf),
    robots.PlanarActuator: (1.2 * mm, 2.16 * mm),
    robots.Hand: (1.2 * mm, 2.25 * mm),
    robots.Manipulator: (1.2 * mm, 2.16 * mm),
}


def rows():
    with tempfile.TemporaryDirectory() as folder:
        for kind, (wall, radius) in WALLS.items():
            yield from _checked(kind, wall, radius, Path(folder))


def _checked(kind, wall: float, radius: float, folder: Path):
    body, name = kind().body(), kind.__name__
    start = time.perf_counter()
    surface = sdf.isosurface(body, SIZE)
    io.export_surface(folder / "body.stl", surface)
    report = sdf.surface_report(io.import_surface(folder / "body.stl"))
    seconds = time.perf_counter() - start
    settings = {
        "robot": name, "cell": SIZE, "triangles": len(surface.triangles),
        "shells": report.num_shells, "genus": report.genus,
        "thinnest_wall": report.wall_thickness,
    }  # fmt: skip
    wrong = float(not report.manifold) + len(report.crossings)
    yield Row(
        "sorojax",
        settings | {"what": "open, crowded, turned, pinched, crossing"},
        0.0,
        seconds,
        seconds,
        seconds,
        error=wrong,
        bar=0.0,
        bar_on="error",
        reference="the file read back",
    )
    lost = _inscribed(radius)
    yield Row(
        "sorojax",
        {"robot": name, "what": "wall missing [m]", "smallest_radius": radius},
        error=max(wall - report.wall_thickness, 0.0),
        bar=min(lost, MOST_LOST * wall),
        bar_on="error",
        reference=f"{wall / mm:g} mm asked for",
    )
    volume = float(sdf.volume(body, RESOLUTION))
    yield Row(
        "sorojax",
        {"robot": name, "what": "volume [m^3]", "volume": volume},
        error=abs(report.volume / volume - 1),
        bar=VOLUME_BAR,
        bar_on="error",
        reference=f"quadrature of the drawing, {RESOLUTION} cells",
    )


def _inscribed(radius: float) -> float:
    """How much thinner [m] than drawn a wall with this radius [m] is between its triangles.

    Of a wall one side bulges, and its triangles cut into it: their corners by h^2 / 8 R, where
    the zero of a distance is taken as that of a line between nodes; their centres by half the
    curvature times the mean square of the corners' distances, in a cell at most 2 h^2 / 3.
    """
    return SIZE**2 / radius * (1 / 8 + 1 / 3) + STL

"""The printable robots as written to STL and read back: closed, free of crossings, thick
enough, of the volume of their drawing."""

import tempfile
import time
from pathlib import Path

from benchmarks.harness import Row
from sorojax import io, robots, sdf
from sorojax.units import mm

SIZE = 0.5 * mm
RESOLUTION = 256  # of the quadrature of the drawing, along its longest side
VOLUME_BAR = 5e-3
#: Thinnest wall asked for [m].
WALLS = {
    robots.BendingActuator: 1.6 * mm, robots.PlanarActuator: 1.2 * mm,
    robots.Hand: 1.2 * mm, robots.Manipulator: 1.2 * mm,
}  # fmt: skip


def rows():
    with tempfile.TemporaryDirectory() as folder:
        for kind, wall in WALLS.items():
            yield from _checked(kind, wall, Path(folder))


def _checked(kind, wall: float, folder: Path):
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
    yield Row("sorojax", settings | {"what": "open, crowded, turned, pinched, crossing"}, 0.0,
              seconds, seconds, seconds, error=wrong, bar=0.0, bar_on="error",
              reference="the file read back")  # fmt: skip
    yield Row("sorojax", {"robot": name, "what": "wall missing [m]"},
              error=max(wall - report.wall_thickness, 0.0), bar=0.02 * wall, bar_on="error",
              reference=f"{wall / mm:g} mm asked for")  # fmt: skip
    volume = float(sdf.volume(body, RESOLUTION))
    yield Row("sorojax", {"robot": name, "what": "volume [m^3]", "volume": volume},
              error=abs(report.volume / volume - 1), bar=VOLUME_BAR, bar_on="error",
              reference=f"quadrature of the drawing, {RESOLUTION} cells")  # fmt: skip

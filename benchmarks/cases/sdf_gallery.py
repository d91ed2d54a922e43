"""Every solid shape and the printed robots: surfaces that read back watertight, or why not."""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row
from sorojax import io, robots, sdf
from sorojax.sdf.surface.report import SurfaceReport
from sorojax.units import mm

BALL = sdf.Sphere([0.0, 0.0, 0.0], 1.0)
TRIANGLE = sdf.triangle([0.3, -0.2], [0.9, 0.1], [0.5, 0.3])
BAR = sdf.Box([-1, -0.2, -0.3], [1, 0.3, 0.3])
TALL = sdf.Box([-0.5, -0.3, -0.8], [0.4, 0.3, 0.8])
LATTICES = {
    "bcc": sdf.BccLattice, "octet": sdf.OctetLattice, "kelvin": sdf.KelvinLattice,
    "gyroid": sdf.Gyroid, "schwarz": sdf.SchwarzP, "diamond": sdf.Diamond,
    "neovius": sdf.Neovius, "lidinoid": sdf.Lidinoid, "iwp": sdf.Iwp,
}  # fmt: skip
CELL = 0.03  # of shapes about 2 m wide with walls of 0.1 m


def shapes() -> dict[str, sdf.AbstractSdf]:
    """Bounded solids, a few units wide; what has no end is cut by a ball."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:40, :40]
    heights = 0.2 * np.sin(rows / 5) * np.cos(columns / 4)
    endless = {name: lattice(0.8, 0.1) for name, lattice in LATTICES.items()} | {
        "half_space": sdf.HalfSpace([0, 0.1, 0], [0, 1, 1]),
        "pipe": sdf.InfiniteCylinder(0.7),
        "foam": sdf.VoronoiFoam(rng.uniform(-1.5, 1.5, (12, 3)), 0.1),
        "heights": sdf.HeightMap(heights, [-1, -1], [0.05, 0.05]),
    }
    other = sdf.Sphere([0.9, 0.1, 0.0], 0.7)
    return {name: shape & BALL for name, shape in endless.items()} | {
        "gyroid_block": sdf.Gyroid(0.5, 0.06) & sdf.Box([-0.75] * 3, [0.75] * 3),
        "sphere": BALL, "box": BAR, "strut": sdf.Strut([-0.5, -0.5, 0], [0.5, 0.6, 0.3], 0.3),
        "capsule": sdf.Capsule([-0.5, -0.5, 0], [0.5, 0.6, 0.3], 0.3),
        "round_cone": sdf.RoundCone([-0.3, -0.3, 0], [0.6, 0.6, 0.1], 0.5, 0.2),
        "polyline": sdf.Polyline([[-1, -1, 0], [0, 0.5, 0.3], [1, -1, -0.5]], 0.2),
        "bezier": sdf.Bezier([[-1, -1, 0], [0, 1.5, 0.3], [1, -0.2, 0.4]], 0.1),
        "helix": sdf.Helix(0.6, 0.4, 2.3, 0.1), "ellipsoid": sdf.Ellipsoid([1, 0.4, 0.7]),
        "frame": sdf.BoxFrame([1.2, 1.4, 2], 0.3), "torus": sdf.Torus(0.8, 0.3),
        "capped_torus": sdf.CappedTorus(0.8, 0.3, 1.2),
        "cylinder": sdf.Cylinder(0.8, 1, 0.2), "capped_cone": sdf.CappedCone(0.9, 0.3, 1.2),
        "cone": sdf.Cone(0.9, 1.6), "prism": sdf.HexagonalPrism(0.9, 1),
        "octahedron": sdf.Octahedron(1), "pyramid": sdf.Pyramid(1.4, 1.2),
        "extrude": sdf.extrude(TRIANGLE, 0.8), "turn": sdf.turn(BAR, [1, 2, 3], 0.7),
        "revolve": sdf.revolve(sdf.Circle([0.8, 0.1], 0.3)), "twist": sdf.twist(TALL, 2),
        "taper": sdf.taper(TALL, 0.5), "bend": sdf.bend(BAR, 1.2),
        "morph": sdf.morph(BAR, sdf.Sphere([0.0, 0.0, 0.0], 0.5), 0.4),
        "shell": sdf.shell(BALL, 0.1) & sdf.HalfSpace([0, 0, 0.4], [0, 0, 1]),
        "row": sdf.repeat(sdf.Sphere([-0.9, 0, 0], 0.25), [0.6, 0, 0], 4),
        "circle": sdf.polar_repeat(sdf.translate(sdf.Torus(0.2, 0.1), [0.7, 0, 0]), 5),
        "blend": sdf.SmoothUnion(BALL, other, 0.3),
        "cut": sdf.SmoothDifference(BALL, other, 0.2),
    }  # fmt: skip


def bodies() -> dict[str, tuple[sdf.AbstractSdf, float]]:
    """The robots with the size of their cells [m], below their thinnest wall or gap."""
    sizes = {
        robots.BendingActuator: 1.2 * mm,
        robots.PlanarActuator: 1.2 * mm,
        robots.Hand: 1.2 * mm,
        robots.Manipulator: 1.0 * mm,
    }
    return {kind.__name__: (kind().body(), size) for kind, size in sizes.items()}


def read_back(shape, size: float, method, folder: Path) -> tuple[SurfaceReport, int]:
    """What the written file holds, and its number of triangles."""
    io.export_surface(folder / "part.stl", sdf.isosurface(shape, size, method))
    surface = io.import_surface(folder / "part.stl")
    return sdf.surface_report(surface), len(surface.triangles)


def rows():
    """One row per shape and method; the error is the number of edges that are not joined."""
    cases = {name: (shape, CELL) for name, shape in shapes().items()} | bodies()
    for name, (shape, size) in cases.items():
        for method in ("marching_cubes", "dual_contouring"):
            with tempfile.TemporaryDirectory() as folder:
                start = time.perf_counter()
                try:
                    found, triangles = read_back(shape, size, method, Path(folder))
                except ValueError as reason:
                    if "would leave holes" not in str(reason):
                        raise
                    # refused: the cells are coarser than a wall, and the bar is not met
                    settings = {"shape": name, "method": method, "refused": str(reason)}
                    yield Row("sorojax", settings, bar=0, bar_on="error")
                    continue
                took = time.perf_counter() - start
            wrong = len(found.open_edges) + len(found.crowded_edges) + len(found.turned_edges)
            wrong += len(found.degenerate)
            settings = {
                "shape": name, "method": method, "triangles": triangles,
                "volume": found.volume, "shells": found.num_shells, "genus": found.genus,
                "pinched": len(found.pinched_vertices), "crossings": len(found.crossings),
            }  # fmt: skip
            yield Row(
                "sorojax",
                settings,
                run_s=took,
                error=float(wrong),
                bar=0,
                bar_on="error",
                reference="edges of the file that do not join two triangles",
            )

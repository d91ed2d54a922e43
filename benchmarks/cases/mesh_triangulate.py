"""Triangles of a section with six chambers: time, smallest angle, mean radius ratio."""

import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, measure_calls, missing, quick
from sorojax import mesh, sdf
from sorojax.mesh.quality import Quality
from sorojax.units import mm

BAR = 0.3  # s for 3000 triangles
AREA = 832 * mm**2


def section():
    """Six chambers over a duct; its area is 832 mm^2."""
    cuts = sdf.Rectangle([14 * mm, 8.5 * mm], [16 * mm, 19 * mm])
    cell = sdf.Rectangle([3 * mm, 4 * mm], [12 * mm, 16 * mm])
    duct = sdf.Rectangle([3 * mm, 4 * mm], [87 * mm, 5.5 * mm])
    air = sdf.repeat(cell, [15 * mm, 0], 6) | duct
    return sdf.Rectangle([0, 0], [90 * mm, 18 * mm]) - sdf.repeat(cuts, [15 * mm, 0], 5) - air


def outlines() -> dict[str, np.ndarray]:
    """Corners [m] of the same section: around it, and around its chambers with their duct."""
    steps = 15.0 * np.arange(6)
    notch = np.array([[14, 18], [14, 8.5], [16, 8.5], [16, 18]])[::-1]
    above = [notch + [x, 0] for x in steps[-2::-1]]
    room = np.array([[3, 5.5], [3, 16], [12, 16], [12, 5.5]])[::-1]
    rooms = np.concatenate([room + [x, 0] for x in steps[::-1]])
    # the outer walls of the first and of the last chamber go on into the duct
    ends = np.array([[3, 4], [87, 4]])
    outer = np.concatenate([[[0, 0], [90, 0], [90, 18]], *above, [[0, 18]]])
    return {"outer": outer * mm, "inner": np.concatenate([ends, rooms[1:-1]]) * mm}


def _shape_numbers(quality: Quality) -> dict:
    return {
        "triangles": quality.num_cells,
        "angle_deg": round(float(np.rad2deg(quality.min_angle)), 1),
        "radius_ratio": round(quality.mean_radius_ratio, 3),
    }


def _gmsh(size: float) -> Row:
    """The same sizes in gmsh, frontal; its numbers are taken by `mesh.quality`."""
    try:
        answer, found = peers.call("gmsh", "triangles", outlines(), size=size, repeats=5)
    except peers.PeerMissing as reason:
        return missing("gmsh", str(reason), size=size)
    quality = mesh.quality(mesh.Mesh(found["points"], found["cells"], mesh.Tri3()))
    runs = sorted(answer["runs"])
    return Row(
        "gmsh",
        _shape_numbers(quality) | {"version": answer["version"]},
        0.0,
        runs[len(runs) // 2],
        runs[0],
        runs[-1],
        abs(quality.area / AREA - 1),
        "the area 832 mm^2",
    )


def rows():
    shape = section()
    every = (1.5 * mm, 0.75 * mm, 0.375 * mm)
    for size in every[:2] if quick("cells of 0.375 mm") else every:
        timing = measure_calls(lambda size=size: mesh.triangulate(shape, size=size))
        quality = mesh.quality(mesh.triangulate(shape, size=size))
        yield Row(
            "sorojax",
            _shape_numbers(quality),
            **timing.columns(),
            error=abs(quality.area / AREA - 1),
            reference="the area 832 mm^2",
            bar=BAR if size == 0.75 * mm else None,
        )
        yield _gmsh(size)

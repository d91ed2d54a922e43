"""Triangles of a section with six chambers: time, smallest angle, mean radius ratio."""

import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import mesh, sdf
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


def rows():
    shape = section()
    for size in (1.5 * mm, 0.75 * mm, 0.375 * mm):
        timing = measure_calls(lambda size=size: mesh.triangulate(shape, size=size))
        quality = mesh.quality(mesh.triangulate(shape, size=size))
        yield Row(
            "sorojax",
            {
                "triangles": quality.num_cells,
                "angle_deg": round(float(np.rad2deg(quality.min_angle)), 1),
                "radius_ratio": round(quality.mean_radius_ratio, 3),
            },
            **timing.columns(),
            error=abs(quality.area / AREA - 1),
            reference="the area 832 mm^2",
            bar=BAR if size == 0.75 * mm else None,
        )

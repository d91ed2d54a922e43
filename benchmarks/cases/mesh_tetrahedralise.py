"""Tetrahedra of a ball and of a ball with a thin wall: time and smallest dihedral angle."""

import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import mesh, sdf

BARS = {"ball": 1.0, "shell": 3.0}  # s


def rows():
    scenes = {
        "ball": (sdf.Sphere([0, 0, 0], 1), 0.12, 4 / 3 * np.pi),
        "shell": (
            sdf.Sphere([0, 0, 0], 15.6) - sdf.Sphere([0, 0, 0], 14.4),
            0.8,
            4 / 3 * np.pi * (15.6**3 - 14.4**3),
        ),
    }
    for name, (shape, size, volume) in scenes.items():
        timing = measure_calls(lambda s=shape, h=size: mesh.tetrahedralise(s, size=h))
        quality = mesh.quality(mesh.tetrahedralise(shape, size=size))
        yield Row(
            "sorojax",
            {
                "scene": name,
                "tetrahedra": quality.num_cells,
                "dihedral_deg": round(float(np.rad2deg(quality.min_angle)), 1),
            },
            **timing.columns(),
            error=abs(quality.area / volume - 1),
            reference="the volume",
            bar=BARS[name],
        )

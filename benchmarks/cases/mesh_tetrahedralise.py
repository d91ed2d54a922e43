"""Tetrahedra of a ball and of a ball with a thin wall: time and smallest dihedral angle."""

import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, measure_calls, missing, quick
from sorojax import mesh, sdf
from sorojax.mesh.quality import Quality

#: Outer and inner radius, size of cells and seconds, by name.
SCENES = {"ball": (1.0, 0.0, 0.12, 1.0), "shell": (15.6, 14.4, 0.8, 3.0)}


def rows():
    for name, (outer, inner, size, bar) in SCENES.items():
        shape = sdf.Sphere([0, 0, 0], outer)
        shape = shape - sdf.Sphere([0, 0, 0], inner) if inner else shape
        made = []
        timing = measure_calls(
            lambda s=shape, h=size, kept=made: (
                kept.append(mesh.tetrahedralise(s, size=h)) or kept[-1]
            ),
            repeats=3 if quick() else 5,
        )
        quality = mesh.quality(made[-1])
        volume = 4 / 3 * np.pi * (outer**3 - inner**3)
        yield Row(
            "sorojax",
            _shape_numbers(name, quality),
            **timing.columns(),
            error=abs(quality.area / volume - 1),
            reference="the volume",
            bar=bar,
        )
        yield _gmsh(name, volume)


def _shape_numbers(name: str, quality: Quality) -> dict:
    angle = round(float(np.rad2deg(quality.min_angle)), 1)
    return {"scene": name, "tetrahedra": quality.num_cells, "dihedral_deg": angle}


def _gmsh(name: str, volume: float) -> Row:
    """The same sizes in gmsh; its numbers are taken by `mesh.quality`."""
    outer, inner, size, _ = SCENES[name]
    try:
        answer, found = peers.call(
            "gmsh", "balls", {}, outer=outer, inner=inner, size=size, repeats=5
        )
    except peers.PeerMissing as reason:
        return missing("gmsh", str(reason), scene=name)
    quality = mesh.quality(mesh.Mesh(found["points"], found["cells"], mesh.Tet4()))
    runs = sorted(answer["runs"])
    return Row(
        "gmsh",
        _shape_numbers(name, quality) | {"version": answer["version"]},
        0.0,
        runs[len(runs) // 2],
        runs[0],
        runs[-1],
        abs(quality.area / volume - 1),
        "the volume",
    )

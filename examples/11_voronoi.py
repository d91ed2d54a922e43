"""A polygonal mesh while Lloyd's method evens it out: 150 cells between a square and a disc.

The mesh of section V-B of the Sorotoki paper. There seeds are mirrored at the boundary; here
cells are cut by it, and their areas are evened at the end, which Lloyd's method alone does not
do in the two cusps.
"""

import sys
from pathlib import Path

import jax
import numpy as np

import sorojax as sj
from sorojax import mesh, sdf
from sorojax.units import deg, mm

UNIT = 10 * mm
CELLS = 150  # paper: 150


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    square = sdf.rotate(sdf.Rectangle([0, 0], [UNIT, UNIT]), 45 * deg)
    shape = square - sdf.Circle([0, 0], UNIT)
    shifts = []

    def after(steps: int) -> mesh.Mesh:
        shifts.clear()
        return mesh.polymesher(
            shape, CELLS, key=jax.random.key(0), iterations=steps,
            on_step=lambda step, error: shifts.append(error),
        )  # fmt: skip

    stages = (0, 2, 16, 60) if quick else (0, 1, 4, 16, 32, 60)
    meshes = [after(steps) for steps in stages]
    areas = [np.asarray(mesh.cell_areas(made)) for made in meshes]
    spread = [float(area.std() / area.mean()) for area in areas]
    quality = mesh.quality(meshes[-1], shape)
    if picture is not None:
        draw(stages, meshes, areas, Path(picture))
    return {
        "cells": meshes[-1].num_cells,
        **{f"spread of areas, {n} steps": s for n, s in zip(stages, spread, strict=True)},
        "shift of the seeds, first step": shifts[0],
        "shift of the seeds, last step": shifts[-1],
        "largest angle of a cell [deg]": quality.max_angle / deg,
        "nodes outside the shape [mm]": float(shape(meshes[-1].points).max() / mm),
        "area of the cells off that of the shape": float(quality.error or 0.0),
    }


def draw(stages, meshes, areas, file: Path) -> None:
    """Cells by their area over the mean one."""
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import Normalize

    figure, axes = plt.subplots(
        2, -(-len(stages) // 2), figsize=(11, 4.6), layout="constrained"
    )
    for place, steps, made, area in zip(axes.flat, stages, meshes, areas, strict=True):
        rings = np.asarray(made.points / mm)[np.asarray(made.cells)]
        painted = PolyCollection(list(rings), edgecolors="#1f2430", linewidths=0.6)
        painted.set(array=area / area.mean(), cmap="viridis", clim=(0, 2))
        place.add_collection(painted)
        place.autoscale_view()
        place.set_title(f"{steps} steps, spread {100 * area.std() / area.mean():.0f} %")
        place.set_aspect("equal")
        place.set_axis_off()
    figure.colorbar(
        ScalarMappable(Normalize(0, 2), "viridis"),
        ax=axes,
        label="area over the mean area",
        shrink=0.8,
    )
    figure.savefig(file, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:42s} {number:10.4g}")

"""A bending actuator whose chamber nobody drew: found by topology optimisation, made a body.

Study VI-B of the Sorotoki paper: a cell of 15 x 30 mm with a hole of 5 mm, filled with a rubber
of 80 Shore A, in which pressure fills whatever becomes empty; 100 steps of moving asymptotes
turn its right side most. The densities become a smooth body of the same volume, a chain of
cells, which is meshed, bent by air, and written for a printer with walls of 2 mm on both
sides. Changed: deformation is large all the way, walls between cells are solid so that no
design leaks, and in place of a printed copy a mesh of half the size answers for the first.
"""

import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import design, fem, material, mesh, sdf
from sorojax.design.pneunet import sharpness
from sorojax.units import kPa, mm

SIZE, DEPTH, WALL, CAP, MOST = (15 * mm, 30 * mm), 25 * mm, 2 * mm, 4 * mm, 80 * kPa


def bent(body, count, size, pressures):
    """Shapes of a chain clamped on its left, on a mesh of its own, with air in its chambers."""
    solid = mesh.chambers(mesh.triangulate(body, size=size, order=2))
    problem = fem.problem(
        solid.mesh, material.presets.flexible_80a(), kinematics=fem.PlaneStrain(DEPTH),
        supports=(fem.Fixed(mesh.nodes_where(solid.mesh, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(solid.largest(count), name="air"),),
    )  # fmt: skip
    return fem.solve_path(problem, air=pressures)


def places(path, length):
    """Where five points of the underside and the upper end are at every pressure [m]."""
    marks = [[x, 0.0] for x in np.linspace(0, length, 6)[1:]] + [[length, SIZE[1]]]
    nodes = [mesh.nearest_node(path.problem.mesh, mark) for mark in marks]
    return np.array(marks) + np.asarray(path.displacements)[:, nodes]


def widths(made):
    """Heights in the chamber of one cell and its width there [m], from the axis outwards."""
    x, y = np.linspace(SIZE[0] / 2, SIZE[0], 151), np.linspace(0, SIZE[1], 601)
    grid = jnp.asarray(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    solid = np.asarray(made.cell(grid)).reshape(len(y), len(x)) <= 0
    wide, middle = 2 * (x[solid.argmax(axis=1)] - x[0]), len(y) // 2
    low = middle - int((wide[middle::-1] == 0).argmax()) + 1
    high = middle + int((wide[middle:] == 0).argmax())
    return y[low:high], wide[low:high]


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    steps, count = (40, 2) if quick else (100, 4)
    cell = design.pneunet_cell(divisions=(15, 30) if quick else (25, 50))
    found = design.optimise_pneunet(cell, steps=steps)
    density = np.asarray(cell.plan(found.design, sharpness(steps - 1, steps)))
    made = design.part(cell.problem.mesh, density, folds=(design.Repeat(0, count),))

    length = count * SIZE[0] + CAP  # a solid end, or its wall would only bulge
    block = sdf.Rectangle([0, 0], [length, SIZE[1]])
    body = made.shape | sdf.Rectangle([length - 1.1 * CAP, 0], [length, SIZE[1]])

    pressures = jnp.linspace(0, MOST, 5 if quick else 9)
    coarse = 1.6 * mm if quick else 1.2 * mm
    paths = [bent(body, count, size, pressures) for size in (coarse, coarse / 2)]
    first, fine = (places(path, length) for path in paths)
    up = fine[:, -1] - fine[:, -2]
    turn = np.degrees(np.arctan2(-up[:, 0], up[:, 1]))

    closed = sdf.extrude(block, DEPTH + 2 * WALL) - sdf.extrude(block - body, DEPTH)
    surface = sdf.isosurface(closed, 1.0 * mm if quick else 0.6 * mm, "dual_contouring")
    printed = sj.io.export_surface(Path(tempfile.gettempdir()) / "pneunet.stl", surface)
    report = sdf.surface_report(sj.io.import_surface(printed))
    volume = sdf.area(body) * DEPTH + sdf.area(block) * 2 * WALL
    heights, wide = widths(made)
    share = (heights[wide.argmax()] - heights[0]) / (heights[-1] - heights[0])
    lower, upper = (part.mean() for part in np.array_split(wide, 3)[::2])
    if picture is not None:
        draw(density, cell, found, made, paths, (first, fine), pressures, picture)
    return {
        "output of the cell at first [mm]": -float(found.history["objective"][0]) / mm,
        "output of the cell [mm]": -float(found.objective) / mm,
        "volume over the largest allowed": 1 + float(found.constraints[0]),
        "grey measure": float(design.greyness(jnp.asarray(density))),
        "widest part of the chamber, share of its height": share,
        "width of the lower third over that of the upper": float(lower / upper),
        "tip moves by [mm]": float(np.linalg.norm(fine[-1, -2] - fine[0, -2]) / mm),
        "tip turns by [deg]": float(turn[-1]),
        "turn grows with pressure": bool(np.all(np.diff(np.abs(turn)) > 0)),
        "finer mesh off the first [mm]": float(np.linalg.norm(first - fine, axis=2).max() / mm),
        "watertight": bool(report.watertight),
        "volume of the triangles over that of the body": float(report.volume / volume),
    }


def draw(density, cell, found, made, paths, feet, pressures, file) -> None:
    """The densities and the smooth chamber, its width, and the chain under air."""
    from matplotlib import pyplot as plt

    from sorojax import view

    figure = plt.figure(figsize=(7, 5.1), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(0.85, 1.15))
    axes = [figure.add_subplot(place) for place in grid[1].subgridspec(1, 3)]
    points = np.asarray(cell.problem.mesh.points) / mm
    cells = np.asarray(cell.problem.mesh.cells)
    corners = points[cells].mean(axis=1)
    order = np.lexsort((corners[:, 0], corners[:, 1]))
    rows = len(np.unique(corners[:, 1].round(6)))
    box = (0, SIZE[0] / mm, 0, SIZE[1] / mm)
    axes[0].imshow(density[order].reshape(rows, -1), origin="lower", cmap="Greys", extent=box)
    for curve in sdf.contour(made.cell, 0.2 * mm):
        axes[0].plot(*(np.asarray(curve.points).T / mm), color="#D55E00", lw=1.5)
    axes[0].set(xlabel="x [mm]", ylabel="y [mm]")
    axes[0].set_title("densities and outline", fontsize=10)
    heights, wide = widths(made)
    axes[1].plot(wide / mm, heights / mm, color="#0072B2", lw=1.8)
    axes[1].set(xlabel="width of the chamber [mm]", ylabel="height [mm]", xlim=(0, None))
    for places_, style, name in zip(feet, ("o", "-"), ("mesh", "finer mesh"), strict=True):
        way = np.linalg.norm(places_[:, -2] - places_[0, -2], axis=1) / mm
        axes[2].plot(np.asarray(pressures) / kPa, way, style, label=name, ms=4.5)
    axes[2].set(xlabel="pressure [kPa]", ylabel="way of the lower end [mm]")
    axes[2].legend(frameon=False, fontsize=9)
    for plot in axes[1:]:
        plot.spines[["top", "right"]].set_visible(False)
    states = (0, len(pressures) // 2, len(pressures) - 1)
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, 3)]
    for place, k in zip(shown, states, strict=True):
        place.set_title(f"{float(pressures[k]) / kPa:.0f} kPa", fontsize=10)
    plate = sdf.Box([-4 * mm, -17 * mm, -4 * mm], [0, 17 * mm, SIZE[1] + 4 * mm])
    bodies = view.scenes_of(paths[1], states, field="von_mises", rest=False)
    scenes = [
        view.merge_scenes(view.extrude(body, DEPTH), view.scene_of(plate)) for body in bodies
    ]
    view.draw_into(shown, scenes, view=view.Camera(-58.0, 20.0))
    figure.savefig(Path(file))
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<50} {value:.4g}")

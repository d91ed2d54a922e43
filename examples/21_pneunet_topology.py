"""A bending actuator whose chamber nobody drew: found by topology optimisation, made a body.

Study VI-B of the Sorotoki paper: a cell of 15 x 30 mm with a hole of 5 mm, filled with a rubber
of 80 Shore A, in which pressure fills whatever becomes empty; 100 steps of moving asymptotes
turn its right side most. The densities become a smooth body of the same volume, a chain of
cells, which is meshed, bent by air, and written for a printer with walls of 2 mm on both
sides. Changed: deformation is large all the way, walls between cells are solid so that no
design leaks, and in place of a printed copy a mesh of half the size answers for the first.

The paper finds an upside-down drop. Ours is none: it has no tip, only a taper, two thirds as
wide under the roof as at its widest, and that is low, near the thick base that the actuator
bends towards. The base is below here; with the base above, as in an actuator that curls up,
the wide end would be on top. Which end is wide hardly counts: upside down between the same base
and roof, the chamber gives 2 % less. The optimisation leaves gravity out, which would add
0.35 kPa from top to bottom to 20 kPa. It acts on the chains, where weight counts: at
1200 kg/m^3, a guess as the maker tells none, the tip sinks by more than a quarter of its way
under air.

Beside it bend two chains that anybody would draw, of the same outer size, rubber, base, roof
and pressure: rectangles with the same volume of air, and rectangles between sides of 1.2 mm,
the thinnest that the optimisation may leave. At 20 kPa, the pressure of the search, the chamber
that was found turns its chain farther, by 2 and by 12 %; at 80 kPa the drawn ones turn farther,
by 30 and by 46 %. What it was found for is how far the free side of one cell goes, and of that
its turn, 0.18 degrees, is a sixth at most, the rest stretch and bulge; in a chain the air of
the next cell takes the bulge away.
"""

import dataclasses
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import design, fem, material, mesh, sdf
from sorojax.design import pneunet
from sorojax.units import deg, kPa, mm

SIZE, DEPTH, WALL, CAP, MOST = (15 * mm, 30 * mm), 25 * mm, 2 * mm, 4 * mm, 80 * kPa
BASE, ROOF, DENSITY = 2.4 * mm, 1.2 * mm, 1200.0  # sides are as thick as the roof; kg/m^3


def bent(body, count, length, size):
    """A chain clamped on its left, on a mesh of its own, with air in its chambers, and where
    five points of its underside and the upper end are at every pressure [m]."""
    solid = mesh.chambers(mesh.triangulate(body, size=size, order=2))
    rubber = dataclasses.replace(material.presets.flexible_80a(), density=jnp.array(DENSITY))
    problem = fem.problem(
        solid.mesh, rubber, kinematics=fem.PlaneStrain(DEPTH),
        supports=(fem.Fixed(mesh.nodes_where(solid.mesh, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(solid.largest(count), name="air"), fem.Gravity()),
    )  # fmt: skip
    path = fem.solve_path(problem, air=jnp.linspace(0, MOST, 9))
    marks = [[x, 0.0] for x in np.linspace(0, length, 6)[1:]] + [[length, SIZE[1]]]
    nodes = [mesh.nearest_node(solid.mesh, mark) for mark in marks]
    return path, np.array(marks) + np.asarray(path.displacements)[:, nodes]


def told(feet, name=""):
    """Way of the lower end and turn of the end towards the base, under air."""
    up, way = feet[:, -1] - feet[:, -2], np.linalg.norm(feet[-1, -2] - feet[0, -2])
    turn = np.arctan2(up[:, 0], up[:, 1]) / deg
    return {
        f"{name}tip moves by [mm]": way / mm,
        f"{name}tip turns by [deg]": turn[-1] - turn[0],
        f"{name}tip turns at 20 kPa [deg]": turn[2] - turn[0],
    }


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    steps, count, (across, rows) = (40, 2, (15, 30)) if quick else (100, 4, (25, 50))
    cell = design.pneunet_cell(divisions=(across, rows), base=BASE, wall=ROOF)
    found = design.optimise_pneunet(cell, steps=steps)
    density = cell.plan(found.design, pneunet.sharpness(steps - 1, steps)).reshape(across, rows)
    free = slice(round(rows * BASE / SIZE[1]), rows - round(rows * ROOF / SIZE[1]))
    both = density, density.at[:, free].set(density[:, free][:, ::-1])  # and upside down
    moved, flipped = (fem.solve(pneunet.body(cell, x.ravel())).displacement for x in both)

    made = design.part(cell.problem.mesh, np.ravel(density), folds=(design.Repeat(0, count),))
    length, size = count * SIZE[0] + CAP, (1.6 if quick else 1.2) * mm  # with a solid end
    block = sdf.Rectangle([0, 0], [length, SIZE[1]])
    body = made.shape | sdf.Rectangle([length - 1.1 * CAP, 0], [length, SIZE[1]])
    air, meshes = float(sdf.area(block) - sdf.area(body)), [(body, size), (body, size / 2)]
    for width in (air / count / (SIZE[1] - BASE - ROOF), SIZE[0] - 2 * ROOF):
        ends = [(SIZE[0] - width) / 2, BASE], [(SIZE[0] + width) / 2, SIZE[1] - ROOF]
        drawn = sdf.repeat(sdf.Rectangle(*ends, 0.6 * mm), [SIZE[0], 0], count, separate=True)
        meshes.append((block - drawn, size / 2))
    paths, feet = zip(*(bent(x, count, length, h) for x, h in meshes), strict=True)

    closed = sdf.extrude(block, DEPTH + 2 * WALL) - sdf.extrude(block - body, DEPTH)
    surface = sdf.isosurface(closed, size / 2, "dual_contouring")
    printed = sj.io.export_surface(Path(tempfile.gettempdir()) / "pneunet.stl", surface)
    wide = SIZE[0] * np.mean(1 - np.asarray(density), axis=0)[free]
    if picture is not None:
        draw(density, made, paths, feet, picture)
    return {
        "output of the cell at first [mm]": -float(found.history["objective"][0]) / mm,
        "output of the cell [mm]": float(pneunet.output(cell, moved)) / mm,
        "output of the chamber upside down [mm]": float(pneunet.output(cell, flipped)) / mm,
        "volume over the largest allowed": 1 + float(found.constraints[0]),
        "grey measure": float(design.greyness(density.ravel())),
        "widest part of the chamber, share of its height": np.argmax(wide) / len(wide),
        "width, lower over upper third": wide[: rows // 3].mean() / wide[-rows // 3 :].mean(),
        "tip sinks in its weight by [mm]": -feet[1][0, -2, 1] / mm,
        **told(feet[1]), **told(feet[2], "plain, same air: "),
        **told(feet[3], "plain, thinnest sides: "),
        "finer mesh off the first [mm]": np.linalg.norm(feet[0] - feet[1], axis=2).max() / mm,
        "watertight": sdf.surface_report(sj.io.import_surface(printed)).watertight,
    }  # fmt: skip


def draw(density, made, paths, feet, file) -> None:
    """The densities and the smooth chamber, its width, and the chains under air."""
    from matplotlib import pyplot as plt

    from sorojax import view

    figure = plt.figure(figsize=(7, 5.1), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(0.85, 1.15))
    axes = [figure.add_subplot(place) for place in grid[1].subgridspec(1, 3)]
    box = (0, SIZE[0] / mm, 0, SIZE[1] / mm)
    axes[0].imshow(density.T, origin="lower", cmap="Greys", extent=box)
    for curve in sdf.contour(made.cell, 0.2 * mm):
        axes[0].plot(*(np.asarray(curve.points).T / mm), color="#D55E00", lw=1.5)
    axes[0].set(xlabel="x [mm]", ylabel="y [mm]")
    axes[0].set_title("densities and outline", fontsize=10)
    wide = SIZE[0] * np.mean(1 - np.asarray(density), axis=0)
    heights = (np.arange(len(wide)) + 0.5) * SIZE[1] / len(wide)
    axes[1].plot(wide / mm, heights / mm, color="#0072B2", lw=1.8)
    axes[1].set(xlabel="width of the chamber [mm]", ylabel="height [mm]", xlim=(0, None))
    names = ("found, coarse mesh", "found", "plain, same air", "plain, thinnest sides")
    looks = zip(names, ("o", "-", "--", ":"), ("C0", "C0", "#D55E00", "#009E73"), strict=True)
    for each, (name, style, colour) in zip(feet, looks, strict=True):
        up = each[:, -1] - each[:, -2]
        turn = np.arctan2(up[:, 0], up[:, 1]) / deg
        axes[2].plot(
            paths[0].values / kPa,
            turn - turn[0],
            style,
            color=colour,
            label=name,
            ms=4.5,
            lw=1.8,
        )
    axes[2].set(xlabel="pressure [kPa]", ylabel="turn of the end [deg]", ylim=(-0.5, 16))
    axes[2].legend(frameon=False, fontsize=8)
    for plot in axes[1:]:
        plot.spines[["top", "right"]].set_visible(False)
    last = len(paths[0]) - 1
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, 3)]
    panels = ((1, 0, "found, 0 kPa"), (1, last, "found, 80 kPa"), (2, last, "plain, 80 kPa"))
    for place, (_, _, title) in zip(shown, panels, strict=True):
        place.set_title(title, fontsize=10)
    plate = sdf.Box([-4 * mm, -17 * mm, -4 * mm], [0, 17 * mm, SIZE[1] + 4 * mm])
    bodies = [*view.scenes_of(paths[1], (0, last), field="von_mises", rest=False)]
    bodies += view.scenes_of(paths[2], (last,), field="von_mises", rest=False)
    scenes = [
        view.merge_scenes(view.extrude(body, DEPTH), view.scene_of(plate)) for body in bodies
    ]
    view.draw_into(shown, scenes, view=view.Camera(-58.0, 20.0))
    figure.savefig(Path(file))
    plt.close(figure)
    finer, tracks = np.linspace(0, MOST, 41), []
    for path in paths[1:3]:
        path = fem.solve_path(path.problem, air=jnp.array(finer))
        bodies = view.scenes_of(path, range(41), field="von_mises", rest=False)
        solids = [
            view.merge_scenes(view.extrude(x, DEPTH), view.scene_of(plate)) for x in bodies
        ]
        tracks.append(view.Track(finer / kPa, solids.__getitem__, bodies[0].scale, "kPa"))
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-58.0, 20.0)}
    look |= {"names": ("the chamber that was found", "plain, same air"), "size": (760, 400)}
    film = view.animate(tracks[0], beside=tracks[1], fps=12.0, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<52} {value:.4g}")

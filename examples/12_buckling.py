"""A square of soft rubber with 4 x 4 holes, pressed between plates: it buckles and draws in.

Section V-C of the Sorotoki paper: E = 19 kPa, nu = 0.45, four modes at 0 and 12.5 %, which at
12.5 % begin with neighbouring holes as ellipses across and along. Side 40 mm, holes of 8 mm,
plates that hold the rubber. Changed: the bulk modulus is E / (3 - 6 nu), not lambda / 2.

On the way that keeps the symmetry two eigenvalues vanish close to each other: that of the
ellipses at 0.0843, and at 0.0861 that of columns that lean to one side, for which an
independent code has 0.0859. The square leaves at the first, into ellipses, and draws in.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, material, mesh, sdf
from sorojax.units import kPa, mm

SIDE, PITCH, RADIUS = 40 * mm, 10 * mm, 4 * mm
LARGEST, BEFORE = 0.125, (0.081, 0.0835)  # strains; two just short of the first zero


def square(coarser: float) -> mesh.Mesh:
    """Triangles, fine at necks and corners. A mesh without symmetry would have no bifurcation:
    a quarter is mirrored twice."""
    places = (0.5 * PITCH, 1.5 * PITCH)
    holes = sdf.union(*(sdf.Circle((x, y), RADIUS) for x in places for y in places))

    def size(p):
        wall, middle = abs((p + PITCH / 2) % PITCH - PITCH / 2), abs(p % PITCH - PITCH / 2)
        neck = np.hypot(wall, middle[:, ::-1]).min(axis=1)
        corner = 0.2 * mm + 0.3 * np.linalg.norm(p, axis=1)
        return coarser * np.minimum(np.minimum(0.3 * mm + 0.12 * neck, corner), 0.85 * mm)

    cut = sdf.Rectangle((0, 0), (SIDE / 2, SIDE / 2)) - holes
    half = mesh.mirror(mesh.triangulate(cut, size=size, order=2), 0, SIDE / 2)
    return mesh.mirror(half, 1, SIDE / 2)


def pressed(cells: mesh.Mesh, strain: float) -> fem.Problem:
    low = mesh.nodes_where(cells, lambda p: p[1] < 1e-9)
    high = mesh.nodes_where(cells, lambda p: p[1] > SIDE - 1e-9)
    rubber = material.NeoHookean(19 * kPa / 2.9, 19 * kPa / 0.3, density=1000.0)  # nu = 0.45
    supports = fem.Fixed(low), fem.Prescribed(high, jnp.array([0.0, -strain * SIDE]))
    return fem.problem(cells, rubber, kinematics=fem.PlaneStrain(1.0), supports=supports)


def alternation(points, shape) -> float:
    """How far neighbouring holes become ellipses across and along: 0 not at all."""
    pattern, all_of_it = 0.0, 0.0
    for i, j in np.ndindex(4, 4):
        arm = (points - PITCH * (np.array([[i, j]]) + 0.5)) / RADIUS
        rim = np.abs(np.linalg.norm(arm, axis=1) - 1) < 0.01
        stretch = (shape[rim] - shape[rim].mean(axis=0, keepdims=True)) * arm[rim]
        pattern += (-1) ** (i + j) * np.mean(stretch * [1.0, -1.0])
        all_of_it += np.mean(np.abs(stretch))
    return float(abs(pattern) / all_of_it)


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    cells = square(1.3 if quick else 1.0)
    points = np.asarray(cells.points)

    def modes(strain):
        problem = pressed(cells, strain)
        u = fem.solve(problem, steps=4).displacement if strain else jnp.zeros_like(cells.points)
        found = fem.eigenmodes(problem, u, 4)
        return found, np.array([alternation(points, np.asarray(s)) for s in found.shapes])

    (rest, before), near, last, (full, after) = (modes(e) for e in (0.0, *BEFORE, LARGEST))
    a, b = (found.eigenvalues[np.argsort(-alike[:2])] for found, alike in (near, last))
    ellipses, leaning = (float(x) for x in BEFORE[0] + np.diff(BEFORE) * a / (a - b))

    # Past buckling, started by a little of the first mode in the shape of the square.
    bent = fem.with_imperfection(pressed(cells, LARGEST), full.shapes[0], 1e-3 * SIDE)
    path = fem.continuation(bent, step=0.2, largest_step=0.7 * mm, locate_critical_points=False)
    rows = np.abs(points[:, 1] - SIDE / 2) < SIDE / 4
    left, right = (rows & (np.abs(points[:, 0] - x) < 1e-9) for x in (0, SIDE))
    sides = np.asarray(path.displacements)[..., 0]
    wider = (sides[:, right].mean(axis=1) - sides[:, left].mean(axis=1)) / SIDE
    shorter = LARGEST * np.asarray(path.factors)
    if picture is not None:
        draw(rest, full, path, (shorter, wider), ellipses, Path(picture))
    begin, past = np.interp((0.02, 0.10), shorter, wider)
    return {
        "unknowns": bent.space.num_dofs,
        "critical strain, ellipses": ellipses,
        "critical strain, columns leaning": leaning,
        "alternation of the first mode, 12.5 %": float(after[0]),
        "alternation of the first four, 0 %": float(before.max()),
        "unstable modes kept at 12.5 %": int(np.sum(np.asarray(full.eigenvalues) < 0)),
        "unstable modes past buckling": int(path.negative_eigenvalues[-1]),
        "Poisson's ratio, 0 to 2 %": float(begin / 0.02),
        "Poisson's ratio beyond 10 %": float((wider[-1] - past) / (shorter[-1] - 0.10)),
    }


def draw(rest, full, path, widths, first, file: Path) -> None:
    """The square between its plates on its way, four modes at 0 and at 12.5 %, its width."""
    import matplotlib.pyplot as plt
    from matplotlib.tri import Triangulation

    from sorojax import view

    figure = plt.figure(figsize=(7, 8.3), dpi=200, layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=(1.25, 1.75, 1))
    points = np.asarray(full.problem.mesh.points)
    corners = np.asarray(full.problem.mesh.cells)[:, :3]
    places, drawn = iter(grid[1].subgridspec(2, 4)), []
    for modes, name in ((rest, "0 %"), (full, "12.5 %")):
        for k, shape in enumerate(np.asarray(modes.shapes)):
            shape = 3 * mm * shape / np.abs(shape).max()
            x, y = (points + np.asarray(modes.displacement) + shape).T / mm
            axes = figure.add_subplot(next(places))
            tinted = axes.tripcolor(
                Triangulation(x, y, corners), shape[:, 0] / mm, cmap="coolwarm",
                clim=(-3, 3), shading="gouraud", rasterized=True,
            )  # fmt: skip
            axes.set(aspect="equal", xlim=(-4, 44), ylim=(-1, 41))
            axes.set_title(f"mode {k + 1} at {name}", fontsize=10)
            axes.set_axis_off()
            drawn.append(axes)
    figure.colorbar(tinted, ax=drawn, aspect=30, pad=0.02, label="sideways [mm]")
    pressed, widening = (100 * np.asarray(w) for w in widths)
    states = np.array([0, np.abs(pressed - 100 * first).argmin(), len(pressed) - 1])
    axes = figure.add_subplot(grid[2])
    axes.plot(pressed, widening, color="#0072B2", lw=1.8)
    axes.plot(pressed[states], widening[states], "o", color="#1f2430", ms=4.5)
    axes.axvline(100 * first, color="#D55E00", lw=1.2)
    axes.text(100 * first, -1.9, f"ellipses from {100 * first:.1f} %  ", ha="right")
    axes.axvline(12.5, color="#8a8f98", lw=1.2, ls="--")
    axes.text(12.5, 2.6, "paper, 12.5 %  ", ha="right")
    axes.set(xlabel="compression [%]", ylabel="widening [%]")
    axes.spines[["top", "right"]].set_visible(False)

    def pressing(scene, share):
        """The square, 12 mm deep, with the plates that hold it."""
        plates = [
            sdf.Box([-5 * mm, -9 * mm, low], [45 * mm, 9 * mm, low + 3 * mm])
            for low in (-3 * mm, 40 * mm * (1 - share / 100))
        ]
        square = view.extrude(scene, 12 * mm)
        return view.merge_scenes(square, *(view.scene_of(plate) for plate in plates))

    bodies = view.scenes_of(path, states, field="von_mises", rest=False)
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, 3)]
    for axes, share in zip(shown, pressed[states], strict=True):
        axes.set_title(f"pressed by {share:.1f} %", fontsize=10)
    scenes = [
        pressing(body, share) for body, share in zip(bodies, pressed[states], strict=True)
    ]
    view.draw_into(shown, scenes, view=view.Camera(-66.0, 14.0))
    figure.savefig(file)
    plt.close(figure)
    path = fem.continuation(
        path.problem, step=0.02, largest_step=0.16 * mm, locate_critical_points=False
    )
    way = np.flatnonzero(np.append(True, np.diff(path.factors) > 0))
    bodies = view.scenes_of(path, way, field="von_mises", rest=False)
    by = 100 * LARGEST * np.asarray(path.factors)[way]  # compressed [%]
    moving = view.Track(by, lambda k: pressing(bodies[k], by[k]), bodies[0].scale, "%")
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-66.0, 14.0)}
    title = "A square pressed between plates"
    film = view.animate(moving, speed=2.5, size=(520, 420), title=title, **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:42s} {number:10.4g}")

"""Where a pushed soft actuator is, from one marker at its tip and the pressure in it.

Study VI-E of the Sorotoki paper with finite elements as the truth: a bellows actuator hangs
in its weight, air goes in and out, random forces push its back. A rod of three bending modes,
made from pressure and weight alone, is brought to the seen tip; what the tip leaves open is
filled by the unbalanced force of the model (the null-space task), or by nothing.

Changed against the paper: nine wider bellows with gaps, 118 mm in all, so that walls do not
touch, and therefore 6 kPa instead of 30. One marker cannot tell pushes apart, so the error of
the middle grows with them: with Dragon Skin 10 and pushes of 20 mN it was 14 mm, no better
than without the task. Here it is Dragon Skin 30, with 12 mN at most on each of three bellows.
"""

import functools
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, reduction
from sorojax.units import kPa, mm

DOWN = [9.81, 0.0]  # m/s^2, along the actuator
PUSH, SHAKEN = 0.012, (2, 4, 7)  # N, greatest, on the third, fifth and eighth bellow


def hanging(problem, pressure, pushes=np.zeros(3), start=None):  # noqa: B008
    """Displacement under a pressure [Pa], the weight, and forces [N] on the backs."""
    values = [pressure, jnp.array(DOWN), *np.stack([0 * pushes, pushes], axis=1)]
    loaded = sj.replace(problem, lambda p: [load.value for load in p.loads], values)
    return fem.solve(loaded, start=start).displacement


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    actuator = sj.robots.BellowsActuator(num_bellows=9)
    mesh = sj.mesh.triangulate(actuator.body(), size=(2.0 if quick else 1.2) * mm, order=2)
    rubber = sj.material.presets.dragon_skin_30()
    problem = sj.robots.bellows_problem(actuator, mesh, rubber, gravity=[0, 0], pushed=SHAKEN)
    path = fem.solve_path(problem, air=jnp.linspace(0, 6 * kPa, 6))
    line = reduction.Line([0.0, 1 * mm], [actuator.length, 1 * mm])

    def backbones(shapes):
        seen = sj.replace(path, lambda x: x.displacements, jnp.stack(shapes))
        return reduction.strain_along(seen, line)

    # A rod of three bending modes and a stretch, as pressure and weight teach it.
    taught = backbones([*path.displacements, *(hanging(problem, p) for p in path.values[::5])])
    basis = reduction.pod_basis(taught, modes={"kappa_z": 3, "sigma_x": 1})
    fit = reduction.identify(path, basis, reduction.strain_along(path, line), line, degree=3)
    rod = sj.rod.rod(sj.SE2(), basis, fit.section, sj.rod.elastic(rubber), length=fit.length)

    random, frames = np.random.default_rng(1), 24 if quick else 60
    pressure = 6 * kPa * np.clip(np.sin(np.linspace(0, 2 * np.pi, frames)), 0, 1)
    pushes = PUSH * random.uniform(-1, 1, (frames, 3))
    pushes[: frames // 6] = 0.0
    shapes = [jnp.zeros_like(problem.mesh.points)]
    for p, f in zip(pressure, pushes, strict=True):
        shapes.append(hanging(problem, p, f, shapes[-1]))
    truth = backbones(shapes[1:])
    true = np.asarray(truth.positions)
    tip = true[:, -1] + 0.1 * mm * random.standard_normal((frames, 2))  # the marker
    heavy = reduction.offset_weight(problem, line, DOWN)

    @functools.partial(jax.jit, static_argnums=0)
    def estimate(balanced, q, tip, pressure):
        forces = (fit.elastic, heavy, sj.rod.Pressurised(fit.pressure, pressure))
        target, own = sj.rod.Position(tip), forces if balanced else None
        q = sj.rod.inverse_kinematics(rod, target, q, forces=own, iterations=20).q
        return q, sj.rod.forward_kinematics(rod, q, truth.s)[:, :2, 2]

    lines, spent = [], []
    for balanced in (True, False):
        q, told = jnp.zeros(rod.basis.num_dof), []
        for x, p in zip(tip, pressure, strict=True):
            begin = time.perf_counter()
            q, shape = jax.block_until_ready(estimate(balanced, q, x, p))
            spent.append(time.perf_counter() - begin)
            told.append(np.asarray(shape))
        lines.append(np.stack(told))
    off = np.linalg.norm(np.stack(lines) - true, axis=3) / mm
    if picture is not None:
        draw(path, shapes[1:], truth.positions, tip, lines, off, picture)
    middle = len(truth.s) // 2
    return {
        "largest error of the tip [mm]": float(off[0, :, -1].max()),
        "largest error of the middle [mm]": float(off[0, :, middle].max()),
        "of the middle without the null-space task [mm]": float(off[1, :, middle].max()),
        "mean of the middle [mm]": float(off[0, :, middle].mean()),
        "mean of the middle without [mm]": float(off[1, :, middle].mean()),
        "way of the tip [mm]": float(np.ptp(true[:, -1, 1]) / mm),
        "estimates a second": float(1 / np.median(spent[1:frames])),
        "estimates a second, slowest of 100": float(1 / np.quantile(spent[1:frames], 0.99)),
    }


def draw(path, shapes, true, tip, lines, off, file) -> None:
    """The hanging solid with both estimates of its backbone at five moments, and the errors."""
    from matplotlib import pyplot as plt

    from sorojax import sdf, view

    frames, depth = np.linspace(5, len(shapes) - 5, 5).astype(int), 20 * mm
    moved = sj.replace(path, lambda x: x.displacements, jnp.stack([shapes[k] for k in frames]))
    hang = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # x is down
    colours = {"tip alone": "#D55E00", "tip and balance of forces": "#0072B2"}
    plate = view.scene_of(sdf.Box([-8 * mm, -16 * mm, 0.0], [36 * mm, 16 * mm, 4 * mm]))

    def scene(body, k):
        """The solid with the lines in front of it."""
        front = -depth / 2 - 1 * mm
        told = [
            view.Lines([np.insert(shape[k], 1, front, axis=1)], colour, 2.2)
            for shape, colour in zip(lines[::-1], colours.values(), strict=True)
        ]
        marker = view.Dots(np.insert(tip[k], 1, front - 1 * mm)[None], "#1f2430", 6.0)
        seen = view.merge_scenes(view.extrude(body, depth), view.Scene((*told, marker)))
        return view.merge_scenes(view.place(seen, hang), plate)

    figure = plt.figure(figsize=(7, 6.6), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.5, 1))
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, 5)]
    for axes, k in zip(shown, frames, strict=True):
        axes.set_title(f"frame {k}", fontsize=10)
    axes, middle = figure.add_subplot(grid[1]), true.shape[1] // 2
    for row, (name, colour) in zip(off[::-1], colours.items(), strict=True):
        axes.plot(row[:, middle], color=colour, lw=1.8, label=f"middle, by {name}")
    axes.plot(off[0][:, -1], color="#8a8f98", lw=1.8, label="tip, by tip and balance of forces")
    axes.set(xlabel="frame", ylabel="error [mm]", ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    bodies = view.scenes_of(moved, range(5), field="stretch", rest=False)
    scenes = [scene(body, k) for body, k in zip(bodies, frames, strict=True)]
    view.draw_into(shown, scenes, view=view.Camera(-78.0, 8.0))
    figure.savefig(Path(file))
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    sj.enable_low_latency()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<48} {value:.4g}")

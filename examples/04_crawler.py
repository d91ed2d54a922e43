"""A soft crawler in its gait: how far a cycle takes it, and what the pressure does to that."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, robots
from sorojax.units import kPa, mm

PERIOD = 0.8  # s


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    crawler = robots.Crawler()
    problem = robots.crawler_problem(crawler, size=(3 if quick else 1.5) * mm)
    damping = fem.Rayleigh(mass=1.0, stiffness=1e-3)
    cycles, step = (1, 6e-3) if quick else (3, 2e-3)
    gait = robots.crawler_gait(8 * kPa, 1 / PERIOD)
    motion = fem.simulate(problem, cycles * PERIOD, step, damping=damping, **gait)

    shares = fem.lumped_mass(problem)[::2] / fem.total_mass(problem)
    centre = np.asarray(jnp.einsum("n,tni->ti", shares, motion.displacements)) / mm
    ends = np.interp(PERIOD * np.arange(cycles + 1), np.asarray(motion.time), centre[:, 0])
    floor = problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    deepest = jnp.min(jax.lax.map(lambda u: floor.points_of(problem, u)[..., 1].min(),
                                  motion.displacements))  # fmt: skip
    if picture is not None:
        draw(problem, motion, centre, Path(picture))
    return {
        "unknowns": problem.space.num_dofs,
        "way of the last cycle [mm]": float(ends[-1] - ends[-2]),
        "highest lift of its centre [mm]": float(centre[:, 1].max()),
        "overlap with the floor [mm]": -float(deepest) / mm,
        "cut steps": motion.stats.cuts,
    }


def draw(problem, motion, centre, file: Path) -> None:
    """The stress at four moments of a cycle, and the way of the centre."""
    import matplotlib.pyplot as plt

    from sorojax import sdf, view

    times, depth = np.asarray(motion.time), float(problem.kinematics.thickness)
    starts = (times[-1] // PERIOD - 1 + np.array([0.2, 0.35, 0.55, 0.75])) * PERIOD
    states = np.searchsorted(times, starts)
    field = {"field": "von_mises", "label": "", "rest": False}
    bodies = [view.extrude(scene, depth) for scene in view.scenes_of(motion, states, **field)]
    low, high = (1e3 * corner for corner in bodies[0].box)
    ground = sdf.Box(
        [low[0] * mm - 6 * mm, -32 * mm, -5 * mm], [high[0] * mm + 6 * mm, 32 * mm, 0]
    )
    floor = view.scene_of(ground)
    figure = plt.figure(figsize=(7, 6.4), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.75, 1))
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(2, 2)]
    for axes, t in zip(shown, times[states], strict=True):
        axes.set_title(f"{(t - starts[0]) / PERIOD + 0.2:.2f} of a cycle", fontsize=10, y=0.92)
    axes = figure.add_subplot(grid[1])
    axes.plot(times, centre[:, 0], color="#0072B2", lw=1.8)
    axes.plot(times, centre[:, 1], color="#D55E00", lw=1.8)
    axes.text(times[-1], centre[-1, 0], " forwards", va="center", color="#0072B2")
    axes.text(times[-1], centre[-1, 1], " upwards", va="center", color="#D55E00")
    axes.plot(times[states], centre[states, 0], "o", ms=4.5, color="#1f2430")
    axes.set(xlabel="time [s]", ylabel="centre of mass [mm]", xlim=(0, 1.16 * times[-1]))
    axes.spines[["top", "right"]].set_visible(False)
    scenes = [view.merge_scenes(body, floor) for body in bodies]
    view.draw_into(shown, scenes, view=view.Camera(-72.0, 20.0))
    figure.savefig(file)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:34s} {number:10.4g}")

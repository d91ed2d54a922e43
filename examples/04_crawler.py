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
    """Four moments of a cycle, and the way of the centre."""
    import matplotlib.pyplot as plt

    facets = np.asarray(sj.mesh.boundary_facets(problem.mesh))[:, [0, 2, 1]]
    positions = np.asarray(problem.mesh.points + motion.displacements) / mm
    times = np.asarray(motion.time)
    figure, axes = plt.subplots(5, 1, figsize=(7, 6), height_ratios=[1, 1, 1, 1, 2])
    for k, share in enumerate((0.0, 0.25, 0.5, 0.75)):
        now = positions[np.searchsorted(times, (times[-1] // PERIOD - 1 + share) * PERIOD)]
        for line in now[facets]:
            axes[k].plot(*line.T, color="#2a6f97", lw=0.8)
        axes[k].axhline(0.0, color="#e76f51", lw=1)
        axes[k].set(aspect="equal", xticks=[], yticks=[], xlim=(-8, 160), ylim=(-1, 34))
        axes[k].set_ylabel(f"{share:g} T")
    axes[4].plot(times, centre[:, 0], color="#2a6f97", label="forwards")
    axes[4].plot(times, centre[:, 1], color="#e76f51", label="upwards")
    axes[4].set(xlabel="time [s]", ylabel="centre of mass [mm]")
    axes[4].legend()
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:34s} {number:10.4g}")

"""A rubber walker goes down a slope by itself, its three pairs of legs in one rhythm.

The paper damps the motion by 1.5 1/s times the mass, a loss of one percent at 20 Hz, and by its
contact and integrator. Here the rubber itself is viscous: without that the body gets faster
until it falls or comes to rest, and no gait lasts.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, mesh, robots
from sorojax.units import deg, mm, ms

RUBBER, SLOPE, DROP = fem.KelvinVoigt(800.0), 30 * deg, 3 * mm


def walk(duration: float, step: float, method=None, **floor: Any) -> fem.Trajectory:
    """From rest, a little above the slope."""
    floor = {"slope": SLOPE, "friction": 0.7} | floor
    problem = robots.walker_problem(robots.Walker(), size=2.5 * mm, **floor)
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest.at[:, 1].set(DROP), rest
    return fem.simulate(problem, duration, step, start=start, damping=RUBBER, method=method)


def legs(motion: fem.Trajectory):
    """Angles of the pairs of legs [rad], and their gait."""
    angles = robots.pair_angles(robots.Walker(), motion.problem.mesh, motion.displacements)
    return np.asarray(angles), robots.gait(np.asarray(motion.time), np.asarray(angles))


#: What is changed, and the frequency of the gait in the first 0.4 s told.
CASES = {
    "nothing": {},
    "contact half as stiff": {"stiffness": 0.5e9},
    "contact twice as stiff": {"stiffness": 2e9},
    "friction 0.65": {"friction": 0.65},
    "friction 0.75": {"friction": 0.75},
    "steps of 0.5 ms": {"step": 0.5 * ms},
    "steps of 2 ms": {"step": 2 * ms},
    "rho_inf 0.8": {"method": fem.GeneralisedAlpha(0.8)},
    "rho_inf 0.2": {"method": fem.GeneralisedAlpha(0.2)},
}


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    motion = walk(0.4 if quick else 0.7, (2 if quick else 1) * ms)
    angles, gait = legs(motion)
    times, problem = np.asarray(motion.time), motion.problem
    front = mesh.nearest_node(problem.mesh, np.asarray(robots.Walker().bottoms())[-1])
    path = np.asarray(motion.displacements[:, front]) / mm
    forward, late = np.diff(path[len(times) // 2 :, 0]), angles[len(times) // 2 :] / deg
    numbers = {
        "unknowns": problem.space.num_dofs,
        "frequency of the gait [Hz]": gait.frequencies.mean(),
        "frequencies apart [Hz]": np.ptp(gait.frequencies),
        "a period like the one before": gait.repeats,
        "second pair behind the first [deg]": gait.lags[1, 1] / deg,
        "third pair behind the first [deg]": gait.lags[1, 2] / deg,
        "largest change of a lag [deg]": np.abs(gait.drift).max() / deg,
        "swing of the legs [deg]": np.ptp(late, axis=0).max(),
        "step of the front foot [mm]": forward.sum() / (times[-1] / 2 * gait.frequencies[0]),
        "slip back of the front foot [mm]": -forward[forward < 0].sum(),
        "cut steps": motion.stats.cuts,
    }
    others = {} if quick else CASES
    others = {
        name: legs(walk(0.4, **({"step": 1 * ms} | case)))[1].frequencies.mean()
        for name, case in others.items()
    }
    if picture is not None:
        draw(problem, motion, angles / deg, path, others, numbers, Path(picture))
    return numbers | {f"frequency, {name} [Hz]": value for name, value in others.items()}


def draw(problem, motion, angles, path, others, numbers, file: Path) -> None:
    """Moments of a period, angles, the way of the front foot, and what changes the rhythm."""
    import matplotlib.pyplot as plt

    times = np.asarray(motion.time)
    facets = np.asarray(mesh.boundary_facets(problem.mesh))[:, [0, 2, 1]]
    positions = np.asarray(problem.mesh.points + motion.displacements) / mm
    turn = np.array([[np.cos(SLOPE), -np.sin(SLOPE)], [np.sin(SLOPE), np.cos(SLOPE)]])
    figure, axes = plt.subplots(2, 2, figsize=(10, 7))
    left, right = axes[0]
    start, period = 0.6 * times[-1], 1 / numbers["frequency of the gait [Hz]"]
    for k in range(3):
        now = positions[np.searchsorted(times, start + 2.5 * k * period)] - [0, 26 * k]
        for line in now[facets] @ turn:
            left.plot(*line.T, color="#2a6f97", lw=0.8)
        ground = np.array([[-16, -26 * k], [130, -26 * k]]) @ turn
        left.plot(*ground.T, color="#e76f51", lw=1)
    left.set(aspect="equal", xticks=[], yticks=[], title="every two and a half periods")
    last = times > times[-1] - 0.2
    for k in range(angles.shape[1]):
        right.plot(1e3 * times[last], angles[last, k], label=f"pair {k + 1}")
    right.set(xlabel="time [ms]", ylabel="angle between its legs [deg]")
    right.legend(loc="upper right")
    left, right = axes[1]
    left.plot(times, path[:, 0], color="#2a6f97", label="down the slope")
    left.plot(times, 10 * path[:, 1], color="#e76f51", label="off it, ten times")
    left.set(xlabel="time [s]", ylabel="front foot [mm]")
    left.legend()
    right.barh(list(others)[::-1], list(others.values())[::-1], color="#8ab6d6")
    right.axvspan(19, 23, color="#2a9d8f", alpha=0.2, lw=0)
    right.axvline(21.1, color="#e76f51", lw=1, label="paper")
    right.set(xlabel="frequency of the gait [Hz]", title="what is changed, first 0.4 s")
    right.legend(loc="lower left")
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:42s} {number:10.4g}")

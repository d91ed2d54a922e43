"""A rubber walker goes down a slope by itself, its three pairs of legs in one rhythm.

Study VI-A of the Sorotoki paper, after Suzumori and Saito (2008). The paper damps the motion by
1.5 1/s times the mass, a loss of one percent at 20 Hz, and by its contact and integrator. Here
the rubber itself is viscous: without that the body gets faster until it falls or comes to rest,
and no gait lasts. No source gives that viscosity, nor the friction of the feet: 800 Pa s and
0.7 are calibrated, so that the gait on 30 degrees lasts and has the 21.1 Hz of the paper. What
they do to the frequency is printed. Predicted without touching them are other slopes, and legs
that stand 29 mm apart for 27.5 mm.
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

VISCOSITY, SLOPE, DROP, SPACING = 800.0, 30 * deg, 3 * mm, 27.5 * mm  # Pa s, rad, m, m


def walk(duration, step, method=None, viscosity=VISCOSITY, spacing=SPACING, **floor: Any):
    """From rest, a little above the slope."""
    floor = {"slope": SLOPE, "friction": 0.7} | floor
    problem = robots.walker_problem(robots.Walker(spacing), size=2.5 * mm, **floor)
    rest = jnp.zeros_like(problem.mesh.points)
    start, rubber = (rest.at[:, 1].set(DROP), rest), fem.KelvinVoigt(viscosity)
    return fem.simulate(problem, duration, step, start=start, damping=rubber, method=method)


def legs(motion: fem.Trajectory, spacing=SPACING):
    """Angles of the pairs of legs [rad], and their gait."""
    walker = robots.Walker(spacing)
    angles = robots.pair_angles(walker, motion.problem.mesh, motion.displacements)
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
    "viscosity 600": {"viscosity": 600.0},
    "viscosity 1000": {"viscosity": 1000.0},
    "slope 25 deg": {"slope": 25 * deg},
    "slope 35 deg": {"slope": 35 * deg},
    "legs 29 mm apart": {"spacing": 29 * mm},
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
    others = {}
    for name, case in ({} if quick else CASES).items():
        changed = walk(0.4, **({"step": 1 * ms} | case))
        others[name] = legs(changed, case.get("spacing", SPACING))[1]
    if picture is not None:
        draw(problem, motion, angles / deg, path, others, numbers, Path(picture))
    for name, gait in others.items():
        numbers[f"frequency, {name} [Hz]"] = gait.frequencies.mean()
        numbers[f"a period like the one before, {name}"] = gait.repeats
    return numbers


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

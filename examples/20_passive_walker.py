"""A rubber walker goes down a slope by itself, its three pairs of legs in one rhythm.

The paper damps the motion by 1.5 1/s times the mass, a loss of one percent at 20 Hz, and by its
contact and integrator. Here the rubber itself is viscous: without that the body gets faster
until it falls or comes to rest, and no gait lasts.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax import fem, mesh, robots
from sorojax.units import deg, mm, ms

RUBBER, FRICTION, SLOPE, DROP = fem.KelvinVoigt(800.0), 0.7, 30 * deg, 3 * mm


def walk(problem: fem.Problem, duration: float, step: float, method=None) -> fem.Motion:
    """From rest, a little above the slope."""
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest.at[:, 1].set(DROP), rest
    return fem.simulate(problem, duration, step, start=start, damping=RUBBER, method=method)


def gait(times: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Of the second half: frequency of every pair [Hz], its phase behind the first [deg] in
    the two halves of that, and how well a period repeats the one before."""
    late = len(times) // 2
    t, waves = times[late:], angles[late:] - angles[late:].mean(axis=0)
    size, step = 32 * len(t), times[1] - times[0]
    power = np.abs(np.fft.rfft(waves * np.hanning(len(t))[:, None], size, axis=0))
    power[np.fft.rfftfreq(size, step) < 8] = 0
    found = np.fft.rfftfreq(size, step)[power.argmax(axis=0)]
    period = round(1 / found[0] / step)
    count = (len(t) // 2 // period) * period
    turn = waves * np.exp(-2j * np.pi * found[0] * t)[:, None]
    phases = np.stack([part.sum(axis=0) for part in (turn[:count], turn[-count:])])
    lags = np.degrees(np.angle(phases[:, :1] / phases))
    before, after = waves[:-period], waves[period:]
    same = (before * after).sum() / np.sqrt((before**2).sum() * (after**2).sum())
    return found, lags, float(same)


def changed(problem: fem.Problem, stiffness: float = 1.0, friction: float = FRICTION):
    """`problem` on another floor."""

    def numbers(p):
        floor = p.loads[-1]
        return floor.stiffness, floor.friction_stiffness, floor.friction

    old = numbers(problem)
    new = stiffness * old[0], stiffness * old[1], jnp.asarray(friction)
    return eqx.tree_at(numbers, problem, new)


def sensitivity(walker: robots.Walker, problem: fem.Problem) -> dict[str, float]:
    """Frequency of the gait [Hz] in the first 0.4 s where one number is another."""
    fast, slow = fem.GeneralisedAlpha(0.8), fem.GeneralisedAlpha(0.2)
    cases = {
        "nothing": (problem, 1 * ms, None),
        "contact half as stiff": (changed(problem, stiffness=0.5), 1 * ms, None),
        "contact twice as stiff": (changed(problem, stiffness=2.0), 1 * ms, None),
        "friction 0.65": (changed(problem, friction=0.65), 1 * ms, None),
        "friction 0.75": (changed(problem, friction=0.75), 1 * ms, None),
        "steps of 0.5 ms": (problem, 0.5 * ms, None),
        "steps of 2 ms": (problem, 2 * ms, None),
        "rho_inf 0.8": (problem, 1 * ms, fast),
        "rho_inf 0.2": (problem, 1 * ms, slow),
    }
    found = {}
    for name, (case, step, method) in cases.items():
        motion = walk(case, 0.4, step, method)
        angles = robots.pair_angles(walker, case.mesh, motion.displacements)
        found[name] = float(gait(np.asarray(motion.times), np.asarray(angles))[0].mean())
    return found


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    walker = robots.Walker()
    problem = robots.walker_problem(walker, size=2.5 * mm, friction=FRICTION, slope=SLOPE)
    motion = walk(problem, 0.4 if quick else 0.7, (2 if quick else 1) * ms)
    times = np.asarray(motion.times)
    angles = np.asarray(robots.pair_angles(walker, problem.mesh, motion.displacements)) / deg
    frequencies, lags, same = gait(times, angles)
    drift = (lags[1] - lags[0] + 180) % 360 - 180
    front = mesh.nearest_node(problem.mesh, np.asarray(walker.bottoms())[-1])
    path = np.asarray(motion.displacements[:, front]) / mm
    forward = np.diff(path[len(times) // 2 :, 0])
    numbers = {
        "unknowns": problem.space.num_dofs,
        "frequency of the gait [Hz]": float(frequencies.mean()),
        "frequencies apart [Hz]": float(np.ptp(frequencies)),
        "a period like the one before": same,
        "second pair behind the first [deg]": float(lags[1, 1]),
        "third pair behind the first [deg]": float(lags[1, 2]),
        "largest change of a lag [deg]": float(np.abs(drift).max()),
        "swing of the legs [deg]": float(np.ptp(angles[len(times) // 2 :], axis=0).max()),
        "step of the front foot [mm]": float(forward.sum() / (times[-1] / 2 * frequencies[0])),
        "slip back of the front foot [mm]": float(-forward[forward < 0].sum()),
        "cut steps": motion.stats.cuts,
    }
    others = {} if quick else sensitivity(walker, problem)
    if picture is not None:
        draw(problem, motion, angles, path, others, numbers, Path(picture))
    return numbers | {f"frequency, {name} [Hz]": value for name, value in others.items()}


def draw(problem, motion, angles, path, others, numbers, file: Path) -> None:
    """Moments of a period, angles, the way of the front foot, and what changes the rhythm."""
    import matplotlib.pyplot as plt

    times = np.asarray(motion.times)
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
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:42s} {number:10.4g}")

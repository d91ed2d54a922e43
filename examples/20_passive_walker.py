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
    """The stress at two moments of a period, the angles of the legs, the way of the front foot,
    and what changes the rhythm."""
    import matplotlib.pyplot as plt

    from sorojax import sdf, view

    times, period = np.asarray(motion.time), 1 / numbers["frequency of the gait [Hz]"]
    last = np.flatnonzero(times > times[-1] - 1.5 * period)
    states = np.sort([last[angles[last, 1].argmax()], last[angles[last, 1].argmin()]])
    down = np.eye(4)
    down[:3:2, :3:2] = [[np.cos(SLOPE), np.sin(SLOPE)], [-np.sin(SLOPE), np.cos(SLOPE)]]
    bodies = view.scenes_of(motion, states, field="von_mises", rest=False)

    def on_slope(bodies):
        (left, _), (right, _) = bodies[0].box
        floor = sdf.Box([left - 10 * mm, -12 * mm, -4 * mm], [right + 10 * mm, 12 * mm, 0.0])
        floor = view.scene_of(floor)
        level = (view.merge_scenes(view.extrude(body, 10 * mm), floor) for body in bodies)
        return [view.place(scene, down) for scene in level]

    figure = plt.figure(figsize=(7, 8.2), dpi=200, layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=(1.35, 1, 1.3))
    shown, below = (
        [figure.add_subplot(at) for at in grid[k].subgridspec(1, 2)] for k in (0, 1)
    )
    for axes, t in zip(shown, times[states], strict=True):
        axes.set_title(f"{1e3 * t:.0f} ms", fontsize=10)
    late, colours = times > times[-1] - 0.15, ("#0072B2", "#D55E00", "#009E73")
    for k, colour in enumerate(colours):
        below[0].plot(
            1e3 * times[late], angles[late, k], lw=1.8, color=colour, label=f"pair {k + 1}"
        )
    below[0].plot(1e3 * times[states], angles[states, 1], "o", ms=4.5, color="#1f2430")
    below[0].set(xlabel="time [ms]", ylabel="legs' angle [deg]", ylim=(83, 103))
    below[0].legend(ncols=3, frameon=False, fontsize=9, loc="upper center", columnspacing=1)
    below[1].plot(1e3 * times, path[:, 0], lw=1.8, color=colours[0])
    below[1].set(xlabel="time [ms]", ylabel="front foot [mm]")
    axes = figure.add_subplot(grid[2])
    axes.axvline(21.1, color="#1f2430", lw=1.2, label="paper, 21.1 Hz")
    axes.axvspan(19, 23, color="#1f2430", alpha=0.08, lw=0)
    kinds = {"numerics": "#8a8f98", "calibrated": colours[1], "predicted": colours[0]}
    for label, colour in kinds.items():
        axes.plot([], [], "o", color=colour, label=label)
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    ours = {
        "friction": colours[1],
        "viscosity": colours[1],
        "slope": colours[0],
        "legs": colours[0],
    }
    for k, (name, gait) in enumerate(others.items()):
        lasts, colour = gait.repeats > 0.8, ours.get(name.split()[0], "#8a8f98")
        face = colour if lasts else "white"
        axes.plot(gait.frequencies.mean(), k, "o", ms=7, color=colour, mfc=face)
        if not lasts:
            axes.text(
                gait.frequencies.mean() - 0.4, k, "no gait lasts", ha="right", va="center"
            )
    axes.set_yticks(range(len(others)), list(others), fontsize=9)
    axes.set(xlabel="frequency of the gait in the first 0.4 s [Hz]", xlim=(14, 32))
    axes.invert_yaxis()
    for plot in (*below, axes):
        plot.spines[["top", "right"]].set_visible(False)
    view.draw_into(shown, on_slope(bodies), view=view.Camera(-75.0, 22.0))
    figure.savefig(file)
    plt.close(figure)
    way = np.flatnonzero(times > times[-1] - 0.3)[::4]
    bodies = view.scenes_of(motion, way, field="von_mises", rest=False)
    moving = view.Track(times[way], on_slope(bodies).__getitem__, bodies[0].scale)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-75.0, 22.0)}
    film = view.animate(moving, speed=0.08, title="Down a slope by itself", **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:42s} {number:10.4g}")

"""A soft crawler at the pressure and frequency of the paper, and what changes its way.

Section V-C of the Sorotoki paper, figures 8 and 9, after Shepherd et al. (2011): half waves of
45 kPa, 2.5 times a second, each group of chambers a sixth of a period after the one before; a
sole of Dragon Skin 30 with the constants of that toolkit; steps of 2 ms. The way is counted
towards the group that fills first: the text of the paper calls it the front, its caption the
back legs. The paper tells no number to meet: its figure 9 shows steps forward.

Deviations. The body is of Dragon Skin 30 too. That of the paper is of Ecoflex, 00-30 in its
text and 00-50 in its listing: at 45 kPa its walls, 0.8 mm thick, blow up like balloons, and the
motion ends at 15 kPa with sides of cells seven times as long as at first; filled slowly, at
0.25 Hz, at 9 kPa. Side walls, which carry air in the real crawler, are not in a plane, in the
paper neither. Friction, viscosity and the stiffness of the floor are not told: 0.6, 1 ms and
1e9 Pa/m here, and the numbers show what the first two do. The drawing is the picture of the
paper, measured, with rectangular chambers.

The way depends on the rubber more than on anything else: with the measured constants of Dragon
Skin 30, a third below those of the toolkit, it is 5.5, 4.1 and 3.2 mm in the second to fourth
cycle, not 6.1 mm, and 2.5 mm in the eighth. It also depends on pressure and frequency, as the
numbers show: 0.8 mm at half the pressure, 3.2 mm at half the frequency, 8.1 mm at 3.75 Hz. The
body of the paper walks 1.0 mm a cycle at 4 kPa, the other way.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, robots
from sorojax.material import presets
from sorojax.units import kPa, mm

AIR, RATE = 45 * kPa, 2.5  # Hz
STIFF = presets.rubber("sorotoki_dragon_skin_30")
SOFT, MEASURED = (
    presets.rubber(name, poisson_ratio=0.45) for name in ("ecoflex_00_50", "dragon_skin_30")
)


def walk(rubbers, air=AIR, rate=RATE, cycles=4, size=3 * mm, friction=0.6, viscosity=1e-3):
    """The crawler, its motion from rest, the place of its centre, and its way in each cycle
    towards the group that fills first [mm]."""
    crawler, damping = robots.Crawler(), fem.Rayleigh(mass=1.0, stiffness=viscosity)
    problem = robots.crawler_problem(
        crawler, size=size, rubbers=rubbers, friction=friction, stiffness=1e9
    )
    gait = robots.crawler_gait(air, rate)
    motion = fem.simulate(problem, cycles / rate, 2e-3, damping=damping, throw=False, **gait)
    shares = fem.lumped_mass(problem)[::2] / fem.total_mass(problem)
    centre = np.asarray(jnp.einsum("n,tni->ti", shares, motion.displacements)) / mm
    centre *= [-1, 1]
    ends = np.interp(np.arange(cycles + 1) / rate, np.asarray(motion.time), centre[:, 0])
    return problem, motion, centre, np.diff(ends)


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    both = STIFF, STIFF
    cycles, size = (2, 3 * mm) if quick else (4, 1.5 * mm)
    problem, motion, centre, ways = walk(both, cycles=cycles, size=size)
    floor = problem.loads[-1]
    assert isinstance(floor, fem.Contact) and bool(motion.status)
    deepest = jnp.min(jax.lax.map(lambda u: floor.points_of(problem, u)[..., 1].min(),
                                  motion.displacements))  # fmt: skip
    told = {
        "unknowns": problem.space.num_dofs,
        "way of the last cycle [mm]": ways[-1],
        "way of the cycle before [mm]": ways[-2],
        "highest lift of its centre [mm]": centre[:, 1].max(),
        "overlap with the floor [mm]": -float(deepest) / mm,
        "cut steps": motion.stats.cuts,
    }
    soft, blown, _, _ = walk((SOFT, STIFF), cycles=1)
    rings = soft.mesh.cells[:, [0, 1, 2, 3, 0]]
    before, after = (
        jnp.linalg.norm(jnp.diff(x[rings], axis=1), axis=2)
        for x in (soft.mesh.points, soft.mesh.points + blown.end.displacement)
    )
    last = AIR * np.sin(2 * np.pi * RATE * float(blown.end.time))
    told["rubbers of the paper: burst at [kPa]"] = last / kPa
    told["rubbers of the paper: longest stretch then"] = jnp.max(after / before)
    changes = {
        "cells of 3 mm": {},
        **{f"{share * AIR / kPa:.3g} kPa": {"air": share * AIR} for share in (0.25, 0.5, 0.75)},
        **{f"{rate} Hz": {"rate": rate} for rate in (1.25, 3.75)},
        **{f"friction {friction}": {"friction": friction} for friction in (0.3, 0.9)},
        "viscosity 3 ms": {"viscosity": 3e-3},
        "rubber as measured": {"rubbers": (MEASURED, MEASURED)},
        "rubbers of the paper, 4 kPa": {"rubbers": (SOFT, STIFF), "air": 4 * kPa},
    }
    for name, change in {} if quick else changes.items():
        told[f"way, {name} [mm]"] = walk(**{"rubbers": both, **change})[-1][-1]
    if picture is not None:
        draw(problem, motion, centre, Path(picture))
    return {name: float(value) for name, value in told.items()}


def draw(problem, motion, centre, file: Path) -> None:
    """The stress at four moments of a cycle, and the way of the centre."""
    import matplotlib.pyplot as plt

    from sorojax import sdf, view

    times, depth = np.asarray(motion.time), float(problem.kinematics.thickness)
    starts = times[-1] + (np.array([0.2, 0.35, 0.55, 0.75]) - 1) / RATE
    states = np.searchsorted(times, starts)
    field = {"field": "von_mises", "label": "", "rest": False}
    bodies = [view.extrude(scene, depth) for scene in view.scenes_of(motion, states, **field)]

    def with_floor(bodies):
        (left, *_), (right, *_) = bodies[0].box
        ends = [left - 6 * mm, -32 * mm, -5 * mm], [right + 6 * mm, 32 * mm, 0]
        floor = view.scene_of(sdf.Box(*ends))
        return [view.merge_scenes(body, floor) for body in bodies]

    figure = plt.figure(figsize=(7, 6.4), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.75, 1))
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(2, 2)]
    for axes, t in zip(shown, times[states], strict=True):
        axes.set_title(f"{(t - starts[0]) * RATE + 0.2:.2f} of a cycle", fontsize=10, y=0.92)
    axes = figure.add_subplot(grid[1])
    axes.plot(times, centre[:, 0], color="#0072B2", lw=1.8)
    axes.plot(times, centre[:, 1], color="#D55E00", lw=1.8)
    axes.text(times[-1], centre[-1, 0], " forwards", va="center", color="#0072B2")
    axes.text(times[-1], centre[-1, 1], " upwards", va="center", color="#D55E00")
    axes.plot(times[states], centre[states, 0], "o", ms=4.5, color="#1f2430")
    axes.set(xlabel="time [s]", ylabel="centre of mass [mm]", xlim=(0, 1.16 * times[-1]))
    axes.spines[["top", "right"]].set_visible(False)
    view.draw_into(shown, with_floor(bodies), view=view.Camera(-72.0, 20.0))
    figure.savefig(file)
    plt.close(figure)
    way = np.arange(0, len(times), 15)
    bodies = [view.extrude(scene, depth) for scene in view.scenes_of(motion, way, **field)]
    moving = view.Track(times[way], with_floor(bodies).__getitem__, bodies[0].scale)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-72.0, 20.0)}
    title = f"A soft crawler, {AIR / kPa:.0f} kPa, {RATE} times a second"
    film = view.animate(moving, speed=0.4, fps=13.3, size=(640, 380), title=title, **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick, names = "--quick" in sys.argv, [a for a in sys.argv[1:] if a[:2] != "--"]
    numbers = main(quick, names[0] if names else None)
    for name, number in numbers.items():
        print(f"{name:44s} {number:10.4g}")

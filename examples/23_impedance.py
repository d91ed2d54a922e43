"""A tip that feels like a spring: a rod of six segments comes to a wavy wall and slides along.

Study VI-D of the Sorotoki paper, after Della Santina et al. (Int. J. Robot. Res. 39, 2020).
Changed: the paper's masses of 334 g and its section of 60 x 20 mm are kept, with the second
moment of area of such a section (the original divides it by the area), so K = 240 N/m and
D = 18 N s/m in place of 0.825 N/m and 0.25 N s/m. The traced wall is a cosine on its chord;
the tip is round, the set-point comes to the wall within 1 s and keeps off the ends of it.

A computer looks at the force of the wall every 8 ms. Once it is above 0.5 N, the set-point
leaves its way to the wall and goes along it: nobody tells beforehand when that will be.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax.math import ContactMidpoint
from sorojax.units import MPa, mm

TICK = 8e-3  # s, from one look at the force to the next
STIFFNESS, DAMPING, HALF = 240.0, 18.0, 10 * mm  # N/m, N s/m, thickness over two
LOW, HIGH = np.array([243.3, 265.2]), np.array([400.6, 92.1])  # ends of the wall [mm]
FIRST, FROM, TO = np.array([[167.0, 28.0], [167.0, 24.0], [45.0, 24.0]])  # on the chord [mm]
APPROACH, SLIDE, FELT = 1.0, 3.5, 0.5  # s, s, and the force that tells of the wall [N]


def on_chord(x):
    """Points of the plane [m] from places along the chord of the wall and off it [mm]."""
    along = (HIGH - LOW) / np.linalg.norm(HIGH - LOW)
    return jnp.asarray((LOW + x[..., :1] * along + x[..., 1:] * [along[1], -along[0]]) * mm)


def wall():
    """The surface, and the solid behind it."""
    chord = np.linalg.norm(HIGH - LOW)
    x = np.linspace(0, chord, 65)
    ends = np.sin(np.clip(np.minimum(x, chord - x) / 30.5, 0, 1) * np.pi / 2)
    bulge = ends * (20.5 + 5.5 * np.cos(2 * np.pi * (x - chord / 2) / 61))
    outline = np.concatenate([np.stack([x, bulge], 1), [[chord, -50.0], [0.0, -50.0]]])
    return sj.sdf.Polygon(on_chord(outline))


def arm():
    return sj.rod.rod(
        sj.SE2(), sj.rod.piecewise_constant(kappa_z=6), sj.rod.rectangle(60 * mm, 2 * HALF),
        length=378 * mm, young_modulus=5 * MPa, poisson_ratio=0.33,
        density=0.334 / (63 * 60 * 20 * mm**3), nodes=12,
    )  # fmt: skip


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    rod, solid, lossy = arm(), wall(), sj.rod.Damping(0.05)
    law = sj.contact.LinePenalty(stiffness=2 * MPa, smoothing=20e-6)
    touch = sj.rod.ObstacleContact(solid, HALF, law, points=20 if quick else 40)

    @jax.jit
    def tick(t, q, v, times, places):
        """From one look at the force to the next, the tip pulled from place to place."""
        goal = sj.systems.Waypoints(times, places)
        spring = sj.systems.CartesianImpedance(rod, (lossy,), goal, STIFFNESS, DAMPING)
        path = sj.rod.rollout(
            rod, q, v, (lossy, touch, sj.systems.ControlForce(spring)), t=t, step=TICK / 4,
            saves=1, every=4, stepper=ContactMidpoint(passes=3, contact_passes=6),
        )  # fmt: skip
        seen = sj.systems.contact_history(rod, (touch,), path.q, path.v)
        return path, seen, sj.systems.tracking(spring, path)

    t, q, v, met, rows = 0.0, jnp.full(6, 0.3), jnp.zeros(6), 0, []
    times, way = [t, APPROACH], [sj.rod.tip_pose(rod, q)[:2, 2], on_chord(FIRST)]
    for k in range(1, round(6.0 / TICK) + 1):
        path, seen, told = tick(t, q, v, np.array(times), jnp.stack(way))
        rows.append(jax.tree.map(lambda x: np.asarray(x[0]), (path.q, seen, told)))
        t, q, v = TICK * k, path.q[1], path.v[1]
        if not met and jnp.linalg.norm(seen.push[1]) > FELT:
            met, times, way = k, [t, t + SLIDE], [on_chord(FROM), on_chord(TO)]
    q, seen, (goal, tips, effort) = jax.tree.map(lambda *x: np.stack(x), *rows)
    time, switch = TICK * np.arange(len(q)), TICK * met
    off = sj.sdf.project(sj.sdf.offset(solid, HALF), goal) - tips
    sizes = off, effort, seen.push[:, 0], STIFFNESS * (goal - tips)
    off, effort, push, asked = (np.linalg.norm(x, axis=1) for x in sizes)
    if picture is not None:
        draw(rod, time, q, goal, tips, push, asked, solid, picture)
    # the jump of the set-point at the switch has half a second to die out
    sliding = (time > switch + 0.5) & (time < switch + SLIDE)
    return {
        "contact at [s]": switch,
        "tip off the projected set-point, sliding [mm]": 1e3 * float(off[sliding].max()),
        "the same at the end [mm]": 1e3 * float(off[-1]),
        "force at the end [N]": float(push[-1]),
        "stiffness times offset [N]": float(asked[-1]),
        "overlap, greatest [mm]": 1e3 * float(seen.overlap.max()),
        "effort at the switch over that before": effort[met:][:25].max() / effort[:met].max(),
    }


def draw(arm, time, q, goal, tips, push, asked, solid, file) -> None:
    """The arm on its way along the wall, and the force that it holds it with."""
    from matplotlib import pyplot as plt

    from sorojax import rod, sdf, view

    tube = rod.rod(
        sj.SE3(), rod.piecewise_constant(kappa_z=6), rod.rectangle(60 * mm, 2 * HALF),
        length=arm.length, young_modulus=1.0, poisson_ratio=0.3, density=1.0,
    )  # fmt: skip
    upright = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    thin = np.diag([1.0, 1, 0.9, 1])  # earlier states are narrower, so that they do not hide it
    states, every = np.array([0, 106, 180, 290, 420, 540, 700]), q
    ways = [np.insert(np.asarray(way), 2, 31 * mm, axis=1) for way in (goal, tips)]
    told = [
        view.Lines([way], c, 2.2) for way, c in zip(ways, ("#D55E00", "#1f2430"), strict=True)
    ]
    q = q[states]
    lying = view.merge_scenes(
        view.place(view.scene_of(tube, q[:-1]), thin),
        view.scene_of(tube, q[-1], colours={"rod": "#6db1e8"}),
        view.place(view.scene_of(sdf.extrude(solid, 60 * mm)), np.eye(4), "#c9d3df"),
        view.Scene(tuple(told)),
    )
    foot = sdf.Box([-60 * mm, -40 * mm, -12 * mm], [60 * mm, 40 * mm, 0.0])
    figure = plt.figure(figsize=(7, 6.8), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(2.1, 1))
    right, left = figure.add_subplot(grid[1]), figure.add_subplot(grid[0])
    right.plot(time, push, color="#0072B2", lw=1.4, label="force on the wall")
    right.plot(time, asked, "--", color="#D55E00", lw=1.6, label="stiffness times offset")
    right.plot(time[states], push[states], "o", color="#1f2430", ms=4.5)
    right.set(xlabel="time [s]", ylabel="force [N]", ylim=(-0.2, 6))
    right.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False, fontsize=9)
    left.plot([], [], color="#D55E00", lw=2.2, label="set-point")
    left.plot([], [], color="#1f2430", lw=2.2, label="tip")
    left.legend(frameon=False, fontsize=9, loc="upper left")
    scene = view.merge_scenes(view.place(lying, upright), view.scene_of(foot))
    view.draw_into(left, scene, view=view.Camera(-76.0, 16.0))
    figure.savefig(Path(file))
    plt.close(figure)
    still = view.place(view.scene_of(sdf.extrude(solid, 60 * mm)), np.eye(4), "#c9d3df")

    def now(k):
        """The arm, and where set-point and tip have been."""
        looks = {"set-point": "#D55E00", "tip": "#1f2430"}
        gone = [
            view.Lines([way[: k + 2]], colour, 2.2, name=name)
            for way, (name, colour) in zip(ways, looks.items(), strict=True)
        ]
        arm = view.scene_of(tube, every[k], colours={"rod": "#6db1e8"})
        moved = view.merge_scenes(arm, still, view.Scene(tuple(gone)))
        return view.merge_scenes(view.place(moved, upright), view.scene_of(foot))

    moving = view.Track(time[::8], lambda k: now(8 * k))
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-76.0, 16.0)}
    film = view.animate(moving, fps=14.0, title="A tip that feels like a spring", **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<46} {value:.4g}")

"""An arm of seven joints with a pneumatic finger picks a ball up and carries it away.

The arm is a KUKA LBR iiwa 7 by public numbers, read from MJCF; on its flange stands a stem with
a rubber finger of one chamber. A computed-torque controller at 250 Hz knows the arm alone and
takes what hangs on it for a disturbance; the pressure curls the finger round a ball on a table.
Nothing holds the ball but contact and friction. `python -m benchmarks robots.arm` takes the
balance of forces and moments over every joint on the way.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import robots, rod, systems
from sorojax.math import ContactMidpoint
from sorojax.units import kPa, mm

BALL, MASS, PERIOD, SPOT = 20 * mm, 0.025, 4e-3, np.array([0.65, 0.0, 0.35])  # m, kg, s, m
LAW = sj.contact.LinePenalty(stiffness=2e6, smoothing=2e-5, friction=0.8, slip=1e-3)
ALONG = jnp.array([[0, 0, 1.0, 0], [0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # x along z
# seconds, place of the base of the finger from where the ball stands [mm], pressure [kPa]
WAY = np.array([[0.0, -5, -100, 80, 0], [0.8, -5, -27, 20, 0], [0.9, -5, -27, 20, 0],
    [1.5, -5, -27, 20, 300], [1.7, -5, -27, 20, 300], [2.4, -5, -27, 140, 300],
    [3.2, -105, 173, 140, 300]])  # fmt: skip


def scene():
    """Arm, arm with finger and ball, contacts, chamber, plan of joints and pressure."""
    arm = sj.io.import_robot(robots.arm_mjcf("iiwa7"))
    basis = rod.chebyshev(kappa_x=2, kappa_y=3, kappa_z=6)
    rubber = rod.Elastic(young_modulus=1.2e6, poisson_ratio=0.5, density=1070)
    band = rod.rectangle(30 * mm, 9 * mm)
    finger = rod.rod(sj.SE3(), basis, band, rubber, length=140 * mm, nodes=18)
    stem, half = robots.cylinder(0.05, 9 * mm, 80 * mm), robots.pose_below(-40 * mm)
    ball, table = robots.standing_ball(MASS, BALL, LAW, at=SPOT)
    base = rod.Part(stem, on="flange", offset=half)
    tool = rod.Part(finger, on="stem", offset=half @ ALONG)
    whole = robots.mount(arm, stem=base, finger=tool, ball=ball)
    grip = rod.LinkContact(sj.sdf.Sphere([0, 0, 0], BALL), 4.5 * mm, LAW, points=24)
    contacts = rod.PairForce("finger", "ball", grip), rod.PartForce("ball", table)
    chamber = rod.thread_chambers(finger, rod.Straight([-2.5 * mm, 0.0]), 140 * mm**2)
    q, reach = rod.rest(whole).at[:7].set(jnp.array([0.0, 0.5, 0, -1.9, 0, -0.9, 0])), []
    for place in WAY[:, 1:4] * mm:
        goal = rod.Pose(jnp.eye(4).at[:3, 3].set(SPOT + place), s=0.0, part="finger")
        q = rod.inverse_kinematics(whole, goal, q).q
        reach.append(q[:7])
    plan = jnp.column_stack([jnp.stack(reach), WAY[:, 4] * kPa])
    return arm, whole, contacts, chamber, systems.Waypoints(WAY[:, 0], plan, smooth=True)


def forces(setup, t, q, v):
    """What acts in a period that begins at t: weight, pressure, contact, computed torque."""
    arm, _, contacts, chamber, plan = setup
    gas = rod.PartForce("finger", rod.Pressurised(chamber, plan(t)[7]))
    torques = robots.computed_torque(arm, lambda t: plan(t)[:7], t, q, v)
    return rod.Gravity(), rod.Damping(0.02), gas, *contacts, *torques


@eqx.filter_jit
def run(setup, ticks):
    """Coordinates and rates at the ticks of the controller."""

    def period(state, t):
        (q, v), grasp = state, ContactMidpoint(theta=1.0, tolerance=1e-6)
        acting, how = forces(setup, t, q, v), dict[str, Any](stepper=grasp, check=False)
        path = rod.rollout(setup[1], q, v, acting, step=PERIOD, saves=1, t=t, **how)
        return (path.q[-1], path.v[-1]), state

    start = rod.rest(setup[1]).at[:7].set(setup[4](ticks[0])[:7])
    return jax.lax.scan(period, (start, jnp.zeros(rod.num_dof(setup[1]))), ticks)[1]


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    setup, ticks = scene(), jnp.array(np.arange(0.0, 2.6 if quick else 3.4, PERIOD))
    run(setup, ticks)  # compiles
    start = time.process_time()
    q, v = jax.block_until_ready(run(setup, ticks))
    cpu = time.process_time() - start
    lifts = systems.contact_history(setup[1], setup[2], q, v, ["ball"]).effort[:, :, -1]
    poses = jax.lax.map(lambda q: rod.tip_pose(setup[1], q), q)
    held = (jnp.linalg.inv(poses["stem"]) @ poses["ball"])[ticks > 2, :3, 3]
    if picture is not None:
        draw(setup, ticks, q, lifts, picture)
    return {
        "lift [mm]": float(poses["ball"][:, 2, 3].max() - SPOT[2] - BALL) / mm,
        "finger on ball over weight": float(lifts[ticks > 2, 0].mean()) / (9.81 * MASS),
        "moved in the grip [mm]": float(jnp.linalg.norm(held - held[:1], axis=1).max()) / mm,
        "simulated over computing time": float(ticks[-1]) / cpu,
    }


def draw(setup, ticks, q, lifts, file) -> None:
    """The arm at three moments, the tool at four; height, pressure, forces and joints."""
    import io

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    whole = setup[1]
    shapes = setup[0].shapes | {
        "ball": sj.sdf.Sphere([0, 0, 0], BALL),
        "stem": sj.sdf.Cylinder(9 * mm, 80 * mm),
    }
    pillar = sj.sdf.translate(sj.sdf.Cylinder(80 * mm, SPOT[2]), [0.63, 0.02, SPOT[2] / 2])
    table = tuple(replace(part, colour="#b8b0a6") for part in sj.view.scene_of(pillar).parts)

    def shown(t, box, camera):
        *links, finger, ball = sj.view.scene_of(
            whole, q[round(t / PERIOD)], shapes=shapes
        ).parts
        soft = replace(finger, colour="#e76f51"), replace(ball, colour="#2a9d8f")
        scene = replace(sj.view.scene_of(pillar), parts=(*links, *soft, *table), extent=box)
        picture = sj.view.show(scene, view=sj.view.Camera(*camera), renderer="own")
        return plt.imread(io.BytesIO(picture.png))

    figure = plt.figure(figsize=(12, 9), layout="constrained")
    grid = figure.add_gridspec(3, 12, height_ratios=(1.3, 1.1, 1))
    far, near = ([0.0, -0.2, 0.1], [0.7, 0.25, 0.7]), (SPOT - 0.05, SPOT + [0.15, 0.1, 0.15])
    for row, (times, box, camera) in enumerate((
        ((0.0, 1.6, 3.3), far, (-55.0, 18.0)), ((0.85, 1.2, 1.6, 2.2), near, (-50.0, 40.0)),
    )):  # fmt: skip
        wide = 12 // len(times)
        for place, t in enumerate(times):
            axes = figure.add_subplot(grid[row, wide * place : wide * (place + 1)])
            image = shown(t, box, camera)
            rows, columns = image.shape[:2]
            axes.imshow(image[: int(0.9 * rows), int(0.12 * columns) : int(0.88 * columns)])
            axes.set_title(f"{t:g} s")
            axes.set_axis_off()
    panels = [figure.add_subplot(grid[2, 4 * k : 4 * k + 4]) for k in range(3)]
    ball = jax.lax.map(lambda q: rod.tip_pose(whole, q)["ball"], q)[:, 2, 3]
    panels[0].plot(ticks, (ball - SPOT[2] - BALL) / mm, label="height of the ball [mm]")
    panels[0].plot(ticks, jax.vmap(setup[4])(ticks)[:, 7] / kPa, label="pressure [kPa]")
    panels[1].plot(ticks, lifts[:, 1], label="table lifts the ball [N]", lw=0.8)
    panels[1].plot(ticks, lifts[:, 0], label="finger lifts it [N]", lw=0.8)
    panels[1].axhline(9.81 * MASS, color="0.6", lw=0.8)
    panels[1].set_ylim(-0.5, 1.5)
    lines = panels[2].plot(ticks, np.degrees(q[:, :7]))
    panels[2].legend(
        lines, [f"joint {k} [deg]" for k in range(1, 8)], frameon=False, fontsize=7
    )
    panels[2].set_xlim(0, 5.5)
    for panel in panels:
        panel.set_xlabel("time [s]")
    for panel in panels[:2]:
        panel.legend(frameon=False, fontsize=8)
    figure.savefig(Path(file), dpi=90)
    plt.close(figure)

    def scene(k):
        *links, finger, ball = sj.view.scene_of(whole, q[15 * k], shapes=shapes).parts
        soft = replace(finger, colour="#e76f51"), replace(ball, colour="#2a9d8f")
        return sj.view.Scene((*links, *soft, *table))

    look = {
        "renderer": "own",
        "samples": 2,
        "shadows": True,
        "view": sj.view.Camera(-55.0, 18.0),
    }
    room = np.array(far[0]), np.array([0.7, 0.25, 0.85])
    moving = sj.view.Track(np.asarray(ticks)[::15], scene, extent=room)
    title = "An arm picks a ball by a soft finger"
    film = sj.view.animate(moving, speed=0.8, fps=13.0, title=title, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<42} {value:.4g}")

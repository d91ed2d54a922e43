"""A soft manipulator picks up a cylinder, carries it and puts it down, behind a valve board.

Section V-F of the Sorotoki paper, figures 16 and 17: three bellows and a gripper of three
fingers on four proportional valves, a free cylinder of 40 mm and 45 g. The robot is that of
`robots.Manipulator` with its reservoirs and regulators, hung from a beam, behind the program
of the board with its noise, dead time and limits; nothing holds the cylinder but contact and
friction with fingers and floor. Changed: the paper plays back pressures; here a loop at 100 Hz
sees the place of the gripper, as a camera would tell it, and brings it along a taught path.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import robots, rod, systems
from sorojax.rod import PairForce, PartForce
from sorojax.units import kPa, mm
from sorojax_hardware import run_loop, simulated_board

RADIUS, HEIGHT, MASS, TARGET = 20 * mm, 40 * mm, 0.045, 29.7 * mm
BEAM, SPINE = 167.5 * mm, 7.2 * mm  # height of the base; from the axis of a finger to its face
FINGERS = tuple(f"finger_{k}" for k in range(3))
GRIP = sj.contact.LinePenalty(stiffness=3e7, smoothing=5e-6, friction=0.8, slip=1e-4)
FLOOR = sj.contact.LinePenalty(stiffness=1e8, smoothing=5e-6, friction=0.8, slip=1e-4)
PERIOD = 4e-3  # s, of the model
# seconds, place of the finger tips x, y, z [mm], pressure in the gripper [kPa]; the arm tilts
# as it reaches out, and the cylinder stands up 8 mm farther out than the tips let it go
WAY = np.array([
    [0.0, 0, 0, 47, -30], [0.5, 0, 0, 30.5, -30], [0.7, 0, 0, 30.5, -30], [0.9, 0, 0, 30.5, 60],
    [1.1, 0, 0, 30.5, 60], [1.6, 0, 0, 40, 60], [2.4, 22, 0, 41, 60], [2.7, 22, 0, 41, 60],
    [3.3, 22, 0, 33.3, 60], [3.6, 22, 0, 33.3, 60], [3.8, 22, 0, 33.3, -30],
    [3.9, 22, 0, 33.3, -30], [4.7, 22, 0, 45, -30], [4.9, 22, 0, 45, -30],
])  # fmt: skip


def scene(size):
    """The robot with air and valves, hung over a cylinder on the floor, and the contacts."""
    thing, floor = robots.standing_cylinder(MASS, RADIUS, HEIGHT, FLOOR)
    touch = rod.LinkContact(sj.sdf.Cylinder(RADIUS, HEIGHT), SPINE, GRIP, points=16)
    contacts = *(PairForce(f, "cylinder", touch) for f in FINGERS), PartForce("cylinder", floor)
    made, up = robots.model(robots.Manipulator(), size=size), robots.upside_down(BEAM)
    return robots.with_contacts(made, contacts, mount=up, cylinder=thing), contacts


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    made, contacts = scene(1.2 * mm if quick else None)
    whole, limits = made.assembly, (made.low, made.high)
    moving = robots.contact_stepper(made, PERIOD)
    board, valves = simulated_board(*moving, limits, period=PERIOD, dead_time=4e-3, keep=True)
    # Pa for a metre, from a jog of the robot: how far [um/Pa] each bellows moves the tips
    back = 1e6 * np.linalg.inv([[-1.35, 0.675, 0.675], [0, 1.169, -1.169], 3 * [-0.2315]])
    tips = jax.jit(lambda q: robots.middle(whole, q, [f"{name}_tip" for name in FINGERS]))
    home = tips(valves.state.q)

    def asked(place, gripper):
        """Pressures that would bring the tips from their first place to another."""
        return jnp.append(back @ (place - home), gripper)

    way = jax.vmap(asked)(WAY[:, 1:4] * mm, WAY[:, 4] * kPa)
    pid = systems.PID(
        0.0, integral_gain=[5.0, 5.0, 5.0, 0.0], feed_forward=1.0, tracking_time=0.025,
        reference=systems.Waypoints(WAY[:, 0], way, smooth=True), low=made.low, high=made.high,
    )  # fmt: skip
    ticks = list(run_loop(
        board, board.clock, jax.jit(lambda *now: pid(*now)), pid.start(0.0, jnp.zeros(4)),
        duration=WAY[-1, 0], period=1e-2, limits=limits,
        measure=lambda *_: asked(tips(valves.state.q), 0.0),
    ))  # fmt: skip

    film = robots.replay(whole, valves.states or (), ("cylinder", "plate"))
    seen = systems.contact_history(whole, contacts, film.q, film.v, ["cylinder"])
    *fingers, floor = np.asarray(seen.overlap).T
    force = np.asarray(seen.effort)[:, : len(fingers), -1].sum(axis=1)  # what lifts it
    thing, plate = film.poses["cylinder"], film.poses["plate"]
    place, up, time = thing[:, :3, 3], thing[:, 2, 2], PERIOD * np.arange(len(thing))
    free = (floor < -0.1 * mm) & (time < 3.7)
    held = np.einsum("tij,ti->tj", plate[:, :3, :3], place - plate[:, :3, 3])[free]
    if picture is not None:
        draw(whole, film.q, time, place, force, ticks, picture)
    return jax.tree.map(float, {
        "lift [mm]": -floor[free].min() / mm,
        "contact forces over weight, carried": force[free].mean() / (9.81 * MASS),
        "moved in the grip [mm]": np.linalg.norm(held - held[0], axis=1).max() / mm,
        "farthest tilt [deg]": np.degrees(np.arccos(up.min())),
        "place off its target [mm]": np.linalg.norm(place[-1, :2] - [TARGET, 0.0]) / mm,
        "tilt at the end [deg]": np.degrees(np.arccos(min(1.0, up[-1]))),
        "speed at the end [mm/s]": np.linalg.norm(film.v[-1, -3:]) / mm,
        "overlap with fingers, greatest [mm]": np.max(fingers) / mm,
        "overlap with the floor, greatest [mm]": floor.max() / mm,
        "gripper lets go [mm]": -np.max(fingers, axis=0)[-1] / mm,
    })  # fmt: skip


def draw(whole, q, time, place, force, ticks, file) -> None:
    """The printed robot at six moments; heights, forces and pressures over time."""
    from matplotlib import pyplot as plt

    from sorojax import sdf, view

    printed = view.scene_of(robots.Manipulator(), size=1.2 * mm).parts[-1:]
    (hung,) = view.place(view.Scene(printed), robots.upside_down(BEAM)).parts
    assert isinstance(hung, view.Surface)
    soft = tuple(name for name in whole.names if name != "cylinder")
    rig = view.rig(whole, (hung.points, hung.triangles), parts=soft, blend=4 * mm)
    cylinder = view.scene_of(sdf.Cylinder(RADIUS, HEIGHT, 1 * mm))
    floor = view.scene_of(sdf.Box([-55 * mm, -48 * mm, -4 * mm], [75 * mm, 48 * mm, 0.0]))
    beam = sdf.Box([-55 * mm, -45 * mm, BEAM], [55 * mm, 45 * mm, BEAM + 8 * mm])

    def scene(t):
        now = q[round(t / PERIOD)]
        held = view.place(cylinder, rod.tip_pose(whole, now)["cylinder"], "#f9c274")
        robot = view.place(view.scene_of(rig, now), np.eye(4), "#8fbce6")
        return view.merge_scenes(robot, held, floor, view.scene_of(beam))

    moments = (0.1, 0.7, 1.6, 2.6, 3.5, 4.85)
    words = "comes", "reaches down", "lifts", "carries", "puts down", "leaves"
    figure = plt.figure(figsize=(7, 8.6), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(2.6, 1))
    shown = [figure.add_subplot(at) for at in grid[0].subgridspec(2, 3)]
    for axes, t, word in zip(shown, moments, words, strict=True):
        axes.set_title(f"{t:g} s: {word}", fontsize=10)
    panels = [figure.add_subplot(at) for at in grid[1].subgridspec(1, 3)]
    panels[0].axhline(TARGET / mm, color="0.7", lw=1)
    for k, name in ((0, "x"), (2, "z")):
        panels[0].plot(time, place[:, k] / mm, lw=1.6, label=name)
    panels[0].set_ylabel("place of the cylinder [mm]")
    panels[1].axhline(9.81 * MASS, color="0.7", lw=1)
    panels[1].plot(time, force, color="#0072B2", lw=1.4)
    panels[1].text(4.9, 9.81 * MASS + 0.04, "weight", ha="right", fontsize=9)
    panels[1].set(ylabel="lift of the fingers [N]", ylim=(-0.6, 0.8))
    pressures = np.array([tick.pressure for tick in ticks]) / kPa
    lines = panels[2].plot([tick.time for tick in ticks], pressures, lw=1.4)
    panels[2].set(ylabel="pressure [kPa]", ylim=(-38, 125))
    look = {"frameon": False, "ncols": 2, "fontsize": 8, "handlelength": 1, "columnspacing": 1}
    panels[2].legend(lines, ["bellows 1", "2", "3", "gripper"], **look)
    panels[0].legend(frameon=False, fontsize=9)
    for panel in panels:
        panel.set_xlabel("time [s]")
        panel.spines[["top", "right"]].set_visible(False)
    view.draw_into(shown, [scene(t) for t in moments], view=view.Camera(-68.0, 12.0))
    figure.savefig(Path(file))
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<42} {value:.4g}")

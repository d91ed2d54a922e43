"""Four soft fingers hold a beaker, two of them pinch a wrench, and all turn a bolt.

Study VI-C of the Sorotoki paper, after Suzumori et al. (1991): fingers of 12 x 80 mm on a
circle of 37.5 mm, with three modes of bending in each direction, whose chambers act as moments.
Beaker and wrench are free to move and to turn once a table lets go of them, in a gripper that
leans by two degrees; the bolt turns on its axis. Changed: Coulomb friction that is smooth below
1 mm/s in place of a sign, the second moment of area of a disc, a bolt with viscous damping.

A beaker of 50 g stays where it is with 15 mN m in every finger. With 20 mN m it twists the
fingers round itself: its turn grows fourfold in half a second, from 1 degree at 2 s, and ends
at 47 degrees, still held. The more fingers press, the more they push a turned beaker on, and
their bending alone holds it back. Two fingers hold a flat wrench of 40 g with 30, 40 and
50 mN m; with 20 mN m it falls, with 60 mN m they throw it out. The bolt turns as its damping
lets it, which is chosen: 0.189 times a second with 4e-4 N m s, 0.265 with half, 0.139 with
twice of that. Fingers of two modes, `main(modes=2)`, turn it 0.194 times.
"""

import sys
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import robots, rod, sdf, systems, view
from sorojax.math import ContactMidpoint
from sorojax.rod import PairForce, Part, PartForce, TimeVaryingForce
from sorojax.units import mm

GRIP = sj.contact.LinePenalty(stiffness=5e5, smoothing=50e-6, friction=0.8, slip=1e-3)
HELD = ContactMidpoint(passes=1, lasting=True, theta=1.0, tolerance=1e-4)
# half widths, radius of the edges, length, depth of the middle below the feet of the fingers
# [mm], mass [g], and what its inertia is divided by: 4 if round
BEAKER, BOLT = (20.0, 20, 20, 60, 75, 50, 4), (28.0, 28, 28, 44, 58, 12, 4)
WRENCH, WALK = (2.5, 5, 0.5, 100, 95, 40, 3), (0.02, 0.02, 0.02)
# damping of the bolt [N m s], moments of even and odd fingers inwards and of all sideways
# [N m], and the phase between the two
RUNS = {
    "beaker": (BEAKER, 0, 0.015, 0.015, 0, 0), "wrench, 20 mN m": (WRENCH, 0, 0.02, 0, 0, 0),
    "wrench": (WRENCH, 0, 0.04, 0, 0, 0), "beaker, 20 mN m": (BEAKER, 0, 0.02, 0.02, 0, 0),
    "bolt left": (BOLT, 4e-4, *WALK, np.pi / 2), "bolt right": (BOLT, 4e-4, *WALK, -np.pi / 2),
    "bolt left, half the damping": (BOLT, 2e-4, *WALK, np.pi / 2),
    "bolt left, twice the damping": (BOLT, 8e-4, *WALK, np.pi / 2)}  # fmt: skip


def chambers(command, t):
    """Moments at a tip, along its axes, and zero forces: inwards and sideways [N m], closed
    within half a second, or once a second in turn, with a phase [rad] between the two."""
    (inwards, aside, phase), angle = command, 2 * np.pi * t
    walk = jnp.where(aside > 0, jnp.clip(jnp.sin(angle), -0.25, 1), 1.0)
    bend = jnp.stack([0 * t, aside * jnp.sin(angle + phase), inwards * walk])
    return jnp.concatenate([jnp.clip(2 * t, 0, 1) * bend, jnp.zeros(3)])


def table(t):
    """What a table carries of the weight [m/s^2], which sinks away from 0.5 to 0.8 s."""
    return jnp.array([-0.3, -0.2, 9.81]) * jnp.clip((0.8 - t) / 0.3, 0, 1)


@partial(sj.jit, kernels=False)
def run(joint, command, size, step, saves, modes):
    """The robot, its motion, and the contact force [N] or moment [N m] that the thing takes
    along the axis, the mean of the last 50 steps."""
    bends, disc = rod.chebyshev(kappa_y=modes, kappa_z=modes), rod.circle(6 * mm)
    finger = rod.rod(sj.SE3(), bends, disc, length=80 * mm, young_modulus=1e6, nodes=6,
                     poisson_ratio=0.3, density=2000)  # fmt: skip
    fingers = robots.ring(finger, 4, 37.5 * mm)
    x, y, edge, length, depth, mass = size[:6] * 1e-3
    across, along = jnp.array([y**2, x**2, x**2 + y**2]), jnp.array([1.0, 1.0, 0.0])
    body = rod.Link(mass, mass * (across / size[6] + along * length**2 / 12))
    thing = Part(body, joint, offset=robots.pose_below(depth))
    model = rod.assembly(sj.SE3(), **fingers, thing=thing)
    shape = sdf.extrude(sdf.Rectangle(jnp.stack([-x, -y]), jnp.stack([x, y]), edge), length)
    touch = rod.LinkContact(shape, 6 * mm, GRIP, points=24)
    touches = tuple(PairForce(name, "thing", touch) for name in fingers)
    push = partial(TimeVaryingForce, partial(rod.PointWrench, follower=True))
    bend = [push(eqx.Partial(chambers, jnp.delete(command, k))) for k in (1, 0)]
    own = [PartForce(name, bend[k % 2]) for k, name in enumerate(fingers)]
    carried = PartForce("thing", TimeVaryingForce(rod.Gravity, table))
    forces = (rod.Damping(0.03), rod.Gravity([0.3, 0.2, -9.81]), carried, *own, *touches)
    q, v = rod.rest(model), jnp.zeros(rod.num_dof(model))
    path = rod.rollout(model, q, v, forces, step=step, saves=saves, stepper=HELD)
    seen = systems.contact_history(model, touches, path.q[-50:], path.v[-50:])
    return model, path, jnp.mean(jnp.sum(seen.effort[..., -1], axis=1))


def main(quick: bool = False, picture: str | Path | None = None, modes: int = 3) -> dict:
    seconds, step = (3, 2e-3) if quick else (5, 1e-3)
    grid, told, films = (step, round(seconds / step), modes), {}, {}
    for name, (size, damping, *moments) in list(RUNS.items())[: 6 if quick else None]:
        joint = rod.Screw(turn=1.0, advance=0.0, damping=damping) if damping else rod.Free()
        films[name] = _, path, pull = run(joint, jnp.array(moments), jnp.array(size), *grid)
        if not damping:
            told[f"{name}: contact forces over weight"] = float(pull) / (9.81e-3 * size[5])
            told[f"{name}: sinks by [mm/s]"] = -float(path.v[-1, -1]) / mm
            turn = np.degrees(2 * np.arccos(np.clip(np.abs(path.q[-1, -7]), 0, 1)))
            told[f"{name}: turned by [deg]"] = float(turn)
            continue
        angle = np.asarray(path.q[grid[1] // seconds :, -1]) / (2 * np.pi)  # after a second
        told[f"{name}: turns a second"] = float(angle[-1] - angle[0]) / (seconds - 1)
        way = np.sign(angle[-1]) * angle
        back, length = np.max(np.maximum.accumulate(way) - way), np.ptp(way) / (seconds - 1)
        told[f"{name}: way back, of a step [%]"] = float(100 * back / length)
    if picture is not None:
        draw(films, picture)
    return told


def draw(films, file) -> None:
    """Three things in the fingers, a step of the bolt, and how far it turns."""
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(7, 7.4), dpi=200, layout="constrained")
    grid = figure.add_gridspec(3, 12, height_ratios=(3.3, 1.8, 1.6))
    plate = sdf.translate(sdf.Cylinder(46 * mm, 7 * mm, 1 * mm), [0, 0, 3.4 * mm])
    plate = view.scene_of(plate - sdf.Cylinder(29.5 * mm, 30 * mm))
    rubber, orange = "#8fbce6", "#f9c274"
    colours = {f"finger_{k}": rubber for k in range(4)}
    names = ("beaker", "wrench", "bolt left")

    def thing(name) -> sj.sdf.Surface:
        """What a thing stands for, with the sides that the fingers touch."""
        if name == "beaker":
            hollow = sdf.translate(sdf.Cylinder(18.5 * mm, 60 * mm), [0, 0, 1.5 * mm])
            made = sdf.Cylinder(20 * mm, 60 * mm, 1 * mm) - hollow
        elif name == "wrench":
            disc = sdf.turn(sdf.Cylinder(13 * mm, 5 * mm, 0.5 * mm), [0, 1, 0], np.pi / 2)
            jaw = disc - sdf.Box([-9 * mm, -6 * mm, -22 * mm], [9 * mm, 6 * mm, 0])
            corner = np.array([2.5, 5, 50]) * mm
            made = sdf.Box(-corner, corner, 0.5 * mm) | sdf.translate(jaw, [0, 0, -58 * mm])
        else:
            groove = sdf.translate(sdf.Cylinder(1.5 * mm, 50 * mm), [28.6 * mm, 0, 0])
            mark = sdf.Box([20 * mm, -3 * mm, -30 * mm], [30 * mm, 3 * mm, 30 * mm])
            socket = sdf.extrude(sdf.RegularPolygon(14 * mm, 6), 24 * mm)
            head = sdf.Cylinder(28 * mm, 44 * mm, 1.5 * mm) - sdf.polar_repeat(groove, 30)
            shank = sdf.translate(sdf.Cylinder(13 * mm, 50 * mm), [0, 0, -40 * mm])
            made = (head - mark - sdf.translate(socket, [0, 0, 18 * mm])) | shank
        return sdf.isosurface(made, 0.8 * mm)

    bellows = robots.Bellows(6 * mm, 4 * mm, 7.9 * mm, 4.7 * mm, 0.9 * mm, 2 * mm, 0.8 * mm, 9)
    printed = robots.Finger(bellows, 5 * mm, 6.5 * mm, 2.2 * mm).along_x()
    fingers = dict.fromkeys(colours, sdf.isosurface(printed, 0.6 * mm))
    solids = {name: fingers | {"thing": thing(name)} for name in names}

    def scene(name, at):
        model, path = films[name][:2]
        return view.scene_of(
            model, path.q[at], shapes=solids[name], colours=colours | {"thing": orange}
        )

    last = len(films["bolt left"][1].time) - 1
    times = np.array([3.9, 4.3, 4.46, 4.6])
    steps = np.searchsorted(np.asarray(films["bolt left"][1].time), times)
    turns = figure.add_subplot(grid[2, :])
    for name, high in (("bolt left", 0.75), ("bolt right", -0.9)):
        path = films[name][1]
        angle = np.asarray(path.q[:, -1]) / (2 * np.pi)
        turns.plot(
            path.time, angle, lw=1.8, color=rubber if name == "bolt right" else "#d98d1f"
        )
        turns.text(0.6, high, f"fingers walk to the {name[5:]}")
        if name == "bolt left":
            turns.plot(times, angle[steps], "o", ms=4.5, color="#1f2430")
    turns.set(xlabel="time [s]", ylabel="turns of the bolt", ylim=(-1.15, 1.15))
    turns.spines[["top", "right"]].set_visible(False)
    held = [figure.add_subplot(grid[0, 4 * k : 4 * k + 4]) for k in range(3)]
    walk = [figure.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(4)]
    titles = ("a beaker", "a wrench", "a bolt", *(f"{t:.2f} s, no plate" for t in times))
    for axes, title in zip((*held, *walk), titles, strict=True):
        axes.set_title(title, fontsize=10, y=0.98)
        axes.set_axis_off()
    whole = [view.merge_scenes(scene(name, last), plate) for name in names]
    view.draw_into(held, whole, view=view.Camera(-62.0, 14.0))
    above = view.Camera(-62.0, 62.0)
    view.draw_into(walk, [scene("bolt left", k) for k in steps], view=above, scale=False)
    figure.savefig(Path(file))
    plt.close(figure)
    coarse = dict.fromkeys(colours, sdf.isosurface(printed, 1 * mm))
    beside = np.eye(4)
    beside[0, 3] = 0.17
    ticks = np.arange(0, last + 1, round(0.1 * last / 5))

    def both(k):
        """A beaker that is held, and a bolt that is turned."""
        drawn = []
        for name, place in (("beaker", np.eye(4)), ("bolt left", beside)):
            model, path = films[name][:2]
            shapes = coarse | {"thing": solids[name]["thing"]}
            look = {"shapes": shapes, "colours": colours | {"thing": orange}}
            robot = view.scene_of(model, path.q[ticks[k]], **look)
            drawn.append(view.place(view.merge_scenes(robot, plate), place))
        return view.merge_scenes(*drawn)

    extent = np.array([-0.06, -0.06, -0.11]), np.array([0.25, 0.06, 0.012])
    moving = view.Track(np.asarray(films["beaker"][1].time)[ticks], both, extent=extent)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-70.0, 16.0)}
    title = "Four fingers hold a beaker and turn a bolt"
    film = view.animate(moving, fps=10.0, size=(680, 400), title=title, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<40} {value:.4g}")

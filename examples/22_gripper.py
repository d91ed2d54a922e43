"""Four soft fingers hold a beaker and a wrench, and turn a bolt by walking round it.

Study VI-C of the Sorotoki paper, after Suzumori et al. (1991): fingers of 12 x 80 mm on a
circle of 37.5 mm, whose chambers act as bending moments, all four with the same command.
Beaker and wrench slide on the axis, the bolt turns on it. Free to turn as well, a beaker that
is held as hard as here twists the fingers round itself within two seconds. Changed: Coulomb
friction that is smooth below 1 mm/s in place of a sign, the second moment of area of a disc,
round things (the wrench a bar of 10 mm), a bolt with viscous damping.
"""

import functools
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import sorojax as sj
from sorojax import robots, rod, sdf, systems, view
from sorojax.math import ContactMidpoint
from sorojax.rod import PairForce, Part, PartForce, TimeVaryingForce
from sorojax.units import mm

GRASP, WALK = 0.03, 0.02  # N m
GRIP = sj.contact.LinePenalty(stiffness=5e5, smoothing=50e-6, friction=0.8, slip=1e-3)
# radius, length, depth of the middle below the feet of the fingers [m], mass [kg]
THINGS = {
    "beaker": (20 * mm, 60 * mm, 75 * mm, 0.05),
    "wrench": (5 * mm, 100 * mm, 95 * mm, 0.04),
}
BOLT = 28 * mm, 44 * mm, 58 * mm, 0.012
HELD = ContactMidpoint(passes=1, lasting=True, theta=1.0, tolerance=1e-4)


class Chambers(eqx.Module):
    """Moments at the tips, along their axes, and zero forces: inwards and sideways [N m],
    closed within half a second, or once a second in turn, `phase` [rad] apart."""

    inwards: Array
    aside: Array
    phase: Array

    def __call__(self, t):
        start, angle = jnp.clip(2 * t, 0, 1), 2 * np.pi * t
        walk = jnp.where(self.aside > 0, jnp.clip(jnp.sin(angle), -0.25, 1), 1.0)
        bend = [0 * t, self.aside * jnp.sin(angle + self.phase), self.inwards * walk]
        return jnp.concatenate([start * jnp.stack(bend), jnp.zeros(3)])


def table(t):
    """What a table carries of the weight [m/s^2], which sinks away from 0.5 to 0.8 s."""
    return jnp.array([0.0, 0.0, 9.81]) * jnp.clip((0.8 - t) / 0.3, 0, 1)


@functools.partial(sj.jit, kernels=False)
def run(joint, command, step, saves, radius, length, depth, mass):
    """The robot, its motion, and the contact force [N] or moment [N m] that the thing takes
    along the axis, the mean of the last 50 steps."""
    finger = rod.rod(
        sj.SE3(), rod.chebyshev(kappa_y=2, kappa_z=2), rod.circle(6 * mm), length=80 * mm,
        young_modulus=1e6, poisson_ratio=0.3, density=2000, nodes=6,
    )  # fmt: skip
    fingers = robots.ring(finger, 4, 37.5 * mm)
    thing = Part(robots.cylinder(mass, radius, length), joint, offset=robots.pose_below(depth))
    model = rod.assembly(sj.SE3(), **fingers, thing=thing)
    touch = rod.LinkContact(sj.sdf.Cylinder(radius, length), 6 * mm, GRIP, points=24)
    touches = tuple(PairForce(name, "thing", touch) for name in fingers)
    push = functools.partial(rod.PointWrench, follower=True)
    own = [PartForce(name, TimeVaryingForce(push, Chambers(*command))) for name in fingers]
    carried = PartForce("thing", TimeVaryingForce(rod.Gravity, table))
    q, v = rod.rest(model), jnp.zeros(rod.num_dof(model))
    forces = (rod.Damping(0.03), rod.Gravity(), carried, *own, *touches)
    path = rod.rollout(model, q, v, forces, step=step, saves=saves, stepper=HELD)
    seen = systems.contact_history(model, touches, path.q[-50:], path.v[-50:])
    return model, path, jnp.mean(jnp.sum(seen.effort[..., -1], axis=1))


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    seconds, step = (3, 2e-3) if quick else (5, 1e-3)
    saves, told, films = round(seconds / step), {}, {}

    def do(name, joint, size, *command):
        films[name] = (*run(joint, jnp.array(command), step, saves, *jnp.array(size)), size)
        return films[name][1:3]

    for name, size in THINGS.items():
        path, pull = do(name, rod.Screw(turn=0.0, advance=1.0), size, GRASP, 0.0, 0.0)
        told[f"{name}: weight [N]"] = size[-1] * 9.81
        told[f"{name}: sum of the contact forces [N]"] = float(pull)
        told[f"{name}: sinks by [mm/s]"] = -float(path.v[-1, -1]) / mm
    turning = rod.Screw(turn=1.0, advance=0.0, damping=4e-4)
    for name, phase in (("left", np.pi / 2), ("right", -np.pi / 2)):
        path, _ = do(name, turning, BOLT, WALK, WALK, phase)
        angle = np.asarray(path.q[saves // seconds :, -1]) / (2 * np.pi)  # after a second
        told[f"bolt {name}: turns a second"] = float(angle[-1] - angle[0]) / (seconds - 1)
        way = np.sign(angle[-1]) * angle
        back, size = np.max(np.maximum.accumulate(way) - way), np.ptp(way) / (seconds - 1)
        told[f"bolt {name}: way back, of a step [%]"] = float(100 * back / size)
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
    names = (*THINGS, "left")

    def thing(name) -> sj.sdf.Surface:
        """What a cylinder stands for, with the round sides that the fingers touch."""
        if name == "beaker":
            hollow = sdf.translate(sdf.Cylinder(18.5 * mm, 60 * mm), [0, 0, 1.5 * mm])
            made = sdf.Cylinder(20 * mm, 60 * mm, 1 * mm) - hollow
        elif name == "wrench":
            disc = sdf.turn(sdf.Cylinder(13 * mm, 9 * mm, 1 * mm), [1, 0, 0], np.pi / 2)
            jaw = disc - sdf.Box([-6 * mm, -9 * mm, -22 * mm], [6 * mm, 9 * mm, 0])
            bar = sdf.Cylinder(5 * mm, 100 * mm, 1 * mm)
            made = bar | sdf.translate(jaw, [0, 0, -58 * mm])
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

    last = len(films["left"][1].time) - 1
    times = np.array([3.9, 4.3, 4.46, 4.6])
    steps = np.searchsorted(np.asarray(films["left"][1].time), times)
    turns = figure.add_subplot(grid[2, :])
    for name, high in (("left", 0.75), ("right", -0.9)):
        path = films[name][1]
        angle = np.asarray(path.q[:, -1]) / (2 * np.pi)
        turns.plot(path.time, angle, lw=1.8, color=rubber if name == "right" else "#d98d1f")
        turns.text(0.6, high, f"fingers walk to the {name}")
        if name == "left":
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
    view.draw_into(walk, [scene("left", k) for k in steps], view=above, scale=False)
    figure.savefig(Path(file))
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<40} {value:.4g}")

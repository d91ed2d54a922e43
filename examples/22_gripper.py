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
from sorojax import robots, rod, systems
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
    """The fingers at the end, seen from the side, and the way of the bolt."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Rectangle

    figure, axes = plt.subplots(1, 4, figsize=(13, 3.8), width_ratios=(1, 1, 1, 1.7))
    points = np.linspace(0, 1, 30)
    for axis, name in zip(axes, (*THINGS, "left"), strict=False):
        model, path, _, (radius, length, *_) = films[name]
        poses = rod.forward_kinematics(model, path.q[-1], points)
        for finger, shade in zip(model.names, (1.0, 0.4, 1.0, 0.4), strict=False):
            x, _, z = np.asarray(poses[finger])[:, :3, 3].T / mm
            axis.plot(x, z, color="#2a6f97", alpha=shade, lw=9, solid_capstyle="round")
        middle = np.asarray(poses["thing"])[0, :3, 3] / mm
        corner = middle[0] - radius / mm, middle[2] - length / 2 / mm
        box = Rectangle(corner, 2 * radius / mm, length / mm, color="#e76f51", alpha=0.8)
        axis.add_patch(box)
        title = "bolt" if name == "left" else name
        axis.set(aspect="equal", xlim=(-55, 55), ylim=(-170, 15), title=title, xlabel="[mm]")
    for name in ("left", "right"):
        path = films[name][1]
        axes[3].plot(
            path.time, np.asarray(path.q[:, -1]) / (2 * np.pi), label=f"phase of {name}"
        )
    axes[3].set(xlabel="time [s]", ylabel="turns of the bolt")
    axes[3].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(Path(file), dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<40} {value:.4g}")

"""Four soft fingers hold a beaker and a wrench, and turn a bolt by walking round it.

Study VI-C of the Sorotoki paper, after Suzumori et al. (1991): fingers of 12 x 80 mm on a
circle of 37.5 mm, whose chambers act as bending moments. All four get the same command, so
one is simulated, with a quarter of an object that slides or turns on the axis between them.
Changed: Coulomb friction that is smooth below 1 mm/s in place of a sign, the second moment
of area of a disc, round things (the wrench a bar of 10 mm), a bolt with viscous damping.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import sorojax as sj
from sorojax.math.lie import homogeneous
from sorojax.rod import Between, On, Part
from sorojax.units import mm

GRASP, WALK = 0.03, 0.02  # N m
GRIP = sj.contact.LinePenalty(stiffness=5e5, smoothing=50e-6, friction=0.8, slip=1e-3)


class Moments(eqx.Module):
    """Bending inwards and sideways [N m]: closed within half a second, or once a second in
    turn, `phase` [rad] apart."""

    inwards: Array
    aside: Array
    phase: Array

    def __call__(self, t):
        start, angle = jnp.clip(2 * t, 0, 1), 2 * np.pi * t
        walk = jnp.where(self.aside > 0, jnp.clip(jnp.sin(angle), -0.25, 1), 1.0)
        aside = jnp.sin(angle + self.phase)
        return self.inwards * start * walk, self.aside * start * aside


class Air(sj.rod.AbstractForce):
    """Bending moments inwards and sideways [N m] that chambers make, as given by time."""

    moments: Moments

    def __call__(self, t, motion):
        inwards, aside = self.moments(t)
        turn = jnp.stack([jnp.zeros_like(inwards), aside, inwards])
        at = sj.rod.points(motion, np.ones(1))
        return at.generalised(None, (at.directors[0] @ turn)[None])


def upright(angle, radius, height):
    """A frame whose x points down and whose y points to the axis."""
    c, s = np.cos(angle), np.sin(angle)
    turn = jnp.array([[0.0, -c, -s], [0.0, -s, c], [-1.0, 0.0, 0.0]])
    return homogeneous(turn, jnp.array([radius * c, radius * s, height]))


class Lowered(sj.rod.AbstractForce):
    """Weight that comes on while a table sinks away, from 0.5 to 0.8 s."""

    def __call__(self, t, motion):
        return jnp.clip((t - 0.5) / 0.3, 0, 1) * sj.rod.Gravity()(t, motion)


class Axial(sj.rod.AbstractJoint):
    """Along x by `advance` [m] and about it by `turn` [rad] per coordinate, with damping."""

    turn: Array
    advance: Array
    damping: Array

    def num_dof(self, group):
        return 1

    def axes(self, group, dtype):
        return jnp.zeros((6, 1), dtype).at[0].set(self.turn).at[3].set(self.advance)

    def pose(self, group, q):
        c, s = jnp.cos(self.turn * q[0]), jnp.sin(self.turn * q[0])
        turn = jnp.eye(3).at[1:, 1:].set(jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])]))
        return turn, jnp.zeros(3).at[0].set(self.advance * q[0])

    def matrices(self, group, dtype):
        return jnp.zeros((1, 1), dtype), self.damping[None, None]

    def effort(self, q, v):
        return -self.damping * v


def quarter(radius, length, top, mass, joint):
    """A finger and a quarter of a round object that hangs by `joint` on the axis."""
    finger = sj.rod.rod(
        sj.SE3(), sj.rod.chebyshev(kappa_y=2, kappa_z=2), sj.rod.circle(6 * mm),
        length=80 * mm, young_modulus=1e6, poisson_ratio=0.3, density=2000, nodes=6,
    )  # fmt: skip
    thing = sj.rod.rod(
        sj.SE3(), sj.rod.constant("kappa_z"), sj.rod.circle(radius), length=length,
        young_modulus=1e7, poisson_ratio=0.3, density=mass / (4 * np.pi * radius**2 * length),
    )  # fmt: skip
    foot, hung = upright(0.0, 37.5 * mm, 0.0), upright(0.0, 0.0, top)
    parts = {"finger": Part(finger, offset=foot), "object": Part(thing, joint, offset=hung)}
    return sj.rod.assembly(sj.SE3(), **parts)


@eqx.filter_jit
def run(model, radius, moments, step, saves):
    """Motion, and the mean force [N] or moment [N m] on the object over its last 50 steps."""
    contact = sj.rod.RodContact(jnp.stack([jnp.asarray(6 * mm), radius]), GRIP, points=24)
    touch = Between("finger", "object", contact)
    forces = (
        On("finger", sj.rod.Gravity()), On("object", Lowered()), sj.rod.Damping(0.03),
        On("finger", Air(moments)), touch,
    )  # fmt: skip
    q, v = sj.rod.rest(model), jnp.zeros(sj.rod.num_dof(model))
    path = sj.rod.rollout(model, q, v, forces, step=step, saves=saves)

    def pull(q, v):  # normal forces act at the end of a step, friction at its middle
        end, none = sj.rod.motion(model, q, v), jnp.zeros(())
        both = sj.rod.total_force((touch,), none, end) - sj.rod.total_force((), none, end)
        return both[sj.rod.slices(model)[1].joint_v][0]

    middle = (path.v[-50:] + path.v[-51:-1]) / 2
    return path, jnp.mean(jax.vmap(pull)(path.q[-50:], middle))


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    radii = {"beaker": 20 * mm, "wrench": 5 * mm, "bolt": 28 * mm}
    seconds, step = (3, 2e-3) if quick else (5, 1e-3)
    saves = round(seconds / step)

    def do(thing, length, top, mass, joint, bend, aside=0.0, phase=0.0):
        radius = jnp.asarray(radii[thing])
        model = quarter(radius, jnp.asarray(length), top, mass, Axial(*map(jnp.asarray, joint)))
        moments = Moments(*map(jnp.asarray, (bend, aside, phase)))
        path, pull = run(model, radius, moments, jnp.asarray(step), saves)
        return model, path, float(pull)

    slides, turns = (0.0, 1.0, 0.0), (1.0, 0.0, 1e-4)  # N m s damps a quarter of the bolt
    told, films = {}, {}
    for thing, length, mass in (("beaker", 60 * mm, 0.05), ("wrench", 100 * mm, 0.04)):
        model, path, pull = do(thing, length, -45 * mm, mass, slides, GRASP)
        films[thing] = model, path
        told[f"{thing}: weight [N]"] = mass * 9.81
        told[f"{thing}: sum of the contact forces [N]"] = -4 * pull
        told[f"{thing}: sinks by [mm/s]"] = float(path.v[-1, 4]) / mm
    for name, phase in (("left", np.pi / 2), ("right", -np.pi / 2)):
        model, path, _ = do("bolt", 44 * mm, -36 * mm, 0.012, turns, WALK, WALK, phase)
        films[name] = model, path
        angle = np.asarray(path.q[:, 4]) / (2 * np.pi)
        angle = angle[saves // seconds :]  # after the first second
        told[f"bolt {name}: turns a second"] = float(angle[-1] - angle[0]) / (seconds - 1)
        way = np.sign(angle[-1]) * angle
        back, size = np.max(np.maximum.accumulate(way) - way), np.ptp(way) / (seconds - 1)
        told[f"bolt {name}: way back, of a step [%]"] = float(100 * back / size)
    if picture is not None:
        draw(films, radii, picture)
    return told


def draw(films, radii, file) -> None:
    """The fingers at the end, seen from the side, and the way of the bolt."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Rectangle

    figure, axes = plt.subplots(1, 4, figsize=(13, 3.8), width_ratios=(1, 1, 1, 1.7))
    points = np.linspace(0, 1, 30)
    for axis, thing in zip(axes, ("beaker", "wrench", "bolt"), strict=False):
        model, path = films["left" if thing == "bolt" else thing]
        poses = sj.rod.forward_kinematics(model, path.q[-1], points)
        line, body = (np.asarray(poses[k])[:, :3, 3] / mm for k in ("finger", "object"))
        for k, shade in ((1, 0.4), (3, 0.4), (0, 1.0), (2, 1.0)):
            c, s = np.cos(np.pi / 2 * k), np.sin(np.pi / 2 * k)
            x = c * line[:, 0] - s * line[:, 1]
            axis.plot(x, line[:, 2], color="#2a6f97", alpha=shade, lw=9, solid_capstyle="round")
        width = radii[thing] / mm
        corner = (-width, body[:, 2].min())
        height = np.ptp(body[:, 2])
        axis.add_patch(Rectangle(corner, 2 * width, height, color="#e76f51", alpha=0.8))
        axis.set(aspect="equal", xlim=(-55, 55), ylim=(-170, 15), title=thing, xlabel="[mm]")
    for name in ("left", "right"):
        path = films[name][1]
        axes[3].plot(
            path.time, np.asarray(path.q[:, 4]) / (2 * np.pi), label=f"phase of {name}"
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

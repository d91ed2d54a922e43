"""A tip that feels like a spring: a rod of six segments comes to a wavy wall and slides along.

Study VI-D of the Sorotoki paper, after Della Santina et al. (Int. J. Robot. Res. 39, 2020).
Changed: the paper's masses of 334 g and its section of 60 x 20 mm are kept, with the second
moment of area of such a section (the original divides it by the area), so K = 240 N/m and
D = 18 N s/m in place of 0.825 N/m and 0.25 N s/m. The traced wall is a cosine on its chord;
the tip is round, the set-point comes to the wall within 1 s and keeps off the ends of it.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import sorojax as sj
from sorojax.math.contact_stepper import ContactMidpoint
from sorojax.units import MPa, mm

SAVED, MOMENTS = 8e-3, 150  # s between saved moments, saved moments of a run
STIFFNESS, DAMPING, HALF = 240.0, 18.0, 10 * mm  # N/m, N s/m, thickness over two
LOW, HIGH = np.array([243.3, 265.2]), np.array([400.6, 92.1])  # ends of the wall [mm]
FIRST, FROM, TO = [167.0, 28.0], [167.0, 24.0], [45.0, 24.0]  # along the chord, from it [mm]
APPROACH, SLIDE = 1.0, 3.5  # s


class Moving(sj.systems.AbstractReference):
    """From one point to another within `time` [s], from `begin` on."""

    begin: Array = eqx.field(converter=jnp.asarray)
    points: Array
    time: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t):
        share = jnp.clip((t - self.begin) / self.time, 0, 1)
        return self.points[0] + share * (self.points[1] - self.points[0])


class Controlled(sj.rod.AbstractForce):
    """The effort of a controller that sees the coordinates at every instant."""

    law: sj.systems.CartesianImpedance

    def __call__(self, t, motion):
        return self.law.effort(t, motion.q, motion.v)


def on_chord(x):
    """Points of the plane [m] from places along the chord of the wall and off it [mm]."""
    along = (HIGH - LOW) / np.linalg.norm(HIGH - LOW)
    x = np.asarray(x)
    return (LOW + x[..., :1] * along + x[..., 1:] * [along[1], -along[0]]) * mm


def wall():
    """The surface, and the solid behind it."""
    chord = np.linalg.norm(HIGH - LOW)
    x = np.linspace(0, chord, 65)
    ends = np.sin(np.clip(np.minimum(x, chord - x) / 30.5, 0, 1) * np.pi / 2)
    bulge = ends * (20.5 + 5.5 * np.cos(2 * np.pi * (x - chord / 2) / 61))
    outline = [*np.stack([x, bulge], 1), [chord, -50.0], [0.0, -50.0]]
    return sj.sdf.Polygon(on_chord(outline))


def arm():
    segments = sj.rod.piecewise_constant(kappa_z=6)
    return sj.rod.rod(
        sj.SE2(), segments, sj.rod.rectangle(60 * mm, 2 * HALF), length=378 * mm,
        young_modulus=5 * MPa, poisson_ratio=0.33, density=0.334 / (63 * 60 * 20 * mm**3),
        nodes=12,
    )  # fmt: skip


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    rod, solid = arm(), wall()
    law = sj.contact.LinePenalty(stiffness=2 * MPa, smoothing=20e-6)
    touch = sj.rod.ObstacleContact(solid, HALF, law, points=20 if quick else 40)
    lossy, every = sj.rod.Damping(0.05), 2 if quick else 4
    stepper = ContactMidpoint(contact_passes=6)

    @eqx.filter_jit
    def run(q, v, t, target):
        spring = sj.systems.CartesianImpedance(rod, (lossy,), target, STIFFNESS, DAMPING)
        forces = (lossy, touch, Controlled(spring))
        path = sj.rod.rollout(
            rod, q, v, forces, step=SAVED / every, saves=MOMENTS, every=every, t=t,
            stepper=stepper,
        )  # fmt: skip

        def seen(t, q, v):
            met = touch.touch(sj.rod.motion(rod, q, v))
            push = (law.pressure(met.gap) * met.weights) @ met.normal
            gap, normal = jax.value_and_grad(solid)(target(t))
            return {
                "goal": target(t), "foot": target(t) + (HALF - gap) * normal, "push": push,
                "tip": sj.rod.tip_pose(rod, q)[:2, 2], "overlap": -jnp.min(met.gap),
                "effort": jnp.linalg.norm(spring.effort(t, q, v)),
            }  # fmt: skip

        return path, jax.vmap(seen)(path.time, path.q, path.v)

    q, v = jnp.full(6, 0.3), jnp.zeros(6)
    way = jnp.stack([sj.rod.tip_pose(rod, q)[:2, 2], jnp.asarray(on_chord(FIRST))])
    path, seen = run(q, v, jnp.zeros(()), Moving(0.0, way, APPROACH))
    k = int(jnp.argmax(seen["overlap"] > 0))  # where it touches
    films, switch = [(path, seen)], float(path.time[k])
    q, v, t = path.q[k], path.v[k], path.time[k]
    for _ in range(4):
        path, more = run(q, v, t, Moving(switch, jnp.asarray(on_chord([FROM, TO])), SLIDE))
        q, v, t = path.q[-1], path.v[-1], path.time[-1]
        films.append((path, more))
    time = np.concatenate([films[0][0].time[:k], *(path.time[:-1] for path, _ in films[1:])])
    film = {
        name: np.concatenate([seen[name][:k], *(more[name][:-1] for _, more in films[1:])])
        for name in seen
    }
    off = np.linalg.norm(film["tip"] - film["foot"], axis=1)
    push = np.linalg.norm(film["push"], axis=1)
    asked = STIFFNESS * np.linalg.norm(film["goal"] - film["tip"], axis=1)
    if picture is not None:
        lines = [jax.vmap(lambda q: line(rod, q))(path.q[:-1]) for path, _ in films]
        lines = np.concatenate([lines[0][:k], *lines[1:]])
        draw(time, film, push, asked, solid, lines, picture)
    # the jump of the set-point at the switch has half a second to die out
    sliding = (time > switch + 0.5) & (time < switch + SLIDE)
    return {
        "contact at [s]": switch,
        "tip off the projected set-point, sliding [mm]": 1e3 * float(off[sliding].max()),
        "the same at the end [mm]": 1e3 * float(off[-1]),
        "force at the end [N]": float(push[-1]),
        "stiffness times offset [N]": float(asked[-1]),
        "overlap, greatest [mm]": 1e3 * float(film["overlap"].max()),
        "effort at the switch over that before": float(
            film["effort"][k : k + 25].max() / film["effort"][:k].max()
        ),
    }


def line(rod, q):
    """Points of the centre line [m]."""
    return sj.rod.forward_kinematics(rod, q, jnp.linspace(0, 1, 40))[:, :2, 2]


def draw(time, film, push, asked, solid, lines, file) -> None:
    """The rod on its way, and the force that it holds the wall with."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), width_ratios=(1, 1.2))
    outline = np.asarray(solid.vertices) / mm
    left.fill(-outline[:, 1], outline[:, 0], color="#adb5bd", lw=0)
    for k in np.linspace(0, len(time) - 1, 9).astype(int):
        shade = 0.25 + 0.75 * k / len(time)
        left.plot(-lines[k, :, 1] / mm, lines[k, :, 0] / mm, color="#2a6f97", alpha=shade, lw=4)
    for name, colour in (("goal", "#e76f51"), ("tip", "#012a4a")):
        left.plot(-film[name][:, 1] / mm, film[name][:, 0] / mm, color=colour, label=name)
    left.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]", xlim=(-290, 20), ylim=(0, 420))
    left.legend(frameon=False, loc="lower right")
    right.plot(time, push, color="#012a4a", label="force on the wall")
    right.plot(time, asked, "--", color="#e76f51", label="stiffness times offset")
    right.set(xlabel="time [s]", ylabel="[N]", ylim=(0, 6))
    right.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(Path(file), dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<46} {value:.4g}")

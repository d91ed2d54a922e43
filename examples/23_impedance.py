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

import sorojax as sj
from sorojax.math.contact_stepper import ContactMidpoint
from sorojax.units import MPa, mm

SAVED, MOMENTS = 8e-3, 150  # s between saved moments, saved moments of a run
STIFFNESS, DAMPING, HALF = 240.0, 18.0, 10 * mm  # N/m, N s/m, thickness over two
LOW, HIGH = np.array([243.3, 265.2]), np.array([400.6, 92.1])  # ends of the wall [mm]
FIRST, FROM, TO = [167.0, 28.0], [167.0, 24.0], [45.0, 24.0]  # along the chord, from it [mm]
APPROACH, SLIDE = 1.0, 3.5  # s


def on_chord(x):
    """Points of the plane [m] from places along the chord of the wall and off it [mm]."""
    along = (HIGH - LOW) / np.linalg.norm(HIGH - LOW)
    x = np.asarray(x)
    return jnp.asarray((LOW + x[..., :1] * along + x[..., 1:] * [along[1], -along[0]]) * mm)


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
        forces = (lossy, touch, sj.systems.ControlForce(spring))
        path = sj.rod.rollout(
            rod, q, v, forces, step=SAVED / every, saves=MOMENTS, every=every, t=t,
            stepper=stepper,
        )  # fmt: skip

        def seen(t, q, v):
            met = touch.touch(sj.rod.motion(rod, q, v))
            push = (law.pressure(met.gap) * met.weights) @ met.normal
            gap, normal = jax.value_and_grad(solid)(target(t))
            return {
                "time": t, "q": q, "goal": target(t), "push": jnp.linalg.norm(push),
                "foot": target(t) + (HALF - gap) * normal, "overlap": -jnp.min(met.gap),
                "tip": sj.rod.tip_pose(rod, q)[:2, 2],
                "effort": jnp.linalg.norm(spring.effort(t, q, v)),
            }  # fmt: skip

        return jax.vmap(seen)(path.time, path.q, path.v), path.v[-1]

    def target(switch):
        """Straight at the wall until `switch` [s], then along it."""
        way = sj.systems.Waypoints([0.0, APPROACH], [tip, on_chord(FIRST)])
        places = [tip, way(switch), on_chord(FROM), on_chord(TO)]
        times = [0.0, switch, switch, switch + SLIDE]
        return sj.systems.Waypoints(jnp.stack(jnp.asarray(times)), jnp.stack(places))

    q, v = jnp.full(6, 0.3), jnp.zeros(6)
    tip = sj.rod.tip_pose(rod, q)[:2, 2]
    first, _ = run(q, v, jnp.zeros(()), target(APPROACH))
    k = int(jnp.argmax(first["overlap"] > 0))  # where it touches
    switch, films, t = first["time"][k], [], jnp.zeros(())
    for _ in range(5):
        part, v = run(q, v, t, target(switch))
        q, t = part["q"][-1], part["time"][-1]
        films.append(part)
    film = jax.tree.map(lambda *parts: np.concatenate([x[:-1] for x in parts]), *films)
    off = np.linalg.norm(film["tip"] - film["foot"], axis=1)
    asked = STIFFNESS * np.linalg.norm(film["goal"] - film["tip"], axis=1)
    if picture is not None:
        draw(rod, film, asked, solid, picture)
    # the jump of the set-point at the switch has half a second to die out
    sliding = (film["time"] > switch + 0.5) & (film["time"] < switch + SLIDE)
    jump = film["effort"][k : k + 25].max() / film["effort"][:k].max()
    return {
        "contact at [s]": float(switch),
        "tip off the projected set-point, sliding [mm]": 1e3 * float(off[sliding].max()),
        "the same at the end [mm]": 1e3 * float(off[-1]),
        "force at the end [N]": float(film["push"][-1]),
        "stiffness times offset [N]": float(asked[-1]),
        "overlap, greatest [mm]": 1e3 * float(film["overlap"].max()),
        "effort at the switch over that before": float(jump),
    }


def draw(rod, film, asked, solid, file) -> None:
    """The rod on its way, and the force that it holds the wall with."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    time, s = film["time"], jnp.linspace(0, 1, 40)
    lines = jax.vmap(lambda q: sj.rod.forward_kinematics(rod, q, s)[:, :2, 2])(film["q"])
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
    right.plot(time, film["push"], color="#012a4a", label="force on the wall")
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

"""A tapered finger on a tendon: where it bends to, what pulls it to a target, what it grips."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp

import sorojax as sj
from sorojax.units import deg, mm

FRAMES, STEP = 50, 1e-3  # saved moments; s


def make_finger(taper=3 * mm):
    """A planar finger, 10 mm thick at the base and thinner by `taper` [m] of radius."""
    section = sj.rod.taper(sj.rod.circle, 5 * mm, 5 * mm - taper)
    rubber = sj.rod.elastic(sj.material.presets.dragon_skin_30())
    basis = sj.rod.chebyshev(kappa_z=4, sigma_x=1)
    return sj.rod.rod(sj.SE2(), basis, section, rubber, length=120 * mm, nodes=12)


def main(picture: str | None = None) -> dict[str, float]:
    finger = make_finger()
    route = sj.rod.Converging([4 * mm, 0.0], [1 * mm, 0.0])

    def angle(tension, taper):  # of the tip at rest [rad]
        rod = make_finger(taper)
        rest = sj.rod.equilibrium(rod, (sj.rod.Tendons(route, tension),))
        return sj.rod.tip_angle(sj.rod.motion(rod, rest.q))

    pull, slopes = jnp.array(0.2), jax.jit(jax.value_and_grad(angle, (0, 1)))
    bent, (by_tension, by_taper) = slopes(pull, 3 * mm)

    # Newton on the angle: the pull that turns the tip by 150 degrees
    for _ in range(6):
        found, (rate, _) = slopes(pull, 3 * mm)
        pull = pull - (found - 150 * deg) / rate

    # the same pull, ramped up within half a second, around a ball
    ball = sj.sdf.Circle([84 * mm, 22 * mm], 14 * mm)
    law = sj.contact.LinePenalty(stiffness=5e6, smoothing=10e-6, friction=0.5)
    thickness = jnp.linspace(5 * mm, 2 * mm, 49)  # at 48 points and the tip
    touch = sj.rod.ObstacleContact(ball, thickness, law, points=48)
    pulled = sj.rod.Tendons(route, lambda t: pull * jnp.minimum(t / 0.5, 1.0))
    path = sj.rod.rollout(
        finger, jnp.zeros(5), jnp.zeros(5), (pulled, touch, sj.rod.Damping(0.02)),
        step=STEP, saves=FRAMES, every=20,
    )  # fmt: skip
    depth = sj.rod.penetration(touch, sj.rod.motion(finger, path.q[-1]))
    if picture is not None:
        draw(finger, path, Path(picture))
    return {
        "tip angle at 0.2 N [deg]": float(bent / deg),
        "by tension [deg/N]": float(by_tension / deg),
        "by taper [deg/mm]": float(by_taper / deg * mm),
        "pull for 150 deg [N]": float(pull),
        "tip angle around the ball [deg]": float(
            sj.rod.tip_angle(sj.rod.motion(finger, path.q[-1])) / deg
        ),
        "overlap over thickness [%]": 100 * float(depth / (10 * mm)),
    }


def draw(finger, path, file: Path) -> None:
    """The finger while it closes on the ball."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle

    s = jnp.linspace(0.0, 1.0, 60)
    poses = jax.vmap(lambda q: sj.rod.forward_kinematics(finger, q, s))(path.q) / mm
    radius = 5 - 3 * s
    figure, axes = plt.subplots(figsize=(7, 4.6))
    for k, shade in ((0, 0.2), (6, 0.3), (10, 0.4), (16, 0.6), (FRAMES, 1.0)):
        middle, across = poses[k, :, :2, 2], poses[k, :, :2, 1] * mm
        upper, lower = middle + radius[:, None] * across, middle - radius[:, None] * across
        outline = jnp.concatenate([upper, lower[::-1]])
        axes.fill(*outline.T, color="#2a6f97", alpha=0.5 * shade, lw=0)
        axes.plot(*middle.T, color="#012a4a", alpha=shade, lw=1)
    axes.add_patch(Circle((84, 22), 14, color="#e76f51"))
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("A tendon closes a tapered finger on a ball")
    figure.tight_layout()
    figure.savefig(file, dpi=110, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main(*names[:1]).items():
        print(f"{name:34s} {number:10.4g}")

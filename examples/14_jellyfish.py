"""Six thin fingers laid on a ball by inverse kinematics: the gripper for jellyfish.

The grasp of section V-D of the Sorotoki paper: ball of 40 mm, fingers of 120 mm with a section
of 4 mm x 1 mm, three Chebyshev modes per curvature. As there, a bent finger is projected on the
ball and pulled to these points; here that is done three times, since the first points are too
far apart or too close, and no section may enter the ball. The paper gives no base frames: the
fingers leave a palm of 20 mm, 25 degrees outwards. Their skin, not their centre line, touches.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import rod, sdf
from sorojax.units import MPa, deg, mm

CENTER, RADIUS = np.array([0.0, 0.0, -60.0]) * mm, 40 * mm  # as in the paper
PALM, TILT, THICKNESS = 20 * mm, 25 * deg, 1 * mm
ROUNDS = 3


def make_finger():
    return rod.rod(
        sj.SE3(), rod.chebyshev(kappa_y=3, kappa_z=3), rod.rectangle(4 * mm, THICKNESS),
        length=120 * mm, young_modulus=0.7 * MPa, poisson_ratio=0.49, density=1070.0, nodes=10,
    )  # fmt: skip


def mount(angle):
    """Pose of the base of the finger at `angle` round the palm, its x axis down and out."""
    out = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0])
    across = jnp.stack([-jnp.sin(angle), jnp.cos(angle), 0.0])
    down = jnp.sin(TILT) * out + jnp.cos(TILT) * jnp.array([0.0, 0.0, -1.0])
    axes = jnp.stack([down, across, jnp.cross(down, across), PALM * out], axis=1)
    return jnp.concatenate([axes, jnp.array([[0.0, 0.0, 0.0, 1.0]])])


def lay(angle, q):
    """One finger on the ball: its coordinates, status, and distances from the ball [m]."""
    base, finger = mount(angle), make_finger()
    center = base[:3, :3].T @ (CENTER - base[:3, 3])  # of the ball, as the finger sees it
    ball, skinned = sdf.Sphere(center, RADIUS), sdf.Sphere(center, RADIUS + THICKNESS / 2)
    outer, everywhere = jnp.linspace(0.6, 1.0, 9), jnp.linspace(0.0, 1.0, 49)
    aims = sdf.project(skinned, rod.forward_kinematics(finger, q, outer)[:, :3, 3])
    clear = rod.ObstacleConstraint(ball, everywhere[1:], THICKNESS / 2)
    found = rod.inverse_kinematics(finger, rod.Position(aims, outer), q, obstacles=(clear,))
    line = rod.forward_kinematics(finger, found.q, jnp.linspace(0.0, 1.0, 401))[:, :3, 3]
    tip = base[:3, :3] @ line[-1] + base[:3, 3]
    return found.q, found.iterations, ball(line) - THICKNESS / 2, tip


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    angles = jnp.arange(6.0) * 60 * deg
    q = jnp.tile(jnp.array([14.0, 14.0, 0.0, 0.0, 0.0, 0.0]), (6, 1))  # bent towards the ball
    project = jax.jit(jax.vmap(lay))
    for _ in range(ROUNDS - 1):
        q = project(angles, q)[0]
    q, iterations, gap, tips = project(angles, q)
    if picture is not None:
        draw(angles, q, Path(picture))
    apart = jnp.linalg.norm(tips - jnp.roll(tips, 1, axis=0), axis=1)
    return {
        "fingers on the ball": int(jnp.sum(jnp.abs(gap[:, 241:]).max(axis=1) < 0.5 * mm)),
        "penetration [mm]": float(jnp.maximum(-gap, 0.0).max() / mm),
        "farthest off the ball, outer 40 % [mm]": float(gap[:, 241:].max() / mm),
        "mean distance, outer 40 % [mm]": float(jnp.abs(gap[:, 241:]).mean() / mm),
        "tips apart [mm]": float(apart.min() / mm),
        "iterations of the last round": int(iterations.max()),
    }


def draw(angles, q, file: Path) -> None:
    """The six fingers on the ball, from the side and from below; a film in which they bend
    evenly from straight to laid, which no simulation tells."""
    import matplotlib.pyplot as plt

    from sorojax import view

    fingers = {
        f"f{k}": rod.Part(make_finger(), offset=mount(angle)) for k, angle in enumerate(angles)
    }
    hand = rod.assembly(sj.SE3(), **fingers)
    orange, laid = dict.fromkeys(fingers, "#f29b4b"), np.asarray(q).ravel()
    palm = sdf.translate(sdf.Cylinder(PALM + 4 * mm, 4 * mm, 1 * mm), [0, 0, 2 * mm])
    stem = sdf.translate(sdf.Cylinder(6 * mm, 14 * mm), [0, 0, 10 * mm])
    ball = view.place(view.scene_of(sdf.Sphere(CENTER, RADIUS)), np.eye(4), "#a9d3ee")
    rest = view.merge_scenes(ball, view.scene_of(palm | stem))

    def scene(share):
        return view.merge_scenes(view.scene_of(hand, share * laid, colours=orange), rest)

    figure, axes = plt.subplots(1, 2, figsize=(7, 4.1), dpi=200, layout="constrained")
    for place, name in zip(axes, ("from the side", "from below"), strict=True):
        place.set_title(name, fontsize=10)
        place.set_axis_off()
    view.draw_into(axes[0], scene(1.0), view=view.Camera(-60.0, 8.0))
    view.draw_into(axes[1], scene(1.0), view=view.Camera(-60.0, -55.0), scale=False)
    figure.savefig(file)
    plt.close(figure)
    shares = np.concatenate([np.linspace(0, 1, 46), np.ones(15)])
    moving = view.Track(np.arange(61) / 20, lambda k: scene(shares[k]), unit="")
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-40.0, -22.0)}
    film = view.animate(moving, title="Fingers laid on a ball", **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:42s} {number:10.4g}")

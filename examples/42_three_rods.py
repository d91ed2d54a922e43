"""A parallel robot of three soft rods between three moved bases and a platform.

Each rod is clamped to the platform at its upper end and to a slider at its lower one: a
parallel continuum robot. The sliders follow given motions, 30 mm up and down, a third of a
period apart, so that the platform wobbles. Sliders and two of the three upper clamps are
closures: 30 equations, which hold at every step. The picture shows four moments and the forces
by which the sliders push.
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax.math.lie import homogeneous
from sorojax.units import mm

TURNS = 2 * np.pi / 3 * np.arange(3)
PLACES = 40 * mm * np.stack([np.cos(TURNS), np.sin(TURNS), 0 * TURNS], axis=1)
UP = jnp.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # rods start along z
STROKE, PERIOD, END = 30 * mm, 1.0, 2.0  # m, s, s


class Slider(eqx.Module):
    """Pose of a base in time: it begins at rest."""

    place: jax.Array
    phase: jax.Array

    def __call__(self, t):
        grown = 1 - jnp.exp(-((t / 0.3) ** 3))
        lift = STROKE * grown * jnp.sin(2 * np.pi * t / PERIOD + self.phase)
        return homogeneous(UP, self.place + jnp.stack([0.0 * t, 0.0 * t, lift]))


def make_robot():
    """Three floating rods and a platform on the first; closures do the rest."""
    basis = sj.rod.chebyshev(kappa_x=1, kappa_y=3, kappa_z=3, sigma_x=1)
    rubber = sj.rod.elastic(sj.material.presets.dragon_skin_30())
    leg = sj.rod.rod(sj.SE3(), basis, sj.rod.circle(6 * mm), rubber, length=0.15, nodes=8)
    legs = {
        f"leg_{k}": sj.rod.Part(leg, sj.rod.Free(), offset=homogeneous(UP, jnp.array(place)))
        for k, place in enumerate(PLACES)
    }
    onto = homogeneous(UP.T, -UP.T @ PLACES[0])  # the platform's centre, seen from a tip
    platform = sj.rod.Part(sj.rod.Link(0.01, [6e-6, 6e-6, 1e-5]), on="leg_0", offset=onto)
    tree = sj.rod.assembly(sj.SE3(), **legs, platform=platform)
    closures = {
        f"slider_{k}": sj.rod.Closure(f"leg_{k}", at=0.0, motion=Slider(jnp.array(place), turn))
        for k, (place, turn) in enumerate(zip(PLACES, jnp.array(TURNS), strict=True))
    }
    for k in (1, 2):
        held = homogeneous(UP, jnp.array(PLACES[k]))
        closures[f"clamp_{k}"] = sj.rod.Closure(f"leg_{k}", on="platform", offset=held)
    return sj.rod.with_closures(tree, **closures)


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    robot = make_robot()
    q, zero = sj.rod.rest(robot), jnp.zeros(sj.rod.num_dof(robot))
    forces, saves = (sj.rod.Gravity(), sj.rod.Damping(0.03)), 10 if quick else 100
    path = sj.rod.rollout(robot, q, zero, forces, step=2e-3, saves=saves, every=10)
    s = np.linspace(0, 1, 21)
    poses = jax.vmap(lambda q: sj.rod.forward_kinematics(robot, q, s))(path.q)
    lifts = (poses["platform"][:, 0, 2, 3] - 150 * mm) / mm
    tips = poses["leg_1"][:, -1, :3, 3], poses["platform"][:, 0, :3, :3]
    apart = tips[0] - poses["platform"][:, 0, :3, 3] - tips[1] @ PLACES[1]
    if picture is not None:
        draw(path, poses, picture)
    return {
        "ended well": float(path.status == sj.Status.successful),
        "platform down [mm]": float(lifts.min()),
        "platform at the end [mm]": float(lifts[-1]),
        "clamp open by [m]": float(jnp.abs(apart).max()),
        "push of the sliders at the start [N]": sum(
            float(path.reactions[f"slider_{k}"][0, 5]) for k in range(3)
        ),
    }


def draw(path, poses, file) -> None:
    """Four moments, and the forces of the sliders along z."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(11, 4.2))
    for column, row in enumerate((0, 60, 75, 90)):
        axes: Any = figure.add_axes((0.185 * column, 0, 0.2, 0.92), projection="3d")
        for k in range(3):
            axes.plot(*(poses[f"leg_{k}"][row, :, :3, 3] / mm).T, lw=4)
        tips = np.stack([poses[f"leg_{k % 3}"][row, -1, :3, 3] for k in range(4)])
        axes.plot(*(tips / mm).T, "k", lw=2)
        axes.set(xlim=(-75, 75), ylim=(-75, 75), zlim=(-30, 190))
        axes.set_title(f"{float(path.time[row]):.1f} s")
        axes.set_box_aspect((15, 15, 22), zoom=1.05)
        axes.set(xticks=(-40, 0, 40), yticks=(-40, 0, 40), zticks=(0, 50, 100, 150))
        axes.tick_params(labelsize=7, pad=-2)
        if column < 3:
            axes.set_zticklabels([])
        axes.view_init(elev=18, azim=-60)
    axes = figure.add_axes((0.81, 0.14, 0.18, 0.74))
    for k in range(3):
        axes.plot(path.time, path.reactions[f"slider_{k}"][:, 5])
    axes.set(xlabel="time [s]")
    axes.set_title("push of the sliders [N]", fontsize=10)
    figure.text(0.01, 0.02, "lengths in mm", size=8)
    figure.savefig(file, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main(picture=Path(__file__).with_suffix(".png")).items():
        print(f"{name}: {value:.4g}")

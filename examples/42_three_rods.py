"""A parallel robot of three soft rods between three moved bases and a platform.

Each rod is clamped to the platform at its upper end and to a slider at its lower one: a
parallel continuum robot. The sliders follow given motions, 30 mm up and down, a third of a
period apart, so that the platform wobbles. Sliders and two of the three upper clamps are
closures: 30 equations, which hold at every step. The picture shows four moments and the forces
by which the sliders push.
"""

from pathlib import Path

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
        draw(robot, path, picture)
    return {
        "ended well": float(path.status == sj.Status.successful),
        "platform down [mm]": float(lifts.min()),
        "platform at the end [mm]": float(lifts[-1]),
        "clamp open by [m]": float(jnp.abs(apart).max()),
        "push of the sliders at the start [N]": sum(
            float(path.reactions[f"slider_{k}"][0, 5]) for k in range(3)
        ),
    }


def draw(robot, path, file) -> None:
    """Four moments, and the forces of the sliders along z; a film of all moments."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    from sorojax import sdf, view

    colours, times = ("#0072B2", "#D55E00", "#009E73"), np.asarray(path.time)
    looks = {f"leg_{k}": colour for k, colour in enumerate(colours)} | {"platform": "#e9e4da"}
    plate = sdf.translate(sdf.Cylinder(50 * mm, 5 * mm, 1 * mm), [0, 0, 2.5 * mm])
    low = -STROKE - 30 * mm
    ground = sdf.translate(sdf.Cylinder(64 * mm, 4 * mm, 1 * mm), [0, 0, low - 2 * mm])

    def scene(k):
        """The robot on its sliders, which are pistons here."""
        parts = list(
            view.scene_of(robot, path.q[k], shapes={"platform": plate}, colours=looks).parts
        )
        for place, phase in zip(PLACES, TURNS, strict=True):
            high = float(Slider(jnp.array(place), phase)(times[k])[2, 3])
            piston = sdf.Cylinder(9 * mm, high - low, 1 * mm)
            parts += view.scene_of(sdf.translate(piston, [*place[:2], (high + low) / 2])).parts
        return view.Scene((*parts, *view.scene_of(ground).parts))

    figure = plt.figure(figsize=(7, 5.6), dpi=200, layout="constrained")
    grid, moments = figure.add_gridspec(2, 1, height_ratios=(1.6, 1)), (0, 60, 75, 90)
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, len(moments))]
    for axes, k in zip(shown, moments, strict=True):
        axes.set_title(f"{times[k]:.1f} s", fontsize=10)
    axes = figure.add_subplot(grid[1])
    for k, colour in enumerate(colours):
        push = path.reactions[f"slider_{k}"][:, 5]
        axes.plot(times, push, color=colour, lw=1.8, label=f"slider {k + 1}")
        axes.plot(times[list(moments)], push[np.array(moments)], "o", ms=4, color=colour)
    axes.set(xlabel="time [s]", ylabel="push of a slider [N]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, ncols=3)
    view.draw_into(shown, [scene(k) for k in moments], view=view.Camera(-60.0, 16.0))
    figure.savefig(file)
    plt.close(figure)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-60.0, 16.0)}
    moving = view.Track(times[::2], lambda k: scene(2 * k))
    title = "A platform on three soft rods"
    film = view.animate(moving, speed=0.5, fps=12.5, size=(480, 560), title=title, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main(picture=Path(__file__).with_suffix(".png")).items():
        print(f"{name}: {value:.4g}")

"""A soft hand whose five fluidic fingers swing one after the other, with their valves and gas.

Section V-E of the Sorotoki paper: fingers of 90 mm, the thumb of 80 mm, five Chebyshev modes of
which the first is driven, square waves of 7 rad/s that follow each other by pi/6, V = V0 (1 +
tanh a) with a proportional to the first coordinate. Changed: the paper sets the force (5 times
the pressure) apart from the volume, so its fluid does work on nothing; here both come from one
V(q), that of a chamber of 60 mm^2, 5 mm off the axis. V0 is 6 ml, which fits into a finger and
its tube, for 180 ml. The wave runs from -5 to 80 kPa as in the experiment, for +- 80 kPa.
"""

import dataclasses
import io
import math
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import rod, systems
from sorojax.units import MPa, deg, kPa, ml, mm

RATE, LAG, PERIOD = 7.0, math.pi / 6, 0.005  # rad/s; rad; s between two set-points
MODES, VOLUME = 5, 6 * ml
LENGTHS, SECTION = np.array([80.0, 90.0, 90.0, 90.0, 90.0]) * mm, (10 * mm, 10 * mm)


class Chamber(rod.AbstractChamber):
    """Gas that grows with the mean curvature; its slope with pressure is the force."""

    length: jax.Array
    ports = ()

    def volume(self, q):
        arm = 60 * mm**2 * 5 * mm * self.length  # volume per curvature
        return VOLUME * (1 + jnp.tanh(arm * q[0] / VOLUME))


def finger(length) -> systems.Network:
    body = rod.rod(
        sj.SE2(), rod.chebyshev(kappa_z=MODES), rod.rectangle(*SECTION), length=length,
        young_modulus=1.5 * MPa, poisson_ratio=0.45, density=1100.0, nodes=8,
    )  # fmt: skip
    upright = rod.Gravity([-9.81, 0.0])
    blocks = {
        "valve": systems.Regulator(4e-9, integral_gain=2e-8), "air": systems.Reservoir(),
        "body": systems.RodBody(body, (Chamber(length), upright, rod.Damping(0.02))),
    }  # fmt: skip
    wires = {
        "valve.pressure": "air.pressure", "air.mass_flow": "valve.mass_flow",
        "air.volume": "body.volume", "air.volume_rate": "body.volume_rate",
        "body.pressure": "air.pressure",
    }  # fmt: skip
    return systems.Network(blocks, wires, exposed=("valve.setpoint",))


class Waves(eqx.Module):
    """One square wave per finger, each behind the one before."""

    def start(self, t, measurement):
        return ()

    def __call__(self, t, measurement, state):
        high = jnp.sin(RATE * t - LAG * jnp.arange(5.0)) > 0
        return jnp.where(high, 80 * kPa, -5 * kPa), state


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    hand = systems.stack([finger(length) for length in jnp.asarray(LENGTHS)])
    network = systems.Network({"fingers": hand}, {}, ("fingers.valve.setpoint",))
    loop = systems.Sampled(Waves(), "fingers.air.pressure", "fingers.valve.setpoint")
    film = systems.simulate_sampled(
        network, loop, 3.0 if quick else 5.0, period=PERIOD, substeps=2,
        method=systems.Rosenbrock2(),
    )  # fmt: skip

    late = np.asarray(film.time) > film.time[-1] - 2 * 2 * math.pi / RATE  # two whole periods
    angle, pressure = (np.asarray(film[f"fingers.{name}"]) for name in
                       ("body.tip_angle", "air.pressure"))  # fmt: skip
    wave = np.exp(-1j * RATE * np.asarray(film.time))[late] @ angle[late]
    behind = -np.diff(np.unwrap(np.angle(wave))) / deg
    grown = np.asarray(film["fingers.body.volume_rate"]) * (pressure + 101325)
    supply = np.asarray(film["fingers.valve.mass_flow"]) * 287.05 * 293.15
    if picture is not None:
        draw(film, angle, pressure, Path(picture))
    return {
        "a finger behind the one before [deg]": float(behind[1:].mean()),
        "fingers of one length differ by [deg]": float(np.ptp(behind[1:])),
        "first finger behind the thumb [deg]": float(behind[0]),
        "swing of the tip [deg]": float(np.ptp(angle[late, 1]) / deg),
        "highest pressure [kPa]": float(pressure[late].max() / kPa),
        "lowest pressure [kPa]": float(pressure[late].min() / kPa),
        "flow that fills the growing finger [%]": float(
            100 * np.abs(grown[late]).max() / np.abs(supply[late]).max()
        ),
    }


def draw(film, angle, pressure, file: Path) -> None:
    """Pressures, angles, and the hand at four moments."""
    import matplotlib.pyplot as plt

    def place(k):  # the thumb lower and aside, turned by 45 degrees about the hand's axis
        pose, turn = np.eye(4), -45 * deg if k == 0 else 0.0
        across = np.array([np.cos(turn), np.sin(turn), 0.0])
        axes = np.stack([[0, 0, 1], across, np.cross([0, 0, 1], across)], axis=1)
        pose[:3, :3], pose[:3, 3] = axes, ((6, 83, -38) if k == 0 else (0, 88 - 22 * k, 0))
        pose[:3, 3] *= mm
        return pose

    def body(length):
        return rod.rod(
            sj.SE3(), rod.chebyshev(kappa_z=MODES), rod.rectangle(*SECTION), length=length,
            young_modulus=1.0, poisson_ratio=0.4, density=1.0,
        )  # fmt: skip

    parts = {f"f{k}": rod.Part(body(LENGTHS[k]), offset=place(k)) for k in range(5)}
    figure = plt.figure(figsize=(11, 7), layout="constrained")
    grid = figure.add_gridspec(2, 4, height_ratios=(1.2, 1))
    moments = [
        -1 - round(share * 2 * math.pi / RATE / PERIOD) for share in (0.75, 0.5, 0.25, 0)
    ]
    states = np.asarray(film.state["fingers"]["body"]["q"])
    scenes = [
        sj.view.scene_of(rod.assembly(sj.SE3(), **parts), states[k].ravel()) for k in moments
    ]
    low = np.min([scene.box[0] for scene in scenes], axis=0)
    high = np.max([scene.box[1] for scene in scenes], axis=0)
    for column, (k, scene) in enumerate(zip(moments, scenes, strict=True)):
        shown = sj.view.show(dataclasses.replace(scene, extent=(low, high)),
                             view=sj.view.Camera(-40.0, 15.0), renderer="own")  # fmt: skip
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(plt.imread(io.BytesIO(shown.png)))
        axes.set_title(f"{float(film.time[k]):.2f} s")
        axes.set_axis_off()
    names = "thumb", "first", "second", "third", "fourth"
    panels = (pressure / kPa, "pressure [kPa]"), (angle / deg, "angle of the tip [deg]")
    below = [figure.add_subplot(grid[1, at : at + 2]) for at in (0, 2)]
    for axes, (values, label) in zip(below, panels, strict=True):
        for k, name in enumerate(names):
            axes.plot(film.time, values[:, k], label=name, lw=1.3)
        axes.set(xlabel="time [s]", ylabel=label)
    below[1].legend(
        frameon=False, ncols=5, fontsize=9, loc="lower right", bbox_to_anchor=(1, 1)
    )
    figure.savefig(file, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:42s} {number:10.4g}")

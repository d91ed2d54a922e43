"""A soft hand whose five fluidic fingers swing one after the other, with their valves and gas.

Section V-E of the Sorotoki paper: fingers of 90 mm, the thumb of 80 mm, five Chebyshev modes of
which the first is driven, square waves of 7 rad/s that follow each other by pi/6, V = V0 (1 +
tanh a) with a proportional to the first coordinate. Changed: the paper sets the force (5 times
the pressure) apart from the volume, so its fluid does work on nothing; here both come from one
V(q), that of a chamber of 60 mm^2, 5 mm off the axis. V0 is 6 ml, which fits into a finger and
its tube, for 180 ml. The wave runs from -5 to 80 kPa as in the experiment, for +- 80 kPa.
"""

import dataclasses
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
    """The hand at four moments of a period in the skins of its printed fingers, coloured by
    their pressure; pressures and angles."""
    import matplotlib.pyplot as plt

    from sorojax import robots, sdf, view

    hand, turn = robots.Hand(), np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])  # fingers up

    def pose(axes, place=(0.0, 0.0, 0.0)):
        return np.block([[axes, np.asarray(place)[:, None]], [np.zeros(3), 1.0]])

    def mounted(name, length):
        foot, angle = (np.asarray(x) for x in hand.places()[name])
        along, palm = np.array([-np.sin(angle), np.cos(angle), 0.0]), np.array([0.0, 0, -1])
        body = rod.rod(
            sj.SE3(), rod.chebyshev(kappa_z=MODES), rod.rectangle(*SECTION), length=length,
            young_modulus=1.0, poisson_ratio=0.4, density=1.0,
        )  # fmt: skip
        axes = np.stack([along, palm, np.cross(along, palm)], axis=1)
        return rod.Part(body, on="palm", offset=pose(axes, foot))

    names = "thumb", "index", "middle", "ring", "little"
    base = rod.Part(robots.cylinder(1.0, 1.0, 1.0), offset=pose(turn))
    fingers = {name: mounted(name, x) for name, x in zip(names, LENGTHS, strict=True)}
    whole = rod.assembly(sj.SE3(), palm=base, **fingers)
    finger = sdf.isosurface(hand.finger.along_x(), 0.7 * mm)
    thumb = sdf.isosurface(hand.thumb.along_x(), 0.7 * mm)
    own = {"thumb": thumb, "palm": sdf.isosurface(hand.palm(), 1.5 * mm)}
    skins = dict.fromkeys(names, finger) | own
    slab = sdf.Box([-54 * mm, -38 * mm, -4 * mm], [54 * mm, 34 * mm, 0.0])
    table, scale = view.scene_of(slab), view.Scale("pressure [kPa]", -10.0, 90.0)
    plain = {"palm": "#e9e4da"}
    states = np.asarray(film.state["fingers"]["body"]["q"])

    def scene(k):
        drawn = view.scene_of(whole, states[k].ravel(), shapes=skins, colours=plain).parts
        palm, *bent = (part for part in drawn if isinstance(part, view.Surface))
        blown = [
            dataclasses.replace(part, values=np.full(len(part.points), p / kPa))
            for part, p in zip(bent, np.asarray(pressure)[k], strict=True)
        ]
        return view.Scene((palm, *blown, *table.parts), scale)

    figure = plt.figure(figsize=(7, 5.4), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.35, 1))
    above, below = grid[0].subgridspec(1, 4), grid[1].subgridspec(1, 2)
    moments = [-1 - round(x * 2 * math.pi / RATE / PERIOD) for x in (0.8, 0.55, 0.3, 0.05)]
    times, colours = (
        np.asarray(film.time),
        ["#D55E00", *plt.get_cmap("Blues")([0.4, 0.6, 0.8, 1.0])],
    )
    panels = (pressure / kPa, "pressure [kPa]"), (angle / deg, "angle of the tip [deg]")
    for at, (values, label) in zip((below[0], below[1]), panels, strict=True):
        axes = figure.add_subplot(at)
        for k, name in enumerate(names):
            axes.plot(times, values[:, k], label=name, lw=1.5, color=colours[k])
        for k in moments:
            axes.axvline(times[k], color="0.75", lw=0.8, zorder=0)
        axes.set(xlabel="time [s]", ylabel=label, xlim=(times[-1] - 2, times[-1]))
        axes.spines[["top", "right"]].set_visible(False)
    lines = axes.get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=5, frameon=False)
    shown = [figure.add_subplot(place) for place in above]
    for axes, k in zip(shown, moments, strict=True):
        axes.set_title(f"{times[k]:.2f} s", fontsize=10)
    scenes = [scene(k) for k in moments]
    view.draw_into(shown, scenes, view=view.Camera(-62.0, 16.0))
    figure.savefig(file)
    plt.close(figure)
    last = np.arange(len(times))[-361::6]  # two periods
    low, high = np.swapaxes([each.box for each in scenes], 0, 1)
    extent = low.min(axis=0), high.max(axis=0)
    moving = view.Track(times[last], lambda k: scene(last[k]), scale, extent=extent)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-62.0, 16.0)}
    film = view.animate(moving, speed=0.5, title="Waves through a soft hand", **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:42s} {number:10.4g}")

"""Where a pushed soft actuator is, from one marker at its tip and the pressure in it.

Study VI-E of the Sorotoki paper with finite elements as the truth: a bellows actuator hangs
in its weight, air goes in and out, random forces push its back. A rod of three bending modes,
made from pressure and weight alone, is brought to the seen tip; what the tip leaves open is
filled by the unbalanced force of the model (the null-space task), or by nothing.

Changed against the paper: nine wider bellows of Dragon Skin 30 with gaps, 118 mm in all, whose
walls do not touch up to the paper's 30 kPa. For every pressure the rod is made anew.

One marker cannot tell pushes apart, so the middle is worse the larger they are and the farther
air bends it. Its largest error is 7 to 9 % of the way of the tip everywhere: 1.9 mm at 6 kPa
with pushes of 12 mN, 3.7 mm at 30 kPa with the same, 8.7 mm with 60 mN. Without the task it is
1.6 to 2.5 times that, and what the task is worth falls with the pushes.
"""

import functools
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, reduction
from sorojax.material.presets import dragon_skin_30
from sorojax.robots import BellowsActuator, bellows_problem
from sorojax.rod import Position, Pressurised, elastic, forward_kinematics, inverse_kinematics
from sorojax.units import kPa, mm

DOWN = [9.81, 0.0]  # m/s^2, along the actuator
NAMES = "error of the tip", "error of the middle", "error of the middle by the tip alone"
TIMES = "time of an estimate, median [ms]", "time of an estimate, 99th percentile [ms]"
STUDIES = ((6, 12), (12, 24), (30, 12), (30, 60))  # kPa, and the greatest push on each [mN]


def hanging(problem, pressure, pushes=np.zeros(3), start=None):  # noqa: B008
    """Displacement under a pressure [Pa], the weight, and forces [N] on the backs."""
    values = [pressure, jnp.array(DOWN), *np.stack([0 * pushes, pushes], axis=1)]
    loaded = sj.replace(problem, lambda p: [load.value for load in p.loads], values)
    return fem.solve(loaded, start=start).displacement


def study(problem, line, most, push, frames):
    """Shapes under air [Pa] and pushes [N], those told with and without the balance of forces,
    how far these are off [mm], and how long each took [s]."""
    path = fem.solve_path(problem, air=jnp.linspace(0, most, 6))

    def backbones(shapes):
        seen = sj.replace(path, lambda x: x.displacements, jnp.stack(shapes))
        return reduction.strain_along(seen, line)

    # A rod of three bending modes and a stretch, as pressure and weight teach it.
    taught = backbones([*path.displacements, *(hanging(problem, p) for p in path.values[::5])])
    basis = reduction.pod_basis(taught, modes={"kappa_z": 3, "sigma_x": 1})
    fit = reduction.identify(path, basis, reduction.strain_along(path, line), line, degree=3)
    rod = sj.rod.rod(sj.SE2(), basis, fit.section, elastic(problem.material), length=fit.length)

    random, shapes = np.random.default_rng(1), [jnp.zeros_like(problem.mesh.points)]
    pressure = most * np.clip(np.sin(np.linspace(0, 2 * np.pi, frames)), 0, 1)
    shaken = np.arange(frames)[:, None] >= frames // 6
    pushes = push * random.uniform(-1, 1, (frames, 3)) * shaken
    for p, f in zip(pressure, pushes, strict=True):
        shapes.append(hanging(problem, p, f, shapes[-1]))
    truth = backbones(shapes[1:])
    true = np.asarray(truth.positions)
    tip = true[:, -1] + 0.1 * mm * random.standard_normal((frames, 2))  # the marker
    heavy = reduction.offset_weight(problem, line, DOWN)

    @functools.partial(jax.jit, static_argnums=0)
    def estimate(balanced, q, tip, pressure):
        own = (fit.elastic, heavy, Pressurised(fit.pressure, pressure)) if balanced else None
        q = inverse_kinematics(rod, Position(tip), q, forces=own, iterations=20).q
        return q, forward_kinematics(rod, q, truth.s)[:, :2, 2]

    lines, spent = [], []
    for balanced in (True, False):
        q = jnp.zeros(rod.basis.num_dof)
        for x, p in zip(tip, pressure, strict=True):
            begin = time.perf_counter()
            q, shape = jax.block_until_ready(estimate(balanced, q, x, p))
            spent.append(time.perf_counter() - begin)
            lines.append(np.asarray(shape))
    off = np.linalg.norm(np.reshape(lines, (2, *true.shape)) - true, axis=3) / mm
    return (path, shapes[1:], true, tip, lines, off), spent[1:frames]  # the first is compiled


def main(quick: bool = False, picture: str | Path | None = None) -> dict:
    actuator = BellowsActuator(num_bellows=9)
    mesh = sj.mesh.triangulate(actuator.body(), size=(2.0 if quick else 1.2) * mm, order=2)
    # the third, fifth and eighth bellow are pushed
    problem = bellows_problem(
        actuator, mesh, dragon_skin_30(), gravity=[0, 0], pushed=(2, 4, 7)
    )
    line = reduction.Line([0.0, 1 * mm], [actuator.length, 1 * mm])
    numbers, times, cases = {}, [], {}
    for pressure, push in STUDIES[::3] if quick else STUDIES:
        found, spent = study(problem, line, pressure * kPa, push / 1e3, 24 if quick else 60)
        case, off, times = f"{pressure} kPa, {push} mN: ", found[-1], times + spent
        cases[case[:-2]] = found
        errors = (off[0, :, -1], *np.moveaxis(off, 2, 0)[off.shape[2] // 2])
        for k, x in zip(NAMES, errors, strict=True):
            numbers |= {f"{case}{k}, largest [mm]": x.max(), f"{case}{k}, mean [mm]": x.mean()}
        numbers[case + "way of the tip [mm]"] = np.ptp(found[2][:, -1, 1]) / mm
    draw(cases, picture)
    return numbers | dict(zip(TIMES, 1e3 * np.quantile(times, (0.5, 0.99)), strict=True))


def draw(cases, file) -> None:
    """For every pressure the hanging solid with both estimates of its backbone where that by
    the tip alone is worst, the errors over the way of the tip, and a film of the last case."""
    if file is None:
        return
    from matplotlib import pyplot as plt

    from sorojax import sdf, view

    depth, middle = 20 * mm, next(iter(cases.values()))[2].shape[1] // 2
    hang = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # x is down
    colours = {"tip alone": "#D55E00", "tip and balance of forces": "#0072B2"}
    plate = view.scene_of(sdf.Box([-8 * mm, -16 * mm, 0.0], [36 * mm, 16 * mm, 4 * mm]))

    def scenes(name, frames, **limits):
        """The solid with the lines in front of it; the scale of its colours."""
        path, shapes, true, tip, lines, _ = cases[name]
        lines, front = np.reshape(lines, (2, *true.shape)), -depth / 2 - 1 * mm
        moved = jnp.stack([shapes[k] for k in frames]), jnp.zeros(len(frames))
        path = sj.replace(path, lambda x: (x.displacements, x.values), moved)
        made = view.scenes_of(path, range(len(frames)), field="stretch", rest=False, **limits)
        drawn = []
        for body, k in zip(made, frames, strict=True):
            told = [
                view.Lines(
                    [np.insert(shape[k], 1, front, axis=1)], colour, 2.2, name=f"by {name}"
                )
                for shape, (name, colour) in zip(lines[::-1], colours.items(), strict=True)
            ]
            marker = view.Dots(np.insert(tip[k], 1, front - 1 * mm)[None], "#1f2430", 6.0)
            seen = view.merge_scenes(view.extrude(body, depth), view.Scene((*told, marker)))
            drawn.append(view.merge_scenes(view.place(seen, hang), plate))
        return drawn, made[0].scale

    figure = plt.figure(figsize=(7, 6.4), dpi=200, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.35, 1))
    shown = [figure.add_subplot(place) for place in grid[0].subgridspec(1, len(cases))]
    below = [figure.add_subplot(place) for place in grid[1].subgridspec(1, len(cases))]
    for axes in below[1:]:
        axes.sharey(below[0])
        axes.tick_params(labelleft=False)
    worst = {name: int(found[-1][1, :, middle].argmax()) for name, found in cases.items()}
    for above, axes, (name, found) in zip(shown, below, cases.items(), strict=True):
        above.set_title(name, fontsize=10)
        off, way = found[-1], np.ptp(found[2][:, -1, 1]) / mm
        for row, (told, colour) in zip(off[::-1], colours.items(), strict=True):
            label = f"middle, by {told}"
            axes.plot(100 * row[:, middle] / way, color=colour, lw=1.5, label=label)
        share = 100 * off[0][:, -1] / way
        axes.plot(share, color="#8a8f98", lw=1.5, label="tip, by both")
        largest = off[:, :, middle].max(axis=1)
        for value, high, colour in zip(
            largest[::-1], (1.0, 0.89), colours.values(), strict=True
        ):
            axes.text(0.97, high, f"{value:.1f} mm", color=colour, ha="right", va="top",
                      transform=axes.transAxes, fontsize=10)  # fmt: skip
        axes.axvline(worst[name], color="0.75", lw=0.8, zorder=0)
        axes.set(xlabel="frame", ylim=(0, 24))
        axes.spines[["top", "right"]].set_visible(False)
    below[0].set_ylabel("error [% of the way of the tip]")
    lines = below[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    last = list(cases)[-1]
    film_scenes, scale = scenes(last, range(len(cases[last][1])))
    assert scale is not None
    limits = {"limits": (scale.low, scale.high)}
    solids = [scenes(name, [k], **limits)[0][0] for name, k in worst.items()]
    view.draw_into(shown, solids, view=view.Camera(-78.0, 8.0))
    figure.savefig(Path(file))
    plt.close(figure)
    moving = view.Track(np.arange(len(film_scenes)), film_scenes.__getitem__, scale, "frames")
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-78.0, 8.0)}
    title = f"A backbone told from its tip, {last}"
    film = view.animate(moving, speed=12.0, fps=12.0, size=(460, 500), title=title, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    sj.enable_low_latency()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<66} {value:.4g}")

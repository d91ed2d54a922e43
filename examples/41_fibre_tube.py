"""A rubber tube wound with fibres: under pressure it twists, by how the fibres are wound.

Twelve Kevlar threads go round the tube as one family of helices. The mesh knows nothing of
them: they are a term of the problem, tied along their centrelines. Long tubes stretch, widen
and twist evenly, which is an exact solution of finite elasticity (Rivlin, "Large elastic
deformations of isotropic materials VI", Phil. Trans. R. Soc. A 242, 1949); its three numbers
minimise the energy of the wall, of the threads and of the pressure, as in Connolly, Walsh,
Bertoldi, "Automatic design of fiber-reinforced soft actuators for trajectory matching", PNAS
114, 2017, where the threads are those of here.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, material, mesh
from sorojax.units import deg, kPa, mm

INNER, OUTER, WOUND, LENGTH = 5 * mm, 7 * mm, 6.5 * mm, 60 * mm
THREADS, AXIAL, PRESSURE = 12, 31.07e9 * np.pi * (0.089 * mm) ** 2, 20 * kPa
RUBBER = material.neo_hookean(young_modulus=300 * kPa, poisson_ratio=0.499)


def helices(angle):
    """Threads at `angle` [rad] from the axis, (threads, points, 3)."""
    height = jnp.linspace(0, LENGTH, 200)[None]
    turn = height * jnp.tan(angle) / WOUND + jnp.linspace(0, 2 * jnp.pi, THREADS + 1)[:-1, None]
    places = WOUND * jnp.cos(turn), jnp.broadcast_to(height, turn.shape), WOUND * jnp.sin(turn)
    return jnp.stack(places, axis=-1)


def tube(around: int) -> mesh.Mesh:
    corners, cuts = ([INNER, 0], [OUTER, LENGTH]), (2, around)
    wall = mesh.rectangle(*corners, divisions=cuts, element=mesh.Quad4())
    return mesh.revolve(wall, layers=around)


def pressed(cells: mesh.Mesh, angle) -> fem.Problem:
    """Held at one end, closed by a stiff cap at the other."""
    top, held = (np.asarray(cells.node_sets[side]) for side in ("top", "bottom"))
    cap, at = fem.rigid(cells, top), np.asarray(cells.points)[top]
    rim = np.hypot(at[:, 0], at[:, 2]) < 1.001 * INNER
    rim = top[rim][np.argsort(np.arctan2(at[rim, 2], at[rim, 0]))]
    apex = np.full(len(rim), cap.leaders[0])
    lid = np.stack([apex, apex, rim, np.roll(rim, -1)], axis=1)
    gas = fem.Pressure(np.concatenate([cells.facet_sets["left"], lid]), PRESSURE)
    threads = fem.embedded_rod(cells, helices(angle), axial_stiffness=AXIAL, name="threads")
    loads = threads, cap, gas
    return fem.problem(cells, RUBBER, supports=(fem.Fixed(held),), loads=loads)


def twist(problem: fem.Problem, u):
    """Of the half in the middle, scaled to the whole length [rad]; positive as the threads."""
    threads = (fem.rod_forces(problem, w, "threads").positions for w in (u, 0 * u))
    now, rest = (jnp.unwrap(jnp.arctan2(x[..., 2], x[..., 0])) for x in threads)
    quarter, last = now.shape[1] // 4, now.shape[1] - 1
    turned = (now - rest)[:, last - quarter] - (now - rest)[:, quarter]
    return jnp.mean(turned) * last / (last - 2 * quarter)


def even(angle):
    """Stretch, twist over the length [rad] and widening of the inner wall of a long tube."""
    R, weight = np.polynomial.legendre.leggauss(12)
    R, weight = (OUTER + INNER + (OUTER - INNER) * R) / 2, (OUTER - INNER) / 2 * weight

    def energy(state):
        along, turn, inner = state[0], state[1] / LENGTH, INNER * state[2]
        r, wound = (jnp.sqrt(inner**2 + (a**2 - INNER**2) / along) for a in (R, WOUND))
        first = (R / (r * along)) ** 2 + (r / R) ** 2 + along**2 + (r * turn) ** 2
        wall = jnp.sum(weight * jnp.pi * R * RUBBER.shear_modulus * (first - 3))
        slope = wound * (jnp.tan(angle) / WOUND + turn)
        stretch = jnp.cos(angle) * jnp.sqrt(along**2 + slope**2) - 1
        threads = THREADS * AXIAL / 2 * stretch**2 / jnp.cos(angle)
        return wall + threads - PRESSURE * jnp.pi * inner**2 * along

    def improved(_, state):
        move = -jnp.linalg.solve(jax.hessian(energy)(state), jax.grad(energy)(state))
        return state + move * jnp.minimum(1, 0.05 / jnp.max(jnp.abs(move)))

    return jax.lax.fori_loop(0, 60, improved, jnp.array([1.0, 0.0, 1.0]))


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    cells, angles = tube(16 if quick else 32), [30.0] if quick else [30.0, 15.0, 50.0, 70.0]
    runs = [fem.solve(pressed(cells, angle * deg)) for angle in angles]
    found = np.array([twist(run.problem, run.displacement) for run in runs]) / deg
    exact = np.asarray(jax.vmap(even)(jnp.asarray(angles) * deg))[:, 1] / deg
    slope = jax.grad(lambda a: twist(p := pressed(cells, a), fem.solve(p).displacement))
    if picture is not None:
        draw(runs[0], angles, found, Path(picture))
    numbers = {f"twist at {a:.0f} deg [deg]": w for a, w in zip(angles, found, strict=True)}
    return numbers | {
        "unknowns": runs[0].problem.space.num_dofs,
        "largest error over the largest twist": abs(found - exact).max() / abs(exact).max(),
        "twist by winding angle at 30 deg [deg/deg]": float(slope(30 * deg)),
        "the same of a long tube [deg/deg]": float(jax.grad(lambda a: even(a)[1])(30 * deg)),
    }


def draw(run, angles, found, file: Path) -> None:
    """The tube, at rest and pressed, and its twist by winding angle."""
    import matplotlib.pyplot as plt

    from sorojax import view

    def scene(run):
        """The rubber, seen through, and the threads in it; the axis of the tube upright."""
        upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        drawn = view.scene_of(run, field=None, rest=False, loads=False).parts
        skin = next(part for part in drawn if isinstance(part, view.Surface))
        wall = view.Surface(skin.points @ upright, skin.triangles, "#8fbce6", opacity=0.4)
        lines = fem.rod_forces(run.problem, run.displacement, "threads").positions
        ways = [np.asarray(line) @ upright for line in lines]
        rest, first = view.Lines(ways[1:], "#1f4e79", 1.3), view.Lines(ways[:1], "#D55E00", 1.8)
        return view.Scene((wall, rest, first))

    figure = plt.figure(figsize=(7, 3.6), dpi=200, layout="constrained")
    grid = figure.add_gridspec(1, 4, width_ratios=(1, 1, 0.1, 2.8))
    shown = [figure.add_subplot(grid[k]) for k in range(2)]
    still = sj.replace(run, lambda run: run.displacement, 0 * run.displacement)
    scenes = [scene(still), scene(run)]
    for axes, title in zip(shown, ("at rest", f"{PRESSURE / kPa:.0f} kPa"), strict=True):
        axes.set_title(title, fontsize=10)
    axes, many = figure.add_subplot(grid[3]), np.linspace(2, 80, 79)
    exact = np.asarray(jax.vmap(even)(jnp.asarray(many) * deg))[:, 1] / deg
    axes.plot(many, exact, color="#0072B2", lw=1.8)
    axes.plot(angles, found, "o", ms=5.5, color="#D55E00")
    axes.text(40, -45, "long tube, exact", color="#0072B2")
    axes.text(33, -28, "solid with embedded threads", color="#D55E00")
    axes.set(
        xlabel="angle of the threads to the axis [deg]", ylabel="twist [deg]", xlim=(0, 84)
    )
    axes.spines[["top", "right"]].set_visible(False)
    camera = view.Camera(-60.0, 12.0)
    view.draw_into(shown, scenes, view=camera)
    figure.savefig(file)
    plt.close(figure)

    rising = np.linspace(0, PRESSURE, 31)
    ways = fem.solve_path(run.problem, pressure=jnp.array(rising)).displacements
    bodies = [scene(sj.replace(run, lambda run: run.displacement, u)) for u in ways]
    moving = view.Track(rising / kPa, bodies.__getitem__, None, "kPa")
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": camera}
    speed = PRESSURE / kPa / 3
    film = view.animate(moving, speed=speed, fps=10.0, size=(300, 400), **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:46s} {number:10.4g}")

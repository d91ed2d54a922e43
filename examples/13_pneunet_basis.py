"""A PneuNet curls round a cylinder; three modes of its bending carry its backbone.

Section V-D of the Sorotoki paper: a PneuNet of 120 x 20 mm under 40 kPa, from whose motion
three modes of curvature are drawn. The cut is that of the paper's picture: 14 chambers (12 in
its text), 13 slots of 0.55 mm whose walls touch, a cylinder of 20 mm below. Changed: Dragon
Skin 30, nearly incompressible, on a layer ten times as stiff, in place of moduli of 0.2 and
5 MPa whose bulk modulus is lambda / 2; equilibria, in place of a motion that its integrator
damps. `--quick` takes the first six chambers.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import fem, material, mesh, reduction, robots, rod, sdf
from sorojax.units import deg, kPa, mm

CENTRE, RADIUS = (25 * mm, -30 * mm), 20 * mm  # of the cylinder


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    robot = robots.PneuNet(num_chambers=6 if quick else 14)
    cells, layer = robots.pneunet_mesh(robot), float(robot.layer)
    length = float(robot.length)
    stiff = np.ones(cells.num_cells)
    stiff[cells.regions["layer"]] = 10.0
    under = mesh.facets_where(cells, lambda p: p[1] < 1e-9)
    problem = fem.problem(
        cells, material.Scaled(material.presets.dragon_skin_30(), stiff),
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9)),),
        loads=(
            fem.Pressure(mesh.facets_on(cells, robot.chambers()), name="air"),
            fem.SelfContact(mesh.facets_on(cells, robot.slots()), reach=0.8 * mm, name="walls"),
            fem.Contact(under, sdf.Circle(CENTRE, RADIUS), name="cylinder"),
        ),
    )  # fmt: skip
    path = fem.solve_path(problem, air=jnp.linspace(0, 40 * kPa, 9 if quick else 21))

    line = reduction.Line([0.0, layer / 2], [length, layer / 2])
    backbone = reduction.strain_along(path, line, samples=241)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 3})
    q = reduction.coordinates(backbone, basis)
    body = rod.rod(
        sj.SE2(), basis, rod.rectangle(20 * mm, layer), length=backbone.length,
        young_modulus=1.0, poisson_ratio=0.4, density=1.0,
    )  # fmt: skip
    errors = sj.view.backbone_errors(backbone, body, q)
    s, shapes = np.asarray(backbone.s), np.asarray(basis.modes["kappa_z"](backbone.s))
    if picture is not None:
        draw(robot, path, backbone, body, q, shapes, Path(picture))

    gram = np.trapezoid(shapes[:, :, None] * shapes[:, None], s, axis=0)
    middles, half = np.asarray(robot.middles), float(robot.pitch) / 2
    inner = (s * length > middles[0] - half) & (s * length < middles[-1] + half)
    waves = shapes[inner, 0] - np.poly1d(np.polyfit(s[inner], shapes[inner, 0], 3))(s[inner])
    turn, off = jnp.trapezoid(backbone.strain[-1, :, 0], s) * length, errors.max() / mm
    last, held = path.displacements[-1], reduction.captured_energy(backbone, basis)
    return {
        "unknowns": problem.space.num_dofs,
        "turn of the tip [deg]": float(turn / deg),
        "modes off orthonormal": float(np.abs(gram - np.eye(3)).max()),
        "waves of the first mode along the chambers": int(np.abs(np.fft.rfft(waves)).argmax()),
        "curvature that three modes hold": float(held["kappa_z"]),
        "mean distance of the backbones, worst [mm]": float(off),
        "overlap with the cylinder [mm]": overlap(problem, last, "cylinder"),
        "overlap of the walls [mm]": overlap(problem, last, "walls"),
    }


def overlap(problem, u, contact: str) -> float:
    return float(fem.contact_state(problem, u, contact).penetration / mm)


def draw(robot, path, backbone, body, q, shapes, file: Path) -> None:
    """The actuator on its way round the cylinder, and the three modes above the chambers."""
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import Circle

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5.2), layout="constrained")
    solid = path.problem.mesh
    facets = np.asarray(mesh.boundary_facets(solid))[:, [0, 2, 1]]
    corners = np.asarray(solid.cells)[:, : solid.element.num_corners]
    s = jnp.linspace(0.0, 1.0, 200)
    steps, under = len(path.displacements) - 1, float(robot.layer) / 2 / mm
    left.add_patch(Circle((CENTRE[0] / mm, CENTRE[1] / mm), RADIUS / mm, color="#d9cfbd"))
    moments = (0, steps // 4, steps // 2, steps)
    for k, fill in zip(moments, ("#eef2f5", "#dce6ee", "#c3d6e4", "#94bad5"), strict=True):
        now = np.asarray(solid.points + path.displacements[k]) / mm
        left.add_collection(PolyCollection(list(now[corners]), color=fill, lw=0.3))
        left.add_collection(LineCollection(list(now[facets]), color="#2a6f97", lw=0.7))
    for k in moments:
        places = np.asarray(rod.forward_kinematics(body, q[k], s)[:, :2, 2]) / mm
        left.plot(places[:, 0], places[:, 1] + under, color="#e76f51", lw=1.6)
    left.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    left.set_title("0, 10, 20 and 40 kPa, the rod of three modes in red", fontsize=10)
    for middle in np.asarray(robot.middles):
        ends = middle + np.array([-0.5, 0.5]) * float(robot.chamber_width)
        right.axvspan(*ends / mm, color="#d9dce1")
    for k, colour in enumerate(("#2a6f97", "#e76f51", "#e9b44c")):
        right.plot(np.asarray(backbone.s * backbone.length) / mm, shapes[:, k], color=colour,
                   label=f"mode {k + 1}")  # fmt: skip
    right.set(xlabel="along the actuator [mm], chambers in grey", ylabel="curvature [-]")
    right.legend(frameon=False)
    figure.savefig(file, dpi=100)
    plt.close(figure)

    from sorojax import view

    solid = sdf.extrude(sdf.Circle(CENTRE, RADIUS), 30 * mm)
    cylinder = view.place(view.scene_of(solid), np.eye(4), "#d9cfbd")
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    bodies = view.scenes_of(path, range(steps + 1), field="von_mises", rest=False)

    def scene(k):
        return view.merge_scenes(
            view.extrude(bodies[k], 20 * mm), view.place(cylinder, upright)
        )

    moving = view.Track(np.asarray(path.values) / kPa, scene, bodies[0].scale, "kPa")
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-70.0, 18.0)}
    film = view.animate(moving, fps=7.0, title="A PneuNet curls round a cylinder", **look)
    film.save(file.with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:46s} {number:10.4g}")

"""Numbers, pictures and the report of the main job."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax import fem, material, systems, view
from sorojax.cli.demo.design import (
    DAMPING_TIME,
    DEPTH,
    LAYER_STIFFNESS,
    Design,
    LoopSensitivity,
    Reduced,
    Sensitivity,
    Tracking,
)
from sorojax.fem.equilibrium.solve import Path as FemPath
from sorojax.math.lie import homogeneous
from sorojax.mesh import chambers
from sorojax.units import kPa, mm
from sorojax.view.film.film import Film


class Results(NamedTuple):
    """Results of all stages."""

    design: Design
    path: FemPath
    slope: Sensitivity
    reduced: Reduced
    film: systems.Trajectory
    tracking: Tracking
    loop_slope: LoopSensitivity


def numbers(r: Results) -> dict[str, list[view.Number]]:
    """Tables of the report, by section."""
    N = view.Number
    rubber, problem = r.design.tensile, r.design.problem
    steps = [step for stats in r.path.stats for step in stats.steps]
    worst = max(step.residual for step in steps)
    area_error = abs(r.design.meshed_area / r.design.area - 1)
    gap = float(r.reduced.errors.max())
    u = r.path.displacements[-1]
    facets = r.design.chamber_facets
    angle = r.film["body.tip_angle"]
    return {
        "rubber": [
            N("c1", float(rubber.material.c1) / kPa, "kPa"),
            N("c2", float(rubber.material.c2) / kPa, "kPa"),
            N("c3", float(rubber.material.c3) / kPa, "kPa"),
            N("rms error of stress", rubber.rms / kPa, "kPa"),
            N("stable up to stretch", rubber.stable_stretch),
        ],
        "mesh": [
            N("triangles", problem.mesh.num_cells),
            N("unknowns", problem.space.num_dofs),
            N("area of the drawing", r.design.area * 1e6, "mm^2"),
            N("area error of the mesh", area_error, "", "< 1e-3", area_error < 1e-3),
        ],
        "equilibrium": [
            N("Newton iterations", sum(step.iterations for step in steps)),
            N("largest residual over load", worst, "", "< 1e-8", worst < 1e-8),
            N("tip rotation", np.degrees(r.slope.rotation), "deg"),
            N("chamber volume at rest", _volume(problem, 0 * u, facets), "ml"),
            N("chamber volume at the top pressure", _volume(problem, u, facets), "ml"),
        ],
        "gradient": [
            N("d rotation / d wall thickness", _deg_per_mm(r.slope, "wall_thickness"),
              "deg/mm"),
            N("difference to central differences", r.slope.error, "", "< 1e-4",
              r.slope.error < 1e-4),
            *(N(f"d rotation / d {name}", _deg_per_mm(r.slope, name), "deg/mm")
              for name in r.slope.gradient if name != "wall_thickness"),
        ],
        "loop gradient": _loop_gradient(r.loop_slope),
        "rod": [
            N("captured squared curvature", float(r.reduced.captured["kappa_z"])),
            N("largest mean backbone error", gap / mm, "mm", "< 1 mm", gap < 1 * mm),
            N("misfit of condensed stiffness", float(r.reduced.fit.stiffness_error)),
            N("misfit of volume change", float(r.reduced.fit.volume_error)),
        ],
        "loop": [
            N("duration", float(r.film.time[-1]), "s"),
            N("integration steps", r.tracking.steps),
            N("rms tracking error", np.degrees(r.tracking.rms), "deg"),
            N("tracking error at the end", np.degrees(r.tracking.final), "deg"),
            N("largest bending", float(np.degrees(jnp.max(-angle))), "deg"),
            N("largest pressure", r.tracking.peak_pressure / kPa, "kPa"),
        ],
    }  # fmt: skip


def pictures(r: Results) -> dict[str, Any]:
    """Figures and the film, by file name."""
    r_ = r.reduced
    time, film = np.asarray(r.film.time), r.film
    bending = {
        "reference": -np.degrees(film["target.value"]),
        "rod": -np.degrees(film["body.tip_angle"]),
    }
    signals = {
        "bending [deg]": bending,
        "pressure [kPa]": {
            "set-point": np.asarray(film["pid.command"]) / kPa,
            "chambers": np.asarray(film["air.pressure"]) / kPa,
        },
    }
    flow = {"mass flow [mg/s]": {"valve": 1e6 * np.asarray(film["valve.mass_flow"])}}
    points = material.presets.DRAGON_SKIN_30_POINTS
    return {
        "rubber.png": view.show(r.design.tensile, points=points),
        "deformed.png": view.show(r.path),
        "modes.png": view.show(r_.basis, length=r_.fit.length, energy=r_.captured),
        "backbones.png": view.show_backbones(
            r_.backbone, r_.rod, r_.states, pressures=r.path.values
        ),
        "loop.png": view.show_signals(time, signals | flow),
        "actuator.gif": _film(r),
    }


def _film(r: Results) -> Film:
    """The mesh on the rod, its chambers coloured by pressure, and the wanted direction."""
    mesh, actuator, film = r.design.problem.mesh, r.design.actuator, r.film
    middle = float(actuator.layer_thickness) / 2
    base = homogeneous(jnp.eye(2), jnp.array([0.0, middle]))
    skin = view.bind(mesh.points, r.reduced.rod, base=base)
    moved = jax.lax.map(lambda q: view.deform(skin, r.reduced.rod, q), film["body.q"])
    moved, angle = np.asarray(moved), np.asarray(film["target.value"])
    tip = np.asarray(film["body.tip_position"]) + np.array([0.0, middle])
    ahead = tip + 15 * mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pressure = np.asarray(film["air.pressure"]) / kPa
    scale = view.Scale("pressure [kPa]", 0.0, max(float(pressure.max()), 1e-3), colours="OrRd")
    body = view.scene_of(mesh).parts[0]
    assert isinstance(body, view.Surface)
    found = chambers(mesh)
    air = np.concatenate(
        [_fan(np.asarray(found.mesh.facet_sets[name])) for name in found.volumes]
    )

    def scene(k: int) -> view.Scene:
        solid = view.Surface(moved[k], body.triangles)
        inside = view.Surface(moved[k], air, values=np.full(len(air), pressure[k]))
        wanted = view.Lines(
            [np.stack([tip[k], ahead[k]])], dashed=True, name="wanted direction"
        )
        return view.Scene((solid, inside, wanted))

    track = view.Track(np.asarray(film.time), scene, scale)
    return view.animate(track, title="closed loop on the bending angle")


def _fan(facets: np.ndarray) -> np.ndarray:
    """Triangles over a loop of facets, as node numbers."""
    return np.column_stack([np.full(len(facets) - 2, facets[0, 0]), facets[1:-1, :2]])


def write(folder: Path, drawn: dict[str, Any], tables, seconds: dict[str, float]) -> None:
    """Pictures, `result.json` and `report.html` in `folder`."""
    files: dict[str, bytes] = {}
    for name, picture in drawn.items():
        files[name] = picture.gif if name.endswith(".gif") else picture.png
        (folder / name).write_bytes(files[name])
    result: dict[str, Any] = {
        section: {
            n.name: {"value": n.value, "unit": n.unit, "bar": n.bar, "holds": n.holds}
            for n in rows
        }
        for section, rows in tables.items()
    }
    result["seconds"] = {name: round(value, 3) for name, value in seconds.items()}
    (folder / "result.json").write_text(json.dumps(result, indent=2) + "\n")
    (folder / "report.html").write_text(_report(files, tables), encoding="utf-8")


def _report(files: dict[str, bytes], tables) -> str:
    sections = []
    for heading, key, captions in _SECTIONS:
        shown = [(caption, files[name]) for name, caption in captions.items()]
        sections.append(view.Section(heading, _TEXT[key], shown, tables[key]))
    title = "A bellows actuator, from its drawing to a closed loop"
    return view.html_report(title, sections, lead=_TEXT["lead"])


def _volume(problem, u, facets) -> float:
    return float(fem.enclosed_volume(problem, u, facets)) * 1e6


_UNITS = {
    "proportional": (kPa, "kPa/rad"),
    "integral_gain": (kPa, "kPa/(rad s)"),
    "derivative": (kPa, "kPa s/rad"),
    "feed_forward": (kPa, "kPa/rad"),
}


def _loop_gradient(slope: LoopSensitivity) -> list[view.Number]:
    rows = [
        view.Number("rms tracking error in 2 s", np.degrees(slope.rms), "deg"),
        view.Number("largest difference to central differences", slope.error, "", "< 1e-4",
                    slope.error < 1e-4),
    ]  # fmt: skip
    for name, value in slope.gradient.items():
        size, unit = _UNITS.get(name, (mm, "mm"))
        per = f"deg per {unit}"
        rows.append(view.Number(f"d error / d {name}", float(np.degrees(value)) * size, per))
    return rows


def _deg_per_mm(slope: Sensitivity, name: str) -> float:
    return float(np.degrees(slope.gradient[name])) * mm


_SECTIONS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("Closed loop", "loop", {
        "actuator.gif": "The rod model, dressed in the mesh, in real time.",
        "loop.png": "Bending, chamber pressure and mass flow.",
    }),
    ("Equilibrium under pressure", "equilibrium", {
        "deformed.png": "Deformed cross-sections, coloured by stress.",
    }),
    ("Gradient", "gradient", {}),
    ("Gradient of the closed loop", "loop gradient", {}),
    ("Strain modes and rod", "rod", {
        "modes.png": "Curvature modes of the snapshots.",
        "backbones.png": "Backbones of solid and rod, and their distance.",
    }),
    ("Mesh", "mesh", {}),
    ("Rubber", "rubber", {"rubber.png": "Measured points and fitted curve."}),
)  # fmt: skip
_TEXT = {
    "lead": (
        "One run of sorojax demo: a cross-section drawn as a signed distance, meshed, "
        "pressurised, reduced to a rod with three bending modes, and controlled through a "
        "pneumatic regulator. Every number below was computed in this run."
    ),
    "rubber": (
        "Yeoh coefficients by least squares on four quoted points of Dragon Skin 30 (L. "
        "Marechal et al., Soft Robotics 8, 2021, doi:10.1089/soro.2019.0115; one specimen, "
        "one rate). The bulk modulus is that of a small-strain Poisson ratio of 0.49."
    ),
    "mesh": (
        "Quadratic triangles with curved sides on the zero set of the drawing; the upper "
        f"edge of the layer, {LAYER_STIFFNESS:g} times stiffer than the rubber, is meshed too."
    ),
    "equilibrium": (
        f"Plane strain, {DEPTH / mm:g} mm deep, clamped at the left end, follower pressure in "
        "the chambers. A step is accepted only when its unbalanced force has vanished."
    ),
    "gradient": (
        "Derivative of the rotation of the free end at the top pressure in every dimension "
        "of the drawing, by reverse mode through mesh motion and equilibrium: one adjoint "
        "solve for all of them. The wall thickness is checked by central differences."
    ),
    "loop gradient": (
        "Derivative of the root mean square of the tracking error, in a run of 2 s, in every "
        "dimension of the drawing and every gain, by reverse mode through the whole chain: "
        "mesh motion, equilibria, strain modes, laws of the rod and the closed loop. The wall "
        "thickness and the integral gain are checked by central differences."
    ),
    "rod": (
        "The curvature of the middle of the layer at every pressure gives the modes; the "
        "stiffness that the solid opposes to them, its equilibria and its chamber volume "
        "give the elastic law and the pressure map. The error is that of the rod's own "
        "equilibrium at each pressure."
    ),
    "loop": (
        "A PID on the bending angle commands a PI pressure regulator that feeds the "
        "chambers; gas, chamber walls and rod exchange energy through one potential. The "
        f"retardation time of the rubber, {DAMPING_TIME * 1e3:g} ms, is an assumption. No "
        "gravity: the actuator moves in a horizontal plane."
    ),
}

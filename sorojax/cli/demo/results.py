"""Numbers, pictures and the report of the main job."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem, material, view
from sorojax._jax.jit import once
from sorojax.cli.demo.design import (
    DAMPING_TIME,
    DEPTH,
    DIMENSIONS,
    LAYER_STIFFNESS,
    Bent,
    Design,
    Sensitivity,
    Tracking,
)
from sorojax.design.closed_loop import Trajectory
from sorojax.math.lie import homogeneous
from sorojax.mesh import chambers
from sorojax.reduction import captured_energy
from sorojax.rod import Rod
from sorojax.units import kPa, mm
from sorojax.view.film.film import Film


class Results(NamedTuple):
    """Results of all stages."""

    design: Design
    run: Trajectory
    slopes: dict[str, Sensitivity]
    tracking: Tracking
    beside: Bent


def numbers(r: Results) -> dict[str, list[view.Number]]:
    """Tables of the report, by section."""
    N = view.Number
    rubber, problem = r.design.tensile, r.design.problem
    path, fit, modes, backbone = r.run.path, r.run.fit, r.run.basis, r.run.backbone
    assert path is not None and fit is not None
    assert modes is not None and backbone is not None
    steps = [step for stats in path.stats for step in stats.steps]
    worst = max(step.residual for step in steps)
    area_error = abs(r.design.meshed_area / r.design.area - 1)
    gap = float(r.beside.errors.max())
    captured = float(captured_energy(backbone, modes)["kappa_z"])
    turn, loop = r.slopes["rotation"], r.slopes["rms"]
    u = path.displacements[-1]
    facets = r.design.chamber_facets
    angle = r.run["body.tip_angle"]
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
            N("tip rotation", np.degrees(turn.value), "deg"),
            N("chamber volume at rest", _volume(problem, 0 * u, facets), "ml"),
            N("chamber volume at the top pressure", _volume(problem, u, facets), "ml"),
        ],
        "gradient": [
            _off(turn),
            *(N(f"d rotation / d {name}", np.degrees(turn.gradient[name]) * mm, "deg/mm")
              for name in DIMENSIONS),
        ],
        "loop gradient": _loop_gradient(loop),
        "rod": [
            N("captured squared curvature", captured),
            N("largest mean backbone error", gap / mm, "mm", "< 1 mm", gap < 1 * mm),
            N("misfit of condensed stiffness", float(fit.stiffness_error)),
            N("misfit of volume change", float(fit.volume_error)),
        ],
        "loop": [
            N("duration", float(r.run.time[-1]), "s"),
            N("integration steps", r.tracking.steps),
            N("rms tracking error", np.degrees(r.tracking.rms), "deg"),
            N("tracking error at the end", np.degrees(r.tracking.final), "deg"),
            N("largest bending", float(np.degrees(jnp.max(-angle))), "deg"),
            N("largest pressure", r.tracking.peak_pressure / kPa, "kPa"),
        ],
    }  # fmt: skip


def pictures(r: Results) -> dict[str, Any]:
    """Figures and the film, by file name."""
    run, time = r.run, np.asarray(r.run.time)
    assert run.path is not None and run.backbone is not None
    assert run.basis is not None and run.fit is not None and run.rod is not None
    bending = {
        "reference": -np.degrees(run["target.value"]),
        "rod": -np.degrees(run["body.tip_angle"]),
    }
    signals = {
        "bending [deg]": bending,
        "pressure [kPa]": {
            "set-point": np.asarray(run["pid.command"]) / kPa,
            "chambers": np.asarray(run["air.pressure"]) / kPa,
        },
    }
    flow = {"mass flow [mg/s]": {"valve": 1e6 * np.asarray(run["valve.mass_flow"])}}
    points = material.presets.DRAGON_SKIN_30_POINTS
    return {
        "rubber.png": view.show(r.design.tensile, points=points),
        "deformed.png": view.show(run.path),
        "modes.png": view.show(
            run.basis, length=run.fit.length, energy=captured_energy(run.backbone, run.basis)
        ),
        "backbones.png": view.show_backbones(
            run.backbone, run.rod, r.beside.states, pressures=run.path.values
        ),
        "loop.png": view.show_signals(time, signals | flow),
        "actuator.gif": _film(r),
    }


def _film(r: Results) -> Film:
    """The mesh on the rod, its chambers coloured by pressure, and the wanted direction."""
    mesh, actuator, run = r.design.problem.mesh, r.design.actuator, r.run
    assert run.rod is not None
    middle = float(actuator.layer_thickness) / 2
    base = homogeneous(jnp.eye(2), jnp.array([0.0, middle]))
    skin = view.bind(mesh.points, run.rod, base=base)
    moved = np.asarray(_moved(skin, run.rod, run["body.q"]))
    angle = np.asarray(run["target.value"])
    tip = np.asarray(run["body.tip_position"]) + np.array([0.0, middle])
    ahead = tip + 15 * mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pressure = np.asarray(run["air.pressure"]) / kPa
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

    track = view.Track(np.asarray(run.time), scene, scale)
    return view.animate(track, title="closed loop on the bending angle")


@once
def _moved(skin, rod: Rod, qs: Float[Array, "frames dof"]):
    return jax.lax.map(lambda q: view.deform(skin, rod, q), qs)


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


def _off(slope: Sensitivity) -> view.Number:
    name, off = "difference to a central difference", slope.error
    return view.Number(name, off, "", "< 1e-4", off < 1e-4)


def _loop_gradient(slope: Sensitivity) -> list[view.Number]:
    rows = [view.Number("rms tracking error", np.degrees(slope.value), "deg"), _off(slope)]
    for name, value in slope.gradient.items():
        size, unit = _UNITS.get(name, (mm, "mm"))
        per = f"deg per {unit}"
        rows.append(view.Number(f"d error / d {name}", float(np.degrees(value)) * size, per))
    return rows


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
        "of the drawing, by reverse mode through mesh motion and equilibria. It is checked by "
        "a central difference along a change of all dimensions at once."
    ),
    "loop gradient": (
        "Derivative of the root mean square of the tracking error in every dimension of the "
        "drawing and every gain, by reverse mode through the whole chain: mesh motion, "
        "equilibria, strain modes, laws of the rod and the closed loop. It is checked by "
        "a central difference along a change of all dimensions and gains at once."
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

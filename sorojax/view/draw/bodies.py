"""Deformed bodies: equilibria, load paths, motions and vibration modes.

Values to colour a body by: fields known by name, functions and arrays.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import fem
from sorojax._jax.jit import once
from sorojax.design.optimise.shape_loop import OptimisedShape
from sorojax.fem import Problem
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.stability.buckling import CriticalLoads
from sorojax.fem.stability.continuation import CriticalPoint
from sorojax.fem.stability.modal import Modes
from sorojax.mesh import cell_areas, cell_volumes
from sorojax.view import style
from sorojax.view.draw.loads import load_parts, support_parts, unit_of, wall_parts
from sorojax.view.draw.meshes import Body
from sorojax.view.picture import Picture, panels, spread
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import (
    Coloured,
    Part,
    Scale,
    Scene,
    Surface,
    joint_extent,
    readable,
    robust_scale,
    short,
)

NodalField = Callable[[Problem, Float[Array, "nodes dim"]], Float[Array, " nodes"]]
States = Sequence[int] | Int[Any, " states"] | None
Field = str | NodalField | Float[Any, " values"] | None


@once
def _nodal_von_mises(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, " nodes"]:
    """Von Mises stress at the nodes, averaged between cells [kPa]."""
    return fem.nodal_average(problem, fem.von_mises_stress(problem, u)) / 1e3


@once
def _mean_stress(problem: Problem, u) -> Float[Array, " nodes"]:
    sigma = fem.cauchy_stress(problem, u)
    return fem.nodal_average(problem, jnp.trace(sigma, axis1=-2, axis2=-1) / 3)


@once
def _largest_stretch(problem: Problem, u) -> Float[Array, " nodes"]:
    F = fem.deformation_gradient(problem, u)
    C = jnp.swapaxes(F, -1, -2) @ F
    return fem.nodal_average(problem, jnp.sqrt(jnp.linalg.eigvalsh(C)[..., -1]))


def _energy_density(problem: Problem, u) -> Float[np.ndarray, " cells"]:
    mesh = problem.mesh
    size = cell_areas(mesh) if mesh.element.dim == 2 else cell_volumes(mesh)
    depth = getattr(problem.kinematics, "thickness", 1.0)
    return np.asarray(fem.strain_energy(problem, u)) / np.asarray(size * depth)


_NAMED: dict[str, tuple[str, str, Callable[..., Any]]] = {
    "von_mises": ("von Mises stress", "Pa", lambda p, u: 1e3 * _nodal_von_mises(p, u)),
    "pressure": ("mean stress", "Pa", _mean_stress),
    "displacement": ("displacement", "m", lambda p, u: jnp.sqrt(jnp.sum(u**2, axis=1))),
    "x": ("displacement along x", "m", lambda p, u: u[:, 0]),
    "y": ("displacement along y", "m", lambda p, u: u[:, 1]),
    "z": ("displacement along z", "m", lambda p, u: u[:, 2]),
    "stretch": ("largest stretch", "-", _largest_stretch),
    "energy": ("strain energy density", "J/m^3", _energy_density),
}


def evaluate(
    problem: Problem, u: Float[Array, "nodes dim"], field: Field, label: str = ""
) -> Coloured | None:
    """The field of a body at displacement `u` [m].

    Args:
        problem: The body.
        u: Displacement of its nodes.
        field: "von_mises", "pressure" (mean stress, tension positive), "displacement", "x",
            "y", "z", "stretch", "energy"; `field(problem, u)` or an array, one value per
            node or per cell; None for no field.
        label: Name and unit of a function or an array.

    Raises:
        ValueError: If there is no field of that name.
    """
    if field is None:
        return None
    if isinstance(field, str):
        if field not in _NAMED:
            raise ValueError(
                f"view: got field={field!r}, need one of {', '.join(_NAMED)}, a function of "
                "(problem, u), or an array."
            )
        name, unit, function = _NAMED[field]
        return Coloured(np.asarray(function(problem, u)), label or name, "" if label else unit)
    values = field(problem, u) if callable(field) else field
    return Coloured(np.asarray(values), label, "")


# Deformed bodies: equilibria, load paths, motions and vibration modes


_CLEAR = 0.4  # opacity of a body whose walls under pressure are seen through it


def problem_scene(problem: Problem, *, title: str = "") -> Scene:
    """The body at rest with its cells, supports and loads."""
    still = np.zeros(problem.mesh.points.shape)
    mesh, points, body = problem.mesh, np.asarray(problem.mesh.points), Body(problem.mesh)
    walls = wall_parts(problem, points) if mesh.element.dim == 3 else []
    clear = _CLEAR if walls else 1.0
    skin = Surface(points, body.shell.triangles, wire=body.shell.wire, opacity=clear)
    parts: list[Part] = [*walls, skin, body.edges(points, style.INK, 0.9)]
    parts += support_parts(problem, still) + load_parts(problem, still)
    name = f"{mesh.num_cells} cells {mesh.element.name}, {problem.space.num_dofs} unknowns"
    return Scene(tuple(parts), title=title or name)


def solution_scene(
    solution: Any,
    *,
    field: Field = "von_mises",
    label: str = "",
    limits: tuple[float, float] | None = None,
    rest: bool = True,
    loads: bool = True,
    wire: bool = False,
    title: str = "",
) -> Scene:
    """An equilibrium: the deformed body, its outline at rest, supports and loads.

    Args:
        solution: From `fem.solve`.
        field: What colours it: a name ("von_mises", "pressure", "displacement", "stretch",
            "energy"), a function of (problem, u), an array per node or cell, or None.
        label: Name and unit of a function or an array.
        limits: Ends of the colour scale, in the unit that the bar shows.
        rest: Draw the outline of the body at rest.
        loads: Draw supports and loads.
        wire: Draw the cells.
        title: Title of the figure.
    """
    u = np.asarray(solution.displacement)
    look = {"field": field, "label": label, "limits": limits, "rest": rest, "wire": wire}
    scene_at, _ = body_scenes([solution.problem], [u], loads=loads, **look)
    return replace(scene_at(0), title=title)


def show_path(
    path: Any,
    *,
    states: Sequence[int] | None = None,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
    **options: Any,
) -> Picture:
    """States along a load path, a continuation or a motion, one panel each, on one scale.

    Args:
        path: From `fem.solve_path`, `fem.volume_path`, `fem.continuation` or `fem.simulate`.
        states: Which of them; up to six, evenly spaced, if omitted.
        view: Camera of a solid body.
        renderer: Of a solid body.
        title: Title of the figure.
        **options: As of a solution; supports and loads are left out.
    """
    chosen = chosen_states("view.show", len(path), states)
    names = [state_name(path, k) for k in chosen]
    scenes = scenes_of(path, chosen, **options)
    return panels(scenes, names, view=view, renderer=renderer, title=title)


def scenes_of(path: Any, states: States = None, **options: Any) -> list[Scene]:
    """States along a load path, a continuation or a motion as scenes, on one scale.

    Args:
        path: From `fem.solve_path`, `fem.volume_path`, `fem.continuation` or `fem.simulate`.
        states: Which of them; up to six, evenly spaced, if omitted.
        **options: As of a solution (`view.options(solution)`); supports and loads are left
            out.

    Returns:
        One scene per state, all with the box and the colour scale of all.

    Raises:
        ValueError: If the path has no such state.

    Example:
        `view.draw_into(axes, [view.extrude(s, 20 * mm) for s in view.scenes_of(motion)])`
    """
    chosen = chosen_states("view.scenes_of", len(path), states)
    moved = np.asarray(path.displacements)[chosen]
    options = {"loads": False} | options
    scene_at, _ = body_scenes(problems_of(path, chosen), moved, **options)
    return joint_extent([scene_at(k) for k in range(len(chosen))])


def show_vibration(
    modes: Modes,
    *,
    share: float = 0.12,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """Mode shapes, drawn with a largest displacement of `share` of the body, and their
    frequencies."""
    base = np.asarray(modes.problem.mesh.points) + np.asarray(modes.displacement)
    body = Body(modes.problem.mesh)
    scenes = [body.mode(base, shape, share) for shape in np.asarray(modes.shapes)]
    names = [f"mode {k + 1}: {_frequency(modes, k)}" for k in range(len(scenes))]
    return panels(joint_extent(scenes), names, view=view, renderer=renderer, title=title)


def show_buckling(
    found: CriticalLoads | CriticalPoint,
    *,
    problem: Problem,
    share: float = 0.12,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """The modes in which a body buckles, with their load factors.

    Args:
        found: From `fem.critical_loads`, or a point of a `fem.continuation`.
        problem: The body.
        share: Largest displacement of a mode, of the size of the body.
        view: Camera of a solid body.
        renderer: Of a solid body.
        title: Title of the figure.
    """
    base, body = np.asarray(problem.mesh.points), Body(problem.mesh)
    if isinstance(found, CriticalPoint):
        base, shapes = base + np.asarray(found.displacement), np.asarray(found.shape)[None]
        names = [f"{found.kind} at load factor {float(found.factor):.4g}"]
    else:
        shapes = np.asarray(found.shapes)
        names = [
            f"mode {k + 1}: load factor {f:.4g}"
            for k, f in enumerate(np.asarray(found.factors))
        ]
    if not len(shapes):
        raise ValueError(
            "view.show: there is no critical load ahead of the state. Ask for more modes, or "
            "turn the load round."
        )
    scenes = [body.mode(base, shape, share) for shape in shapes]
    return panels(joint_extent(scenes), names, view=view, renderer=renderer, title=title)


def optimised_shape_scene(found: OptimisedShape, *, title: str = "") -> Scene:
    """The body with the best dimensions; `found.optimised` has the history."""
    steps = len(np.asarray(found.optimised.history["objective"]))
    text = f"objective {float(found.objective):.4g} after {steps} steps"
    return problem_scene(found.problem, title=title or text)


def body_scenes(
    problems: Sequence[Problem],
    moved: Float[np.ndarray, "states nodes dim"] | Sequence[np.ndarray],
    *,
    field: Field = "von_mises",
    label: str = "",
    limits: tuple[float, float] | None = None,
    rest: bool = True,
    loads: bool = True,
    wire: bool = False,
) -> tuple[Callable[[int], Scene], Scale | None]:
    """The scene of each state of a body, made when it is asked for, and the scale of colours
    of all."""
    body, points = Body(problems[0].mesh), np.asarray(problems[0].mesh.points)
    rows = [
        evaluate(p, jnp.asarray(u), field, label) for p, u in zip(problems, moved, strict=True)
    ]
    found = [row for row in rows if row is not None]
    scale, values = coloured(found, limits) if found else (None, [None] * len(rows))

    def scene(k: int) -> Scene:
        problem, u = problems[k], moved[k]
        parts = body.parts(points + u, values[k], rest=points if rest else None, wire=wire)
        if loads:
            parts += support_parts(problem, u) + load_parts(problem, u)
        return Scene(tuple(parts), scale)

    return scene, scale


def coloured(
    rows: list[Coloured], limits: tuple[float, float] | None = None
) -> tuple[Scale, list[np.ndarray]]:
    """The values of all states in a readable unit, and the scale that they share."""
    values, label = readable(rows)
    return robust_scale(label, values, limits=limits), values


def chosen_states(where: str, count: int, states: States) -> list[int]:
    """States to draw: those asked for, or up to six."""
    if not count:
        raise ValueError(f"{where}: the path has no state. Look at its status.")
    if states is None:
        return spread(count, 7)[-6:]
    states = [int(k) for k in states]
    wrong = [k for k in states if not -count <= k < count]
    if wrong or not states:
        raise ValueError(
            f"{where}: `states` is {states}, there are states 0 to {count - 1}. Choose "
            "one or more of them."
        )
    return [k % count for k in states]


def problems_of(path: Any, states: Sequence[int]) -> list[Problem]:
    """The problems of states of a path, with their loads, or of a motion."""
    return [path.problem_at(k) if isinstance(path, Path) else path.problem for k in states]


def state_name(path: Any, k: int) -> str:
    """The label of a state: its load, its factor or its time."""
    if isinstance(path, fem.Trajectory):
        return f"{float(path.time[k]):.4g} s"
    if path.pressures is not None:
        pressure = short(float(path.pressures[k]), "Pa")
        return f"{1e6 * float(path.values[k]):.4g} ml at {pressure}"
    name = getattr(path, "name", None)
    value = np.asarray(path.values[k])
    if name is None:
        return f"load factor {float(value):.3g}"
    load = next(load for load in path.problem.loads if load.name == name)
    unit = unit_of(load)
    if value.ndim:
        return f"|{name}| = {short(float(np.linalg.norm(value)), unit)}"
    if isinstance(load, fem.Pressure):
        return short(float(value), unit)
    return f"{name} = {short(float(value), unit)}"


def _frequency(modes: Modes, k: int) -> str:
    return f"{float(modes.frequencies[k]):.4g} Hz"

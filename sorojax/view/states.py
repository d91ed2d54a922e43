"""Deformed bodies: equilibria, load paths, motions and vibration modes."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.fem import Modes, Problem
from sorojax.view import style
from sorojax.view.camera import View
from sorojax.view.fields import Field, evaluate
from sorojax.view.load_marks import wall_parts
from sorojax.view.loads import load_parts, support_parts
from sorojax.view.meshes import edge_lines
from sorojax.view.panels import panels
from sorojax.view.picture import Picture
from sorojax.view.quantity import Coloured, readable, short
from sorojax.view.scene import Part, Scale, Scene, Surface, joint_extent, robust_scale
from sorojax.view.shell import Shell, on_triangles, shell
from sorojax.view.stage import show_scene

_UNITS = {
    fem.Pressure: "Pa", fem.Traction: "Pa", fem.Force: "N", fem.Tendon: "N", fem.Cable: "m",
    fem.Gravity: "m/s$^2$", fem.Contact: "m", fem.Torque: "N m", fem.Spring: "m",
}  # fmt: skip
_CLEAR = 0.4  # opacity of a body whose walls under pressure are seen through it


def show_problem(problem: Problem, *, view: View = "iso", renderer: str = "auto",
                 title: str = "") -> Picture:  # fmt: skip
    """The body at rest with its cells, supports and loads."""
    return show_scene(problem_scene(problem, title), view=view, renderer=renderer)


def problem_scene(problem: Problem, title: str = "") -> Scene:
    """As `show_problem`, before it is drawn."""
    still = np.zeros(problem.mesh.points.shape)
    mesh, points = problem.mesh, np.asarray(problem.mesh.points)
    seen = shell(mesh)
    walls = wall_parts(problem, points) if mesh.element.dim == 3 else []
    clear = _CLEAR if walls else 1.0
    parts: list[Part] = [
        *walls, Surface(points, seen.triangles, wire=seen.wire, opacity=clear)
    ]  # fmt: skip
    parts += [edge_lines(mesh, points, colour=style.INK, width=0.9)]
    parts += support_parts(problem, still) + load_parts(problem, still)
    name = f"{mesh.num_cells} cells {mesh.element.name}, {problem.space.num_dofs} unknowns"
    return Scene(tuple(parts), title=title or name)


def show_solution(
    solution: Any,
    *,
    field: Field = "von_mises",
    label: str = "",
    limits: tuple[float, float] | None = None,
    rest: bool = True,
    loads: bool = True,
    wire: bool = False,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
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
        view: Camera of a solid body.
        renderer: Of a solid body.
        title: Title of the figure.
    """
    scene = solution_scene(
        solution, title, field=field, label=label, limits=limits, rest=rest, loads=loads,
        wire=wire,
    )  # fmt: skip
    return show_scene(scene, view=view, renderer=renderer)


def solution_scene(solution: Any, title: str = "", **options: Any) -> Scene:
    """As `show_solution`, before it is drawn."""
    u = np.asarray(solution.displacement)
    (scene,) = body_scenes([solution.problem], [u], **options)
    return replace(scene, title=title)


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
        **options: As of `show_solution`; supports and loads are left out.
    """
    chosen = chosen_states("view.show", len(path), states)
    moved = np.asarray(path.displacements)
    problems = [problem_at(path, k) for k in chosen]
    options = {"loads": False} | options
    scenes = joint_extent(body_scenes(problems, [moved[k] for k in chosen], **options))
    names = [state_name(path, k) for k in chosen]
    return panels(scenes, names, view=view, renderer=renderer, title=title)


def show_vibration(
    modes: Modes, *, share: float = 0.12, view: View = "iso", renderer: str = "auto",
    title: str = "",
) -> Picture:  # fmt: skip
    """Mode shapes, drawn with a largest displacement of `share` of the body, and their
    frequencies."""
    mesh, base = modes.problem.mesh, np.asarray(modes.displacement)
    points = np.asarray(mesh.points)
    size = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    seen = shell(mesh)
    scenes, names = [], []
    scale = Scale("amplitude [-]", 0.0, 1.0)
    for k, shape in enumerate(np.asarray(modes.shapes)):
        length = np.linalg.norm(shape, axis=1)
        drawn = points + base + shape * (share * size / length.max())
        parts: list[Part] = [edge_lines(mesh, points + base, colour=style.GREY, width=0.8)]
        parts.append(Surface(drawn, seen.triangles, values=length / length.max()))
        parts.append(edge_lines(mesh, drawn, colour=style.INK, width=0.7))
        scenes.append(Scene(tuple(parts), scale))
        names.append(f"mode {k + 1}: {_frequency(modes, k)}")
    return panels(joint_extent(scenes), names, view=view, renderer=renderer, title=title)


def body_scenes(
    problems: Sequence[Problem],
    moved: Sequence[Float[np.ndarray, "nodes dim"]],
    *,
    field: Field = "von_mises",
    label: str = "",
    limits: tuple[float, float] | None = None,
    rest: bool = True,
    loads: bool = True,
    wire: bool = False,
) -> list[Scene]:
    """One scene per state of a body, on one scale of colours."""
    mesh = problems[0].mesh
    seen, points = shell(mesh), np.asarray(mesh.points)
    rows = [
        evaluate(p, jnp.asarray(u), field, label) for p, u in zip(problems, moved, strict=True)
    ]
    found = [row for row in rows if row is not None]
    scale, values = coloured(found, limits) if found else (None, [None] * len(rows))
    scenes = []
    for problem, u, value in zip(problems, moved, values, strict=True):
        parts = _body(problem, points + u, seen, value, wire)
        if rest:
            parts.insert(0, edge_lines(mesh, points, colour=style.GREY, width=0.8))
        if loads:
            parts += support_parts(problem, u) + load_parts(problem, u)
        scenes.append(Scene(tuple(parts), scale))
    return scenes


def coloured(
    rows: list[Coloured], limits: tuple[float, float] | None
) -> tuple[Scale, list[np.ndarray]]:
    """The values of all states in a readable unit, and the scale that they share."""
    values, label = readable(rows)
    return robust_scale(label, values, limits=limits), values


def _body(problem: Problem, points, seen: Shell, value, wire: bool) -> list[Part]:
    mesh = problem.mesh
    on = None if value is None else on_triangles(mesh, seen, value)[0]
    body = Surface(points, seen.triangles, values=on, wire=seen.wire if wire else None)
    return [body, edge_lines(mesh, points, colour=style.INK, width=0.7)]


def chosen_states(where: str, count: int, states: Sequence[int] | None) -> list[int]:
    """States to draw: those asked for, or up to six."""
    if not count:
        raise ValueError(f"{where}: the path has no state. Look at its status.")
    if states is None:
        return np.unique(np.round(np.linspace(0, count - 1, 7)).astype(int))[-6:].tolist()
    wrong = [k for k in states if not -count <= k < count]
    if wrong or not states:
        raise ValueError(
            f"{where}: `states` is {list(states)}, there are states 0 to {count - 1}. Choose "
            "one or more of them."
        )
    return [k % count for k in states]


def problem_at(path: Any, k: int) -> Problem:
    """The problem with the load of state `k` of a path."""
    if isinstance(path, fem.VolumePath):
        return fem.with_load(path.problem, path.name, path.pressures[k])
    if isinstance(path, fem.Path) or (getattr(path, "name", None) is not None):
        return fem.with_load(path.problem, path.name, path.values[k])
    return path.problem


def state_name(path: Any, k: int) -> str:
    """What tells a state from the others: its load, its factor or its time."""
    if isinstance(path, fem.Motion):
        return f"{float(path.times[k]):.4g} s"
    if isinstance(path, fem.VolumePath):
        pressure = short(float(path.pressures[k]), "Pa")
        return f"{1e6 * float(path.volumes[k]):.4g} ml at {pressure}"
    name = getattr(path, "name", None)
    value = np.asarray(path.values[k])
    if name is None:
        return f"load factor {float(value):.3g}"
    load = next(load for load in path.problem.loads if load.name == name)
    unit = next((u for kind, u in _UNITS.items() if isinstance(load, kind)), "")
    if value.ndim:
        return f"|{name}| = {short(float(np.linalg.norm(value)), unit)}"
    if isinstance(load, fem.Pressure):
        return short(float(value), unit)
    return f"{name} = {short(float(value), unit)}"


def _frequency(modes: Modes, k: int) -> str:
    return f"{float(modes.frequencies[k]):.4g} Hz"

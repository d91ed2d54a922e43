"""Results over time, steps and designs: signals, histories, densities."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.design import History
from sorojax.design.optimise.minimise import Optimised
from sorojax.mesh import Mesh
from sorojax.systems import AbstractBlock, Trajectory
from sorojax.view import style
from sorojax.view.draw.meshes import mesh_scene
from sorojax.view.draw.plots import show_signals
from sorojax.view.picture import Picture, panels, plotted, spread
from sorojax.view.raster.scene import Scale, Scene, Surface

_MOST = 8  # lines in one panel
_SHOWN: dict[str, tuple[float, str]] = {
    "Pa": (1e-3, "kPa"), "m": (1e3, "mm"), "m^3": (1e6, "ml"), "m^3/s": (1e6, "ml/s"),
    "rad": (180 / np.pi, "deg"), "rad/s": (180 / np.pi, "deg/s"), "kg/s": (1e6, "mg/s"),
    "m^3/Pa": (1e9, "ml/kPa"),
}  # fmt: skip


def show_trajectory(
    film: Trajectory,
    *,
    network: AbstractBlock | None = None,
    names: Sequence[str] | None = None,
    references: Mapping[str, str] | None = None,
    title: str = "",
) -> Picture:
    """Outputs over time: one panel per unit if the network is given, else per output.

    Args:
        film: From `systems.simulate`.
        network: What was simulated: it knows the units.
        names: Outputs to draw, "block.output"; all numbers and short vectors if omitted.
        references: Measured or wanted signals to draw dashed, {output: output}.
        title: Title of the figure.
    """
    known = dict(film.outputs)
    wrong = [name for name in names or () if name not in known]
    if wrong:
        raise ValueError(
            f"view.show: there is no output {wrong[0]!r}, need some of {', '.join(known)}."
        )
    units = {} if network is None else {k: port.unit for k, port in network.outputs.items()}
    chosen = list(names) if names else [k for k in known if _is_drawn(known[k])]
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name in chosen:
        unit = units.get(name)
        factor, shown = _SHOWN.get(unit or "", (1.0, unit or ""))
        quantity = name.split(".", 1)[-1].replace("_", " ")
        label = f"[{shown}]" if shown and unit else quantity
        lines = groups.setdefault(label, {})
        for part, values in _components(name, np.asarray(known[name])):
            lines[part] = factor * values
    for target, source in (references or {}).items():
        for lines in groups.values():
            if target in lines:
                factor = _SHOWN.get(units.get(target) or "", (1.0, ""))[0]
                lines[f"{source} (reference)"] = factor * np.asarray(known[source])
    if not groups:
        raise ValueError(
            "view.show: the trajectory has no output that is a number or a short vector. Pass "
            "names= or draw its state yourself."
        )
    note = _ended(film)
    title = f"{title} ({note})" if title and note else title or note
    return show_signals(film.time, _named(groups), title=title)


def _is_drawn(values: Any) -> bool:
    shape = np.shape(values)
    return len(shape) == 1 or (len(shape) == 2 and shape[1] <= _MOST)


def _components(name: str, values: np.ndarray):
    if values.ndim == 1:
        yield name, values
        return
    flat = values.reshape(len(values), -1)[:, :_MOST]
    for k in range(flat.shape[1]):
        yield f"{name}[{k}]", flat[:, k]


def _named(groups: Mapping[str, dict[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """Panels with the quantity before the unit where all of it is one."""
    found = {}
    for label, lines in groups.items():
        kinds = {name.split(".", 1)[-1].split("[")[0].split(" (")[0] for name in lines}
        same = label.startswith("[") and len(kinds) == 1
        found[f"{kinds.pop().replace('_', ' ')} {label}" if same else label] = lines
    return found


def _ended(film: Trajectory) -> str:
    from sorojax.math.status import Status

    if bool(np.all(np.asarray(film.status == Status.successful))):
        return ""
    return f"stopped after {float(film.stats['reached']):.4g} s"


def show_rollout(film: Any, *, title: str = "") -> Picture:
    """Coordinates of a rod and their rates over time."""
    q, v = np.asarray(film.q), np.asarray(film.v)
    groups = {
        "coordinates": {f"q[{k}]": q[:, k] for k in range(min(q.shape[1], _MOST))},
        "rates [1/s]": {f"v[{k}]": v[:, k] for k in range(min(v.shape[1], _MOST))},
    }
    return show_signals(film.time, groups, title=title)


def show_optimised(
    result: Optimised,
    *,
    mesh: Mesh | None = None,
    densities: Any = None,
    title: str = "",
) -> Picture:
    """How the objective, the constraints and the change of the design went.

    Args:
        result: From `design.minimise`.
        mesh: Cells whose densities the design is: they are drawn instead.
        densities: Snapshots (steps, cells) to draw beside the last, as kept by `on_step`.
        title: Title of the figure.
    """
    if mesh is not None:
        rows = np.asarray(result.design)[None] if densities is None else np.asarray(densities)
        return show_densities(mesh, rows, title=title)
    step = 1 + np.arange(len(result.history["objective"]))
    names = ["objective", "constraints", "change"]
    held = np.asarray(result.history["constraints"]).reshape(len(step), -1)
    if not held.shape[1]:
        names.remove("constraints")
    figure = style.new_figure(8.0, 0.6 + 1.8 * len(names))
    axes = style.grid(figure, len(names), 1, sharex=True)
    for panel, name in zip(axes, names, strict=True):
        rows = np.asarray(result.history[name]).reshape(len(step), -1)
        for k in range(min(rows.shape[1], _MOST)):
            label = f"constraint {k}" if name == "constraints" else None
            panel.plot(step, rows[:, k], color=style.COLOURS[k % 6], lw=1.7, label=label)
        if name == "constraints":
            panel.axhline(0.0, color=style.INK, lw=0.9, ls=style.DASHES)
        if name == "change" and np.all(rows > 0):
            panel.set_yscale("log")
        style.dress(panel, "", {"change": "largest change"}.get(name, name))
        if rows.shape[1] > 1:
            style.legend(panel, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes[-1].set_xlabel("step", fontsize=style.LABEL, color=style.INK)
    figure.align_ylabels(axes)
    last = f"objective {float(result.objective):.4g} after {len(step)} steps"
    return plotted(figure, axes, title or last)


def show_history(
    history: History, *, steps: Sequence[int] | None = None, title: str = ""
) -> Picture:
    """Layouts of a run that `design.History(..., mesh=mesh)` kept.

    Args:
        history: With the mesh of its cells.
        steps: Which of the kept ones; up to six, evenly spaced, if omitted.
        title: Title of the figure.
    """
    return show_densities(
        history.mesh, history.densities, steps=steps, title=title, counts=history.steps
    )


def show_densities(
    mesh: Mesh,
    densities: Float[Any, "steps cells"],
    *,
    steps: Sequence[int] | None = None,
    counts: Sequence[int] | None = None,
    title: str = "",
) -> Picture:
    """Densities of a layout, one panel per step, black where there is material.

    Args:
        mesh: The cells.
        densities: One row per step, or one row.
        steps: Which rows to draw; up to six, evenly spaced, if omitted.
        counts: Number of the step of every row; 1, 2, ... if omitted.
        title: Title of the figure.
    """
    rows = np.atleast_2d(np.asarray(densities))
    do = "Give one per cell, in rows of steps."
    _check.shape("view.show", "densities", rows, (None, mesh.num_cells), do)
    count = len(rows)
    chosen = spread(count, 6) if steps is None else [k % count for k in steps]
    scale = Scale("density [-]", 0.0, 1.0, colours="Greys")
    scenes = []
    for k in chosen:
        scene = mesh_scene(mesh, field=rows[k])
        body = scene.parts[0]
        assert isinstance(body, Surface)
        bare = Surface(body.points, body.triangles, values=body.values)
        scenes.append(Scene((bare, *scene.parts[1:]), scale))
    numbers = np.arange(1, count + 1) if counts is None else np.asarray(counts)
    names = [f"step {numbers[k]}" if count > 1 else "" for k in chosen]
    return panels(scenes, names, title=title)

"""Pictures of files: surfaces, meshes with results, saved motions."""

import inspect
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax import io
from sorojax.mesh import Mesh
from sorojax.view.draw.bodies import coloured
from sorojax.view.draw.meshes import Body, mesh_scene
from sorojax.view.draw.plots import show_signals
from sorojax.view.draw.shapes import surface_scene
from sorojax.view.film.film import Film
from sorojax.view.picture import Picture, panels, show_scene, spread
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import Coloured, Scene, joint_extent
from sorojax.view.show import options as drawn_by, show

_SURFACES = (".stl", ".obj", ".ply")
_UNITS = {"von_mises": "Pa", "pressure": "Pa", "displacement": "m", "energy": "J"}
_MOST = 8  # lines in one panel


def show_file(
    path: str | Path,
    *,
    field: str | None = None,
    unit: float | None = None,
    wire: bool = False,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """The content of a file.

    Args:
        path: A surface (.stl, .obj, .ply), a mesh or a result that meshio reads (.vtu, .vtk,
            .msh, .inp, ...), a series of results (.pvd), or what `io.save` wrote (.npz).
        field: Which values of a result; the first scalar ones if omitted.
        unit: What 1 in the file means [m]; mm for surfaces, else m.
        wire: Draw the triangles or cells.
        view: Camera of what is solid.
        renderer: Of what is solid.
        title: Title; the name of the file if omitted.

    Returns:
        The picture.

    Raises:
        ValueError: If the file is damaged, of no known kind, or has no such field.
    """
    path = Path(path)
    kind, name = path.suffix.lower(), title or Path(path).name
    if kind in _SURFACES:
        surface = io.import_surface(path, unit=unit)
        text = f"{path.name}: {len(surface.triangles)} triangles"
        scene = surface_scene(surface, title or text, wire)
        return show_scene(scene, view=view, renderer=renderer)
    if kind == ".npz":
        return _saved(path, name, field=field, view=view, renderer=renderer, wire=wire)
    scale = 1.0 if unit is None else unit
    if kind == ".pvd":
        states = [_state(file, field, scale) for file in _series(path)]
        chosen = spread(len(states), 6)
        scenes = joint_extent(_scenes([states[k] for k in chosen], wire))
        names = [f"state {k}" for k in chosen]
        return panels(scenes, names, view=view, renderer=renderer, title=name)
    state = _state(path, field, scale)
    if state.values is None and np.allclose(state.moved, 0):
        scene = mesh_scene(state.mesh, title=title)
    else:
        scene = replace(_scenes([state], wire)[0], title=name)
    return show_scene(scene, view=view, renderer=renderer)


def animate_file(
    path: str | Path,
    *,
    field: str | None = None,
    unit: float = 1.0,
    fps: float = 10.0,
    **options: Any,
) -> Film:
    """A film of a series of results (.pvd); options of `animate`.

    Args:
        path: File name.
        field: Which values of a result; the first scalar ones if omitted.
        unit: What 1 in the file means [m].
        fps: Frames per second.
        **options: Of `animate`.

    Returns:
        The film.
    """
    from sorojax.view.film.animation import Track, animate

    states = [_state(file, field, unit) for file in _series(Path(path))]
    scenes = joint_extent(_scenes(states, False))
    time = np.arange(len(states), dtype=float)
    track = Track(time, lambda k: scenes[k], scenes[0].scale, "steps", scenes[0].box)
    return animate(track, fps=fps, speed=fps, **options)


class _State(NamedTuple):
    """One result: the mesh, where its nodes went, what colours it."""

    mesh: Mesh
    moved: Float[np.ndarray, "nodes dim"]
    values: Any
    label: str


def _state(path: Path, field: str | None, unit: float) -> _State:
    import meshio

    mesh = io.import_mesh(path, unit=unit)
    whole = meshio.read(path)
    dim = mesh.element.dim
    at_nodes = {k: v for k, v in whole.point_data.items() if len(v) == mesh.num_nodes}
    at_cells = {k: np.concatenate(blocks) for k, blocks in whole.cell_data.items()}
    at_cells = {k: v for k, v in at_cells.items() if len(v) == mesh.num_cells}
    given = at_nodes.get("displacement")
    moved = np.zeros(mesh.points.shape) if given is None else unit * given[:, :dim]
    known = {k: v for k, v in (at_nodes | at_cells).items() if not k.startswith("vtk")}
    scalars = [k for k, v in known.items() if v.ndim == 1 and v.dtype.kind in "fiu"]
    if field is None:
        field = next(iter(scalars), "displacement" if given is not None else None)
    if field is None:
        return _State(mesh, moved, None, "")
    if field not in known:
        raise ValueError(
            f"show: {path} has no field {field!r}, it has {', '.join(known) or 'none'}. Name "
            "one of these."
        )
    values = known[field].astype(float)
    if values.ndim > 1:
        values = np.linalg.norm(values.reshape(len(values), -1), axis=1)
    values = unit * values if field == "displacement" else values
    return _State(mesh, moved, values, field)


def _scenes(states: list[_State], wire: bool) -> list[Scene]:
    """One scene per result, on one scale of colours."""
    label = states[0].label
    scale, rows = None, [None] * len(states)
    if states[0].values is not None:
        name = label.replace("_", " ")
        found = [Coloured(state.values, name, _UNITS.get(label, "")) for state in states]
        scale, rows = coloured(found)
    scenes = []
    for state, row in zip(states, rows, strict=True):
        points = np.asarray(state.mesh.points)
        rest = None if np.allclose(state.moved, 0) else points
        parts = Body(state.mesh).parts(points + state.moved, row, rest=rest, wire=wire)
        scenes.append(Scene(tuple(parts), scale))
    return scenes


def _series(path: Path) -> list[Path]:
    """Files of a collection of VTK, in its folder."""
    text = path.read_bytes()
    if b"<!ENTITY" in text or b"<!DOCTYPE" in text:
        raise ValueError(f"show: {path} declares entities, need a plain collection of VTK.")
    try:
        sets = ET.fromstring(text).iter("DataSet")
        files = [path.parent / str(entry.get("file")) for entry in sets]
    except ET.ParseError as error:
        raise ValueError(f"show: {path} is damaged ({error}). Write it again.") from error
    inside = path.parent.resolve()
    files = [file for file in files if file.resolve().is_relative_to(inside)]
    if not files:
        raise ValueError(f"show: {path} lists no file beside it. Keep the .vtu files with it.")
    return files


def _saved(path: Path, title: str, **options: Any) -> Picture:
    """Everything in a file of `io.save` that has one entry per instant, over time; where
    there is no time, or a body of finite elements, what was saved, as `show` draws it."""
    arrays = io.leaves(path)
    times = [
        name for name in arrays if re.search(r"\btimes?\W*$", name) and arrays[name].ndim == 1
    ]
    is_body = any(name.startswith((".dynamics", ".problem")) for name in arrays)
    if not times or is_body:
        return _drawn(path, arrays, title, options)
    time = arrays[times[0]]
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        is_row = array.ndim in (1, 2) and len(array) == len(time) and array.dtype.kind == "f"
        if not is_row or name in times or array.size > _MOST * len(time):
            continue
        short = re.sub(r"^\.(outputs|states?)\b|[\[\]']", "", name).lstrip(".")
        columns = array.reshape(len(time), -1).T
        lines = {f"{short}[{k}]": column for k, column in enumerate(columns)}
        groups[short] = lines if len(columns) > 1 else {short: columns[0]}
    if not groups:
        return _drawn(path, arrays, title, options)
    return show_signals(time, groups, title=title)


def _drawn(path: Path, arrays: dict[str, np.ndarray], title: str, options: dict) -> Picture:
    """`show` with those options that it takes for what was saved."""
    thing = io.load(path)
    try:
        known = inspect.signature(drawn_by(thing)).parameters
    except TypeError as error:
        listed = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(
            f"show: {path} holds a {type(thing).__name__} of {listed}, need a noun or result "
            "of sorojax, or a time to draw over. Load it with io.load."
        ) from error
    given = {"title": title} | {k: v for k, v in options.items() if v}
    return show(thing, **{k: v for k, v in given.items() if k in known})

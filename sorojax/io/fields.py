"""Results on meshes to VTU files, one for a state, a PVD collection for a path."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import jax.numpy as jnp
import numpy as np

from sorojax import _check, fem
from sorojax.fem.equilibrium.solve import Path as FemPath
from sorojax.fem.reactions import balance
from sorojax.io import _files
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import valences

FIELDS = ("von_mises", "pressure", "stress", "principal", "energy", "reaction")


def export_fields(
    path: str | os.PathLike,
    problem: fem.Problem,
    states: fem.Solution | FemPath | fem.Trajectory | np.ndarray,
    *,
    fields: Sequence[str] = ("von_mises", "pressure"),
    deformed: bool = False,
    times: Sequence[float] | None = None,
    unit: float = 1.0,
    root: str | os.PathLike | None = None,
) -> list[Path]:
    """Write displacement and stresses for ParaView and other readers of VTK files.

    A `.vtu` file holds one state (the last one of a path); a `.pvd` file lists one `.vtu`
    file per state, NAME_0000.vtu and so on beside it, with their times. Files of the same
    names are replaced, each whole or not at all, the collection last. Cells go as the VTK
    type of the same nodes; Tri7 and Tet15, for which there is none, are written as Tri6 and
    Tet10, without their inner nodes.

    Args:
        path: File name, ending in .vtu or .pvd.
        problem: What was solved.
        states: A solution, a path, a motion, or displacements (nodes, dim) or
            (states, nodes, dim) [m].
        fields: Beside "displacement" [m], any of "von_mises" [Pa], "pressure" (mean stress,
            tension positive) [Pa], "stress" (Cauchy, 9 components) [Pa], "principal" [Pa],
            "reaction" [N] at the nodes and "energy" [J] in the cells. Nodal stresses are
            means over the cells of a node.
        deformed: Put the points where the body is; otherwise in the reference
            configuration, where a viewer can warp them by "displacement".
        times: One number per state; those of the motion or the values of the path's load when
            omitted, where these are numbers, else 0, 1, 2...
        unit: What 1 in the file means for points and displacements [m].
        root: Folder that the files must lie in, links followed.

    Returns:
        The files written, the one of `path` last.

    Raises:
        ValueError: If the ending or a field is unknown, a state is not finite, shapes do
            not fit, or a file would leave `root`.
    """
    where = "export_fields"
    file = _files.inside(where, path, root)
    if file.suffix.lower() not in (".vtu", ".pvd"):
        raise ValueError(
            f"{where}: the file name ends in `{file.suffix}`, need .vtu for one state or .pvd "
            "for a path."
        )
    if unknown := sorted(set(fields) - set(FIELDS)):
        raise ValueError(f"{where}: got fields {unknown}, need some of {list(FIELDS)}.")
    _check.positive(where, "unit", unit, "m", "Write unit=sorojax.units.mm.")
    moved, problems, moments = _states(where, problem, states, times)
    if file.suffix.lower() == ".vtu":
        _write(file, problems[-1], moved[-1], fields, deformed, unit)
        return [file]
    parts = [file.with_name(f"{file.stem}_{k:04d}.vtu") for k in range(len(moved))]
    for part, here, u in zip(parts, problems, moved, strict=True):
        # a link in the folder must not lead out of it either
        target = part if root is None else _files.inside(where, part, root)
        _write(target, here, u, fields, deformed, unit)
    text = _collection(parts, moments).encode()
    _files.write(file, lambda out: out.write(text))
    return [*parts, file]


def _states(where, problem, states, times):
    """Displacements (states, nodes, dim), the problem of each, and their times."""
    problems = own = None
    if isinstance(states, FemPath):
        path = dataclasses.replace(states, problem=problem)
        problems = [path.problem_at(k) for k in range(len(path))]
        own = states.values if states.values.ndim == 1 else None
    elif isinstance(states, fem.Trajectory):
        own = states.time
    if isinstance(states, FemPath | fem.Trajectory):
        states = states.displacements
    elif isinstance(states, fem.Solution):
        states = states.displacement
    moved = np.asarray(states, float)
    moved = moved[None] if moved.ndim == 2 else moved
    moments = own if times is None else times
    want = (None if len(moved) else 1, *problem.mesh.points.shape)
    _check.shape(where, "states", moved, want, "Give one state or more.")
    _check.finite(where, "states", moved, "Leave out states that did not converge.")
    moments = np.arange(len(moved)) if moments is None else np.asarray(moments, float)
    _check.shape(where, "times", moments, (len(moved),), "Give one per state.")
    return moved, problems or [problem] * len(moved), moments


def _write(file: Path, problem, u, fields, deformed: bool, unit: float) -> None:
    import meshio

    points = np.asarray(problem.mesh.points) + (u if deformed else 0.0)
    blocks, kept = _blocks(problem.mesh)
    at_nodes, at_cells = _values(problem, jnp.asarray(u), fields)
    order = np.concatenate([ids for _, _, ids in blocks])
    ends = np.cumsum([len(ids) for _, _, ids in blocks])[:-1]
    point_data = {"displacement": _three(u[kept]) / unit}
    point_data |= {name: field[kept] for name, field in at_nodes.items()}
    cell_data = {name: np.split(field[order], ends) for name, field in at_cells.items()}
    cells: list[Any] = [(kind, rows) for kind, rows, _ in blocks]
    data: dict[str, Any] = {"point_data": point_data, "cell_data": cell_data}
    whole = meshio.Mesh(_three(points[kept]) / unit, cells, **data)
    with _files.made_beside(file) as made:
        whole.write(made)


def _blocks(mesh):
    """Cells by VTK type, with the numbers of the cells, and the nodes that they use."""
    cells = np.asarray(mesh.cells)
    if isinstance(mesh.element, PolyN):
        corners = valences(mesh)
        blocks = [
            ({3: "triangle", 4: "quad"}.get(n, "polygon"), cells[ids][:, :n], ids)
            for n in np.unique(corners)
            for ids in [np.flatnonzero(corners == n)]
        ]
    else:
        known = mesh.element if mesh.element.cell_type else mesh.element.plain
        blocks = [(known.cell_type, cells[:, : known.num_nodes], np.arange(len(cells)))]
    kept = np.unique(np.concatenate([block.ravel() for _, block, _ in blocks]))
    number = np.zeros(mesh.num_nodes, int)
    number[kept] = np.arange(len(kept))
    return [(kind, number[block], ids) for kind, block, ids in blocks], kept


def _values(problem, u, fields):
    """Fields at the nodes and in the cells."""
    nodes, cells = {}, {}
    if {"von_mises", "pressure", "stress", "principal"} & set(fields):
        sigma = fem.cauchy_stress(problem, u)
        flat = jnp.moveaxis(sigma.reshape(*sigma.shape[:2], 9), -1, 0)
        mean = [np.asarray(fem.nodal_average(problem, entry)) for entry in flat]
        stress = np.stack(mean, axis=1).reshape(-1, 3, 3)
        trace = np.trace(stress, axis1=1, axis2=2) / 3
        deviator = stress - trace[:, None, None] * np.eye(3)
        nodes = {
            "von_mises": np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2))),
            "pressure": trace,
            "stress": stress.reshape(-1, 9),
            "principal": np.linalg.eigvalsh(np.nan_to_num(stress)),
        }
    if "reaction" in fields:
        nodes["reaction"] = _three(np.asarray(balance(problem, u)))
    if "energy" in fields:
        cells["energy"] = np.asarray(fem.strain_energy(problem, u))
    return {name: nodes[name] for name in fields if name in nodes}, cells


def _collection(parts: list[Path], times) -> str:
    rows = "".join(
        f'    <DataSet timestep="{float(time)!r}" group="" part="0" '
        f"file={quoteattr(part.name)}/>\n"
        for part, time in zip(parts, times, strict=True)
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" '
        f'byte_order="LittleEndian">\n  <Collection>\n{rows}  </Collection>\n</VTKFile>\n'
    )


def _three(rows: np.ndarray) -> np.ndarray:
    return np.pad(rows, ((0, 0), (0, 3 - rows.shape[1])))

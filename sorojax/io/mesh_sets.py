"""Node sets, facet sets and regions as values and sets of a file, and back."""

from typing import Any, NamedTuple

import numpy as np

from sorojax.mesh import Mesh, Repaired

_NODE, _FACET, _REGION = "node_set:", "facet_set:", "region:"
_PHYSICAL, _BETWEEN = "gmsh:physical", " + "


class Parts(NamedTuple):
    """What a file holds beside points and cells."""

    blocks: list
    point_data: dict
    cell_data: dict
    point_sets: dict
    cell_sets: dict
    field_data: dict


class Sets(NamedTuple):
    nodes: dict[str, np.ndarray]
    facets: dict[str, np.ndarray]
    regions: dict[str, np.ndarray]


def packed(mesh: Mesh, facet_type: str, suffix: str) -> Parts:
    """Sets of `mesh`: as values of points and cells, or in INP files as sets."""
    facets = [np.asarray(f) for f in mesh.facet_sets.values() if len(f)]
    blocks, number, starts = [], {}, {}
    if facets:
        every = np.concatenate(facets)
        _, first, row = np.unique(
            np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True
        )
        blocks = [(facet_type, every[first])]
        stops = np.cumsum([len(f) for f in facets])
        names = [name for name, f in mesh.facet_sets.items() if len(f)]
        number = dict(zip(names, np.split(row.ravel(), stops[:-1]), strict=True))
        starts = {name: number[name] for name in names}
    nodes = {name: np.asarray(ids) for name, ids in mesh.node_sets.items()}
    regions = {name: np.asarray(ids) for name, ids in mesh.regions.items()}
    if suffix == ".inp":
        nothing = np.zeros(0, int)
        cell_sets = {name: [ids, *[nothing] * len(blocks)] for name, ids in regions.items()}
        cell_sets |= {name: [nothing, ids] for name, ids in starts.items()}
        return Parts(blocks, {}, {}, nodes, cell_sets, {})
    size = mesh.num_cells, len(blocks[0][1]) if blocks else 0
    cell_data = {_REGION + n: _masks(size, 0, ids, blocks) for n, ids in regions.items()}
    cell_data |= {_FACET + n: _masks(size, 1, ids, blocks) for n, ids in number.items()}
    point_data = {_NODE + n: _mask(mesh.num_nodes, ids) for n, ids in nodes.items()}
    if suffix == ".msh":
        point_data = {name: mask.astype(float) for name, mask in point_data.items()}
        lists = {n: [ids, np.zeros(0, int)] for n, ids in regions.items()}
        lists |= {n: [np.zeros(0, int), ids] for n, ids in number.items()}
        tags, names = _physical(lists, size[: 1 + len(blocks)], mesh.element.dim)
        return Parts(blocks, point_data, tags, {}, {}, names)
    return Parts(blocks, point_data, cell_data, {}, {}, {})


def _physical(lists: dict, sizes, dim: int) -> tuple[dict, dict]:
    """Gmsh gives a cell one physical group: each combination of sets becomes one."""
    groups, names = [], {}
    for k, size in enumerate(sizes):
        member = np.zeros((size, len(lists)), bool)
        for column, rows in enumerate(lists.values()):
            member[rows[k], column] = True
        kinds, group = np.unique(member, axis=0, return_inverse=True)
        first = len(names) + 1
        for i, kind in enumerate(kinds):
            name = _BETWEEN.join(np.array(list(lists), dtype=object)[kind])
            names[name or f"rest_{dim - k}"] = np.array([first + i, dim - k])
        groups.append(group.ravel().astype(np.int32) + first)
    return {_PHYSICAL: groups, "gmsh:geometrical": groups}, names


def _mask(count: int, ids: np.ndarray) -> np.ndarray:
    mask = np.zeros(count, np.int32)
    mask[ids] = 1
    return mask


def _masks(size, which: int, ids, blocks) -> list[np.ndarray]:
    masks = [np.zeros(n, np.int32) for n in size[: 1 + len(blocks)]]
    masks[which] = _mask(size[which], ids)
    return masks


def unpacked(
    raw: Any, own: list[int], facet_blocks: list[int], fixed: Repaired, count: int
) -> Sets:
    """Sets of a file that was read, in the numbers of the repaired mesh."""
    new = np.full(count, -1)
    kept = np.setdiff1d(np.arange(count), np.concatenate([fixed.merged, fixed.removed]))
    new[kept] = np.arange(len(kept))
    nodes = {n: np.flatnonzero(v) for n, v in _named(raw.point_data, _NODE)}
    nodes |= {n: np.asarray(ids, int) for n, ids in raw.point_sets.items()}
    lists = {
        n: [np.flatnonzero(v) for v in values] for n, values in _named(raw.cell_data, _REGION)
    }
    lists |= {n: [np.flatnonzero(v) for v in vs] for n, vs in _named(raw.cell_data, _FACET)}
    lists |= {n: [_ids(v) for v in vs] for n, vs in raw.cell_sets.items()}
    for name, (group, _) in raw.field_data.items():
        tags = raw.cell_data.get(_PHYSICAL, [])
        rows = [np.flatnonzero(np.asarray(t) == group) for t in tags]
        for part in () if name.startswith("rest_") or not tags else name.split(_BETWEEN):
            known = lists.get(part)
            lists[part] = rows if known is None else _together(known, rows)
    _check_sets(nodes, lists, count, [len(block.data) for block in raw.cells])
    start = np.cumsum([0, *(len(raw.cells[i].data) for i in own)])
    regions, facets = {}, {}
    for name, rows in lists.items():
        mine = [rows[i] + start[k] for k, i in enumerate(own)]
        if sum(map(len, mine)):
            regions[name] = np.concatenate(mine)
        sides = [np.asarray(raw.cells[i].data)[rows[i]] for i in facet_blocks]
        if sum(map(len, sides)):
            facets[name] = new[np.concatenate(sides)]
    renumbered = {name: new[ids] for name, ids in nodes.items()}
    return Sets({n: ids[ids >= 0] for n, ids in renumbered.items()}, facets, regions)


def _check_sets(nodes: dict, lists: dict, num_nodes: int, num_cells: list[int]) -> None:
    """Raise a `ValueError` where a set names nodes or cells that the file does not hold."""
    for name, ids in nodes.items():
        if not _within(ids, num_nodes):
            raise ValueError(_unknown(name, "nodes", f"{num_nodes} nodes"))
    for name, rows in lists.items():
        if len(rows) != len(num_cells) or not all(map(_within, rows, num_cells)):
            raise ValueError(_unknown(name, "cells", f"{len(num_cells)} blocks of {num_cells}"))


def _within(ids: np.ndarray, count: int) -> bool:
    return len(ids) == 0 or (ids.min() >= 0 and ids.max() < count)


def _unknown(name: str, kind: str, found: str) -> str:
    return (
        f"import_mesh: the set `{name}` names {kind} that the file does not hold, which has "
        f"{found}. Export it again."
    )


def _together(first: list, second: list) -> list[np.ndarray]:
    return [np.union1d(a, b) for a, b in zip(first, second, strict=True)]


def _ids(value: Any) -> np.ndarray:
    return np.zeros(0, int) if value is None else np.asarray(value, int)


def _named(data: dict, prefix: str):
    return [(name[len(prefix) :], v) for name, v in data.items() if name.startswith(prefix)]

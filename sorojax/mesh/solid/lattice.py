"""The body-centred cubic lattice over a solid: graded by bisection of longest edges where a
size asks for it, and cut into tetrahedra at the surface.

References:
    Labelle and Shewchuk, Isosurface stuffing, SIGGRAPH 2007.
    Arnold, Mukherjee and Pouly, Locally adapted tetrahedral meshes using bisection, SIAM J.
    Sci. Comput. 22, 2000.
"""

from typing import NamedTuple

import numpy as np

from sorojax.mesh.sizes import Sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values

_SNAP_LONG, _SNAP_SHORT = 0.25, 0.41  # share of an edge within which a node is moved
_SNAP_ANY = 0.25  # the same where edges of the lattice are of many lengths
_MOST_CUBES = 2e7
_EDGES = np.array(((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)))


class Lattice(NamedTuple):
    """Tetrahedra of cubes that may hold inside.

    Attributes:
        start: Where the coordinates are zero [m].
        at: (nodes, 3) coordinates in cubes: whole for corners, plus a half for centres.
        cells: (cells, 4) tetrahedra, not all of one sense.
    """

    start: np.ndarray
    at: np.ndarray
    cells: np.ndarray


def lattice(shape: AbstractSdf, lower, upper, pitch: float) -> Lattice:
    """The lattice with cubes of side `pitch` [m] where `shape` may have its inside.

    Cubes are kept where the Lipschitz constant cannot exclude the inside, so memory
    follows the volume of the shape and not that of its box.
    """
    count = np.ceil((upper - lower) / pitch).astype(int) + 2
    start = (lower + upper) / 2 - pitch * count / 2
    if float(np.prod(count.astype(float))) > _MOST_CUBES:
        raise ValueError(
            f"tetrahedralise: a pitch of {pitch:g} m over a box of {upper - lower} m takes "
            f"{count.prod():.2g} cubes, at most {_MOST_CUBES:.0e} are allowed. Raise `size`."
        )
    cubes = _near_cubes(shape, start, count, pitch)
    centre = np.full(tuple(count), -1, np.int64)
    centre[tuple(cubes.T)] = np.arange(len(cubes))
    pairs, rings = [], []
    for axis in range(3):
        u, w = (axis + 1) % 3, (axis + 2) % 3
        beside = cubes.copy()
        beside[:, axis] += 1
        inside = beside[:, axis] < count[axis]
        other = np.full(len(cubes), -1, np.int64)
        other[inside] = centre[tuple(beside[inside].T)]
        joined = other >= 0
        pairs.append(np.stack([np.flatnonzero(joined), other[joined]], axis=1))
        ring = np.repeat(beside[joined][:, None], 4, axis=1)
        ring[:, [1, 2], u] += 1
        ring[:, [2, 3], w] += 1
        rings.append(ring)
    pair, ring = np.concatenate(pairs), np.concatenate(rings)
    flat = np.ravel_multi_index(tuple(np.moveaxis(ring, 2, 0)), tuple(count + 1))
    used, number = np.unique(flat, return_inverse=True)
    number = len(cubes) + number.reshape(flat.shape)
    corners = np.stack(np.unravel_index(used, tuple(count + 1)), axis=1)
    cells = np.concatenate(
        [
            np.concatenate([pair, number[:, [k]], number[:, [(k + 1) % 4]]], axis=1)
            for k in range(4)
        ]
    )
    return Lattice(start, np.concatenate([cubes + 0.5, corners]), cells)


def touching(shape: AbstractSdf, points, cells, tiny: float):
    """Field [m] at `points`, nowhere nearer to zero than `tiny` [m], and the cells with a
    corner inside `shape`."""
    f = values(shape, points)
    f = np.where(np.abs(f) < tiny, -tiny, f)
    return f, cells[(f[cells] < 0).any(axis=1)]


def _near_cubes(shape: AbstractSdf, start, count, pitch: float) -> np.ndarray:
    """Cubes that may hold inside, with their neighbours: tested in blocks, then singly."""
    width = 8
    blocks = np.stack(
        np.meshgrid(*(np.arange(-(-n // width)) for n in count), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    reach = shape.lipschitz * np.sqrt(0.75) * pitch
    middle = start + pitch * width * (blocks + 0.5)
    blocks = blocks[values(shape, middle) < reach * (width + 3)]
    within = np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), axis=-1)
    cubes = (width * blocks[:, None] + within.reshape(-1, 3)).reshape(-1, 3)
    cubes = cubes[(cubes < count).all(axis=1)]
    return cubes[values(shape, start + pitch * (cubes + 0.5)) < 3 * reach]


def unique_edges(cells: np.ndarray, num_nodes: int) -> np.ndarray:
    """Distinct edges of tetrahedra, smaller node first."""
    ends = np.concatenate([cells[:, e] for e in _EDGES])
    keys = np.unique(ends.min(axis=1) * np.int64(num_nodes) + ends.max(axis=1))
    return np.stack(np.divmod(keys, num_nodes), axis=1)


def roots(shape: AbstractSdf, a, b, fa, fb, steps: int = 4):
    """Share of the way from `a` to `b` where the field vanishes, and the point there."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    fa, fb, inside = fa.copy(), fb.copy(), fa < 0
    share, point = low, a
    for _ in range(steps):
        share = low + (high - low) * fa / (fa - fb)
        point = a + share[:, None] * (b - a)
        f = values(shape, point)
        same = (f < 0) == inside
        low, high = np.where(same, share, low), np.where(same, high, share)
        # Illinois: the end that stays is given half its value.
        fa, fb = np.where(same, f, fa / 2), np.where(same, fb / 2, f)
    return np.clip(share, 1e-6, 1 - 1e-6), point


def snap(shape: AbstractSdf, points, f, cells, pitch: float | None):
    """Lattice nodes close to the surface moved onto it; their field becomes zero.

    `pitch` [m] is that of a regular lattice, `None` where cells were bisected.
    """
    edges = unique_edges(cells, len(points))
    edges = edges[(f[edges[:, 0]] < 0) != (f[edges[:, 1]] < 0)]
    a, b = edges.T
    share, crossing = roots(shape, points[a], points[b], f[a], f[b])
    length = np.linalg.norm(points[a] - points[b], axis=1)
    if pitch is None:
        reach = np.full(len(a), _SNAP_ANY)
    else:
        reach = np.where(length > 0.95 * pitch, _SNAP_LONG, _SNAP_SHORT)
    node, way = np.concatenate([a, b]), np.concatenate([share, 1 - share])
    close = way < np.concatenate([reach, reach])
    distance = (way * np.concatenate([length, length]))[close]
    node, target = node[close], np.concatenate([crossing, crossing])[close]
    order = np.lexsort((distance, node))
    node, target = node[order], target[order]
    first = np.r_[True, node[1:] != node[:-1]] if len(node) else np.zeros(0, bool)
    points, f = points.copy(), f.copy()
    points[node[first]], f[node[first]] = target[first], 0.0
    return points, f


def clip(shape: AbstractSdf, points, f, cells):
    """The part of the tetrahedra inside `shape`: `(points, cells, skin)`, `skin` the nodes on
    its surface; nodes outside are still among them."""
    sign = np.sign(f).astype(int)
    state = sign[cells]
    flat = (state == 0).all(axis=1)
    if flat.any():
        flat[flat] = values(shape, points[cells[flat]].mean(axis=1)) > 0
    cells = cells[((state < 0).any(axis=1) | (state == 0).all(axis=1)) & ~flat]
    positive = (sign[cells] > 0).any(axis=1)
    whole, cut = cells[~positive], cells[positive]
    edges = unique_edges(cut, len(points)) if len(cut) else np.zeros((0, 2), int)
    edges = edges[sign[edges[:, 0]] * sign[edges[:, 1]] < 0]
    a, b = edges.T
    fa, fb = values(shape, points[a]), values(shape, points[b])
    _, crossing = roots(shape, points[a], points[b], fa, fb)
    keys, base = a * np.int64(len(points)) + b, len(points)

    def middle(p, q):
        key = np.minimum(p, q) * np.int64(base) + np.maximum(p, q)
        return base + np.searchsorted(keys, key)

    cells = np.concatenate([whole, inside_parts(cut, sign, middle)[0]])
    skin = np.concatenate([sign == 0, np.ones(len(crossing), bool)])
    return np.concatenate([points, crossing]), cells, skin


def inside_parts(cells, sign, middle) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra of the parts of `cells` where `sign` of their nodes is below zero, and which
    cell each is of; `middle(p, q)` is the node between two of unlike sign."""
    order = np.argsort(sign[cells], axis=1, kind="stable")
    cells = np.take_along_axis(cells, order, axis=1)
    inside, on = (sign[cells] < 0).sum(axis=1), (sign[cells] == 0).sum(axis=1)
    parts, rows = [cells[:0]], [np.zeros(0, int)]
    for m, z in {*zip(inside.tolist(), on.tolist(), strict=True)}:
        mine = np.flatnonzero((inside == m) & (on == z))
        found = _inside_part(*cells[mine].T, m, z, middle)
        parts += found
        rows += [mine] * len(found)
    return np.concatenate(parts), np.concatenate(rows)


def _inside_part(a, b, c, d, inside: int, on: int, middle) -> list[np.ndarray]:
    """Corners sorted inside, on, outside: the tetrahedra of the inside."""
    if inside == 1:
        others = [x if k < on else middle(a, x) for k, x in enumerate((b, c, d))]
        return [np.stack([a, *others], axis=1)]
    if inside == 2 and on == 1:
        return _pyramid(np.stack([a, b, middle(b, d), middle(a, d)], axis=1), c)
    if inside == 2:
        return wedge(a, middle(a, c), middle(a, d), b, middle(b, c), middle(b, d))
    return wedge(a, b, c, middle(a, d), middle(b, d), middle(c, d))


def _pyramid(quad: np.ndarray, apex: np.ndarray) -> list[np.ndarray]:
    """Split by the diagonal from the smallest node: the neighbour does the same."""
    turn = (np.argmin(quad, axis=1)[:, None] + np.arange(4)) % 4
    p, q, r, s = np.take_along_axis(quad, turn, axis=1).T
    return [np.stack([p, q, r, apex], axis=1), np.stack([p, r, s, apex], axis=1)]


_TURNS = np.array(
    [
        [0, 1, 2, 3, 4, 5],
        [1, 2, 0, 4, 5, 3],
        [2, 0, 1, 5, 3, 4],
        [3, 5, 4, 0, 2, 1],
        [4, 3, 5, 1, 0, 2],
        [5, 4, 3, 2, 1, 0],
    ]
)


def wedge(*corners: np.ndarray) -> list[np.ndarray]:
    """Three tetrahedra of a prism, every diagonal from the smallest node of its side."""
    v = np.stack(corners, axis=1)
    v = np.take_along_axis(v, _TURNS[np.argmin(v, axis=1)], axis=1)
    first = np.minimum(v[:, 1], v[:, 5]) < np.minimum(v[:, 2], v[:, 4])
    one = np.where(first[:, None], v[:, [0, 1, 2, 5]], v[:, [0, 1, 2, 4]])
    two = np.where(first[:, None], v[:, [0, 1, 5, 4]], v[:, [0, 4, 2, 5]])
    return [one, two, v[:, [0, 4, 5, 3]]]


# Numbers of tetrahedra: volumes, dihedral angles, radius ratios


FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))  # opposite to each corner, outward


def signed_volumes(x: np.ndarray) -> np.ndarray:
    """Volumes [m^3] of tetrahedra with corners `x` (cells, 4, 3)."""
    a, b, c = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], x[:, 3] - x[:, 0]
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6


def dihedral_cosines(x: np.ndarray) -> np.ndarray:
    """Cosines of the six dihedral angles, (cells, 6)."""
    normals = []
    for i, j, k in FACES:
        n = np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i])
        normals.append(n / np.maximum(np.sqrt((n * n).sum(axis=1)), 1e-300)[:, None])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    return np.stack([-(normals[i] * normals[j]).sum(axis=1) for i, j in pairs], axis=1)


def badness(x: np.ndarray) -> np.ndarray:
    """Largest |cos| of the dihedral angles; 2 to 3 for a cell without positive volume.

    It is 1/3 for the regular tetrahedron and near 1 where an angle is near 0 or pi.
    """
    worst = np.abs(dihedral_cosines(x)).max(axis=1)
    volume = signed_volumes(x)
    good = volume > 0
    if good.all():
        return worst
    # The more inverted the worse, so that moves can lead out of it.
    side = np.linalg.norm(x - x[:, [1, 2, 3, 0]], axis=2).max(axis=1)
    depth = 6 * np.abs(volume) / np.maximum(side, 1e-300) ** 3
    return np.where(good, worst, 3 - 1 / (1 + depth))


def radius_ratios(x: np.ndarray) -> np.ndarray:
    """Three times the inscribed over the circumscribed radius, 1 for regular cells."""
    a, b, c = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], x[:, 3] - x[:, 0]
    volume = np.abs(signed_volumes(x))
    faces = sum(
        np.linalg.norm(np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i]), axis=1) / 2
        for i, j, k in FACES
    )
    turns = ((a, b, c), (b, c, a), (c, a, b))
    center = sum((u * u).sum(axis=1)[:, None] * np.cross(v, w) for u, v, w in turns)
    circum = np.linalg.norm(center, axis=1) / np.maximum(12 * volume, 1e-300)
    return 9 * volume / (faces * circum)


# A lattice of tetrahedra graded by bisection of longest edges


_COARSE = 1.12  # pitch of a cell over the wanted one: a bisection takes it to 0.9
_UNIT = 2**12  # steps per cube: lengths are compared as whole numbers
_MOST_CELLS = 10_000_000


def graded(shape: AbstractSdf, background: Lattice, pitch: float, size: Sizes):
    """Points [m] and cells of `background` bisected until they are as small as `size`.

    The longest edge of a cell is halved together with all cells around it, so faces
    match; cells of the lattice stay within four shapes, of dihedral angles from 45 degrees.
    """
    parts = _Parts(shape, background, pitch)
    for _ in range(200):
        wanted = size(parts.points)[parts.cells].min(axis=1)
        wanted = np.minimum(wanted, size(parts.points[parts.cells].mean(axis=1)))
        split = parts.pitches() > _COARSE * wanted
        split |= parts.hanging()
        if not split.any():
            break
        parts.bisect(split)
        if len(parts.cells) > _MOST_CELLS:
            raise ValueError(
                f"tetrahedralise: `size` asks for more than {_MOST_CELLS:.0e} cells. Raise "
                "its least length, or let it grow faster."
            )
    return parts.points, parts.cells


class _Parts:
    """Cells while they are bisected: coordinates are whole numbers of the smallest step."""

    def __init__(self, shape: AbstractSdf, background: Lattice, pitch: float):
        self.shape, self.start, self.step = shape, background.start, pitch / _UNIT
        self.lipschitz = float(np.asarray(shape.lipschitz))
        self.at = np.rint(background.at * _UNIT).astype(np.int64)
        self.f = values(shape, self.points)
        self.cells = background.cells
        self.ends = np.zeros(0, np.int64)  # keys of bisected edges, sorted
        self.middle = np.zeros(0, np.int64)
        self._drop()

    @property
    def points(self) -> np.ndarray:
        return self.start + self.step * self.at

    def _keys(self, cells: np.ndarray) -> np.ndarray:
        pairs = np.sort(cells[:, _EDGES], axis=2)
        return pairs[..., 0] << 32 | pairs[..., 1]

    def pitches(self) -> np.ndarray:
        """Pitch [m] of the lattice whose cells are as large."""
        volume = np.abs(signed_volumes(self.at[self.cells].astype(float)))
        return np.cbrt(12 * volume) * self.step

    def hanging(self) -> np.ndarray:
        """Cells with an edge that was bisected beside them."""
        return self._bisected(self._keys(self.cells)).any(axis=1)  # type: ignore

    def _bisected(self, keys: np.ndarray) -> np.ndarray:
        if not len(self.ends):
            return np.zeros(keys.shape, bool)
        place = np.minimum(np.searchsorted(self.ends, keys), len(self.ends) - 1)
        return np.equal(self.ends[place], keys)

    def bisect(self, split: np.ndarray) -> None:
        cells, rows = self.cells[split], np.arange(int(split.sum()))
        keys, x = self._keys(cells), self.at[cells]
        gap = x[:, _EDGES[:, 0]] - x[:, _EDGES[:, 1]]
        square = (gap * gap).sum(axis=2)
        # Of edges of one length the same is taken from every side.
        longest = np.where(square == square.max(axis=1, keepdims=True), keys, -1).argmax(axis=1)
        own = keys[rows, longest]
        new = np.unique(own[~self._bisected(own)])
        a, b = new >> 32, new & (2**32 - 1)
        number = len(self.at) + np.arange(len(new))
        self.at = np.concatenate([self.at, (self.at[a] + self.at[b]) // 2])
        fresh = self.start + self.step * self.at[number]
        self.f = np.concatenate([self.f, values(self.shape, fresh)])
        ends, middle = np.r_[self.ends, new], np.r_[self.middle, number]
        order = np.argsort(ends)
        self.ends, self.middle = ends[order], middle[order]
        node = self.middle[np.searchsorted(self.ends, own)]
        halves = [cells.copy(), cells.copy()]
        for half, end in zip(halves, _EDGES[longest].T, strict=True):
            half[rows, end] = node
        self.cells = np.concatenate([self.cells[~split], *halves])
        self._drop()

    def _drop(self) -> None:
        """Leave out cells that cannot touch the inside."""
        f = self.f[self.cells].min(axis=1)
        x = self.at[self.cells]
        reach = np.sqrt(((x - x[:, :1]) ** 2).sum(axis=2).max(axis=1)) * self.step
        self.cells = self.cells[f < 2 * self.lipschitz * reach]

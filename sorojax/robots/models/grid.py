"""Small strains of a drawn solid on a grid of boxes that its surface cuts.

A thin-walled drawing needs no mesh that follows it: quadratic boxes are integrated over the
part of them that is solid, the pressure that keeps rubber from locking is linear in each. All
runs on the host with nothing to compile, for cells that are each solved once.

Reference: Parvizian, Duester, Rank, Finite cell method, Comput. Mech. 41, 2007.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sorojax.material import AbstractHyperelastic, small_strain_moduli
from sorojax.math.linalg import sparse
from sorojax.sdf import AbstractSdf
from sorojax.sdf.query import evaluate

_FINE = 6  # samples of a cut box along each axis
_VOID = 1e-7  # stiffness of what is not solid in a cut box, over that of the solid
_BLOCK = 600  # boxes at a time
_POINTS = 2**17  # samples at a time: those of a block


class Grid(NamedTuple):
    """A drawn solid and its gas on boxes.

    Attributes:
        points: Nodes [m].
        active: Nodes of boxes that hold solid.
        system, values: Pattern and stiffness [N/m].
        swelling: Volume of the gas per displacement of the nodes [m^2].
        gas: Volume of the gas [m^3].
        volumes, places: Samples of the solid [m^3], [m].
        pieces: The same samples, and those of the gas, by boxes.
    """

    points: Float[np.ndarray, "nodes 3"]
    active: Bool[np.ndarray, " nodes"]
    system: sparse.SparseSymmetric
    values: Float[np.ndarray, " nnz"]
    swelling: Float[np.ndarray, "nodes 3"]
    gas: float
    volumes: Float[np.ndarray, " samples"]
    places: Float[np.ndarray, "samples 3"]
    pieces: tuple["Piece", ...]

    def force(self, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
        """Internal force [N] of a displacement [m]."""
        return self.system.solver.product(self.values, u.ravel()).reshape(u.shape)

    def displacement(self, known, prescribed, load) -> Float[np.ndarray, "nodes 3"]:
        """At rest under `load` [N] with the known components as prescribed [m].

        Raises:
            ValueError: If the supports leave a rigid motion.
        """
        move = np.where(known, prescribed, 0.0)
        rhs = np.where(known, 0.0, load - self.force(move))
        fixed = sparse.fixed_on_host(self.system, self.values, known.ravel())
        factor = self.system.solver.factor(fixed)
        if factor is None:
            raise ValueError(
                "unit_cell: the cell is singular, need one connected piece between the planes. "
                "Check `span`: both ends have to lie in planes of symmetry."
            )
        return factor.solve(rhs.ravel()).reshape(move.shape) + move


class Samples(NamedTuple):
    """Points of the reference box, what a box of these edges answers at each of them."""

    at: Float[np.ndarray, "points 3"]
    modes: Float[np.ndarray, "points 4"]
    gradient: Float[np.ndarray, "points dofs"]
    shear: Float[np.ndarray, "points upper"]


class Piece(NamedTuple):
    """Boxes whose samples are `solid` and `gas` [m^3], None where there is none of it."""

    cells: Int[np.ndarray, "boxes 27"]
    samples: Samples
    solid: Float[np.ndarray, "boxes points"] | None
    gas: Float[np.ndarray, "boxes points"] | None


def cut_grid(
    body: AbstractSdf,
    air: AbstractSdf,
    lower,
    upper,
    size: float,
    material: AbstractHyperelastic,
) -> Grid:
    """`body` and `air` between two corners [m] on boxes with edges of about `size` [m]."""
    shear, bulk = (float(modulus) for modulus in small_strain_moduli(material))
    counts = np.maximum(np.rint((np.asarray(upper) - lower) / size), 1).astype(int)
    edges = (np.asarray(upper) - lower) / counts
    cells, points = _boxes(counts, lower, edges)
    fine = _samples((np.arange(_FINE) + 0.5) / _FINE, edges)
    gauss, weights = np.polynomial.legendre.leggauss(3)
    exact = _samples((gauss + 1) / 2, edges)
    whole = np.prod(edges) * np.prod(np.meshgrid(*[weights / 2] * 3), axis=0).reshape(1, -1)
    matrix = _matrices(exact, whole, shear, bulk)[0]
    swell = (whole @ exact.gradient)[0]
    start = points[cells[:, 0]]
    solid, gas = (_filled(shape, start, edges) for shape in (body, air))
    cut = np.flatnonzero((solid == 0) | (gas == 0))
    active, swelling = solid > 0, np.zeros(points.size)
    volumes, places, pieces, content = [], [], [], 0.0
    rows = {}
    for at in range(0, len(cut), _BLOCK):
        some = cut[at : at + _BLOCK]
        place = start[some][:, None] + fine.at * edges
        share, air_share = (
            covered(shape, place, np.mean(edges) / _FINE) for shape in (body, air)
        )
        part = share * np.prod(edges) / _FINE**3
        some_solid = part.sum(axis=1) > 1e-6 * np.prod(edges)
        active[some] = some_solid
        for box, row in zip(
            some[some_solid], _matrices(fine, part[some_solid], shear, bulk), strict=True
        ):
            rows[box] = row + _VOID * matrix
        empty = (1 - air_share) * np.prod(edges) / _FINE**3
        # the exact whole less what is sampled as solid: nodes in the gas then feel nothing
        holds = np.any(air_share > 0, axis=1, keepdims=True)
        own = (swell - empty @ fine.gradient) * holds
        np.add.at(swelling, _dofs(cells[some]), own)
        pieces.append(Piece(cells[some], fine, part * some_solid[:, None], -empty * holds))
        pieces.append(_all_gas(cells[some[holds[:, 0]]], exact, whole))
        content += float(np.sum(np.prod(edges) - empty.sum(axis=1)))
        volumes.append(part[part > 0])
        places.append(place[part > 0])
    full_gas = np.flatnonzero((gas > 0) & (solid < 0))
    np.add.at(swelling, _dofs(cells[full_gas]), np.tile(swell, (len(full_gas), 1)))
    pieces.append(_all_gas(cells[full_gas], exact, whole))
    full = (solid > 0) & (gas != 0)
    inner = start[full][:, None] + exact.at * edges
    filled = np.broadcast_to(whole, inner.shape[:2])
    pieces.append(Piece(cells[full], exact, filled, None))
    volumes.append(filled.ravel())
    places.append(inner.reshape(-1, 3))
    boxes = np.flatnonzero(active)
    system = sparse.from_cells(len(points), cells[boxes], 3)
    slots, values = np.asarray(system.slots), np.zeros(system.num_values)
    for box, slot in zip(boxes, slots, strict=True):
        values[slot] += rows.get(box, matrix)
    used = np.zeros(len(points), bool)
    used[cells[boxes]] = True
    return Grid(
        points,
        used,
        system,
        values,
        swelling.reshape(-1, 3),
        content + float(len(full_gas) * np.prod(edges)),
        np.concatenate(volumes),
        np.concatenate(places),
        tuple(pieces),
    )


def _all_gas(cells, exact: Samples, whole) -> Piece:
    return Piece(cells, exact, None, np.broadcast_to(whole, (len(cells), whole.shape[1])))


def _boxes(counts, lower, edges) -> tuple[Int[np.ndarray, "boxes 27"], np.ndarray]:
    """Nodes of each box, the lowest first, and the nodes [m]."""
    many = 2 * counts + 1
    grid = np.stack(np.meshgrid(*map(np.arange, many), indexing="ij"), axis=-1).reshape(-1, 3)
    first = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    local = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    number = 2 * first.reshape(-1, 1, 3) + local
    stride = np.array([many[1] * many[2], many[2], 1])
    return number @ stride, lower + grid * edges / 2


def _dofs(cells) -> np.ndarray:
    return (3 * cells[..., None] + np.arange(3)).reshape(len(cells), 3 * cells.shape[1])


def _samples(line: np.ndarray, edges: np.ndarray) -> Samples:
    at = np.stack(np.meshgrid(*[line] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.stack([(1 - at) * (1 - 2 * at), 4 * at * (1 - at), at * (2 * at - 1)])
    slopes = np.stack([4 * at - 3, 4 - 8 * at, 4 * at - 1]) / edges
    parts = []
    for axis in range(3):
        lines = [slopes[..., i] if i == axis else values[..., i] for i in range(3)]
        parts.append(np.einsum("aq,bq,cq->qabc", *lines).reshape(len(at), -1))
    gradient = np.stack(parts, axis=-1)  # points, nodes, axis
    both = np.einsum("qai,qbj->qaibj", gradient, gradient)
    law = np.swapaxes(both, 2, 4) - 2 / 3 * both
    dot = np.einsum("qaibi->qab", both)
    for i in range(3):
        law[:, :, i, :, i] += dot
    size = 3 * gradient.shape[1]
    law = law.reshape(len(at), size, size)[:, *np.triu_indices(size)]
    modes = np.concatenate([np.ones((len(at), 1)), 2 * at - 1], axis=1)
    return Samples(at, modes, gradient.reshape(len(at), -1), law)


def _matrices(samples: Samples, volumes, shear: float, bulk: float) -> np.ndarray:
    """Upper triangles of boxes whose samples have these volumes [m^3]."""
    seen = np.einsum("cq,qm,qd->cmd", volumes, samples.modes, samples.gradient, optimize=True)
    gram = np.einsum("cq,qm,qn->cmn", volumes, samples.modes, samples.modes, optimize=True)
    # what a nearly empty box does not tell apart takes no pressure
    squeezed = np.swapaxes(seen, 1, 2) @ (np.linalg.pinv(gram, 1e-6, hermitian=True) @ seen)
    first, second = np.triu_indices(seen.shape[2])
    return shear * (volumes @ samples.shear) + bulk * squeezed[:, first, second]


def _filled(shape: AbstractSdf, start, edges) -> Int[np.ndarray, " boxes"]:
    """1 where a box lies in the shape, -1 where it does not, 0 where it may be cut."""
    middle = _field(shape, start + edges / 2)
    reach = np.linalg.norm(edges) / 2
    return np.where(middle < -reach, 1, np.where(middle > reach, -1, 0))


def covered(shape: AbstractSdf, points, edge: float) -> Float[np.ndarray, "*points"]:
    """Share of the cube with this `edge` [m] around each point that lies in the shape."""
    depth = _field(shape, points.reshape(-1, 3)).reshape(points.shape[:-1])
    return np.clip(0.5 - depth / edge, 0.0, 1.0)


def _field(shape: AbstractSdf, points) -> Float[np.ndarray, " points"]:
    """By one program for any number, as it takes longer to compile than to run."""
    found = []
    for at in range(0, max(len(points), 1), _POINTS):
        some = points[at : at + _POINTS]
        rest = np.zeros((_POINTS - len(some), points.shape[1]))
        field = evaluate(shape, jnp.asarray(np.concatenate([some, rest])))
        found.append(np.asarray(field)[: len(some)])
    return np.concatenate(found)

"""A reduced body whose force comes from a few weighted cells (hyper-reduction): trained from
the full body by one verb.

Shapes are the main directions of equilibria under given inputs, of their derivatives by these
inputs, and the lowest eigenmodes. Weights make the work of the chosen cells along every shape
that of all cells, in the states of training; as none is negative, the sum is an energy.

Reference:
    Farhat, Chapman, Avery, Structure-preserving, stability, and accuracy properties of the
    energy-conserving sampling and weighting method for the hyper reduction of nonlinear finite
    element dynamic models, Int. J. Num. Meth. Eng. 102, 2015.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import fem
from sorojax._display import displayed
from sorojax._progress import report
from sorojax.fem.assembly.energy import (
    Body,
    Entries,
    Response,
    energy_density,
    response,
    tangent_entries,
)
from sorojax.fem.assembly.geometry import deformation, quadrature_points
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.fem.kinematics import component_pairs, entries_of
from sorojax.fem.problem import body as bare, body_at, load_force
from sorojax.math.linalg.sparse import product
from sorojax.systems.blocks.fem_body import FemBody
from sorojax.systems.blocks.modal_basis import (
    Basis,
    Modes,
    coordinates,
    displacement,
    orthonormal,
)
from sorojax.systems.blocks.modal_body import (
    AbstractModalForce,
    ModalBody,
    Polynomial,
    derivatives,
    modal_body,
    reducible,
    without_weight,
)

_EIGENMODES = 2  # of the shapes, beside those of the equilibria
_AROUND = 0.05  # of the spread of states: how far more of them are drawn about each
_SLOPES = 0.2  # weight of the slopes of the force, beside it
_SMALL = 0.1  # of the largest displacement: errors of smaller ones count as of one of this size
_PASSES = 12  # of Newton's method to an equilibrium
_MOST = 400  # cells that are chosen at most


class SampledForce(AbstractModalForce):
    """The force of a few cells, each times a weight.

    Attributes:
        body: Data of the energy of the chosen cells.
        rest: Kept entries of F at q = 0.
        slopes: Their derivatives by the modal coordinates [1/m].
        volumes: Of the quadrature points, times the weight of their cell [m^3].
        loads: Force of the loads that are not driven.
        trained: Largest change of an entry of F that the training has seen; None without one.
    """

    body: Body
    rest: Entries
    slopes: Float[Array, "modes entries quad cells"]
    volumes: Float[Array, "quad cells"]
    loads: Polynomial
    trained: Float[Array, ""] | None = None

    @property
    def is_trained(self):
        return self.trained is not None

    def reach(self, q):
        assert self.trained is not None
        return self.strain(q) / self.trained

    def strain(self, q: Modes) -> Float[Array, ""]:
        """Largest change of an entry of F from q = 0."""
        return jnp.max(jnp.abs(jnp.tensordot(q, self.slopes, 1)))

    def __call__(self, q):
        return _of_cells(self, q) - self.loads(q)

    def energy(self, q):
        zero, terms = jnp.zeros_like(q), self.loads.terms
        scaled = tuple(term / (k + 1) for k, term in enumerate(terms))
        return self._stored(q) - self._stored(zero) - Polynomial(scaled)(q) @ q

    def stored_by(self, F: Entries) -> Float[Array, ""]:
        """Energy of the cells [J] with these entries of F."""
        return jnp.sum(self.volumes * energy_density(self.body, F))

    def stiffness(self, q: Modes) -> Float[Array, "modes modes"]:
        """Derivative of the force of the cells: dP/dF at each point, between the slopes."""
        answer = response(self.body, self._gradients(q), None, lambda work: work())
        kinematics, count = self.body.kinematics, q.shape[0]
        blocks = tangent_entries(kinematics, answer.tangent)
        tangent = {}
        for (i, k), block in zip(component_pairs(kinematics.dim), blocks, strict=True):
            for (e, _), row in zip(entries_of(kinematics, i), block, strict=True):
                for (f, _), entry in zip(entries_of(kinematics, k), row, strict=True):
                    tangent[e, f] = tangent[f, e] = (self.volumes * entry)[None]
        # points last, so that many members are one product of matrices
        every = range(self.slopes.shape[1])
        bent = [sum(tangent[e, f] * self.slopes[:, f] for f in every) for e in every]
        flat = self.slopes.reshape(count, -1)
        total = jnp.stack(bent, axis=1).reshape(count, -1) @ flat.T
        return total if self.body.modes is None else total + self._bulk(answer)

    def _bulk(self, answer: Response) -> Float[Array, "modes modes"]:
        """Stiffness of the pressures of the cells, which couple the points of each."""
        modes, volumes = self.body.modes, self.body.volumes
        assert modes is not None and answer.slopes is not None and answer.stiffness is not None
        turned = jnp.einsum("eqc,meqc->mqc", answer.slopes, self.slopes)
        each = jnp.einsum("aqc,qc,mqc->mac", modes, volumes, turned)
        weights = self.volumes[0] / volumes[0]
        return jnp.einsum("c,mac,abc,nbc->mn", weights, each, answer.stiffness, each)

    def _stored(self, q: Modes) -> Float[Array, ""]:
        return self.stored_by(self._gradients(q))

    def _gradients(self, q: Modes) -> Entries:
        return self.rest + jnp.tensordot(q, self.slopes, 1)


@eqx.filter_custom_jvp
def _of_cells(force: SampledForce, q: Modes) -> Modes:
    """Force of the cells. Its derivative by all coordinates, which implicit steps ask for, is
    one stiffness and not a pass for each."""
    return jax.grad(force._stored)(q)


@_of_cells.def_jvp
def _(primals, tangents):
    (force, q), (numbers, way) = primals, tangents
    found = jax.grad(force._stored)(q)
    change = jnp.zeros_like(found) if way is None else force.stiffness(q) @ way
    if any(leaf is not None for leaf in jax.tree.leaves(numbers, is_leaf=lambda x: x is None)):
        by_numbers = eqx.filter_jvp(lambda f: jax.grad(f._stored)(q), (force,), (numbers,))[1]
        change = change + by_numbers
    return found, change


def sampled_force(
    body: FemBody,
    basis: Basis,
    cells: Int[np.ndarray, " kept"],
    weights: Float[Array | np.ndarray, " kept"],
) -> SampledForce:
    """The force of `cells` of a body, each times its weight."""
    free = body.loaded({name: jnp.zeros_like(x.value) for name, x in body.drives.items()})
    whole = _cells(free, basis)
    chosen = _taken(whole, np.asarray(cells), free.mesh.num_cells)

    def loads(q):
        force = load_force(free, displacement(basis, q))
        return jnp.einsum("kni,ni->k", basis.shapes, force)

    zero = jnp.zeros(len(basis), basis.shapes.dtype)
    made = Polynomial(derivatives(loads, zero, 3))
    volumes = chosen.volumes * jnp.asarray(weights)[None]
    return eqx.tree_at(lambda f: (f.volumes, f.loads), chosen, (volumes, made))


def _cells(problem: fem.Problem, basis: Basis) -> SampledForce:
    """Every cell of a problem, once."""
    mesh, kinematics = problem.mesh, problem.kinematics
    points = quadrature_points(mesh, kinematics)
    rest = deformation(mesh, kinematics, points, basis.displacement)
    still = jnp.zeros_like(basis.displacement)
    identity = deformation(mesh, kinematics, points, still)
    moved = jax.lax.map(lambda s: deformation(mesh, kinematics, points, s), basis.shapes)
    slopes = moved - identity[None]
    energy = body_at(bare(problem), points)
    none = Polynomial((jnp.zeros(len(basis), rest.dtype),))
    return SampledForce(energy, rest, slopes, points.volumes, none)


def _taken(force: SampledForce, cells: np.ndarray, count: int) -> SampledForce:
    """The force of some of the cells."""

    def last(leaf):
        by_cell = eqx.is_array(leaf) and leaf.ndim > 0 and leaf.shape[-1] == count
        return leaf[..., cells] if by_cell else leaf

    energy, rest, volumes = jax.tree.map(last, (force.body, force.rest, force.volumes))
    return SampledForce(energy, rest, force.slopes[..., cells], volumes, force.loads)


# Training: shapes from equilibria, cells and weights from their forces


@displayed
class SampledBody(eqx.Module):
    """A trained reduction: `sampled_body(body, paths)`.

    Attributes:
        body: The reduced body, a block with the ports of the full one and `reach`.
        cells: Those that its force comes from.
        weights: How many cells each stands for.
        training_error: Of the force and its slopes in the states of training, relative, each
            as the displacement that it makes.
        error: Of the displacement at equilibria that the training has not seen, in the norm
            of the mass, over the largest displacement; infinite where none is found.
        num_cells: Of the full body.
    """

    body: ModalBody
    cells: Int[Array, " kept"]
    weights: Float[Array, " kept"]
    training_error: Float[Array, ""]
    error: Float[Array, ""]
    num_cells: int = eqx.field(static=True)

    def _text(self) -> str:
        share = len(self.cells) / self.num_cells
        return (
            f"SampledBody: {len(self.body.basis)} shapes, {len(self.cells)} of "
            f"{self.num_cells} cells ({share:.1%})\n  force off by "
            f"{float(self.training_error):.2g} in training, displacement by "
            f"{float(self.error):.2g} beside it"
        )


Inputs = Mapping[str, Float[Array | np.ndarray, "states ..."]]


def sampled_body(
    body: FemBody,
    paths: Sequence[Inputs],
    *,
    motions: Sequence[Float[Array | np.ndarray, "frames nodes dim"]] = (),
    modes: int = 12,
    tolerance: float = 1e-2,
    states: int = 3,
    seed: int = 0,
) -> SampledBody:
    """The body in a few shapes, with the force of a few weighted cells, trained on equilibria.

    Of every path of inputs the equilibria and their derivatives by the inputs are found; every
    second equilibrium is trained on, the others tell the error. Driven loads work as in
    `modal_body`: of a pressure exactly, as the volume is a cubic of the shapes. What a fast
    motion adds to the shapes of equilibria has to be seen: give some `motions` too.

    Args:
        body: The full body.
        paths: Of the inputs, each from rest: values of driven loads by name, one row per
            equilibrium, in the unit of the load; one load in a path.
        motions: Displacements of the full body in motions like those that are asked for later
            [m], `film.state["body"]["u"]` of a network or those of `fem.simulate`.
        modes: Number of shapes.
        tolerance: Relative error of the force in training at which no more cells are chosen.
        states: How many states are drawn around each equilibrium, so that the force is right
            beside the paths too.
        seed: Of these.

    Returns:
        The reduced body, and how well it stands for the full one. Reports its progress.

    Raises:
        ValueError: If there are too few equilibria for the shapes, a path names no driven
            load, a body is in contact, or `modal_body` refuses it.

    Its output `reach` is the largest strain in the chosen cells over that of the training. A
    run that passes 1.25 at a saved instant ends as `Status.outside_model`.

    Example:
        >>> bar = mesh.rectangle([0, 0], [80 * mm, 10 * mm], divisions=(12, 2))
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),),
        ...     loads=(fem.Force(bar.node_sets["right"], [0.0, 0.0], name="push"),))
        >>> pushes = jnp.stack([jnp.zeros(9), jnp.linspace(0, 0.2, 9)], axis=1)
        >>> small = systems.sampled_body(
        ...     systems.FemBody(problem, driven=("push",)), [{"push": pushes}], modes=6)
        >>> len(small.body.basis), bool(small.error < 0.02)
        (6, True)
    """
    _checked(body, paths, modes)
    weighed, body = body, without_weight(body)
    seen, told, slopes = _equilibria(body, paths)
    report("sampled_body: cells", 0, 1)
    shown = [jnp.asarray(u) for frames in motions for u in frames]
    basis = snapshot_basis(body, jnp.stack([*(s.u for s in seen), *slopes, *shown]), modes)
    count = body.problem.mesh.num_cells
    every = sampled_force(body, basis, np.arange(count), np.ones(count))
    whole = modal_body(weighed, basis, order=None)
    whole = eqx.tree_at(lambda b: b.force, whole, every)
    known = [coordinates(body, basis, s.u) for s in seen]
    free = [coordinates(body, basis, u) for u in shown]
    near: list = [(q, None, 0) for q in free]
    for q, state in zip(known, seen, strict=True):
        near.append((q, -_slope(whole, state.inputs, q), states))
    spread = _AROUND * jnp.std(jnp.stack([*known, *free]), axis=0)
    cells, weights, left = _chosen(every, near, spread, tolerance, seed)
    chosen = sampled_force(body, basis, cells, weights)
    known += [coordinates(body, basis, s.u) for s in told]
    trained = jnp.max(jax.vmap(chosen.strain)(jnp.stack([*known, *free])))
    chosen = dataclasses.replace(chosen, trained=trained)
    small = eqx.tree_at(lambda b: b.force, whole, chosen)
    error = _error(body, small, told)
    report("sampled_body: cells", 1, 1)
    return SampledBody(small, *map(jnp.asarray, (cells, weights, left)), error, count)


class _State(NamedTuple):
    """An equilibrium [m], its inputs, and the equilibrium before it on its path [m]."""

    u: Float[Array, "nodes dim"]
    inputs: dict[str, Array]
    before: Float[Array, "nodes dim"]


def _equilibria(
    body: FemBody, paths: Sequence[Inputs]
) -> tuple[list[_State], list[_State], list[Float[Array, "nodes dim"]]]:
    """Those to train on, those that tell the error, and displacements by the inputs."""
    rest = {name: jnp.zeros_like(load.value) for name, load in body.drives.items()}
    seen, told, slopes = [], [], []
    for number, path in enumerate(paths):
        report("sampled_body: equilibria", number, len(paths))
        ((name, rows),) = path.items()
        rows = jnp.asarray(rows)
        driven: dict[str, Any] = {name: rows}
        solved = fem.solve_path(body.loaded(rest), **driven).displacements
        reach = jnp.max(jnp.abs(rows), axis=0)
        for k, (u, row) in enumerate(zip(solved, rows, strict=True)):
            state = _State(u, {**rest, name: row}, solved[max(k - 1, 0)])
            (told if k % 2 else seen).append(state)
            if k % 2 == 0:
                slopes.extend(_slopes(body, u, state.inputs, name, reach))
    return seen, told, slopes


def _error(body: FemBody, small: ModalBody, told: Sequence[_State]) -> Float[Array, ""]:
    """Largest difference to equilibria in the norm of the mass, over the largest of these."""
    off, sizes = [], []
    for state in told:
        start = coordinates(body, small.basis, state.before)
        q = _equilibrium(small, state.inputs, start)
        off.append(_size(body, state.u - displacement(small.basis, q)))
        sizes.append(_size(body, state.u))
    error = jnp.max(jnp.stack(off)) / jnp.max(jnp.stack(sizes))
    return jnp.where(jnp.isfinite(error), error, jnp.inf)


def _checked(body: FemBody, paths: Sequence[Inputs], modes: int) -> None:
    reducible("sampled_body", body)
    touching = [load.name for load in body.problem.loads if not load.smooth]
    if touching:
        raise ValueError(
            f"sampled_body: got contact {touching}, need loads that are smooth functions of "
            "the displacement. Keep the FemBody, or modal_body(..., order=None)."
        )
    for path in paths:
        if len(path) != 1 or not set(path) <= set(body.drives):
            raise ValueError(
                f"sampled_body: got a path of {sorted(path)}, need one driven load of "
                f"{sorted(body.drives)}. Give one path per load."
            )
    count = sum(len(rows) for path in paths for rows in path.values())
    if count < 4 or modes < 1 + _EIGENMODES:
        raise ValueError(
            f"sampled_body: got {count} equilibria and {modes} modes, need 4 and "
            f"{1 + _EIGENMODES} or more. Give longer paths."
        )


def _slopes(body: FemBody, u, values, name: str, reach) -> list[Float[Array, "nodes dim"]]:
    """What each component of an input adds to an equilibrium, times its range."""
    problem = body.loaded(values)

    def force(value):
        return load_force(body.loaded({**values, name: value}), u).ravel()

    slopes = jax.jacfwd(force)(values[name]).reshape(u.size, -1).T
    found = tangent_solve(problem, u, slopes * reach.reshape(-1, 1))
    return list(found.reshape(-1, *u.shape))


def _size(body: FemBody, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Norm of a displacement in the mass."""
    weighed = product(body.problem.space.system, body.matter().mass, u.ravel())
    return jnp.sqrt(u.ravel() @ weighed)


def snapshot_basis(
    body: FemBody, displacements: Float[Array, "states nodes dim"], modes: int
) -> Basis:
    """Shapes for `modal_body`: the lowest eigenmodes and the main directions of displacements
    from rest (proper orthogonal decomposition in the mass)."""
    system, mass = body.problem.space.system, body.matter().mass
    rows = displacements.reshape(displacements.shape[0], -1)
    sizes = jax.vmap(lambda row: jnp.sqrt(row @ product(system, mass, row)))(rows)
    rows = rows[np.asarray(sizes) > 1e-12 * float(jnp.max(sizes))]
    weighed = jax.vmap(lambda row: product(system, mass, row))(rows)
    values, vectors = jnp.linalg.eigh(rows @ weighed.T)
    main = (vectors[:, ::-1].T @ rows)[: modes - _EIGENMODES]
    still = jnp.zeros_like(displacements[0])
    eigen = fem.eigenmodes(body.problem, still, _EIGENMODES).shapes
    both = jnp.concatenate([main, eigen.reshape(_EIGENMODES, -1)])
    shapes = orthonormal(system, mass, both)
    return Basis(still, shapes.reshape(-1, *still.shape))


def _chosen(
    whole: SampledForce,
    states: Sequence[tuple[Modes, Float[Array, "modes modes"] | None, int]],
    spread: Modes,
    tolerance: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Cells and their weights, and the error that is left; from coordinates, the stiffness at
    equilibria, and how many more states are drawn about each.

    Each state has rows of the force, as the displacement that it makes there, and of its
    slopes, as a metric sees them that makes their sum one: small errors in stiff directions
    would otherwise hide soft ones.
    """
    upper = np.triu_indices(len(spread))

    def of_cells(q):
        P = jax.grad(whole.stored_by)(whole.rest + jnp.tensordot(q, whole.slopes, 1))
        return jnp.einsum("eqc,meqc->mc", P, whole.slopes)

    @jax.jit
    def rows_of(q, stiffness):
        slopes = jax.jacfwd(of_cells)(q)
        values, vectors = jnp.linalg.eigh(jnp.sum(slopes, axis=1))
        half = vectors.T / jnp.sqrt(jnp.abs(values))[:, None]
        bent = jnp.einsum("am,mcn,bn->abc", half, slopes, half)[upper]
        size = jnp.sqrt(jnp.asarray(len(values), q.dtype))
        force = of_cells(q)
        moved = half.T @ half @ force
        if stiffness is not None:
            moved = jnp.linalg.solve(stiffness, force)
        return moved, _SLOPES * bent / size

    draw = np.random.default_rng(seed)
    rows = []
    for q, stiffness, more in states:
        for away in (0.0, *draw.normal(size=(more, len(q)))):
            rows.append(rows_of(q + spread * jnp.asarray(away), stiffness))
    forces, slopes = ([np.asarray(x) for x in kind] for kind in zip(*rows, strict=True))
    sizes = np.array([np.linalg.norm(force.sum(axis=1)) for force in forces])
    sizes = np.maximum(sizes, _SMALL * sizes.max())
    sized = [force / size for force, size in zip(forces, sizes, strict=True)]
    return sparse_weights(np.concatenate([*sized, *slopes]), tolerance)


def sparse_weights(
    rows: Float[np.ndarray, "rows cells"], tolerance: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Few columns and weights, none negative, whose weighted sum is that of all columns up to
    a relative error, and that error: Lawson and Hanson's method, ended early.

    Reference:
        Chapman, Avery, Collins, Farhat, Accelerated mesh sampling for the hyper reduction of
        nonlinear computational models, Int. J. Num. Meth. Eng. 109, 2017.
    """
    want = rows.sum(axis=1)
    size, left = np.linalg.norm(want), want
    chosen, weights = np.zeros(0, int), np.zeros(0)
    while np.linalg.norm(left) > tolerance * size and len(chosen) < min(_MOST, rows.shape[1]):
        gain = rows.T @ left
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        if not gain[best] > 0:
            break
        chosen, weights = np.append(chosen, best), np.append(weights, 0.0)
        while True:
            trial = np.linalg.lstsq(rows[:, chosen], want, rcond=None)[0]
            if (trial > 0).all():
                weights = trial
                break
            low = trial <= 0
            share = np.min(weights[low] / (weights[low] - trial[low]))
            weights = weights + share * (trial - weights)
            kept = weights > 1e-12 * weights.max()
            chosen, weights = chosen[kept], weights[kept]
        left = want - rows[:, chosen] @ weights
    order = np.argsort(chosen)
    return chosen[order], weights[order], float(np.linalg.norm(left) / size)


def _accelerated(body: ModalBody, q: Modes, values: Mapping[str, Array]) -> Modes:
    """Acceleration from rest under values of the driven loads."""
    inputs = {port: values[name] for name, port, *_ in body.ports}
    return body.pull(q, 0.0 * q, inputs)


@jax.jit
def _slope(body: ModalBody, values: Mapping[str, Array], q: Modes):
    """Derivative of the acceleration from rest by the coordinates: one program for all."""
    return jax.jacfwd(lambda q: _accelerated(body, q, values))(q)


@jax.jit
def _equilibrium(body: ModalBody, values: Mapping[str, Array], start: Modes) -> Modes:
    """Coordinates at rest, by Newton's method."""

    def closer(q, _):
        slope = _slope(body, values, q)
        return q - jnp.linalg.solve(slope, _accelerated(body, q, values)), None

    return jax.lax.scan(closer, start, length=_PASSES)[0]

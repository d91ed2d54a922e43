"""A reduced body whose force comes from a few weighted cells, trained by one verb.

Shapes are the main directions of equilibria under given inputs, of their derivatives by these
inputs, and of motions, or else the lowest eigenmodes. Weights make the work of the chosen cells
along every shape that of all cells, in the states of training.

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
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from sorojax import fem
from sorojax._display import displayed
from sorojax._progress import report
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.fem.problem import load_force
from sorojax.fem.relaxation import at_instant, moduli, relaxed
from sorojax.material import Viscoelastic
from sorojax.material.viscoelastic import branch_moduli
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
    ModalBody,
    modal_body,
    reducible,
    without_contacts,
    without_weight,
)
from sorojax.systems.blocks.sampled_force import (
    Branches,
    SampledForce,
    pieces,
    sampled_force,
)

_EIGENMODES = 2  # of the shapes, where no motion is shown
_AROUND = 0.02  # of the spread of states: how far more of them are drawn about each
_SLOPES = 0.2  # weight of the slopes of the force, beside it
_SMALL = 0.1  # of the largest displacement: errors of smaller ones count as of one of this size
_SOFTEST = 0.1  # of the stiffness without loads: what errors of the force are divided by
_FREE = 1e-9  # of the largest stiffness: below it a shape moves the body as a whole
_PASSES = 12  # of Newton's method to an equilibrium
_ROOT = 1e-6  # of the largest coordinate: change by which it is one
_CANDIDATES = 6000  # cells or points among which is chosen, at most
_FRAMES = 200  # of the motions that cells are chosen by, at most about
_MOST = 400  # cells that are chosen at most


@displayed
class SampledBody(eqx.Module):
    """A trained reduction: `sampled_body(body, paths)`.

    Attributes:
        body: The reduced body, a block with the ports of the full one and `reach`.
        cells: Those that its force comes from. A cell stands there for each of its points
            that are chosen, where these can be chosen one by one: where no pressure is one
            unknown of the whole cell.
        weights: How many cells, or points, each stands for.
        training_error: Of the force and its slopes in the states of training, relative, each
            as the displacement that it makes.
        error: Of the displacement at equilibria that the training has not seen, in the norm
            of the mass, over the largest displacement; infinite where none is found. Without
            paths, at frames of the motions.
        share: Of all quadrature points, those that are evaluated.
        num_cells: Of the full body.
    """

    body: ModalBody
    cells: Int[Array, " kept"]
    weights: Float[Array, " kept"]
    training_error: Float[Array, ""]
    error: Float[Array, ""]
    share: Float[Array, ""]
    num_cells: int = eqx.field(static=True)

    def _text(self) -> str:
        cells = len(np.unique(np.asarray(self.cells)))
        return (
            f"SampledBody: {len(self.body.basis)} shapes, {float(self.share):.1%} of the "
            f"quadrature points, in {cells} of {self.num_cells} cells\n  force off by "
            f"{float(self.training_error):.2g} in training, displacement by "
            f"{float(self.error):.2g} beside it"
        )


Inputs = Mapping[str, Float[Array | np.ndarray, "states ..."]]


def sampled_body(
    body: FemBody,
    paths: Sequence[Inputs] = (),
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
    motion adds to the shapes of equilibria has to be seen: give some `motions` too. A body of a
    `Viscoelastic` material is trained on its equilibria when all has relaxed; what it does at
    once is added to the shapes, and its branches relax in coordinates of their own.

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
            load, a body is in contact, or `modal_body` refuses it; if a body relaxes in plane
            stress, or with times per cell.

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
    given, body = body, _without_memory(body)
    shown = [jnp.asarray(u) for frames in motions for u in frames]
    _checked(body, paths, modes, len(shown))
    weighed, body = body, without_contacts(without_weight(body))
    seen, told, slopes = _equilibria(body, paths, given.problem)
    report("sampled_body: cells", 0, 1)
    shown, beside = (shown, []) if paths else (shown[::2], shown[1::2])
    eigen = 0 if motions else _EIGENMODES
    snapshots = jnp.stack([*(s.u for s in seen), *slopes, *shown])
    basis = snapshot_basis(body, snapshots, modes, eigen=eigen)
    cells, points = pieces(body)
    every = sampled_force(body, basis, cells, np.ones(len(cells)), points)
    whole = modal_body(_without_viscosity(weighed), basis, order=None)
    whole = eqx.tree_at(lambda b: b.force, whole, every)
    known = [coordinates(body, basis, s.u) for s in seen]
    free = [coordinates(body, basis, u) for u in shown[:: 1 + len(shown) // _FRAMES]]
    near = [(q, _stiffness_in_motion(whole, q), 0) for q in free]
    for q, state in zip(known, seen, strict=True):
        near.append((q, -_slope(whole, state.inputs, q), states))
    spread = _AROUND * jnp.std(jnp.stack([*known, *free]), axis=0)
    kept, weights, left = _chosen(every, near, spread, tolerance, seed)
    cells, points = cells[kept], None if points is None else points[kept]
    chosen = sampled_force(body, basis, cells, weights, points)
    known += [coordinates(body, basis, s.u) for s in told]
    shown_at = jnp.stack([*known, *free])
    trained = jnp.max(jax.vmap(chosen.strain)(shown_at))
    branches = _branches(given, cells)
    viscosity = _viscosity(given, cells)
    chosen = dataclasses.replace(
        chosen, trained=trained, branches=branches, viscosity=viscosity
    )
    touching = tuple(one.near(shown_at) for one in whole.contacts)
    small = dataclasses.replace(whole, force=chosen, contacts=touching)
    error = _error(body, small, told) if told else _error_of_frames(body, small, whole, beside)
    report("sampled_body: cells", 1, 1)
    share = chosen.volumes.size / every.volumes.size
    told = map(jnp.asarray, (cells, weights, left, error, share))
    return SampledBody(small, *told, body.problem.mesh.num_cells)


def _without_memory(body: FemBody) -> FemBody:
    """The body with the law that is left when it has relaxed."""
    law = body.problem.material
    if not isinstance(law, Viscoelastic):
        return body
    if not body.problem.kinematics.has_volume:
        raise ValueError(
            "sampled_body: got a Viscoelastic sheet in plane stress, need plane strain, an "
            "axisymmetric body or a solid. Keep the FemBody."
        )
    if any(jnp.ndim(time) for time in law.relaxation.times):
        raise ValueError(
            "sampled_body: got relaxation times per cell, need those of the whole body, as "
            "its coordinates relax. Give shares per cell, 0 where there is no branch."
        )
    return eqx.tree_at(lambda b: b.problem.material, body, law.base)


def _branches(body: FemBody, cells: np.ndarray) -> Branches | None:
    law, count = body.problem.material, body.problem.mesh.num_cells
    if not isinstance(law, Viscoelastic):
        return None
    shear = [jnp.broadcast_to(modulus, (count,))[cells] for modulus in branch_moduli(law)]
    return Branches(jnp.stack(shear)[:, None], jnp.stack(law.relaxation.times))


def _without_viscosity(body: FemBody) -> FemBody:
    """The body with the damping that is the same in every state."""
    return dataclasses.replace(body, damping=tuple(x for x in body.damping if x.constant))


def _viscosity(body: FemBody, cells: np.ndarray) -> Float[Array, " kept"] | None:
    """Of the cells [Pa s], all there is together; None without any."""
    count = body.problem.mesh.num_cells
    found = [x.viscosity for x in body.damping if isinstance(x, fem.KelvinVoigt)]
    if not found:
        return None
    return jnp.sum(jnp.stack([jnp.broadcast_to(x, (count,))[cells] for x in found]), axis=0)


class _State(NamedTuple):
    """An equilibrium [m], and its inputs."""

    u: Float[Array, "nodes dim"]
    inputs: dict[str, Array]


def _equilibria(
    body: FemBody, paths: Sequence[Inputs], given: fem.Problem
) -> tuple[list[_State], list[_State], list[Float[Array, "nodes dim"]]]:
    """Those to train on, those that tell the error, and displacements by the inputs, at once
    too where the problem that was `given` relaxes."""
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
            state = _State(u, {**rest, name: row})
            (told if k % 2 else seen).append(state)
            if k % 2 == 0:
                slopes.extend(_slopes(body, u, state.inputs, name, reach))
                if given.material is not body.problem.material:
                    law = at_instant(given, moduli(given), relaxed(given, u)).material
                    sudden = eqx.tree_at(lambda b: b.problem.material, body, law)
                    slopes.extend(_slopes(sudden, u, state.inputs, name, reach))
    return seen, told, slopes


def _error(body: FemBody, small: ModalBody, told: Sequence[_State]) -> Float[Array, ""]:
    """Largest difference to equilibria in the norm of the mass, over the largest of these."""
    off, sizes = [], []
    for state in told:
        q = _equilibrium(small, state.inputs, coordinates(body, small.basis, state.u))
        off.append(_size(body, state.u - displacement(small.basis, q)))
        sizes.append(_size(body, state.u))
    error = jnp.max(jnp.stack(off)) / jnp.max(jnp.stack(sizes))
    return jnp.where(jnp.isfinite(error), error, jnp.inf)


def _error_of_frames(
    body: FemBody, small: ModalBody, whole: ModalBody, beside: Sequence[Array]
) -> Float[Array, ""]:
    """Largest error of displacements that were not trained on, what the shapes miss of them and
    what the cells do, over the largest of them without their part in a motion of the whole."""

    def squares(u):
        q = coordinates(body, small.basis, u)
        missed = _size(body, u - displacement(small.basis, q))
        lack = small.force(q) - whole.force(q)
        values, vectors = jnp.linalg.eigh(jax.jacfwd(whole.force)(q))
        held = values > _FREE * values[-1]
        moved = jnp.where(held, vectors.T @ lack / jnp.where(held, values, 1.0), 0.0)
        bent = jnp.where(held, vectors.T @ (q - small.q), 0.0)
        return missed**2 + moved @ moved, missed**2 + bent @ bent

    off, size = jax.lax.map(squares, jnp.stack(beside))
    return jnp.sqrt(jnp.max(off) / jnp.max(size))


def _checked(body: FemBody, paths: Sequence[Inputs], modes: int, frames: int) -> None:
    reducible("sampled_body", body)
    for load in body.problem.loads:
        if not (load.smooth or isinstance(load, fem.Contact)):
            raise ValueError(
                f"sampled_body: got the contact `{load.name}` of the body with itself, need "
                "loads that are smooth functions of the displacement, or fem.Contact. Keep "
                "the FemBody."
            )
    for path in paths:
        if len(path) != 1 or not set(path) <= set(body.drives):
            raise ValueError(
                f"sampled_body: got a path of {sorted(path)}, need one driven load of "
                f"{sorted(body.drives)}. Give one path per load."
            )
    free = not body.problem.supports
    if free and paths:
        raise ValueError(
            "sampled_body: got paths of a body without supports, which has no equilibria of "
            "its own, need motions. Leave `paths` out and give `motions`."
        )
    count = sum(len(rows) for path in paths for rows in path.values())
    least = 1 + _EIGENMODES
    if modes < least or (count < 4 if paths else frames < 2 * modes):
        need = "4 equilibria" if paths else f"{2 * modes} frames, as there is no path,"
        raise ValueError(
            f"sampled_body: got {count} equilibria, {frames} frames and {modes} modes, need "
            f"{need} and {least} modes or more. Give longer paths or motions."
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
    body: FemBody,
    displacements: Float[Array, "states nodes dim"],
    modes: int,
    *,
    eigen: int = 0,
) -> Basis:
    """Shapes for `modal_body`: the main directions of displacements from rest (proper
    orthogonal decomposition), and as many of the lowest eigenmodes as `eigen` says. Of a body
    without supports its translations come first.

    Directions are ordered by their strain energy in small deformation and their mass, each as
    a share of the sum over all displacements. What a body in few shapes is off by is bounded by
    the energy that they miss: by mass alone the tip of a finger was off three times as far. A
    body without supports, which friction moves, gained nothing by it and keeps to the mass.
    """
    system, mass = body.problem.space.system, body.matter().mass
    still, free = jnp.zeros_like(displacements[0]), not body.problem.supports
    rows = displacements.reshape(displacements.shape[0], -1)

    def weighed(matrix, rows):
        return jax.vmap(lambda row: product(system, matrix, row))(rows)

    fixed = orthonormal(system, mass, _translations(body.problem)) if free else rows[:0]
    rows = rows - rows @ weighed(mass, fixed).T @ fixed if free else rows
    by_mass = rows @ weighed(mass, rows).T
    both = by_mass / jnp.trace(by_mass)
    if not free:
        unloaded = eqx.tree_at(lambda p: p.loads, body.problem, ())
        stiffness = linearise(unloaded, prepare(unloaded), still, still).values
        by_energy = rows @ weighed(stiffness, rows).T
        both = both + by_energy / jnp.trace(by_energy)
    kept = np.sqrt(np.asarray(jnp.diag(by_mass)))
    kept = np.flatnonzero(kept > 1e-12 * kept.max())
    _, vectors = jnp.linalg.eigh(both[jnp.ix_(kept, kept)])
    beside = [fixed] if free else [_eigenmodes(body.problem, still, eigen)] if eigen else []
    main = (vectors[:, ::-1].T @ rows[kept])[: modes - sum(map(len, beside))]
    shapes = orthonormal(
        system, mass, jnp.concatenate([*beside, main] if free else [main, *beside])
    )
    return Basis(still, shapes.reshape(-1, *still.shape))


def _eigenmodes(problem: fem.Problem, still, count: int) -> Float[Array, "modes dofs"]:
    return fem.eigenmodes(problem, still, count).shapes.reshape(count, -1)


def _translations(problem: fem.Problem) -> Float[Array, "directions dofs"]:
    """Displacements by one length of all nodes, along each axis of the world."""
    nodes, dim = problem.mesh.points.shape
    first = 1 if isinstance(problem.kinematics, fem.Axisymmetric) else 0
    return jnp.tile(jnp.eye(dim)[first:], (1, nodes))


def _chosen(
    whole: SampledForce,
    states: Sequence[tuple[Modes, Float[Array, "modes modes"], int]],
    spread: Modes,
    tolerance: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Cells and their weights, and the error that is left; from coordinates, the stiffness
    under the loads there, and how many more states are drawn about each.

    Each state has rows of the force, as the displacement that it makes under these loads, and
    of its slopes, as a metric sees them that makes their sum one: small errors in stiff
    directions would otherwise hide soft ones.
    """
    upper = np.triu_indices(len(spread))

    def of_cells(q):
        P = jax.grad(whole.stored_by)(whole.rest + jnp.tensordot(q, whole.slopes, 1))
        return jnp.einsum("eqc,meqc->mc", P, whole.slopes)

    @jax.jit
    def rows_of(q, stiffness):
        slopes = jax.jacfwd(of_cells)(q)
        half = _whitened(jnp.sum(slopes, axis=1))
        bent = jnp.einsum("am,mcn,bn->abc", half, slopes, half)[upper]
        size = jnp.sqrt(jnp.asarray(len(q), q.dtype))
        values, vectors = jnp.linalg.eigh(half @ stiffness @ half.T)
        ways = vectors.T @ half
        moved = ways.T @ ((ways @ of_cells(q)) / jnp.maximum(values, _SOFTEST)[:, None])
        return moved, _SLOPES * bent / size

    draw = np.random.default_rng(seed)
    # so many slopes have nearly the scalar products of all of them
    count, pieces = min(len(upper[0]), len(spread)), whole.volumes.shape[1]
    some = np.sort(draw.permutation(pieces)[:_CANDIDATES])
    rows = []
    for q, stiffness, more in states:
        for away in (0.0, *draw.normal(size=(more, len(q)))):
            moved, bent = rows_of(q + spread * jnp.asarray(away), stiffness)
            mix = draw.normal(size=(count, len(bent))) / np.sqrt(count)
            each = np.asarray(moved), mix @ np.asarray(bent)
            rows.append([(row[:, some], row.sum(axis=1)) for row in each])
    sizes = np.array([np.linalg.norm(moved[1]) for moved, _ in rows])
    sizes = np.maximum(sizes, _SMALL * sizes.max())
    sized = [(x / size for x in moved) for (moved, _), size in zip(rows, sizes, strict=True)]
    of_some, of_all = zip(*sized, *(bent for _, bent in rows), strict=True)
    found = sparse_weights(np.concatenate(of_some), np.concatenate(of_all), tolerance)
    return some[found[0]], *found[1:]


def _whitened(stiffness: Float[Array, "modes modes"]) -> Float[Array, "modes modes"]:
    """Combinations of the shapes, one a row, whose stiffness is one; nothing in the rows of
    those that move the body as a whole."""
    values, vectors = jnp.linalg.eigh(stiffness)
    size = jnp.abs(values)
    held = size > _FREE * jnp.max(size)
    return jnp.where(held, 1 / jnp.sqrt(jnp.where(held, size, 1.0)), 0.0)[:, None] * vectors.T


@jax.jit
def _stiffness_in_motion(body: ModalBody, q: Modes) -> Float[Array, "modes modes"]:
    """Stiffness at a frame of a motion, whose loads are not given: those that balance the
    force of the body best. Pressures may leave a tenth of what is stiff without them. What
    touches a body in contact is not known, so there it is the stiffness without loads."""
    force, stiffness = body.force(q), jax.jacfwd(body.force)(q)
    if body.contacts or not body.ports:
        return stiffness
    none = {port: jnp.zeros(shape, q.dtype) for _, port, shape, _ in body.ports}
    flat, inputs = ravel_pytree(none)
    half = _whitened(stiffness)
    pushes = jax.jacfwd(lambda values: body.loads(inputs(values))(q))(flat)
    values = jnp.linalg.lstsq(half @ pushes, half @ force)[0]
    return stiffness - jax.jacfwd(body.loads(inputs(values)))(q)


def sparse_weights(
    rows: Float[np.ndarray, "rows columns"], want: Float[np.ndarray, " rows"], tolerance: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Few columns and weights, none negative, whose weighted sum is `want` up to a relative
    error, and that error: Lawson and Hanson's method, ended early.

    Reference:
        Chapman, Avery, Collins, Farhat, Accelerated mesh sampling for the hyper reduction of
        nonlinear computational models, Int. J. Num. Meth. Eng. 109, 2017.
    """
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
    """Coordinates at rest, by Newton's method; infinite where it finds none."""

    def closer(q, _):
        slope = _slope(body, values, q)
        change = jnp.linalg.solve(slope, _accelerated(body, q, values))
        return q - change, jnp.max(jnp.abs(change))

    q, changes = jax.lax.scan(closer, start, length=_PASSES)
    found = changes[-1] <= _ROOT * jnp.maximum(jnp.max(jnp.abs(q)), jnp.max(jnp.abs(start)))
    return jnp.where(found, q, jnp.inf)

"""Load stepping and Newton's method inside a trace, as one compiled loop.

The `rules` are those of the driver on the host. Every pass assembles once and does one
thing: accept the load level, halve it, shorten the last update or take a Newton step with the
direct solver behind a callback.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax.fem.assembly.assemble import cell_matrices
from sorojax.fem.assembly.geometry import geometry
from sorojax.fem.assembly.space import Space
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import (
    Linearised,
    Prepared,
    constrain,
    linearise,
    load_stiffness,
    prepare,
)
from sorojax.fem.equilibrium.load_stepping import between, unloaded
from sorojax.fem.equilibrium.newton import Newton, overshoots, safe_fraction, share_of_step
from sorojax.fem.problem import Problem, unsupported, with_terms
from sorojax.fem.supports import known_components, known_values
from sorojax.math.linalg import sparse


class Begin(NamedTuple):
    """Where to start from: a displacement [m], the loads and supports it balances and the
    values of the tangent there, if known. Without loads and supports it is a guess of the
    end, and the load is followed from rest if it is too far away."""

    u: Float[Array, "nodes dim"]
    terms: tuple | None = None
    tangent: Float[Array, " nnz"] | None = None


class Outcome(NamedTuple):
    """Displacement, tangent values there (empty unless asked for), and as floats, so that
    one rule serves every output: failed or not, fraction of the load, iterations, cuts and
    load steps."""

    u: Float[Array, "nodes dim"]
    counts: Float[Array, " 5"]
    tangent: Float[Array, " nnz"]


class _State(NamedTuple):
    """`u` is the trial, `start` the last equilibrium on the `way`; `guess` while a guess of
    the end is tried. `share` of the last step was taken, at whose start the energy has the
    `slope` along it [J], zero where that is not judged, after so many `shortenings`."""

    u: Float[Array, "nodes dim"]
    before: Float[Array, "nodes dim"]
    start: Float[Array, "nodes dim"]
    tangent: Float[Array, " nnz"]
    predict: Bool[Array, ""]
    moved: Bool[Array, ""]
    shortened: Bool[Array, ""]
    guess: Bool[Array, ""]
    update: Float[Array, ""]
    way: rules.LoadSteps
    iterations: Int[Array, ""]
    total: Int[Array, ""]
    slope: Float[Array, ""]
    share: Float[Array, ""]
    shortenings: Int[Array, ""]
    running: Bool[Array, ""]


class _Level(NamedTuple):
    """Outcome of one pass at the trial state; exactly one of the first five is true. `slope`
    belongs to the next step `du`, `share` is what is to be taken of the last one where it
    `overran`: where the energy has turned before its end."""

    collapsed: Bool[Array, ""]
    overran: Bool[Array, ""]
    converged: Bool[Array, ""]
    failed: Bool[Array, ""]
    stepped: Bool[Array, ""]
    usable: Bool[Array, ""]
    du: Float[Array, "nodes dim"]
    values: Float[Array, " nnz"]
    slope: Float[Array, ""]
    share: Float[Array, ""]


def prepare_traced(problem: Problem) -> Prepared:
    """`linear.prepare` for a problem whose node numbers may be traced as well."""
    mesh, dim = problem.mesh, problem.mesh.element.dim
    known = known_mask(problem.supports, mesh.num_nodes, dim)
    parts = [load.curved_part(problem) for load in problem.loads]
    groups = [part.groups for part in parts if part is not None]
    slots = tuple(group_slots(problem.space.system, group, dim) for group in groups)
    shape = geometry(problem.space, problem.kinematics, problem.formulation, mesh.points)
    length = jnp.max(jnp.ptp(mesh.points[mesh.cells], axis=1))
    return Prepared(shape, known, length, slots)


def known_mask(supports: tuple, num_nodes: int, dim: int) -> Bool[Array, " dofs"]:
    """`known_dofs` where node numbers may be traced."""
    known = jnp.zeros((num_nodes, dim), bool)
    for support in supports:
        for component in known_components(support, dim):
            known = known.at[support.nodes, component].set(True)
    return known.ravel()


def group_slots(system: sparse.SparseSymmetric, groups, dim: int):
    """Slots of the upper triangles of groups of nodes, whose numbers may be traced."""
    dofs = (groups[:, :, None] * dim + jnp.arange(dim, dtype=groups.dtype)[None, None]).astype(
        jnp.int64
    )
    dofs = dofs.reshape(len(groups), -1)
    first, second = jnp.triu_indices(dofs.shape[1])
    low = jnp.minimum(dofs[:, first], dofs[:, second])
    high = jnp.maximum(dofs[:, first], dofs[:, second])
    keys = system.rows.astype(jnp.int64) * system.size + system.cols.astype(jnp.int64)
    return jnp.searchsorted(keys, low * system.size + high).astype(jnp.int32)


def follow_traced(
    problem: Problem,
    begin: Begin | None,
    newton: Newton,
    steps: int,
    max_cuts: int,
    prepared: Prepared | None = None,
    moves: bool = False,
) -> Outcome:
    """Step from `begin` to `problem`, halving steps that fail; every number may be traced. Of
    a body that `moves` all steps of Newton's method are judged by the energy at their ends."""
    first = _first(problem, begin)
    prepared = prepare_traced(problem) if prepared is None else prepared
    state = _initial(problem, begin, steps)

    def one_pass(state: _State) -> _State:
        here = between(first, problem, rules.goal(state.way))
        level = _examine(here, prepared, state, newton, moves)
        return _next(problem, prepared, state, level, steps, max_cuts)

    end = jax.lax.while_loop(lambda state: state.running, one_pass, state)
    way = end.way
    numbers = (way.done < 1.0, way.done, end.total, way.cuts, way.accepted)
    counts = jnp.stack([jnp.asarray(n, end.u.dtype) for n in numbers])
    return Outcome(end.start, counts, end.tangent)


def _first(problem: Problem, begin: Begin | None) -> Problem:
    if begin is None or begin.terms is None:
        return unloaded(problem)
    return with_terms(problem, begin.terms)


def _initial(problem: Problem, begin: Begin | None, steps: int) -> _State:
    points = problem.mesh.points
    u = jnp.zeros_like(points) if begin is None else jnp.asarray(begin.u, points.dtype)
    tangent = None if begin is None else begin.tangent
    predict = jnp.asarray(tangent is not None and rules.predicts(problem.loads))
    guess = begin is not None and begin.terms is None
    if tangent is None:
        tangent = jnp.zeros(problem.space.system.num_values, points.dtype)
    return _State(
        u=u,
        before=u,
        start=u,
        tangent=tangent,
        predict=predict,
        guess=jnp.asarray(guess),
        way=_way(1 if guess else steps, points.dtype),
        total=jnp.asarray(0, jnp.int32),
        running=jnp.all(jnp.isfinite(u)),
        **_unmoved(points.dtype),
    )


def _unmoved(dtype) -> dict[str, Array]:
    """What a state knows of a load level before the first step there."""
    false, none, zero = jnp.asarray(False), jnp.asarray(0, jnp.int32), jnp.zeros((), dtype)
    return {
        "moved": false,
        "shortened": false,
        "update": zero + jnp.inf,
        "iterations": none,
        "slope": zero,
        "share": zero + 1,
        "shortenings": none,
    }


def _way(steps: int, dtype) -> rules.LoadSteps:
    return jax.tree.map(
        lambda n: jnp.asarray(n, dtype if isinstance(n, float) else jnp.int32),
        rules.first_step(steps),
    )


def _examine(
    here: Problem, prepared: Prepared, state: _State, newton: Newton, moves: bool
) -> _Level:
    """Judge the trial state and, where it is worth it, find the Newton step from there."""
    found = linearise(here, prepared, state.u, state.before)
    wanted = known_values(here.supports, *state.u.shape)
    move = jnp.where(prepared.known, wanted - state.u.ravel(), jnp.zeros_like(wanted))
    move = rules.left_to_move(move, wanted)
    still = ~jnp.any(move != 0)
    collapsed = state.moved & ~state.shortened & ~rules.keeps_volume(found.volume_ratio)
    norm, tolerance = found.residual_norm, newton.residual_tolerance
    valid = rules.sound(norm, found.volume_ratio)
    small = rules.balanced(norm, found.reference, found.rounding, tolerance)
    answer = rules.converged(small, state.update, still, newton) & ~state.predict
    overran, share = jnp.asarray(False), state.share
    if moves:
        end = _slope(prepared, found, state.u - state.before) / state.share
        more = state.moved & ~collapsed & (state.shortenings < rules.MAX_SHORTENINGS)
        overran = more & rules.turned(state.slope, end)
        share = rules.shortened(state.share, state.slope, end)
    converged = ~collapsed & ~overran & valid & answer
    exhausted = (state.iterations >= newton.max_iterations) & ~state.predict
    failed = ~collapsed & ~overran & ~converged & (~valid | exhausted)
    values = jnp.where(state.predict, state.tangent, found.values)

    def direction():
        system = here.space.system
        pull = jax.lax.cond(  # most steps move no support
            jnp.any(move != 0),
            lambda: sparse.product(system, values, move),
            lambda: jnp.zeros_like(move),
        )
        matrix, rhs = constrain(system, values, found.residual + pull, prepared.known)
        x, negative = sparse.solve_with_inertia(system, matrix, rhs)
        usable = negative >= 0
        du = jnp.where(usable, x + move, jnp.zeros_like(x))
        return du.reshape(state.u.shape), usable

    def nothing():
        return jnp.zeros_like(state.u), jnp.asarray(True)

    seek = ~(collapsed | overran | converged | failed)
    du, usable = jax.lax.cond(seek, direction, nothing)
    slope = jnp.zeros_like(state.slope)
    if moves:
        seen = [load.longest_share(du) for load in here.loads]
        du = jnp.min(jnp.stack([jnp.ones_like(slope), *seen])) * du
        slope = jnp.where(still, _slope(prepared, found, du), slope)
    elif overshoots(here):
        part = share_of_step(here, prepared.known, found.residual, state.u, du)
        free = seek & ~state.predict & still
        du = jnp.where(free, part, jnp.ones_like(part)) * du
    # a singular tangent ends the level, except that of the first guess
    failed = failed | (seek & ~usable & ~state.predict)
    judged = (collapsed, overran, converged, failed, seek & ~failed)
    return _Level(*judged, usable, du, found.values, slope, share)


def _slope(prepared: Prepared, found: Linearised, du) -> Float[Array, ""]:
    """Slope of the energy along `du` [J], of the displacements that supports leave free."""
    residual = jnp.where(prepared.known, jnp.zeros_like(found.residual), found.residual)
    return jnp.sum(residual * du.ravel())


def _next(problem, prepared, state: _State, level: _Level, steps: int, max_cuts: int) -> _State:
    whole = state.u - state.before

    def shorter():
        return state.before + safe_fraction(problem, prepared, state.before, whole) * whole

    short = jax.lax.cond(level.collapsed, shorter, lambda: state.u)
    new = state.u + level.du
    update = rules.relative_size(level.du, new, prepared.length)
    update = jnp.where(level.usable, update, jnp.full_like(update, jnp.inf))
    moved = state._replace(
        u=new,
        before=state.u,
        predict=jnp.asarray(False),
        moved=jnp.asarray(True),
        shortened=jnp.asarray(False),
        update=update,
        iterations=state.iterations + jnp.where(state.predict, 0, 1).astype(jnp.int32),
        slope=level.slope,
        share=jnp.ones_like(state.share),
        shortenings=jnp.zeros_like(state.shortenings),
    )
    # how small it is, is asked of the step that Newton's method wanted
    update = rules.relative_size(whole, short, prepared.length)
    shortened = state._replace(u=short, shortened=jnp.asarray(True), update=update)
    less = level.share / state.share
    overran = state._replace(
        u=state.before + less * whole,
        update=less * state.update,
        share=level.share,
        shortenings=state.shortenings + 1,
    )
    branches = (
        (level.stepped, moved),
        (level.overran, overran),
        (level.collapsed, shortened),
        (level.converged, _accepted(state, level, rules.predicts(problem.loads))),
        (level.failed, _cut(state, steps, max_cuts)),
    )
    chosen = state
    for taken, branch in branches:
        chosen = jax.tree.map(lambda a, b, taken=taken: jnp.where(taken, b, a), chosen, branch)
    return chosen


def _accepted(state: _State, level: _Level, predicts: bool) -> _State:
    way = rules.accept(state.way, state.iterations)
    return state._replace(
        before=state.u,
        start=state.u,
        tangent=level.values,
        way=way,
        predict=jnp.asarray(predicts),
        guess=jnp.asarray(False),
        total=state.total + state.iterations,
        running=way.done < 1.0,
        **_unmoved(state.u.dtype),
    )


def _cut(state: _State, steps: int, max_cuts: int) -> _State:
    """After a load step that failed: a shorter one, or the first one where it was a guess."""
    from_rest = state.guess
    u = jnp.where(from_rest, jnp.zeros_like(state.start), state.start)
    shorter, first = rules.cut(state.way), _way(steps, state.u.dtype)
    way = jax.tree.map(lambda a, b: jnp.where(from_rest, a, b), first, shorter)
    return state._replace(
        u=u,
        before=u,
        start=u,
        way=way,
        predict=jnp.asarray(False),
        guess=jnp.asarray(False),
        running=from_rest | rules.goes_on(shorter, steps, max_cuts),
        **_unmoved(u.dtype),
    )


# Stiffness of single cells at rest, for bodies whose cells differ by a factor


def stiffness_at_rest(
    problem: Any,
) -> tuple[Float[Array, "blocks entries lanes"], Float[Array, " nnz"]]:
    """Matrices of all cells in the blocks of the space [N/m], and what the loads add to the
    tangent, in the order of its values."""
    prepared = prepare_traced(problem) if is_traced(problem) else prepare(problem)
    rest = jnp.zeros_like(problem.mesh.points)
    cells = cell_matrices(
        problem.space, prepared.geometry, problem.material, problem.kinematics, rest
    )
    return cells, load_stiffness(unsupported(problem), prepared, rest)


@eqx.filter_jit
def assembled(
    space: Space,
    cells: Float[Array, "blocks entries lanes"],
    factor: Float[Array, " cells"],
) -> Float[Array, " nnz"]:
    """Tangent of the body in which each cell counts `factor` times [N/m]."""
    scaled = cells * factor[space.ids][:, None]
    values = jnp.zeros(space.system.num_values + 1, cells.dtype).at[space.slots].add(scaled)
    return jax.lax.slice_in_dim(values, 0, space.system.num_values)
